//! The windows of views that a block is trained on.

use scene::{Camera, Rect, Rigid};

/// A window of a view that a block trains on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainView {
    /// Index of the view in the capture.
    pub view: u32,
    /// Finest mip that the block trains on.
    pub mip: u8,
    /// Window, in pixels of that mip.
    pub rect: Rect,
    /// Camera of the whole image at mip 0, in the axes of the trained splats.
    pub camera: Camera,
    /// Takes the axes of the frozen context to the camera's, where they are not those of the trained splats: for an object that moves.
    pub camera_from_context: Option<Rigid>,
}

impl TrainView {
    /// The window `coarser` mips up: its mip, rectangle and camera. `None` if the window would be under 8 pixels or the
    /// image under 16 pixels on a side: ingest makes no mips below that.
    pub fn at(&self, coarser: u8) -> Option<(u8, Rect, Camera)> {
        let mip = self.mip + coarser;
        let (x, y) = (self.rect.x >> coarser, self.rect.y >> coarser);
        let image = self.camera.mip(mip);
        let width = ((self.rect.x + self.rect.width) >> coarser).min(image.pinhole.width).saturating_sub(x);
        let height = ((self.rect.y + self.rect.height) >> coarser).min(image.pinhole.height).saturating_sub(y);
        let rect = Rect { x, y, width, height };
        let image_side = image.pinhole.width.min(image.pinhole.height);
        (coarser == 0 || (width.min(height) >= 8 && image_side >= 16)).then(|| (mip, rect, image.window(rect)))
    }
}
