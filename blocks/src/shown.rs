//! How much of the photos windows show, each pixel counted once: what a level of the tree is the first to see.

use std::collections::BTreeMap;

use scene::Capture;

use crate::plan::ViewUse;

/// Of each view, by index, what some windows show.
#[derive(Debug, Clone, Default)]
pub(crate) struct Shown(BTreeMap<u32, OfView>);

#[derive(Debug, Clone, Copy, Default)]
struct OfView {
    /// Pixels in the windows, where they overlap counted again.
    in_windows: u64,
    /// Pixels of the whole image at their finest mip.
    in_image: u64,
}

impl OfView {
    fn pixels(self) -> u64 {
        self.in_windows.min(self.in_image)
    }
}

impl Shown {
    /// Adds windows.
    pub(crate) fn add<'a>(&mut self, windows: impl IntoIterator<Item = &'a ViewUse>, capture: &Capture) {
        for used in windows {
            let image = capture.views[used.view as usize].camera.mip(used.mip).full().area();
            let of_view = self.0.entry(used.view).or_default();
            of_view.in_windows += used.window.area();
            of_view.in_image = image.max(of_view.in_image);
        }
    }

    /// Pixels in the windows, where they overlap counted again: the work of looking at them all.
    pub(crate) fn in_windows(&self) -> u64 {
        self.0.values().map(|of_view| of_view.in_windows).sum()
    }

    /// Pixels that are not only the ones that `before` shows, coarser: detail that nobody saw until now. A view's
    /// pixels count by this share at least.
    pub(crate) fn first(&self, before: &Self, seen_again: f64) -> f64 {
        let of_views = self.0.iter().map(|(view, now)| {
            let before = before.0.get(view).map_or(0, |before| before.pixels());
            (now.pixels().saturating_sub(before) as f64).max(seen_again * now.pixels() as f64)
        });
        of_views.sum()
    }

    /// With the views that only `before` shows, and of all others whichever shows more.
    pub(crate) fn or(mut self, before: Self) -> Self {
        for (view, before) in before.0 {
            let now = self.0.entry(view).or_insert(before);
            if before.pixels() > now.pixels() {
                *now = before;
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
        let shown = |mip: u8, windows: u32| {
            let mut shown = Shown::default();
            let window = camera.mip(mip).full();
            shown.add(&vec![ViewUse { view: 0, mip, window }; windows as usize], &capture);
            shown
        };
        let area = camera.full().area();
        assert_eq!(shown(0, 3).in_windows(), 3 * area);
        assert_eq!(shown(0, 3).first(&Shown::default(), 0.0), area as f64);
        assert_eq!(shown(0, 3).first(&shown(1, 1), 0.0), 0.75 * area as f64);
        assert_eq!(shown(0, 3).first(&shown(0, 1), 0.05), 0.05 * area as f64);
        assert_eq!(shown(1, 1).or(shown(0, 1)).first(&shown(0, 1), 0.0), 0.0);
        // Windows that do not cover the image show less than it.
        let mut corner = Shown::default();
        let window = Rect { x: 0, y: 0, width: 16, height: 16 };
        corner.add(&[ViewUse { view: 0, mip: 0, window }], &capture);
        assert_eq!(corner.first(&Shown::default(), 0.0), 256.0);
    }
}
