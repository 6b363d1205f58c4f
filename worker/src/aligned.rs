//! The perception-aligned loss of a block's training, with a tally of what it was and took.

use std::sync::{Mutex, PoisonError};

use blocks::Plan;
use eval::AlignedLoss;
use scene::{Pixels, Rect};
use store::BlockingStore;
use train::PictureLoss;

use crate::clock::Stopwatch;
use crate::task::{AlignedReport, ExecuteError};

/// The loss of one block.
pub(crate) struct TalliedLoss {
    loss: AlignedLoss,
    tally: Mutex<Tally>,
}

/// What the loss was and took since the last report.
#[derive(Debug, Clone, Copy, Default)]
struct Tally {
    steps: u32,
    /// Windows with objects.
    compared: u32,
    loss: f64,
    cpu_seconds: f64,
}

impl TalliedLoss {
    /// The loss of the plan's detector, if it has a weight.
    pub(crate) fn of(plan: &Plan, store: &BlockingStore) -> Result<Option<Self>, ExecuteError> {
        let Some(id) = plan.detector.filter(|_| plan.settings.aligned_weight > 0.0) else { return Ok(None) };
        let loss = AlignedLoss::new(dataset::networks::load_aligned(store, id)?);
        Ok(Some(Self { loss, tally: Mutex::default() }))
    }

    /// What the loss was and took since the last call; `None` if it was not computed.
    pub(crate) fn report(&self) -> Option<AlignedReport> {
        let Tally { steps, compared, loss, cpu_seconds } =
            std::mem::take(&mut *self.tally.lock().unwrap_or_else(PoisonError::into_inner));
        (steps > 0).then(|| AlignedReport {
            loss: (compared > 0).then(|| loss / f64::from(compared)),
            cpu_seconds: cpu_seconds / f64::from(steps),
        })
    }
}

impl PictureLoss for TalliedLoss {
    fn evaluate(
        &self,
        view: u32,
        mip: u8,
        rect: Rect,
        photo: &Pixels,
        picture: &[f32],
    ) -> Result<Option<(f64, Vec<f32>)>, String> {
        let clock = Stopwatch::start();
        let compared = self.loss.evaluate(view, mip, rect, photo, picture);
        let mut tally = self.tally.lock().unwrap_or_else(PoisonError::into_inner);
        tally.steps += 1;
        if let Ok(Some((loss, _))) = &compared {
            tally.compared += 1;
            tally.loss += loss;
        }
        tally.cpu_seconds += clock.cpu_seconds();
        compared
    }
}

#[cfg(test)]
mod tests {
    use blocks::{Mode, PlanSettings};
    use store::Store;

    use super::*;
    use crate::testing::plan_of;

    #[test]
    fn the_loss_of_a_plan_is_tallied() {
        let store = Store::open("memory://").unwrap().blocking();
        let onnx = include_bytes!("../../perceive/tests/yolov8_tiny.onnx");
        let card = "classes = ['a', 'b', 'c']\nscore = 0.2";
        let id = store.put(dataset::networks::to_frame(onnx, Some(card))).unwrap();
        let plan = plan_of(Mode::Whole, Vec::new());
        let of = |aligned_weight| {
            let settings = PlanSettings { aligned_weight, ..plan.settings.clone() };
            TalliedLoss::of(&Plan { detector: Some(id), settings, ..plan.clone() }, &store).unwrap()
        };
        assert!(of(0.0).is_none());
        let loss = of(0.5).expect("a loss");
        assert_eq!(loss.report(), None);
        let rect = Rect { x: 0, y: 0, width: 90, height: 70 };
        let area = 90 * 70;
        // Waves, in which a network of random weights sees something.
        let wave = |i: usize| 0.5 + 0.4 * ((i % 90) as f32 * 0.11 + (i / 90) as f32 * 0.07).sin();
        let rgb = (0..3 * area).map(|i| (255.0 * wave(i)).round() as u8).collect();
        let photo = Pixels { width: 90, height: 70, rgb, ..Pixels::default() };
        // Two steps, of which one has no object that counts.
        let masked = Pixels { mask: Some(vec![0; area]), ..photo.clone() };
        let picture = vec![0.3; 3 * area];
        assert_eq!(loss.evaluate(0, 0, rect, &masked, &picture), Ok(None));
        let report = loss.report().unwrap();
        assert!(report.loss.is_none() && report.cpu_seconds >= 0.0);
        let (value, _) = loss.evaluate(1, 0, rect, &photo, &picture).unwrap().expect("objects");
        assert_eq!((loss.report().unwrap().loss, loss.report()), (Some(value), None));
    }
}
