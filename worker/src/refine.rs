//! Decides whether a block is refined beyond its parent's resolution.
//!
//! A block starts from its parent's splats. If their error in the block's own, finer photos is already within a share of the root's
//! error, the block is *settled*: it keeps the parent's resolution and is only pruned. So a meadow stays coarse beside a facade that is
//! refined. The children of a settled block are decided again with their finer photos, so that a monument in the meadow is found.

use glam::Vec3;
use scene::Splats;
use train::importance::EvaluationViews;
use train::{TrainError, TrainView, low_pass};

use crate::initial_splats::InitialSplats;

/// Largest number of windows that an error is measured on.
const MAX_WINDOWS: usize = 16;

/// Root mean square error of the splats in the photos, 0 to 1; `None` if too little of them is visible.
///
/// # Errors
/// A window that cannot be read.
pub(crate) fn residual(all: EvaluationViews, splats: &Splats) -> Result<Option<f64>, TrainError> {
    let some = all.some(MAX_WINDOWS);
    let evaluation = EvaluationViews { views: &some, ..all };
    evaluation.residual(splats, &evaluation.ownership_weights(splats)?)
}

/// As [`residual`], of the splats that the block owns, over the pixels that show them.
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

/// The windows at the parent's resolution, one mip coarser, if they have such a mip.
pub(crate) fn coarser(views: &[TrainView]) -> Vec<TrainView> {
    views.iter().map(|view| view.at(1).map_or(*view, |(mip, rect, _)| TrainView { mip, rect, ..*view })).collect()
}

/// Converts splats that were filtered for the pixels of some windows to those of others (see [`low_pass`]).
pub(crate) fn refilter(initial: InitialSplats, from: &[TrainView], to: &[TrainView]) -> InitialSplats {
    let refilter = |mut splats: Splats| {
        low_pass::to_full_resolution(&mut splats, from);
        low_pass::from_full_resolution(&mut splats, to);
        splats
    };
    InitialSplats { trained: refilter(initial.trained), context: initial.context.map(refilter) }
}
