//! Target depths of a window, from the sparse points that its view observed.

use scene::{Capture, Rect};

/// The sparse points that each view observed. Takes four bytes per observation, like the capture's tracks.
#[derive(Debug)]
pub(super) struct SparseDepth {
    /// View `v` observed `points[start[v] .. start[v + 1]]`.
    start: Vec<u32>,
    points: Vec<u32>,
}

impl SparseDepth {
    /// Inverts the tracks of a capture. A capture without tracks gives no observations.
    pub(super) fn new(capture: &Capture) -> Self {
        let tracks = || (0..capture.points.len()).filter_map(|i| Some((i as u32, capture.points.track(i)?)));
        let mut start = vec![0u32; capture.views.len() + 1];
        tracks().flat_map(|(_, views)| views).for_each(|&view| start[view as usize + 1] += 1);
        (1..start.len()).for_each(|view| start[view] += start[view - 1]);
        let mut next = start.clone();
        let mut points = vec![0; capture.points.seen_by.len()];
        for (point, views) in tracks() {
            for &view in views {
                points[next[view as usize] as usize] = point;
                next[view as usize] += 1;
            }
        }
        Self { start, points }
    }

    /// Depths in metres of the view's points in a window of a mip, 0 elsewhere. The nearest point of a pixel wins. Empty if
    /// no point is in the window.
    pub(super) fn plane(&self, capture: &Capture, view: u32, mip: u8, rect: Rect) -> Vec<f32> {
        let camera = capture.views[view as usize].camera.mip(mip).window(rect);
        let (width, height) = (f64::from(rect.width), f64::from(rect.height));
        let mut plane = Vec::new();
        let range = self.start[view as usize] as usize..self.start[view as usize + 1] as usize;
        for &point in &self.points[range] {
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
