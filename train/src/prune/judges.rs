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

/// The number of views of an evaluation. It grows with the recovery steps, so that evaluating takes no longer than the
/// recovery between two evaluations.
#[derive(Clone, Copy)]
pub(super) struct ViewCount {
    pub(super) min: usize,
    pub(super) max: usize,
    pub(super) per_step: f32,
}

impl ViewCount {
    pub(super) fn for_steps(&self, steps: u32) -> usize {
        ((steps as f32 * self.per_step) as usize).clamp(self.min, self.max)
    }
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
    /// Share of the objects that the unpruned splats show on the judging views which may be lost, 0 to 1. New ones make up for
    /// none.
    pub share: f64,
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
}

/// The objects that the unpruned splats show on some views.
pub(super) struct Objects<'a> {
    tolerance: ObjectTolerance<'a>,
    /// Those that show objects.
    views: Vec<TrainView>,
    /// Of each view, which objects on its photo are shown.
    before: Vec<Vec<bool>>,
}

impl<'a> Objects<'a> {
    /// On at most `count` of the views.
    pub(super) fn new(
        tolerance: ObjectTolerance<'a>,
        judging: &EvaluationViews,
        count: usize,
        unpruned: &Splats,
    ) -> Result<Self, TrainError> {
        let views = judging.some(count);
        let before = shown(&EvaluationViews { views: &views, ..*judging }, unpruned, tolerance.judge)?;
        let with_objects = views.into_iter().zip(before).filter(|(_, shown)| shown.contains(&true));
        let (views, before) = with_objects.unzip();
        Ok(Self { tolerance, views, before })
    }

    /// Number of the objects, and of those that these splats show too.
    pub(super) fn counts(&self, all: &EvaluationViews, splats: &Splats) -> Result<[usize; 2], TrainError> {
        let after = shown(&EvaluationViews { views: &self.views, ..*all }, splats, self.tolerance.judge)?;
        let pairs = self.before.iter().flatten().zip(after.iter().flatten()).filter(|(before, _)| **before);
        Ok([pairs.clone().count(), pairs.filter(|(_, after)| **after).count()])
    }

    /// Whether these splats lose few enough.
    pub(super) fn are_shown(&self, all: &EvaluationViews, splats: &Splats) -> Result<bool, TrainError> {
        let [before, after] = self.counts(all, splats)?;
        Ok((before - after) as f64 <= self.tolerance.share * before as f64)
    }
}

/// Which objects splats show, for each view.
fn shown(on: &EvaluationViews, splats: &Splats, judge: &dyn ObjectJudge) -> Result<Vec<Vec<bool>>, TrainError> {
    let mut of_views = Ok(Vec::new());
    on.pictures(splats, |view, photo, picture| {
        if let Ok(known) = &mut of_views {
            match judge.shown(view, photo, picture) {
                Ok(of_view) => known.push(of_view),
                Err(line) => of_views = Err(TrainError::Objects(line)),
            }
        }
    })?;
    of_views
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
        (0..count)
            .map(|view| TrainView { view, mip: 0, rect: camera.full(), camera, camera_from_context: None })
            .collect()
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
}
