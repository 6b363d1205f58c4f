//! Densification under a budget: removes transparent splats and splits those with the largest error.
//!
//! A splat that no view has shown since the last refinement stays. Of a large capture only a few views are drawn between two
//! refinements, and what stands behind a wall in all of these is in front of it in others (docs/decisions/0063).
//!
//! Splats are ranked by the absolute screen-space gradient (AbsGS, Ye et al. 2024), summed over all views since the
//! last refinement. A split halves a splat along its longest axis, which covers both "clone" and "split" of 3DGS. The
//! number of splats follows a schedule instead of a gradient threshold, so the budget is reached and not only
//! respected.

use glam::{Mat3, Quat, Vec3};
use render::Gradients;
use scene::{Splats, column, morton};
use serde::{Deserialize, Serialize};

/// The densification schedule.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Growth {
    /// Largest number of steps between two refinements.
    pub every: u32,
    /// Share of the steps at which growth starts.
    pub from: f32,
    /// Share of the steps at which growth ends.
    pub until: f32,
    /// Growth ends early when it gains less than this for each five percent of splats, dB. With 0 it never ends early.
    pub worth_db: f32,
    /// Largest share of new splats in one refinement.
    pub max_growth_share: f32,
    /// Splats of lower opacity are removed.
    pub min_opacity: f32,
    /// Distance of the two halves from the old mean, in units of the longest axis.
    pub offset: f32,
    /// Longest axis of the halves, in units of the old one.
    pub shrink: f32,
    /// Opacity of the halves relative to the split splat.
    pub fade: f32,
}

impl Default for Growth {
    fn default() -> Self {
        Self {
            every: 50,
            from: 0.05,
            until: 0.7,
            worth_db: 0.02,
            max_growth_share: 0.3,
            min_opacity: 0.01,
            offset: 0.7,
            shrink: 0.6,
            fade: 0.85,
        }
    }
}

/// Smallest number of refinements in a short job, as each can add only a share of splats.
const MIN_REFINEMENTS: u32 = 16;
/// Smallest number of steps between two refinements, as the statistics need several views.
const MIN_INTERVAL: u32 = 10;

impl Growth {
    /// Disables densification.
    #[must_use]
    pub fn none(self) -> Self {
        // Starts after the last step.
        Self { from: 2.0, ..self }
    }

    /// Number of steps between two refinements of a job of `steps` steps.
    pub fn interval(&self, steps: u32) -> u32 {
        (steps / MIN_REFINEMENTS).clamp(MIN_INTERVAL.min(self.every), self.every).max(1)
    }

    /// Number of splats to reach at `step`, between `start` and `budget`. The schedule is geometric, as the error per
    /// splat falls with their number.
    pub fn target(&self, step: u32, steps: u32, start: usize, budget: usize) -> usize {
        let at = f64::from(step) / f64::from(steps.max(1));
        let (from, until) = (f64::from(self.from), f64::from(self.until));
        let progress = ((at - from) / (until - from).max(1e-9)).clamp(0.0, 1.0);
        let (start, budget) = (start.max(1) as f64, budget.max(1) as f64);
        (start * (budget / start).powf(progress)).round() as usize
    }
}

/// Densification statistics of each splat since the last refinement.
#[derive(Debug, Default, Clone)]
pub struct DensificationStats {
    /// Σ over views of the absolute screen-space gradient.
    pub(crate) error: Vec<f32>,
}

impl DensificationStats {
    /// Adds a view. `pixels`, the number of pixels in the view, undoes the mean of the loss, so that every pixel counts
    /// alike.
    pub fn add(&mut self, gradients: &Gradients, pixels: f32) {
        let n = gradients.screen_gradient_abs.len();
        self.error.resize(n, 0.0);
        for i in 0..n {
            if gradients.seen[i / 16] >> (i % 16) & 1 == 1 {
                self.error[i] += gradients.screen_gradient_abs[i] * pixels;
            }
        }
    }
}

/// Counts of a refinement.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Refined {
    /// Splats removed because they were transparent or left the allowed region.
    pub removed: usize,
    /// Splats removed because a parameter was not finite.
    pub broken: usize,
    /// Splats added.
    pub added: usize,
}

/// What a refinement makes.
pub struct Grown {
    /// The new splats.
    pub splats: Splats,
    /// The old row of each.
    pub parents: Vec<u32>,
    /// The old row of each whose Adam moments it keeps; `None` for both halves of a split.
    pub rows: Vec<Option<u32>>,
    /// Counts.
    pub counts: Refined,
}

/// Densifies: removes splats that are transparent or lie where `keeps` is false, and splits the `target - owned` splats
/// with the largest error, where `owned` are the kept splats for which `counts` is true. The other splats (the
/// halo) do not count against the target and grow in proportion. The result is in Morton order, for memory locality.
pub fn refine(
    splats: &Splats,
    stats: &mut DensificationStats,
    growth: &Growth,
    target: usize,
    counts: &(dyn Fn(Vec3) -> bool + Sync),
    keeps: &(dyn Fn(Vec3) -> bool + Sync),
) -> Grown {
    let n = splats.len();
    stats.error.resize(n, 0.0);
    let mut refined = Refined::default();
    let min_logit = (growth.min_opacity / (1.0 - growth.min_opacity)).ln();
    let mut kept: Vec<u32> = Vec::with_capacity(n);
    for i in 0..n {
        if !splats.is_finite(i) {
            refined.broken += 1;
        } else if !keeps(splats.mean(i)) || splats.col(column::OPACITY)[i] < min_logit {
            refined.removed += 1;
        } else {
            kept.push(i as u32);
        }
    }

    let owned = kept.iter().filter(|&&i| counts(splats.mean(i as usize))).count();
    let limit = (kept.len() as f32 * growth.max_growth_share) as usize + 1;
    // Splats in the halo grow at the same rate as those in the core.
    let share = kept.len() as f64 / owned.max(1) as f64;
    let wanted = ((target.saturating_sub(owned)) as f64 * share) as usize;
    let wanted = wanted.min(limit).min(kept.len());
    let mut order = kept.clone();
    let by_error = |a: &u32, b: &u32| stats.error[*b as usize].total_cmp(&stats.error[*a as usize]).then(a.cmp(b));
    if wanted < order.len() {
        order.select_nth_unstable_by(wanted, by_error);
    }
    order.truncate(wanted);
    order.retain(|&i| stats.error[i as usize] > 0.0);
    refined.added = order.len();

    let mut rows: Vec<Option<u32>> = kept.iter().map(|&i| Some(i)).collect();
    let mut parents = kept.clone();
    let mut grown = splats.select(&kept);
    let mut new_row = vec![u32::MAX; n];
    for (at, &i) in kept.iter().enumerate() {
        new_row[i as usize] = at as u32;
    }
    order.sort_unstable();
    for &i in &order {
        let (one, other) = halve(splats, i as usize, growth);
        grown.set(new_row[i as usize] as usize, &one);
        rows[new_row[i as usize] as usize] = None;
        grown.push_like(new_row[i as usize] as usize, &other);
        rows.push(None);
        parents.push(i);
    }
    stats.error.clear();
    let order = morton::order([0, 1, 2].map(|axis| grown.col(column::MEAN + axis)));
    let rows = order.iter().map(|&i| rows[i as usize]).collect();
    let parents = order.iter().map(|&i| parents[i as usize]).collect();
    Grown { splats: grown.select(&order), parents, rows, counts: refined }
}

/// Splits a splat into two halves along its longest axis.
fn halve(splats: &Splats, i: usize, growth: &Growth) -> (scene::Splat, scene::Splat) {
    let mut splat = splats.get(i);
    let scale = splat.log_scale.to_array();
    let axis = (0..3).fold(0, |best, k| if scale[k] > scale[best] { k } else { best });
    let [w, x, y, z] = splat.quat;
    let rotation = Mat3::from_quat(Quat::from_xyzw(x, y, z, w).normalize());
    let offset = rotation.col(axis) * (scale[axis].exp() * growth.offset);
    splat.log_scale[axis] += growth.shrink.ln();
    let opacity = growth.fade / (1.0 + (-splat.opacity_logit).exp());
    splat.opacity_logit = (opacity / (1.0 - opacity)).ln();
    let mut other = splat;
    splat.mean += offset;
    other.mean -= offset;
    (splat, other)
}

#[cfg(test)]
mod tests {
    use super::*;
    use scene::Splat;

    #[test]
    fn short_jobs_refine_more_often() {
        let growth = Growth::default();
        assert_eq!([5, 57, 400, 1500, 30_000].map(|steps| growth.interval(steps)), [10, 10, 25, 50, 50]);
    }

    fn row_of(n: usize) -> (Splats, DensificationStats) {
        let mut splats = Splats::new(0);
        for i in 0..n {
            splats.push(&Splat::round(Vec3::new(i as f32, 0.0, 0.0), -1.0, Vec3::splat(0.5), 0.5));
        }
        (splats, DensificationStats { error: (0..n).map(|i| i as f32).collect() })
    }

    #[test]
    fn refinement_meets_its_target_and_splits_the_largest_errors() {
        let (splats, mut stats) = row_of(100);
        let growth = Growth::default();
        let Grown { splats: grown, rows, parents, counts: refined } =
            refine(&splats, &mut stats, &growth, 110, &|_| true, &|_| true);
        assert!((0..110).all(|i| (grown.mean(i).x - parents[i] as f32).abs() < 0.5));
        assert_eq!((grown.len(), rows.len(), refined.added), (110, 110, 10));
        assert!((0..110).filter(|&i| rows[i].is_none()).all(|i| grown.mean(i).x > 85.0));
    }

    #[test]
    fn broken_and_transparent_splats_are_removed_and_hidden_ones_stay() {
        let (mut splats, mut stats) = row_of(10);
        splats.columns_mut()[column::MEAN][3] = f32::NAN;
        splats.columns_mut()[column::OPACITY][4] = -9.0;
        // No view has shown the first one.
        assert_eq!(stats.error[0], 0.0);
        let Grown { splats: grown, counts: refined, .. } =
            refine(&splats, &mut stats, &Growth::default(), 1, &|_| true, &|_| true);
        assert_eq!((refined.broken, refined.removed, refined.added, grown.len()), (1, 1, 0, 8));
    }

    #[test]
    fn halves_keep_mass_and_variance() {
        let (splats, _) = row_of(1);
        let growth = Growth::default();
        let (a, b) = halve(&splats, 0, &growth);
        let scale = (-1.0f32).exp();
        assert!(((a.mean - b.mean).length() - 2.0 * growth.offset * scale).abs() < 1e-5);
        let variance = (growth.shrink * scale).powi(2) + (growth.offset * scale).powi(2);
        assert!((variance / (scale * scale) - 1.0).abs() < 0.2);
    }

    #[test]
    fn schedule_runs_from_start_to_budget() {
        let growth = Growth::default();
        assert_eq!(growth.target(0, 1000, 100, 800), 100);
        assert_eq!(growth.target(1000, 1000, 100, 800), 800);
        let middle = growth.target(375, 1000, 100, 800);
        assert!(middle > 200 && middle < 400, "{middle}");
    }
}
