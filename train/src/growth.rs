//! Growth under a budget: every so often the splats that explain nothing go, and those with the most error to repair are
//! split, until the number wanted is reached.
//!
//! Which to split is decided by the screen-space gradient summed without cancellation (AbsGS, Ye et al. 2024) over
//! all views since the last time; how, by halving along the longest axis, which serves both 3DGS's "clone" and its
//! "split" with one rule. Counts follow a schedule, not a threshold: a budget is a target, not only a cap.

use glam::{Mat3, Quat, Vec3};
use render::Gradients;
use scene::{Splats, column};
use serde::{Deserialize, Serialize};

use crate::morton;

/// When and how splats are added and removed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Growth {
    /// Steps between two refinements, at most.
    pub every: u32,
    /// Share of the steps at which growth begins and ends.
    pub from: f32,
    /// See `from`.
    pub until: f32,
    /// Growth ends when it brings less than this for each five percent of splats, dB; with 0 not before its time.
    pub worth_db: f32,
    /// Most new splats in one refinement, as a share of those there.
    pub at_most: f32,
    /// Splats less opaque than this are removed.
    pub min_opacity: f32,
    /// Distance of the two halves from the old centre, and their length, in units of the longest axis.
    pub offset: f32,
    /// See `offset`.
    pub shrink: f32,
    /// Opacity of the halves relative to the whole.
    pub fade: f32,
}

impl Default for Growth {
    fn default() -> Self {
        Self {
            every: 50,
            from: 0.05,
            until: 0.7,
            worth_db: 0.02,
            at_most: 0.3,
            min_opacity: 0.01,
            offset: 0.7,
            shrink: 0.6,
            fade: 0.85,
        }
    }
}

/// Refinements, at least, in a job of a few hundred steps: each may add only so many splats.
const REFINEMENTS: u32 = 16;
/// Steps between two refinements, at least: fewer see too little of the splats.
const MIN_STEPS: u32 = 10;

impl Growth {
    /// Neither adds nor removes.
    #[must_use]
    pub fn none(self) -> Self {
        // It begins after the end.
        Self { from: 2.0, ..self }
    }

    /// Steps between two refinements of a job of so many steps.
    pub fn interval(&self, steps: u32) -> u32 {
        (steps / REFINEMENTS).clamp(MIN_STEPS.min(self.every), self.every).max(1)
    }

    /// How many splats there should be at `step` on the way from `start` to `budget`: geometric, as the error per splat
    /// falls with their number.
    pub fn target(&self, step: u32, steps: u32, start: usize, budget: usize) -> usize {
        let at = f64::from(step) / f64::from(steps.max(1));
        let (from, until) = (f64::from(self.from), f64::from(self.until));
        let progress = ((at - from) / (until - from).max(1e-9)).clamp(0.0, 1.0);
        let (start, budget) = (start.max(1) as f64, budget.max(1) as f64);
        (start * (budget / start).powf(progress)).round() as usize
    }
}

/// What the views since the last refinement said of each splat.
#[derive(Debug, Default, Clone)]
pub struct Evidence {
    /// Σ over views of the absolute screen-space gradient.
    pub(crate) error: Vec<f32>,
    /// Largest share of a view, in pixels, that the splat explained.
    pub(crate) weight: Vec<f32>,
    /// Views that saw it.
    pub(crate) views: Vec<u32>,
}

impl Evidence {
    /// Adds a view. `pixels` undoes the loss's mean, so that views of all sizes count alike per pixel.
    pub fn add(&mut self, gradients: &Gradients, pixels: f32) {
        let n = gradients.screen_abs.len();
        self.resize(n);
        for i in 0..n {
            if gradients.seen[i / 16] >> (i % 16) & 1 == 1 {
                self.error[i] += gradients.screen_abs[i] * pixels;
                self.weight[i] = self.weight[i].max(gradients.weight[i]);
                self.views[i] += 1;
            }
        }
    }

    fn resize(&mut self, n: usize) {
        self.error.resize(n, 0.0);
        self.weight.resize(n, 0.0);
        self.views.resize(n, 0);
    }

    fn clear(&mut self) {
        self.error.clear();
        self.weight.clear();
        self.views.clear();
    }
}

/// What a refinement did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Refined {
    /// Splats removed: transparent, or never seen to matter.
    pub removed: usize,
    /// Splats removed because a number was not finite.
    pub broken: usize,
    /// Splats added.
    pub added: usize,
}

/// Removes what explains nothing or lies where `keeps` is false, splits the `target - kept` splats with the most error among those that `counts`
/// (the splats that the block owns; the others are neither counted nor limited by the budget, and grow in proportion),
/// and puts all in Morton order, so that neighbours in space are neighbours in memory. Returns the new splats, and for
/// each the old row whose moments it keeps.
pub fn refine(
    splats: &Splats,
    evidence: &mut Evidence,
    growth: &Growth,
    target: usize,
    counts: &(dyn Fn(Vec3) -> bool + Sync),
    keeps: &(dyn Fn(Vec3) -> bool + Sync),
) -> (Splats, Vec<Option<u32>>, Refined) {
    let n = splats.len();
    evidence.resize(n);
    let mut refined = Refined::default();
    let min_logit = (growth.min_opacity / (1.0 - growth.min_opacity)).ln();
    let mut kept: Vec<u32> = Vec::with_capacity(n);
    for i in 0..n {
        if !splats.is_finite(i) {
            refined.broken += 1;
        } else if !keeps(splats.mean(i))
            || splats.col(column::OPACITY)[i] < min_logit
            || (evidence.views[i] > 2 && evidence.weight[i] < 0.02)
        {
            refined.removed += 1;
        } else {
            kept.push(i as u32);
        }
    }

    let owned = kept.iter().filter(|&&i| counts(splats.mean(i as usize))).count();
    let limit = (kept.len() as f32 * growth.at_most) as usize + 1;
    // Splats in the halo grow at the rate of the core.
    let share = kept.len() as f64 / owned.max(1) as f64;
    let wanted = ((target.saturating_sub(owned)) as f64 * share) as usize;
    let wanted = wanted.min(limit).min(kept.len());
    let mut order = kept.clone();
    let by_error =
        |a: &u32, b: &u32| evidence.error[*b as usize].total_cmp(&evidence.error[*a as usize]).then(a.cmp(b));
    if wanted < order.len() {
        order.select_nth_unstable_by(wanted, by_error);
    }
    order.truncate(wanted);
    order.retain(|&i| evidence.error[i as usize] > 0.0);
    refined.added = order.len();

    let mut rows: Vec<Option<u32>> = kept.iter().map(|&i| Some(i)).collect();
    let mut grown = splats.select(&kept);
    let mut place = vec![u32::MAX; n];
    for (at, &i) in kept.iter().enumerate() {
        place[i as usize] = at as u32;
    }
    order.sort_unstable();
    for &i in &order {
        let (one, other) = halve(splats, i as usize, growth);
        grown.set(place[i as usize] as usize, &one);
        rows[place[i as usize] as usize] = None;
        grown.push(&other);
        rows.push(None);
    }
    evidence.clear();
    let order = morton::order([0, 1, 2].map(|axis| grown.col(column::MEAN + axis)));
    let rows = order.iter().map(|&i| rows[i as usize]).collect();
    (grown.select(&order), rows, refined)
}

/// Two halves of a splat, side by side along its longest axis.
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

    fn row_of(n: usize) -> (Splats, Evidence) {
        let mut splats = Splats::new(0);
        for i in 0..n {
            splats.push(&Splat::round(Vec3::new(i as f32, 0.0, 0.0), -1.0, Vec3::splat(0.5), 0.5));
        }
        let evidence = Evidence { error: (0..n).map(|i| i as f32).collect(), weight: vec![1.0; n], views: vec![5; n] };
        (splats, evidence)
    }

    #[test]
    fn growth_meets_its_target_and_splits_the_worst() {
        let (splats, mut evidence) = row_of(100);
        let growth = Growth::default();
        let (grown, rows, refined) = refine(&splats, &mut evidence, &growth, 110, &|_| true, &|_| true);
        assert_eq!((grown.len(), rows.len(), refined.added), (110, 110, 10));
        assert!((0..110).filter(|&i| rows[i].is_none()).all(|i| grown.mean(i).x > 85.0));
    }

    #[test]
    fn what_is_broken_transparent_or_useless_goes() {
        let (mut splats, mut evidence) = row_of(10);
        splats.columns_mut()[column::MEAN][3] = f32::NAN;
        splats.columns_mut()[column::OPACITY][4] = -9.0;
        evidence.weight[5] = 0.0;
        let (grown, _, refined) = refine(&splats, &mut evidence, &Growth::default(), 1, &|_| true, &|_| true);
        assert_eq!((refined.broken, refined.removed, refined.added, grown.len()), (1, 2, 0, 7));
    }

    #[test]
    fn a_half_keeps_mass_and_spread() {
        let (splats, _) = row_of(1);
        let growth = Growth::default();
        let (a, b) = halve(&splats, 0, &growth);
        let scale = (-1.0f32).exp();
        assert!(((a.mean - b.mean).length() - 2.0 * growth.offset * scale).abs() < 1e-5);
        let variance = (growth.shrink * scale).powi(2) + (growth.offset * scale).powi(2);
        assert!((variance / (scale * scale) - 1.0).abs() < 0.2);
    }

    #[test]
    fn the_schedule_runs_from_start_to_budget() {
        let growth = Growth::default();
        assert_eq!(growth.target(0, 1000, 100, 800), 100);
        assert_eq!(growth.target(1000, 1000, 100, 800), 800);
        let middle = growth.target(375, 1000, 100, 800);
        assert!(middle > 200 && middle < 400, "{middle}");
    }
}
