//! Pixel coverage: for each view, how many pixels a set of training windows shows. This is an upper bound: the windows' areas
//! are added up, and the sum is capped at the area of the image.
//!
//! The planner takes the difference of two levels' coverage as the detail that the finer level adds.

use std::collections::BTreeMap;

use scene::Capture;

use crate::task::ViewUse;

/// The coverage of each view, by view index. All windows of a view have the same mip.
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
    /// Upper bound of the number of covered pixels.
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

    /// For each view, how many more pixels are covered than by `coarser`: detail that is new at this level. Each view
    /// contributes at least the share `min_share` of its covered pixels, so that every level gets some work.
    pub(crate) fn new_pixels(&self, coarser: &Self, min_share: f64) -> f64 {
        let of_views = self.0.iter().map(|(view, finer)| {
            let coarser = coarser.0.get(view).map_or(0, |coarser| coarser.pixels());
            (finer.pixels().saturating_sub(coarser) as f64).max(min_share * finer.pixels() as f64)
        });
        of_views.sum()
    }

    /// For each view the larger of both coverages.
    pub(crate) fn max_per_view(mut self, other: Self) -> Self {
        for (view, other) in other.0 {
            let largest = self.0.entry(view).or_insert(other);
            if other.pixels() > largest.pixels() {
                *largest = other;
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
    fn covered_pixels_are_capped_at_the_image() {
        let capture = aerial(3, 60.0, 300);
        let camera = capture.views[0].camera;
        let covered = |mip: u8, windows: u32| {
            let mut coverage = PixelCoverage::default();
            let window = camera.mip(mip).full();
            coverage.add(&vec![ViewUse { view: 0, mip, window }; windows as usize], &capture);
            coverage
        };
        let area = camera.full().area();
        assert_eq!(covered(0, 3).new_pixels(&PixelCoverage::default(), 0.0), area as f64);
        assert_eq!(covered(0, 3).new_pixels(&covered(1, 1), 0.0), 0.75 * area as f64);
        assert_eq!(covered(0, 3).new_pixels(&covered(0, 1), 0.05), 0.05 * area as f64);
        assert_eq!(covered(1, 1).max_per_view(covered(0, 1)).new_pixels(&covered(0, 1), 0.0), 0.0);
        // A window smaller than the image covers only its own pixels.
        let mut corner = PixelCoverage::default();
        let window = Rect { x: 0, y: 0, width: 16, height: 16 };
        corner.add(&[ViewUse { view: 0, mip: 0, window }], &capture);
        assert_eq!(corner.new_pixels(&PixelCoverage::default(), 0.0), 256.0);
    }
}
