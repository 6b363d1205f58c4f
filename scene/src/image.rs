//! Pixels of an image or of a window of a view.

/// An 8-bit sRGB image or window, as planes: all red, all green, all blue, rows from the top.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Pixels {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `3 · width · height` bytes.
    pub rgb: Vec<u8>,
    /// `width · height` bytes if the view has a mask: 255 = use, 0 = leave out.
    pub mask: Option<Vec<u8>>,
    /// `width · height` factors of the pixels' training loss, finite and at least 0. Pixels of weight 0 are left out
    /// like masked ones. `None`: all 1.
    pub weights: Option<Vec<f32>>,
    /// `width · height` target depths along the camera's z axis, metres; 0 = no target.
    pub depth: Option<Vec<f32>>,
    /// `width · height` bytes where it is known which pixels show the trained object: 255 = it is there, 0 = it is not, 128 = unknown.
    pub silhouette: Option<Vec<u8>>,
}

impl Pixels {
    /// The number of pixels.
    pub fn area(&self) -> usize {
        self.width as usize * self.height as usize
    }
}
