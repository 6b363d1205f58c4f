//! The box of an object from the points of its surface at many times, and where that box stood at each.
//!
//! A sensor sees the near sides of an object only. Its size is therefore taken from the times that show most of it, and at every time
//! the box is laid against the sides that are seen.

use glam::{DVec2, DVec3};

use super::filter::{Motion, Place};
use super::kinds::Kind;
use super::sighting::Sighting;

/// Fewer points tell nothing about a size.
const LEAST_POINTS: usize = 5;
/// The share of the times, by how many points they have, that sizes are taken from, and the quantile that is taken of them.
const BEST_SHARE: f64 = 0.5;
const QUANTILE: f64 = 0.8;
/// No vehicle is shorter or narrower, metres.
const LEAST_CAR: DVec2 = DVec2::new(3.3, 1.5);
/// What is narrower is a person or a bicycle, and what of that is shorter is a person, metres.
const NARROW: f64 = 1.25;
const SHORT: f64 = 1.1;
/// No person or bicycle is higher, metres: foliage is.
const HIGH: f64 = 2.2;
/// A lorry or a bus is longer, metres.
const LONG: f64 = 6.2;
/// Sides and height that no box is without, metres.
const LEAST_SIDE: f64 = 0.4;
const LEAST_HEIGHT: f64 = 0.8;
/// A side shows its whole length from this share of it on.
const WHOLE: f64 = 0.8;
/// 1σ of a box's middle: across a side that is seen, and along one that is seen in part, metres.
const SEEN: f64 = 0.12;
const UNSEEN: f64 = 0.5;

/// What kind of object a box of this size is; `None` if none is so high and narrow.
fn kind(size: DVec3) -> Option<Kind> {
    match size {
        DVec3 { y, z, .. } if y < NARROW && z > HIGH => None,
        DVec3 { x, y, .. } if y < NARROW && x < SHORT => Some(Kind::Person),
        DVec3 { x, y, .. } if y < NARROW && x < LEAST_CAR.x => Some(Kind::Bicycle),
        DVec3 { x, .. } if x > LONG => Some(Kind::Truck),
        _ => Some(Kind::Car),
    }
}

/// Corners of the points' bounds in the axes of a heading, lower first: x along it, y to its left, and z.
fn bounds(points: &[DVec3], heading: f64) -> [DVec3; 2] {
    let ahead = DVec2::from_angle(heading);
    let turned = |p: &DVec3| DVec3::new(p.truncate().dot(ahead), p.truncate().dot(ahead.perp()), p.z);
    points.iter().map(turned).fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[low, high], p| [low.min(p), high.max(p)])
}

/// Length, width and height of what was seen of an object, metres; `None` if it never showed enough points.
pub(crate) fn sides(seen: &[(&Sighting, Motion)]) -> Option<DVec3> {
    let mut shown: Vec<(usize, DVec3)> = Vec::new();
    for (sighting, motion) in seen.iter().filter(|(sighting, _)| sighting.points.len() >= LEAST_POINTS) {
        let [low, high] = bounds(&sighting.points, motion.heading);
        let sides = DVec3::new(high.x - low.x, high.y - low.y, high.z - sighting.ground);
        shown.push((sighting.points.len(), sides));
    }
    shown.sort_by_key(|(points, _)| usize::MAX - points);
    shown.truncate(((shown.len() as f64 * BEST_SHARE).ceil() as usize).max(3));
    let side = |k: usize| {
        let mut sides: Vec<f64> = shown.iter().map(|(_, sides)| sides[k]).collect();
        sides.sort_by(f64::total_cmp);
        sides.get(((sides.len() as f64 * QUANTILE) as usize).min(sides.len().saturating_sub(1))).copied()
    };
    Some(DVec3::new(side(0)?, side(1)?, side(2)?))
}

/// What an object is, and its length, width and height in metres, from what was seen of it and from what photos say that it is. Sides
/// that were never seen are those that its kind usually has. `None` if it cannot be such an object.
pub(crate) fn shape(sides: Option<DVec3>, known: Option<Kind>) -> Option<(Kind, DVec3)> {
    let Some(seen) = sides else { return known.map(|kind| (kind, kind.size())) };
    let height = seen.z.max(LEAST_HEIGHT);
    let is_small = seen.y < NARROW && seen.x < LEAST_CAR.x;
    if known.map_or(is_small, Kind::is_narrow) {
        let size = DVec3::new(seen.x.max(LEAST_SIDE), seen.y.clamp(LEAST_SIDE, NARROW), height);
        return Some((known.or_else(|| kind(size))?, size));
    }
    // A vehicle shows at least one of its sides.
    if seen.x.max(seen.y) < NARROW {
        return None;
    }
    let usual = known.unwrap_or(Kind::Car).size();
    let or = |side: f64, least: f64, usual: f64| if side < least { usual } else { side };
    let size = DVec3::new(or(seen.x, LEAST_CAR.x, usual.x), or(seen.y, LEAST_CAR.y, usual.y), height);
    Some((known.or_else(|| kind(size))?, size))
}

/// Where the box stood when it was seen; as seen if that had too few points.
pub(crate) fn place(sighting: &Sighting, heading: f64, size: DVec3) -> Place {
    if sighting.points.len() < LEAST_POINTS {
        return sighting.place;
    }
    let ahead = DVec2::from_angle(heading);
    let [low, high] = bounds(&sighting.points, heading);
    let sensor = DVec2::new(sighting.sensor.dot(ahead), sighting.sensor.dot(ahead.perp()));
    let along = |k: usize| {
        let (low, high, half) = (low[k], high[k], 0.5 * size[k]);
        let is_whole = high - low >= WHOLE * size[k];
        if sensor[k] < low {
            (low + half, SEEN)
        } else if sensor[k] > high {
            (high - half, SEEN)
        } else {
            (0.5 * (low + high), if is_whole { SEEN } else { UNSEEN })
        }
    };
    let ((x, x_sigma), (y, y_sigma)) = (along(0), along(1));
    let laid = Place::along(x * ahead + y * ahead.perp(), ahead, [x_sigma, y_sigma]);
    Place { radial: sighting.place.radial, ..laid }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points on the two sides of a box of 4 × 2 × 1.5 m that a sensor at the origin sees.
    fn seen(middle: DVec2, heading: f64) -> Sighting {
        let ahead = DVec2::from_angle(heading);
        let mut points = Vec::new();
        for i in 0..=20 {
            let share = f64::from(i) / 10.0 - 1.0;
            for (x, y) in [(2.0 * share, 1.0), (2.0 * share, -1.0), (2.0, share), (-2.0, share)] {
                let at = middle + x * ahead + y * ahead.perp();
                let outward = if y.abs() == 1.0 && x.abs() < 2.0 { y * ahead.perp() } else { x.signum() * ahead };
                if outward.dot(at) < 0.0 {
                    points.extend([0.4, 1.0, 1.5].map(|z| at.extend(z)));
                }
            }
        }
        let place = Place { middle, covariance: [0.5, 0.0, 0.5], radial: None };
        Sighting { place, points, sensor: DVec2::ZERO, ground: 0.0, moves: true, kind: None }
    }

    #[test]
    fn a_box_is_laid_against_the_sides_that_are_seen() {
        let middle = DVec2::new(12.0, -7.0);
        for heading in [0.0, 0.9, 2.0, -2.5] {
            let sighting = seen(middle, heading);
            let found = place(&sighting, heading, DVec3::new(4.0, 2.0, 1.5));
            assert!((found.middle - middle).length() < 0.25, "{heading}: {}", found.middle);
            let (is, whole) = shape(sides(&[(&sighting, Motion { middle, heading, speed: 5.0 })]), None).unwrap();
            assert_eq!(is, Kind::Car);
            assert!((whole - DVec3::new(4.0, 2.0, 1.5)).abs().max_element() < 0.45, "{heading}: {whole}");
        }
        // From behind only its rear is seen, 2 m nearer than the middle.
        let from_behind = seen(DVec2::new(20.0, 0.0), 0.0);
        let rear = Sighting { points: from_behind.points.into_iter().filter(|p| p.x < 18.1).collect(), ..from_behind };
        let found = place(&rear, 0.0, DVec3::new(4.0, 2.0, 1.5));
        assert!((found.middle - DVec2::new(20.0, 0.0)).length() < 0.25, "{}", found.middle);
        assert_eq!(place(&Sighting { points: Vec::new(), ..rear }, 0.0, Kind::Car.size()), rear.place);
    }

    #[test]
    fn sizes_tell_classes() {
        let of = |x: f64, y: f64, z: f64| kind(DVec3::new(x, y, z));
        let kinds = [of(0.6, 0.5, 1.7), of(1.7, 0.6, 1.6), of(4.3, 1.8, 1.5), of(9.0, 2.5, 3.2)];
        assert_eq!(kinds, [Kind::Person, Kind::Bicycle, Kind::Car, Kind::Truck].map(Some));
        assert_eq!(of(0.6, 0.5, 2.5), None);
        assert_eq!(shape(None, Some(Kind::Person)), Some((Kind::Person, Kind::Person.size())));
        let small = DVec3::new(0.7, 0.5, 1.6);
        assert_eq!(shape(Some(small), None), Some((Kind::Person, small)));
        assert_eq!([shape(Some(small), Some(Kind::Car)), shape(None, None)], [None; 2]);
        // Only its rear was seen.
        let rear = shape(Some(DVec3::new(0.4, 1.7, 1.5)), Some(Kind::Car)).unwrap();
        assert_eq!(rear, (Kind::Car, DVec3::new(4.3, 1.7, 1.5)));
    }
}
