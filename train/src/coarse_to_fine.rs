//! Measures what decides when to go to a finer mip and when to end growth. The trainer compares the measurements with the
//! recipe.
//!
//! The mean absolute error of an epoch (every view once), or of a part of it, is a by-product of training. Two rules use it:
//!
//! - **Coarse to fine.** While the error at a coarse mip exceeds the detail that the mip lacks, the finer photos add
//!   little information for four times the pixels. Training goes to the next finer mip once the error is down to a
//!   multiple of that detail ([`Recipe::detail_factor`](crate::Recipe::detail_factor)), or when the recipe's share of
//!   the steps is used.
//! - **End of growth.** Growth ends early when its last epochs gained less than
//!   [`Growth::worth_db`](crate::growth::Growth::worth_db) for each five percent of splats. Parts of an epoch do not count: their
//!   errors differ more by which views they have.

use scene::{Camera, Rect};
use serde::{Deserialize, Serialize};

use crate::error::TrainError;
use crate::source::{self, WindowSource};
use crate::view::TrainView;

/// Largest number of views that the missing detail is measured on, spaced evenly.
const DETAIL_VIEWS: usize = 16;
/// Smallest growth factor of the number of splats over which the gain is measured.
const MIN_MEASURED_GROWTH: f64 = 1.3;

/// Mean absolute difference, 0 to 1, between the photos `coarser` mips up and those one mip finer. Infinite where no
/// window has such a coarse mip, so that the stage ends after its first period.
///
/// # Errors
/// A window that cannot be read.
pub fn missing_detail(views: &[TrainView], source: &dyn WindowSource, coarser: u8) -> Result<f64, TrainError> {
    let (mut sum, mut count) = (0.0, 0.0f64);
    let some = views.iter().step_by(views.len().div_ceil(DETAIL_VIEWS).max(1));
    let pairs = some.filter_map(|view| {
        let of = |(mip, rect, _): (u8, Rect, Camera)| (view.view, mip, rect);
        Some([view.at(coarser).map(of)?, view.at(coarser - 1).map(of)?])
    });
    let mut photos = source::each(source, pairs.clone().flatten());
    for [(_, _, rect), (_, _, fine_rect)] in pairs {
        let mut next = || photos.next().unwrap_or_else(|| Err("no window".into())).map_err(TrainError::Source);
        let (coarse, fine) = (next()?, next()?);
        let (width, fine_width) = (coarse.width as usize, fine.width as usize);
        for y in 0..fine.height {
            for x in 0..fine.width {
                // Windows start at any pixel of their mip: match pixels by image coordinates.
                let (cx, cy) = ((x + fine_rect.x) / 2, (y + fine_rect.y) / 2);
                if cx < rect.x || cy < rect.y || cx >= rect.x + coarse.width || cy >= rect.y + coarse.height {
                    continue;
                }
                let at = (cy - rect.y) as usize * width + (cx - rect.x) as usize;
                let fine_at = y as usize * fine_width + x as usize;
                if fine.mask.as_ref().is_some_and(|mask| mask[fine_at] < 128) {
                    continue;
                }
                let (area, fine_area) = (coarse.area(), fine.area());
                for c in 0..3 {
                    let (coarse, fine) = (coarse.rgb[c * area + at], fine.rgb[c * fine_area + fine_at]);
                    sum += f64::from(coarse.abs_diff(fine)) / 255.0;
                }
                count += 3.0;
            }
        }
    }
    Ok(if count > 0.0 { sum / count } else { f64::INFINITY })
}

/// Sum of the errors of the steps of a period.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Tally {
    pub(crate) sum: f64,
    /// Number of summed steps.
    pub(crate) count: u32,
}

impl Tally {
    pub(crate) fn add(&mut self, error: f64) {
        self.sum += error;
        self.count += 1;
    }
}

/// Coarse-to-fine stage and the errors of its periods.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct CoarseToFine {
    /// Number of completed coarse stages.
    pub(crate) stage: u8,
    /// Step at which the current stage started.
    pub(crate) stage_start: u32,
    /// Errors of the current period.
    pub(crate) tally: Tally,
    /// For each period of this stage: number of splats at its end, and -20 log10 of the mean absolute error (higher is better).
    // Their name in checkpoints of before periods were parts of an epoch.
    #[serde(rename = "epochs")]
    periods: Vec<(u32, f32)>,
}

impl CoarseToFine {
    /// Ends a period of `steps` steps with `splats` splats. Returns its mean error, or `None` if a step was skipped.
    pub(crate) fn end_period(&mut self, splats: usize, steps: u32) -> Option<f64> {
        let Tally { sum, count } = std::mem::take(&mut self.tally);
        let (mean, full) = (sum / f64::from(count.max(1)), count == steps);
        if full {
            self.periods.push((splats as u32, (-20.0 * mean.max(1e-9).log10()) as f32));
        }
        full.then_some(mean)
    }

    /// Starts the next stage. Errors of different mips are not comparable, so the periods are cleared.
    pub(crate) fn advance(&mut self, step: u32) {
        (self.stage, self.stage_start) = (self.stage + 1, step);
        self.tally = Tally::default();
        self.periods.clear();
    }

    /// True if the last growth by at least [`MIN_MEASURED_GROWTH`] gained less than `worth_db` for each five percent of splats.
    pub(crate) fn growth_gains_less_than(&self, worth_db: f64) -> bool {
        let Some(&(splats, now)) = self.periods.last() else { return false };
        let before = self.periods.iter().rev().find(|(n, _)| f64::from(*n) * MIN_MEASURED_GROWTH <= f64::from(splats));
        before.is_some_and(|&(n, then)| {
            let five_percents = (f64::from(splats) / f64::from(n.max(1))).ln() / 1.05f64.ln();
            f64::from(now - then) < worth_db * five_percents
        })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::DVec3;
    use scene::{Pinhole, Pixels, Rigid};

    use super::*;

    /// A photo whose columns alternate between two greys at mip 0; mip 1 holds their mean.
    struct Stripes;

    impl WindowSource for Stripes {
        fn window(&self, _: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
            let grey = |x: u32| if mip > 0 { 100 } else { 80 + 40 * ((rect.x + x) % 2) as u8 };
            let row: Vec<u8> = (0..rect.width).map(grey).collect();
            let rgb = row.repeat(3 * rect.height as usize);
            Ok(Arc::new(Pixels { width: rect.width, height: rect.height, rgb, ..Pixels::default() }))
        }
    }

    #[test]
    fn missing_detail_is_the_difference_to_the_finer_mip() {
        let pinhole = Pinhole { width: 128, height: 96, fx: 90.0, fy: 90.0, cx: 64.0, cy: 48.0 };
        let camera = Camera { pinhole, camera_from_world: Rigid { translation: DVec3::ZERO, ..Rigid::IDENTITY } };
        let rect = Rect { x: 7, y: 3, width: 40, height: 36 };
        let view = TrainView { view: 0, mip: 0, rect, camera, camera_from_context: None };
        let found = missing_detail(&[view; 40], &Stripes, 1).unwrap();
        assert!((found - 20.0 / 255.0).abs() < 1e-9, "{found}");
        assert_eq!(missing_detail(&[view], &Stripes, 2), Ok(0.0));
        // Windows without a coarser mip.
        let small = TrainView { rect: Rect { width: 9, height: 9, ..rect }, ..view };
        assert_eq!(missing_detail(&[small], &Stripes, 1), Ok(f64::INFINITY));
    }

    #[test]
    fn growth_gain_is_measured_over_full_epochs_of_one_stage() {
        let mut stages = CoarseToFine::default();
        let epoch = |stages: &mut CoarseToFine, error: f64, splats: usize| -> Option<f64> {
            (0..4).for_each(|_| stages.tally.add(error));
            stages.end_period(splats, 4)
        };
        assert_eq!(epoch(&mut stages, 0.1, 1000), Some(0.1));
        assert_eq!(epoch(&mut stages, 0.0999, 1100), Some(0.0999));
        assert!(!stages.growth_gains_less_than(0.02), "growth by a tenth is too small to measure");
        // +30 % are 5.4 times five percent: 0.11 dB at least.
        assert!(epoch(&mut stages, 0.0995, 1300).is_some() && stages.growth_gains_less_than(0.02));
        assert!(epoch(&mut stages, 0.098, 1300).is_some() && !stages.growth_gains_less_than(0.02));
        stages.advance(40);
        assert_eq!((stages.stage, stages.stage_start), (1, 40));
        assert!(epoch(&mut stages, 0.2, 2000).is_some() && !stages.growth_gains_less_than(0.02));
        // An epoch with a skipped step has no mean error.
        stages.tally.add(1.0);
        assert_eq!(stages.end_period(9, 4), None);
    }
}
