//! Drives of camera cars through whole streets, one after the other, in both directions, as a capture of an area by car is made.
//!
//! A street is a part of a lane of [`City::streets`] of at most [`STREET_METRES`]. Streets come in the order of their distance
//! from the city's centre, so that few drives cover a small area closely and not a large one thinly. Generated traffic leaves
//! these lanes free; so both directions use the same lane, each on its right side.

use super::rig::{Polyline, Rig};
use super::{SenseError, check_count, check_range};
use crate::{City, Waypoint};

/// Maximum length of a street.
const STREET_METRES: f64 = 150.0;
/// Time at which another car sets out: generated traffic ends soon after.
const SHIFT_SECONDS: f64 = 600.0;
/// Pause between two streets, seconds.
const PAUSE_SECONDS: f64 = 1.0;

/// The drives of the cars.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Drives {
    /// Poses of each drive through a street, one waypoint per stop; see [`super::rig::legs`]. Time advances from leg to leg until
    /// another car sets out.
    pub legs: Vec<Vec<Waypoint>>,
    /// Length of the drives, metres; each direction counts.
    pub driven_metres: f64,
    /// Length of all streets in both directions, metres.
    pub street_metres: f64,
}

/// Drives with a stop every [`Rig::spacing_metres`] and at most `stops` stops. [`Rig::fleet`] is not used.
///
/// # Errors
/// [`SenseError`] for settings out of range, or more stops than [`super::MAX_READINGS`].
pub fn drives(city: &City, rig: &Rig, stops: usize) -> Result<Drives, SenseError> {
    let spacing = check_range("spacing_metres", rig.spacing_metres, 0.01, 1e4)?;
    let speed = check_range("speed", rig.speed, 0.01, 100.0)?;
    let right = check_range("lane_metres", rig.lane_metres, -50.0, 50.0)?;
    let start = check_range("start_seconds", rig.start_seconds, -1e9, 1e9)?;
    let backwards: Vec<Vec<_>> = city.streets.iter().map(|lane| lane.iter().rev().copied().collect()).collect();
    let lanes: Vec<[Polyline; 2]> = (city.streets.iter().zip(&backwards))
        .filter_map(|(ahead, back)| Some([Polyline::new(ahead)?, Polyline::new(back)?]))
        .collect();
    let street_metres = 2.0 * lanes.iter().map(|[ahead, _]| ahead.length()).sum::<f64>();
    check_count(street_metres / spacing)?;

    let mut streets: Vec<Street> = lanes.iter().flat_map(Street::all_of).collect();
    streets.sort_by(|a, b| a.from_centre.total_cmp(&b.from_centre));
    let (mut drives, mut seconds, mut left) = (Drives { street_metres, ..Drives::default() }, start, stops);
    for street in &streets {
        for (line, [from, to]) in street.lanes.iter().zip([[street.from, street.to], street.back()]) {
            // Stops lie at multiples of the spacing along the lane, so that streets of a lane join without a gap.
            let first = (from / spacing).ceil();
            let count = (((to / spacing).ceil() - first).max(0.0) as usize).min(left);
            let metres = count as f64 * spacing;
            if count == 0 {
                continue;
            }
            if seconds + metres / speed > start + SHIFT_SECONDS {
                seconds = start;
            }
            let waypoint = |i: usize| Waypoint {
                seconds: seconds + i as f64 * spacing / speed,
                world_from_asset: line.pose((first + i as f64) * spacing, right),
            };
            drives.legs.push((0..count).map(waypoint).collect());
            drives.driven_metres += metres;
            seconds += metres / speed + PAUSE_SECONDS;
            left -= count;
        }
    }
    drives.driven_metres = drives.driven_metres.min(street_metres);
    Ok(drives)
}

/// A part of a lane.
struct Street<'a> {
    /// The lane, and the same backwards.
    lanes: &'a [Polyline<'a>; 2],
    /// Its ends, metres along the lane.
    from: f64,
    to: f64,
    /// Distance of its middle from the city's centre, metres.
    from_centre: f64,
}

impl<'a> Street<'a> {
    fn all_of(lanes: &'a [Polyline<'a>; 2]) -> impl Iterator<Item = Self> {
        let length = lanes[0].length();
        let count = (length / STREET_METRES).ceil().max(1.0);
        (0..count as usize).map(move |i| {
            let [from, to] = [i as f64, i as f64 + 1.0].map(|at| at / count * length);
            let from_centre = lanes[0].at(0.5 * (from + to)).truncate().length();
            Self { lanes, from, to, from_centre }
        })
    }

    /// Its ends along the reversed lane.
    fn back(&self) -> [f64; 2] {
        let length = self.lanes[0].length();
        [length - self.to, length - self.from]
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::test_scene;

    fn rig(spacing_metres: f64) -> Rig {
        Rig { spacing_metres, lane_metres: 0.5, ..Rig::default() }
    }

    #[test]
    fn a_street_is_driven_in_both_directions_on_the_right() {
        let city = test_scene::city();
        let driven = drives(&city, &rig(2.0), usize::MAX).unwrap();
        assert_eq!(driven.legs.iter().map(Vec::len).collect::<Vec<_>>(), [60, 60]);
        assert_eq!((driven.driven_metres, driven.street_metres), (240.0, 240.0));
        for (leg, ahead) in driven.legs.iter().zip([1.0, -1.0]) {
            for pair in leg.windows(2) {
                let [a, b] = [&pair[0], &pair[1]].map(|at| at.world_from_asset.translation);
                assert!((b - a - DVec3::X * 2.0 * ahead).length() < 1e-9, "{a} {b}");
                assert!((a.y + 0.5 * ahead).abs() < 1e-9 && pair[1].seconds - pair[0].seconds > 0.19);
            }
        }
        assert!(driven.legs[1][0].seconds > driven.legs[0][59].seconds);
    }

    #[test]
    fn few_stops_cover_the_streets_near_the_centre_first() {
        let line = |y: f64| vec![DVec3::new(-500.0, y, 0.0), DVec3::new(500.0, y, 0.0)];
        let city = City { streets: vec![line(400.0), line(30.0), line(-60.0)], ..City::default() };
        let few = drives(&city, &rig(3.0), 300).unwrap();
        let places = || few.legs.iter().flatten().map(|at| at.world_from_asset.translation);
        assert_eq!(places().count(), 300);
        assert!((few.driven_metres - 900.0).abs() < 1e-6 && (few.street_metres - 6000.0).abs() < 1e-6);
        let farthest = places().map(|p| p.truncate().length()).fold(0.0, f64::max);
        assert!(farthest < 260.0, "{farthest}");
        // The driven parts of the nearest lane join without a gap.
        let mut x: Vec<f64> = places().filter(|p| p.y < 30.0 && p.y > 0.0).map(|p| p.x).collect();
        x.sort_by(f64::total_cmp);
        assert!(x.len() > 50 && x.windows(2).all(|pair| (pair[1] - pair[0] - 3.0).abs() < 1e-6));
        // All streets take longer than a shift.
        let all = drives(&city, &rig(3.0), usize::MAX).unwrap();
        let seconds: Vec<f64> = all.legs.iter().flatten().map(|at| at.seconds).collect();
        assert!((1990..=2010).contains(&seconds.len()), "{}", seconds.len());
        assert!(seconds.iter().all(|s| (0.0..=SHIFT_SECONDS).contains(s)));
        assert!(drives(&city, &rig(f64::NAN), 1).is_err() && drives(&city, &rig(0.0), 1).is_err());
        assert_eq!(drives(&City::default(), &rig(3.0), 9), Ok(Drives::default()));
    }
}
