//! Is a block worth looking at more closely than its parent did?
//!
//! A block begins with its parent's splats. Where these already are what its own, finer photos show, within the plan's
//! tolerance, it is *settled*: it keeps them, and healing and pruning at the parent's resolution is all that is done to it. A
//! meadow stays as coarse as it was beside the facade that is refined. A settled block's children ask again, with
//! photos finer still, so that a monument in the meadow is found.

use glam::Vec3;
use scene::Splats;
use train::importance::Views;
use train::{TrainError, TrainView, WindowSource, blur};

/// Windows looked at, at most.
const WINDOWS: usize = 16;

/// Splats to train and what is drawn around them.
pub(crate) type Start = (Splats, Option<Splats>);

/// Are the parent's splats off by no more than `residual` (root mean square, 0 to 1) in what the windows show of the core?
/// Where too little is seen of it to tell, they are not.
///
/// # Errors
/// A window that cannot be read.
pub(crate) fn is_settled(
    (splats, context): &Start,
    residual: f64,
    views: &[TrainView],
    owns: &(dyn Fn(Vec3) -> bool + Sync),
    antialiased: bool,
    source: &dyn WindowSource,
) -> Result<bool, TrainError> {
    let inside: Vec<bool> = (0..splats.len()).map(|i| owns(splats.mean(i))).collect();
    let core = splats.filter(|i| inside[i]);
    if core.is_empty() {
        return Ok(false);
    }
    let mut rest = splats.filter(|i| !inside[i]);
    context.iter().for_each(|context| rest.append(context));
    let all = Views { views, context: Some(&rest), antialiased, source };
    let some = all.some(WINDOWS);
    let judge = Views { views: &some, ..all };
    let found = judge.residual(&core, &judge.shares(&core)?)?;
    tracing::debug!(residual = found, "what the parent lacks");
    Ok(found.is_some_and(|found| found <= residual))
}

/// The windows as the parent's resolution has them, where they have one.
pub(crate) fn coarser(views: &[TrainView]) -> Vec<TrainView> {
    views.iter().map(|view| view.at(1).map_or(*view, |(mip, rect, _)| TrainView { mip, rect, ..*view })).collect()
}

/// A start on some windows as one on others: what pixels hide of a splat's size depends on theirs (see [`blur`]).
pub(crate) fn moved((splats, context): Start, from: &[TrainView], to: &[TrainView]) -> Start {
    let again = |mut splats: Splats| {
        blur::to_full_images(&mut splats, from);
        blur::from_full_images(&mut splats, to);
        splats
    };
    (again(splats), context.map(again))
}
