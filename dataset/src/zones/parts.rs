//! What detection tasks find: each looks at a range of a capture's views, and whoever reads their results puts them together.
//! Zones are smoothed only then, so the division into tasks changes nothing.

use scene::frame::{self, Kind};
use scene::{Capture, CodecError, Zones};

use super::smoothed;

/// What a detector found on views that follow each other, not smoothed.
const OBJECTS: Kind = Kind(*b"objs", 1);

/// The artefact of what was found on some views.
pub fn objects_to_frame(found: &Zones) -> Vec<u8> {
    frame::encode(OBJECTS, found, &[])
}

/// What was found on some views.
///
/// # Errors
/// A damaged frame, or one of another kind.
pub fn objects_from_frame(bytes: &[u8]) -> Result<Zones, CodecError> {
    frame::decode(OBJECTS, bytes).map(|(found, _)| found)
}

/// The zones of a capture's views, smoothed, from what was found on some of them: each part begins at the view of this index.
/// Views of no part have none. Those of a view are right if the parts contain it and, where they exist, the views before and
/// after it.
///
/// # Errors
/// Parts that do not fit the capture, or each other.
pub fn gathered(capture: &Capture, parts: Vec<(u32, Zones)>) -> Result<Zones, CodecError> {
    let mut zones = Zones { of_views: vec![Vec::new(); capture.views.len()], ..Zones::default() };
    for (first, part) in parts {
        if zones.classes.is_empty() {
            zones.classes = part.classes;
        } else if zones.classes != part.classes {
            return Err(CodecError::new("the objects of some views have other classes than those of others"));
        }
        let places = zones.of_views.iter_mut().skip(first as usize);
        if places.len() < part.of_views.len() {
            return Err(CodecError::new("objects were found on more views than the capture has"));
        }
        places.zip(part.of_views).for_each(|(place, found)| *place = found);
    }
    let zones = smoothed(capture, zones);
    zones.check(&capture.views).map(|()| zones)
}

#[cfg(test)]
mod tests {
    use scene::{Camera, Pinhole, Rigid, View, Zone};

    use super::*;

    fn view(name: String) -> View {
        let pinhole = Pinhole { width: 100, height: 50, fx: 50.0, fy: 50.0, cx: 50.0, cy: 25.0 };
        let camera = Camera { pinhole, camera_from_world: Rigid::IDENTITY };
        View { name, camera, mips: Vec::new(), masked: false, depth: None, seconds: None }
    }

    #[test]
    fn the_division_into_parts_changes_nothing() {
        let name = |i: usize| format!("{}/{i}.png", if i < 5 { "a" } else { "b" });
        let capture = Capture { views: (0..9).map(|i| view(name(i))).collect(), ..Capture::default() };
        // A car that moves, jitters and is missed once.
        let left = |i: usize| 2.0 * i as f32 + (i % 2) as f32;
        let car = |i: usize| Zone { corners: [left(i), 10.0, left(i) + 30.0, 30.0], class: 0, score: 0.5, mask: None };
        let found: Vec<Vec<Zone>> = (0..9).map(|i| if i == 3 { Vec::new() } else { vec![car(i)] }).collect();
        let part = |from: usize, to: usize| {
            (from as u32, Zones { classes: vec!["car".into()], of_views: found[from..to].to_vec() })
        };
        let whole = gathered(&capture, vec![part(0, 9)]).unwrap();
        assert!(whole.of(3).len() == 1 && whole.of(1) != found[1] && whole.of(5) == found[5]);
        for cut in 1..9 {
            assert_eq!(gathered(&capture, vec![part(cut, 9), part(0, cut)]).unwrap(), whole);
        }
        // A block that uses the third and the fourth view needs the parts with the second to the fifth.
        let some = gathered(&capture, vec![part(1, 3), part(3, 5)]).unwrap();
        assert!(some.of(2) == whole.of(2) && some.of(3) == whole.of(3) && some.of(8).is_empty());

        let other = |mut part: (u32, Zones)| {
            part.1.classes = vec!["bus".into()];
            part
        };
        assert!(gathered(&capture, vec![part(0, 4), other(part(4, 9))]).is_err());
        assert!(
            gathered(&capture, vec![(1, part(0, 9).1)]).is_err()
                && gathered(&capture, vec![(99, part(0, 1).1)]).is_err()
        );
        let outside = Zone { corners: [0.0, 0.0, 101.0, 5.0], class: 0, score: 0.5, mask: None };
        let outside = Zones { classes: vec!["car".into()], of_views: vec![vec![outside]] };
        assert!(gathered(&capture, vec![(0, outside)]).is_err());
        assert!(gathered(&Capture::default(), Vec::new()).unwrap().is_empty());
    }

    #[test]
    fn frames_round_trip() {
        let found = Zones { classes: vec!["car".into()], of_views: vec![Vec::new(); 3] };
        let bytes = objects_to_frame(&found);
        assert_eq!(objects_from_frame(&bytes).unwrap(), found);
        assert!(objects_from_frame(&bytes[..bytes.len() - 1]).is_err());
        assert!(objects_from_frame(&frame::encode(super::super::ZONES, &found, &[])).is_err());
    }
}
