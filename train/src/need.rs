//! What a block still lacks, as its training says: when to look closer, and when to stop growing.
//!
//! The mean absolute error of an epoch (every view once) is known for free. Two rules follow from it:
//!
//! - **Finer pixels when they have something to say.** While the error at a coarse mip is larger than what the photos show
//!   beyond that mip, three of four fine pixels repeat what the coarse one says. So training goes to the next finer mip when its
//!   error has come down to that detail, or at the latest after the recipe's share of the steps.
//! - **Growth that pays.** When the last tenths of growth brought less than [`Growth::worth_db`](crate::growth::Growth::worth_db)
//!   for each five percent of splats, it ends, and the rest of the schedule follows at once.

use scene::{Camera, Rect};
use serde::{Deserialize, Serialize};

use crate::{TrainError, TrainView, WindowSource};

/// Views whose photos say how much detail a mip lacks, at most: of more, evenly many.
const DETAIL_VIEWS: usize = 16;
/// Growth is judged over at least this factor in the number of splats.
const JUDGED_GROWTH: f64 = 1.3;

/// Mean absolute difference between the photos at `coarser` mips and one finer, 0 to 1; infinite where no window is that
/// coarse, so that there nobody waits for it.
///
/// # Errors
/// A window that cannot be read.
pub fn detail(views: &[TrainView], source: &dyn WindowSource, coarser: u8) -> Result<f64, TrainError> {
    let (mut sum, mut count) = (0.0, 0.0f64);
    let some = views.iter().step_by(views.len().div_ceil(DETAIL_VIEWS).max(1));
    let pairs = some.filter_map(|view| {
        let of = |(mip, rect, _): (u8, Rect, Camera)| (view.view, mip, rect);
        Some([view.at(coarser).map(of)?, view.at(coarser - 1).map(of)?])
    });
    let mut photos = crate::source::each(source, pairs.clone().flatten());
    for [(_, _, rect), (_, _, fine_rect)] in pairs {
        let mut next = || photos.next().unwrap_or_else(|| Err("no window".into())).map_err(TrainError::Source);
        let (coarse, fine) = (next()?, next()?);
        let (width, fine_width) = (coarse.width as usize, fine.width as usize);
        for y in 0..fine.height {
            for x in 0..fine.width {
                // Windows of a mip start at any pixel, so a pixel's coarser one is found in the image.
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

/// Errors of an epoch's steps.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Tally {
    pub(crate) sum: f64,
    /// Steps that are in it.
    pub(crate) count: u32,
}

impl Tally {
    pub(crate) fn add(&mut self, error: f64) {
        self.sum += error;
        self.count += 1;
    }
}

/// What the steps so far say.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Need {
    /// Stages of coarse mips that are over.
    pub(crate) stage: u8,
    /// Step at which the present one began.
    pub(crate) since: u32,
    /// Of the epoch under way.
    pub(crate) tally: Tally,
    /// Of the epochs of this stage: splats at the end, and the mean error in dB.
    epochs: Vec<(u32, f32)>,
}

impl Need {
    /// Ends an epoch of so many steps: its mean error, if none was left out.
    pub(crate) fn end_epoch(&mut self, splats: usize, epoch: u32) -> Option<f64> {
        let Tally { sum, count } = std::mem::take(&mut self.tally);
        let (mean, full) = (sum / f64::from(count.max(1)), count == epoch);
        if full {
            self.epochs.push((splats as u32, (-20.0 * mean.max(1e-9).log10()) as f32));
        }
        full.then_some(mean)
    }

    /// Begins the next stage: errors at another mip cannot be compared.
    pub(crate) fn look_closer(&mut self, step: u32) {
        (self.stage, self.since) = (self.stage + 1, step);
        self.tally = Tally::default();
        self.epochs.clear();
    }

    /// Did the last of growth gain less than so many dB for each five percent of splats?
    pub(crate) fn gains_less_than(&self, worth_db: f64) -> bool {
        let Some(&(splats, now)) = self.epochs.last() else { return false };
        let before = self.epochs.iter().rev().find(|(n, _)| f64::from(*n) * JUDGED_GROWTH <= f64::from(splats));
        before.is_some_and(|&(n, then)| {
            let steps_of_growth = (f64::from(splats) / f64::from(n.max(1))).ln() / 1.05f64.ln();
            f64::from(now - then) < worth_db * steps_of_growth
        })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::DVec3;
    use scene::{Pinhole, Pixels, Rigid};

    use super::*;

    /// A photo whose columns alternate between two greys at mip 0, which mip 1 shows as their mean.
    struct Stripes;

    impl WindowSource for Stripes {
        fn window(&self, _: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
            let grey = |x: u32| if mip > 0 { 100 } else { 80 + 40 * ((rect.x + x) % 2) as u8 };
            let row: Vec<u8> = (0..rect.width).map(grey).collect();
            let rgb = row.repeat(3 * rect.height as usize);
            Ok(Arc::new(Pixels { width: rect.width, height: rect.height, rgb, mask: None }))
        }
    }

    #[test]
    fn detail_is_what_the_coarser_mip_does_not_show() {
        let pinhole = Pinhole { width: 128, height: 96, fx: 90.0, fy: 90.0, cx: 64.0, cy: 48.0 };
        let camera = Camera { pinhole, camera_from_world: Rigid { translation: DVec3::ZERO, ..Rigid::IDENTITY } };
        let rect = Rect { x: 7, y: 3, width: 40, height: 36 };
        let view = TrainView { view: 0, mip: 0, rect, camera };
        let found = detail(&[view; 40], &Stripes, 1).unwrap();
        assert!((found - 20.0 / 255.0).abs() < 1e-9, "{found}");
        assert_eq!(detail(&[view], &Stripes, 2), Ok(0.0));
        // A window without a coarser one has nothing to wait for.
        let small = TrainView { rect: Rect { width: 9, height: 9, ..rect }, ..view };
        assert_eq!(detail(&[small], &Stripes, 1), Ok(f64::INFINITY));
    }

    #[test]
    fn growth_is_judged_by_whole_epochs_of_one_stage() {
        let mut need = Need::default();
        let epoch = |need: &mut Need, error: f64, splats: usize| -> Option<f64> {
            (0..4).for_each(|_| need.tally.add(error));
            need.end_epoch(splats, 4)
        };
        assert_eq!(epoch(&mut need, 0.1, 1000), Some(0.1));
        assert_eq!(epoch(&mut need, 0.0999, 1100), Some(0.0999));
        assert!(!need.gains_less_than(0.02), "a tenth more is too little to tell");
        // +30 % are 5.4 times five percent: 0.11 dB at least.
        assert!(epoch(&mut need, 0.0995, 1300).is_some() && need.gains_less_than(0.02));
        assert!(epoch(&mut need, 0.098, 1300).is_some() && !need.gains_less_than(0.02));
        need.look_closer(40);
        assert_eq!((need.stage, need.since), (1, 40));
        assert!(epoch(&mut need, 0.2, 2000).is_some() && !need.gains_less_than(0.02));
        // A step that was left out makes an epoch that says nothing.
        need.tally.add(1.0);
        assert_eq!(need.end_epoch(9, 4), None);
    }
}
