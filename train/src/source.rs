//! Where pixels come from: the one thing that training asks of the world outside.

use std::sync::Arc;

use scene::{Pixels, Rect};

/// Gives windows of views. Implemented over the store by `dataset`, over memory by tests.
pub trait WindowSource: Sync {
    /// The pixels of `rect`, in pixels of that mip, of a view of the capture.
    ///
    /// # Errors
    /// A line that says which view could not be read and why.
    fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String>;
}
