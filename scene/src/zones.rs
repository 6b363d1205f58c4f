//! Zones: the objects on photos that training, pruning and measuring look at more closely.

mod mask;

use serde::{Deserialize, Serialize};

pub use self::mask::{MaskBuilder, ZoneMask};
use crate::capture::View;
use crate::error::CodecError;

/// An object on a photo.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Zone {
    /// Left, top, right and bottom edge, pixels of mip 0 from the top left corner of the picture.
    pub corners: [f32; 4],
    /// Index of its class in [`Zones::classes`].
    pub class: u16,
    /// How sure its source is, 0 to 1.
    pub score: f32,
    /// Which pixels of mip 0 are its own, if its source says so; without, all inside the edges.
    pub mask: Option<ZoneMask>,
}

impl Zone {
    /// Its area, pixels of mip 0.
    pub fn area(&self) -> f32 {
        let [left, top, right, bottom] = self.corners;
        self.mask.as_ref().map_or((right - left) * (bottom - top), |mask| mask.area() as f32)
    }
}

/// The zones of all views of a capture.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Zones {
    /// Names of the classes.
    pub classes: Vec<String>,
    /// Zones of each view, in the order of the capture's views.
    pub of_views: Vec<Vec<Zone>>,
}

impl Zones {
    /// Most zones of a view.
    pub const MAX: usize = 1000;
    /// Most bytes of all masks: a worker holds them while it trains.
    pub const MAX_MASK_BYTES: usize = 256 << 20;

    /// The zones of a view, by its index in the capture.
    pub fn of(&self, view: usize) -> &[Zone] {
        self.of_views.get(view).map_or(&[], Vec::as_slice)
    }

    /// The number of zones.
    pub fn len(&self) -> usize {
        self.of_views.iter().map(Vec::len).sum()
    }

    /// Whether no view has a zone.
    pub fn is_empty(&self) -> bool {
        self.of_views.iter().all(Vec::is_empty)
    }

    /// Checks them against a capture's views. They come from files, so every number is untrusted.
    ///
    /// # Errors
    /// Zones that do not fit the views: in number, place, class, score or mask.
    pub fn check(&self, views: &[View]) -> Result<(), CodecError> {
        if self.of_views.len() != views.len() {
            return Err(CodecError::new("zones are not of as many views as the capture has"));
        }
        let masks = self.of_views.iter().flatten().filter_map(|zone| zone.mask.as_ref());
        if masks.map(ZoneMask::bytes).sum::<usize>() > Self::MAX_MASK_BYTES {
            let most = Self::MAX_MASK_BYTES >> 20;
            return Err(CodecError::new(format!(
                "have masks of over {most} MB; fewer classes or smoother masks take less"
            )));
        }
        for (view, zones) in views.iter().zip(&self.of_views) {
            let bad = |what: String| Err(CodecError::new(format!("view {:?} {what}", view.name)));
            if zones.len() > Self::MAX {
                return bad(format!("has {} zones, and {} are the most", zones.len(), Self::MAX));
            }
            let size = [view.camera.pinhole.width as f32, view.camera.pinhole.height as f32];
            let pixels = u64::from(view.camera.pinhole.width) * u64::from(view.camera.pinhole.height);
            for Zone { corners: [left, top, right, bottom], class, score, mask } in zones {
                let inside = |from: f32, to: f32, side: f32| from >= 0.0 && from < to && to <= side;
                if !inside(*left, *right, size[0]) || !inside(*top, *bottom, size[1]) {
                    return bad(format!("has a zone from {left}, {top} to {right}, {bottom}, not inside the photo"));
                }
                if usize::from(*class) >= self.classes.len() || !(0.0..=1.0).contains(score) {
                    return bad("has a zone without a class or with a score outside 0 to 1".to_owned());
                }
                if let Some(Err(error)) = mask.as_ref().map(|mask| mask.check(pixels)) {
                    return bad(error.to_string());
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::tests::view;

    #[test]
    fn zones_lie_inside_their_photos() {
        let views = [view(40, 30)];
        let masked = |corners, class, score, mask| Zones {
            classes: vec!["car".into()],
            of_views: vec![vec![Zone { corners, class, score, mask }]],
        };
        let zones = |corners, class, score| masked(corners, class, score, None);
        let mask = |row| {
            let mut builder = MaskBuilder::new(40);
            builder.push(row, 3..5);
            builder.finish().unwrap()
        };
        let whole = [0.0, 0.0, 40.0, 30.0];
        assert!(zones(whole, 0, 1.0).check(&views).is_ok() && Zones::default().check(&[]).is_ok());
        assert_eq!([zones(whole, 0, 1.0).of(0).len(), zones(whole, 0, 1.0).of(1).len()], [1, 0]);
        let ((last, at), (below, _)) = (mask(29), mask(30));
        assert_eq!(at, [3.0, 29.0, 5.0, 30.0]);
        let zone = masked(at, 0, 1.0, Some(last));
        assert!(zone.check(&views).is_ok());
        assert_eq!([zone.of(0)[0].area(), zones(whole, 0, 1.0).of(0)[0].area()], [2.0, 1200.0]);
        for bad in [
            masked(whole, 0, 1.0, Some(below)),
            zones([-1.0, 0.0, 4.0, 3.0], 0, 0.5),
            zones([4.0, 0.0, 4.0, 3.0], 0, 0.5),
            zones([0.0, 0.0, 41.0, 3.0], 0, 0.5),
            zones([0.0, f32::NAN, 4.0, 3.0], 0, 0.5),
            zones(whole, 1, 0.5),
            zones(whole, 0, f32::NAN),
            Zones::default(),
            Zones { of_views: vec![Vec::new(); 2], ..zones(whole, 0, 1.0) },
            Zones { of_views: vec![vec![zones(whole, 0, 1.0).of(0)[0].clone(); 1001]], ..zones(whole, 0, 1.0) },
        ] {
            assert!(bad.check(&views).is_err(), "{bad:?}");
        }
    }
}
