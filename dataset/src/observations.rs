//! Which sparse points each view observed: the capture's tracks, inverted.

use scene::Capture;

/// The sparse points of each view. Takes four bytes per observation, like the capture's tracks.
#[derive(Debug)]
pub(crate) struct Observations {
    /// View `v` observed `points[start[v] .. start[v + 1]]`.
    start: Vec<u32>,
    points: Vec<u32>,
}

impl Observations {
    /// Inverts the tracks of a capture. A capture without tracks gives no observations.
    pub(crate) fn new(capture: &Capture) -> Self {
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

    /// Indices of the points that a view observed, ascending.
    pub(crate) fn of(&self, view: usize) -> &[u32] {
        &self.points[self.start[view] as usize..self.start[view + 1] as usize]
    }
}
