//! Target depths of a window, from the sparse points that its view observed.

use scene::{Capture, Rect};

use crate::observations::Observations;

/// Depths of the sparse points that each view observed.
#[derive(Debug)]
pub(super) struct SparseDepth(Observations);

impl SparseDepth {
    pub(super) fn new(capture: &Capture) -> Self {
        Self(Observations::new(capture))
    }

    /// Depths in metres of the view's points in a window of a mip, 0 elsewhere. The nearest point of a pixel wins. Empty if
    /// no point is in the window.
    pub(super) fn plane(&self, capture: &Capture, view: u32, mip: u8, rect: Rect) -> Vec<f32> {
        let camera = capture.views[view as usize].camera.mip(mip).window(rect);
        let (width, height) = (f64::from(rect.width), f64::from(rect.height));
        let mut plane = Vec::new();
        for &point in self.0.of(view as usize) {
            let (pixel, depth) = camera.project(capture.points.positions[point as usize]);
            if !(depth > 0.0 && (0.0..width).contains(&pixel.x) && (0.0..height).contains(&pixel.y)) {
                continue;
            }
            if plane.is_empty() {
                plane.resize(rect.area() as usize, 0.0);
            }
            let nearest: &mut f32 = &mut plane[pixel.y as usize * rect.width as usize + pixel.x as usize];
            if *nearest == 0.0 || (depth as f32) < *nearest {
                *nearest = depth as f32;
            }
        }
        plane
    }
}
