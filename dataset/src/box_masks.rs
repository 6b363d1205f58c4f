//! The pixels that boxes of objects cover on a photo, and their exclusion.

use std::ops::Range;

use glam::{DVec2, DVec3};
use scene::Pinhole;

/// A box grows by this share and this many metres on each side: annotations are not exact.
const GROWTH: f64 = 0.05;
const GROWTH_METRES: f64 = 0.1;

/// Sets the pixels that these boxes cover to 0. `boxes` are corners in the camera's axes, numbered by the bits of their signs along
/// the three sides.
pub(crate) fn exclude(mask: &mut [u8], pinhole: &Pinhole, boxes: &[[DVec3; 8]]) {
    for corners in boxes {
        for (row, columns) in covered(&grown(corners), pinhole) {
            let start = row as usize * pinhole.width as usize;
            mask[start + columns.start as usize..start + columns.end as usize].fill(0);
        }
    }
}

/// The pixels that a box covers, the convex hull of its picture: for each row from the top the columns.
pub fn covered(corners: &[DVec3; 8], pinhole: &Pinhole) -> impl Iterator<Item = (u32, Range<u32>)> {
    let outline = pinhole.outline(corners);
    let bound =
        |pick: fn(&DVec2) -> f64, start: f64, fold: fn(f64, f64) -> f64| outline.iter().map(pick).fold(start, fold);
    let top = bound(|p| p.y, f64::INFINITY, f64::min).floor().max(0.0) as u32;
    let bottom = bound(|p| p.y, 0.0, f64::max).ceil().min(f64::from(pinhole.height)) as u32;
    let width = f64::from(pinhole.width);
    (top..bottom).filter_map(move |y| {
        // The convex hull's extent in a row is that of the lines between all pairs of points.
        let row = f64::from(y) + 0.5;
        let (mut left, mut right) = (f64::INFINITY, f64::NEG_INFINITY);
        for (i, a) in outline.iter().enumerate() {
            for b in outline[i + 1..].iter().filter(|b| (a.y - row) * (b.y - row) <= 0.0 && a.y != b.y) {
                let x = a.x + (b.x - a.x) * (row - a.y) / (b.y - a.y);
                (left, right) = (left.min(x), right.max(x));
            }
        }
        let column = |x: f64| x.clamp(0.0, width) as u32;
        (left <= right).then(|| (y, column(left.floor())..column(right.ceil())))
    })
}

fn grown(corners: &[DVec3; 8]) -> [DVec3; 8] {
    let centre = corners.iter().sum::<DVec3>() / 8.0;
    corners.map(|corner| {
        let arm = corner - centre;
        corner + arm * GROWTH + arm.normalize_or_zero() * (GROWTH_METRES * 3f64.sqrt())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const PINHOLE: Pinhole = Pinhole { width: 80, height: 60, fx: 50.0, fy: 50.0, cx: 40.0, cy: 30.0 };

    fn cube(centre: DVec3, side: f64) -> [DVec3; 8] {
        std::array::from_fn(|i| centre + side * DVec3::from([1, 2, 4].map(|bit| if i & bit == 0 { -0.5 } else { 0.5 })))
    }

    fn excluded(boxes: &[[DVec3; 8]]) -> Vec<(u32, u32)> {
        let mut mask = vec![255; 80 * 60];
        exclude(&mut mask, &PINHOLE, boxes);
        (0..80 * 60).filter(|i| mask[*i as usize] == 0).map(|i| (i % 80, i / 80)).collect()
    }

    #[test]
    fn a_box_covers_its_picture() {
        let found = excluded(&[cube(DVec3::new(1.0, 0.0, 10.0), 2.0)]);
        // The near face spans ±1.15 m at 8.85 m: 6.5 pixels around x = 40 + 5 · (1 ± 0).
        let (left, right) = (found.iter().map(|p| p.0).min().unwrap(), found.iter().map(|p| p.0).max().unwrap());
        let (top, bottom) = (found.iter().map(|p| p.1).min().unwrap(), found.iter().map(|p| p.1).max().unwrap());
        assert!((38..=40).contains(&left) && (50..=53).contains(&right), "{left} {right}");
        assert!((22..=24).contains(&top) && (35..=37).contains(&bottom), "{top} {bottom}");
    }

    #[test]
    fn boxes_behind_and_around_the_camera_are_cut() {
        assert!(excluded(&[cube(DVec3::new(0.0, 0.0, -10.0), 2.0)]).is_empty());
        assert_eq!(excluded(&[cube(DVec3::ZERO, 4.0)]).len(), 80 * 60, "the camera is inside");
        let beside = excluded(&[cube(DVec3::new(3.0, 0.0, 0.0), 3.0)]);
        assert!(!beside.is_empty() && beside.iter().all(|p| p.0 > 40), "only to the right");
        assert!(excluded(&[cube(DVec3::new(0.0, 0.0, 5.0), 0.0), [DVec3::splat(1e300); 8]]).len() < 200);
    }
}
