//! Why a capture cannot be planned.

/// Why a capture cannot be planned.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// A setting is out of range.
    #[error("{setting}: {problem}; {advice}")]
    Setting {
        /// The command-line flag or name of the setting.
        setting: &'static str,
        /// The problem.
        problem: String,
        /// What to do about it.
        advice: &'static str,
    },
    /// No training view remains.
    #[error(
        "no training view: of {views} views, {usable} have a usable camera and {test} are held out; add views or hold out fewer (--test-every)"
    )]
    NoTrainViews {
        /// Number of views of the capture.
        views: usize,
        /// Number of views with a usable camera.
        usable: usize,
        /// Number of held-out views.
        test: usize,
    },
    /// The capture has no sparse points.
    #[error(
        "the capture has no finite sparse points, which plat needs to divide and initialise the scene; run structure from motion or provide a point cloud"
    )]
    NoPoints,
    /// No training view observes a sparse point.
    #[error(
        "no training view observes any of the {points} sparse points; check that poses and points are in the same frame and that cameras look along +z"
    )]
    NoObservations {
        /// Number of finite sparse points.
        points: usize,
    },
    /// The blocks are too small for the capture.
    #[error("no block of level {levels} has {needed} views and enough sparse points; use fewer levels (--levels)")]
    NoBlocks {
        /// The level that was tried.
        levels: u8,
        /// Minimum number of views of a block.
        needed: usize,
    },
}
