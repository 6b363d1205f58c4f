//! Trains the splats of one block: losses, optimiser, growth, and the metrics that judge the result.
//!
//! Architecture invariant: no files, no network, no clock. Pixels come through [`WindowSource`]; randomness is counter-based
//! ([`random`]), so the same job gives the same splats whatever the number of threads.

pub mod blur;
pub mod checkpoint;
pub mod exposure;
pub mod growth;
pub mod importance;
pub mod init;
pub mod loss;
pub mod metrics;
mod morton;
pub mod need;
pub mod optimiser;
pub mod prune;
pub mod random;
mod side;
pub mod sight;
pub mod source;
pub mod trainer;

pub use checkpoint::State;
pub use side::{Backend, MOST_VIEWS_PER_STEP};
pub use source::WindowSource;
pub use trainer::{Flow, Job, Progress, Recipe, TrainError, TrainView, train, train_on};
