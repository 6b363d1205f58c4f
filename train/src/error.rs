//! The reasons for which training a block fails.

/// Why a block could not be trained.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TrainError {
    /// No window to train on.
    #[error("no view sees this block")]
    NoViews,
    /// A window could not be read.
    #[error("{0}")]
    Source(String),
    /// The device failed.
    #[error("{0}")]
    Device(String),
    /// The device has too little memory for the block. A larger device may train it.
    #[error("{0}")]
    OutOfMemory(String),
    /// A loss from outside could not be computed.
    #[error("{0}")]
    PictureLoss(String),
    /// Objects on a render could not be judged.
    #[error("{0}")]
    Objects(String),
    /// All splats were removed after this number of steps.
    #[error("every splat was removed after {0} steps: the views and the points do not agree, or poses are wrong")]
    Empty(u32),
}
