//! What pruning is judged by: views that are kept apart from those that heal, their PSNR, and the objects that they show.

use scene::{Pixels, Splats};

use crate::error::TrainError;
use crate::importance::{EvaluationViews, OwnershipWeights};
use crate::view::TrainView;

/// Every which view judges. With every eighth, held-out views lost more than the tolerance (decision 0081).
pub(super) const JUDGE_EVERY: usize = 4;

/// The views that judge, and those that recoveries train on meanwhile. Fewer than [`JUDGE_EVERY`] views do both.
pub(super) fn apart(views: &[TrainView]) -> [Vec<TrainView>; 2] {
    if views.len() < JUDGE_EVERY {
        return [views.to_vec(), views.to_vec()];
    }
    let with_place = views.iter().enumerate();
    let (judging, healing): (Vec<_>, Vec<_>) =
        with_place.partition(|(place, _)| place % JUDGE_EVERY == JUDGE_EVERY / 2);
    [judging, healing].map(|part| part.into_iter().map(|(_, view)| *view).collect())
}

/// Number of the views that judge, of `views`.
pub(super) fn judges_of(views: usize) -> usize {
    if views < JUDGE_EVERY { views } else { (views + JUDGE_EVERY / 2 - 1) / JUDGE_EVERY }
}

/// Says which objects renders show. It comes from outside, as this crate knows no detectors.
pub trait ObjectJudge: Sync {
    /// For each object on the photo of a view, whether the picture shows it: three planes of the photo's size, red first, with
    /// the view's exposure. Equal arguments give equal answers, as many for every picture of a view.
    ///
    /// # Errors
    /// One line that says why it cannot be told.
    fn shown(&self, view: u32, photo: &Pixels, picture: &[f32]) -> Result<Vec<bool>, String>;
}

/// A tolerance on objects.
#[derive(Clone, Copy)]
pub struct ObjectTolerance<'a> {
    /// Says which objects renders show.
    pub judge: &'a dyn ObjectJudge,
    /// Share of the objects that the unpruned splats show on the judging views which may be lost, 0 to 1.
    pub share: f64,
}

impl ObjectTolerance<'_> {
    /// Whether few enough of the objects that were shown are lost. New ones make up for none.
    pub(super) fn allows(&self, before: &[bool], after: &[bool]) -> bool {
        let shown = before.iter().filter(|shown| **shown).count();
        let lost = shown - still_shown(before, after);
        lost as f64 <= self.share * shown as f64
    }
}

/// Number of the objects that were shown and still are.
pub(super) fn still_shown(before: &[bool], after: &[bool]) -> usize {
    before.iter().zip(after).filter(|(before, after)| **before && **after).count()
}

/// PSNR over all pixels and over those of zones, dB; without zones both are the same.
#[derive(Debug, Clone, Copy)]
pub(super) struct Quality([f64; 2]);

impl Quality {
    /// Over all pixels.
    pub(super) fn psnr(self) -> f64 {
        self.0[0]
    }

    pub(super) fn less(self, db: f64) -> Self {
        Self(self.0.map(|psnr| psnr - db))
    }

    /// How far this lies below the other, dB.
    pub(super) fn below(self, other: Self) -> [f64; 2] {
        [0, 1].map(|part| other.0[part] - self.0[part])
    }

    pub(super) fn reaches(self, floor: Self) -> bool {
        self.0.iter().zip(floor.0).all(|(psnr, floor)| *psnr >= floor)
    }
}

/// Views to measure on, with pixel weights from the unpruned splats.
pub(super) struct Evaluator {
    views: Vec<TrainView>,
    weights: OwnershipWeights,
}

impl Evaluator {
    pub(super) fn new(all: &EvaluationViews, count: usize, splats: &Splats) -> Result<Self, TrainError> {
        let views = all.some(count);
        let weights = EvaluationViews { views: &views, ..*all }.ownership_weights(splats)?;
        Ok(Self { views, weights })
    }

    pub(super) fn quality(&self, all: &EvaluationViews, splats: &Splats) -> Result<Quality, TrainError> {
        EvaluationViews { views: &self.views, ..*all }.psnr(splats, &self.weights).map(Quality)
    }

    /// Which objects the splats show, view by view.
    pub(super) fn shown(
        &self,
        all: &EvaluationViews,
        splats: &Splats,
        judge: &dyn ObjectJudge,
    ) -> Result<Vec<bool>, TrainError> {
        let (mut shown, mut failed) = (Vec::new(), None);
        EvaluationViews { views: &self.views, ..*all }.pictures(splats, |view, photo, picture| {
            if failed.is_none() {
                match judge.shown(view, photo, picture) {
                    Ok(of_view) => shown.extend(of_view),
                    Err(line) => failed = Some(TrainError::Objects(line)),
                }
            }
        })?;
        failed.map_or(Ok(shown), Err)
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use scene::{Camera, Pinhole, Rigid};

    use super::*;

    fn views(count: u32) -> Vec<TrainView> {
        let pinhole = Pinhole { width: 4, height: 4, fx: 4.0, fy: 4.0, cx: 2.0, cy: 2.0 };
        let camera =
            Camera { pinhole, camera_from_world: Rigid { rotation: DQuat::IDENTITY, translation: DVec3::ZERO } };
        (0..count).map(|view| TrainView { view, mip: 0, rect: camera.full(), camera }).collect()
    }

    #[test]
    fn no_view_both_judges_and_heals_unless_they_are_few() {
        for count in 0..40 {
            let numbers = apart(&views(count)).map(|part| part.iter().map(|view| view.view).collect::<Vec<_>>());
            let [judging, healing] = &numbers;
            assert_eq!(judging.len(), judges_of(count as usize), "of {count}");
            if count < JUDGE_EVERY as u32 {
                assert_eq!((judging.len(), judging), (count as usize, healing));
                continue;
            }
            let mut all = numbers.concat();
            all.sort_unstable();
            assert_eq!(all, (0..count).collect::<Vec<_>>());
            assert!(!judging.is_empty() && 2 * judging.len() < healing.len(), "{judging:?} of {count}");
        }
    }

    #[test]
    fn new_objects_make_up_for_no_lost_ones() {
        struct None;
        impl ObjectJudge for None {
            fn shown(&self, _: u32, _: &Pixels, _: &[f32]) -> Result<Vec<bool>, String> {
                Ok(Vec::new())
            }
        }
        let of = |share| ObjectTolerance { judge: &None, share };
        let (before, after) = ([true, true, false, true, true], [true, false, true, true, true]);
        assert_eq!(still_shown(&before, &after), 3);
        assert!(!of(0.0).allows(&before, &after) && !of(0.24).allows(&before, &after));
        assert!(of(0.25).allows(&before, &after) && of(0.0).allows(&before, &before) && of(0.0).allows(&[], &[]));
    }
}
