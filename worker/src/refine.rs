//! Is a block worth looking at more closely than its parent did?
//!
//! A block begins with its parent's splats. Where these already are so near to what its own, finer photos show that the
//! scene as a whole has hardly anything to gain there, it is *settled*: it keeps them, and healing and pruning at the
//! parent's resolution is all that is done to it. A meadow stays as coarse as it was beside the facade that is refined. A settled
//! block's children ask again, with photos finer still, so that a monument in the meadow is found.

use glam::Vec3;
use scene::Splats;
use train::importance::EvaluationViews;
use train::{TrainError, TrainView, low_pass};

/// Windows looked at, at most.
const WINDOWS: usize = 16;

/// Splats to train and what is drawn around them.
pub(crate) type Start = (Splats, Option<Splats>);

/// How far splats are off in the photos: root mean square, 0 to 1; `None` where too little is seen to tell.
///
/// # Errors
/// A window that cannot be read.
pub(crate) fn residual(all: EvaluationViews, splats: &Splats) -> Result<Option<f64>, TrainError> {
    let some = all.some(WINDOWS);
    let judge = EvaluationViews { views: &some, ..all };
    judge.residual(splats, &judge.ownership_weights(splats)?)
}

/// As [`residual`], of those splats that the block owns, in what the windows show of them.
///
/// # Errors
/// A window that cannot be read.
pub(crate) fn residual_of_core(
    around: EvaluationViews,
    splats: &Splats,
    owns: &(dyn Fn(Vec3) -> bool + Sync),
) -> Result<Option<f64>, TrainError> {
    let inside: Vec<bool> = (0..splats.len()).map(|i| owns(splats.mean(i))).collect();
    let core = splats.filter(|i| inside[i]);
    let mut rest = splats.filter(|i| !inside[i]);
    around.context.iter().for_each(|context| rest.append(context));
    if core.is_empty() { Ok(None) } else { residual(EvaluationViews { context: Some(&rest), ..around }, &core) }
}

/// The windows as the parent's resolution has them, where they have one.
pub(crate) fn coarser(views: &[TrainView]) -> Vec<TrainView> {
    views.iter().map(|view| view.at(1).map_or(*view, |(mip, rect, _)| TrainView { mip, rect, ..*view })).collect()
}

/// A start on some windows as one on others: what pixels hide of a splat's size depends on theirs (see [`low_pass`]).
pub(crate) fn moved((splats, context): Start, from: &[TrainView], to: &[TrainView]) -> Start {
    let again = |mut splats: Splats| {
        low_pass::to_full_resolution(&mut splats, from);
        low_pass::from_full_resolution(&mut splats, to);
        splats
    };
    (again(splats), context.map(again))
}
