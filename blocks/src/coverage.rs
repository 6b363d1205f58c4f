//! Pixel coverage: how many pixels of the photos a set of windows shows, each pixel counted once.
//!
//! The planner uses it to measure how much detail a level of the tree adds to the level above.

use std::collections::BTreeMap;

use scene::Capture;

use crate::plan::ViewUse;

/// The covered pixels of each view, by view index.
#[derive(Debug, Clone, Default)]
pub(crate) struct PixelCoverage(BTreeMap<u32, ViewCoverage>);

#[derive(Debug, Clone, Copy, Default)]
struct ViewCoverage {
    /// Pixels of all windows; overlaps count several times.
    in_windows: u64,
    /// Pixels of the whole image at the finest mip of its windows.
    in_image: u64,
}

impl ViewCoverage {
    fn pixels(self) -> u64 {
        self.in_windows.min(self.in_image)
    }
}

impl PixelCoverage {
    /// Adds windows.
    pub(crate) fn add<'a>(&mut self, windows: impl IntoIterator<Item = &'a ViewUse>, capture: &Capture) {
        for used in windows {
            let image = capture.views[used.view as usize].camera.mip(used.mip).full().area();
            let of_view = self.0.entry(used.view).or_default();
            of_view.in_windows += used.window.area();
            of_view.in_image = image.max(of_view.in_image);
        }
    }

    /// Pixels of all windows. Overlaps count several times, as they do in the training work.
    pub(crate) fn in_windows(&self) -> u64 {
        self.0.values().map(|of_view| of_view.in_windows).sum()
    }

    /// Pixels that this coverage has beyond `coarser`: detail that is new at this level. Each view contributes at least
    /// the share `min_share` of its pixels.
    pub(crate) fn new_pixels(&self, coarser: &Self, min_share: f64) -> f64 {
        let of_views = self.0.iter().map(|(view, now)| {
            let before = coarser.0.get(view).map_or(0, |before| before.pixels());
            (now.pixels().saturating_sub(before) as f64).max(min_share * now.pixels() as f64)
        });
        of_views.sum()
    }

    /// The union of both: for each view the larger coverage.
    pub(crate) fn union(mut self, other: Self) -> Self {
        for (view, other) in other.0 {
            let now = self.0.entry(view).or_insert(other);
            if other.pixels() > now.pixels() {
                *now = other;
            }
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use scene::Rect;

    use super::*;
    use crate::testing::aerial;

    #[test]
    fn pixels_count_once() {
        let capture = aerial(3, 60.0, 300);
        let camera = capture.views[0].camera;
        let covered = |mip: u8, windows: u32| {
            let mut coverage = PixelCoverage::default();
            let window = camera.mip(mip).full();
            coverage.add(&vec![ViewUse { view: 0, mip, window }; windows as usize], &capture);
            coverage
        };
        let area = camera.full().area();
        assert_eq!(covered(0, 3).in_windows(), 3 * area);
        assert_eq!(covered(0, 3).new_pixels(&PixelCoverage::default(), 0.0), area as f64);
        assert_eq!(covered(0, 3).new_pixels(&covered(1, 1), 0.0), 0.75 * area as f64);
        assert_eq!(covered(0, 3).new_pixels(&covered(0, 1), 0.05), 0.05 * area as f64);
        assert_eq!(covered(1, 1).union(covered(0, 1)).new_pixels(&covered(0, 1), 0.0), 0.0);
        // A window smaller than the image covers only its own pixels.
        let mut corner = PixelCoverage::default();
        let window = Rect { x: 0, y: 0, width: 16, height: 16 };
        corner.add(&[ViewUse { view: 0, mip: 0, window }], &capture);
        assert_eq!(corner.new_pixels(&PixelCoverage::default(), 0.0), 256.0);
    }
}
