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

    /// Says that this window will be asked for in a few steps: whoever has it far away may fetch it meanwhile. What is wrong with
    /// it is said when it is asked for.
    fn expect(&self, _view: u32, _mip: u8, _rect: Rect) {}
}
