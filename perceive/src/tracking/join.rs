//! Tracks that are one object: hidden for some time, or followed twice.

use glam::DVec2;

use super::filter::smoothed;
use super::follow::{Followed, GATE, LEAST_SEEN};
use super::kinds::may_be_same;
use super::track::{Moment, Track, TrackPose};

/// It is continued by one that begins up to this much later, seconds.
const HIDDEN_SECONDS: f64 = 5.0;
/// A track continues another if their velocities differ by less than this, metres per second, and if the way between them is that of
/// their mean velocity up to a share of this, and some metres, as other parts of an object are seen.
const SAME_VELOCITY: f64 = 5.0;
const BETWEEN_SHARE: f64 = 0.5;
const BETWEEN_METRES: f64 = 2.0;
/// Boxes are in one place if their middles are nearer than this share of their mean length and width.
const IN_SHARE: f64 = 0.8;
/// Two tracks are one vehicle if their boxes are in one place at this many times, and at more than this share of those of both.
const LEAST_TIMES: usize = 3;
const TIMES_SHARE: f64 = 0.5;

/// Joins tracks whose end and beginning are the same object, hidden in between: the most likely ones first.
pub(crate) fn joined(moments: &[Moment], mut followed: Vec<Followed>) -> Vec<Followed> {
    followed.retain(|of| of.seen.len() >= LEAST_SEEN);
    let ends = |of: &Followed| (of.seen[0], of.seen[of.seen.len() - 1]);
    let seconds = |(at, _): (usize, usize)| moments[at].seconds;
    let place = |(at, which): (usize, usize)| &moments[at].sightings[which].place;
    // Two sightings alone say little of how fast it goes; all that came after them say more.
    let first_velocity = |of: &Followed| {
        let seen = of.seen.iter().map(|&seen| (seconds(seen), Some(*place(seen))));
        let motions = smoothed(&of.first, &seen.collect::<Vec<_>>());
        DVec2::from_angle(motions[0].heading) * motions[0].speed
    };
    let begins_with: Vec<DVec2> = followed.iter().map(first_velocity).collect();
    let mut pairs = Vec::new();
    for (i, a) in followed.iter().enumerate() {
        // Its belief when it was last seen.
        let (mut belief, mut at) = (a.first.clone(), seconds(ends(a).0));
        for &seen in &a.seen {
            belief = belief.predicted(seconds(seen) - at).updated(place(seen));
            at = seconds(seen);
        }
        for (j, b) in followed.iter().enumerate() {
            let gap = seconds(ends(b).0) - at;
            if i == j || gap <= 0.0 || gap > HIDDEN_SECONDS || !may_be_same(a.kind, b.kind) {
                continue;
            }
            let later = belief.predicted(gap);
            let place = place(ends(b).0);
            let way = place.middle - belief.middle();
            let off = way - 0.5 * gap * (belief.velocity() + begins_with[j]);
            if later.distance(place) <= GATE
                && later.velocity().distance(begins_with[j]) <= SAME_VELOCITY
                && off.length() <= BETWEEN_SHARE * SAME_VELOCITY * gap + BETWEEN_METRES
            {
                pairs.push((later.surprise(place), i, j));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let (mut next, mut has_previous) = (vec![None; followed.len()], vec![false; followed.len()]);
    for (_, i, j) in pairs {
        if next[i].is_none() && !has_previous[j] {
            (next[i], has_previous[j]) = (Some(j), true);
        }
    }
    let first = (0..followed.len()).filter(|&i| !has_previous[i]);
    let chain = first.map(|i| {
        let mut whole = followed[i].clone();
        let mut at = i;
        while let Some(j) = next[at] {
            whole.seen.extend(&followed[j].seen);
            at = j;
        }
        whole
    });
    chain.collect()
}

/// The tracks, with vehicles that were followed twice joined, as two are never in one place: what only the other was seen as is added to
/// the one that was seen to move more often. `path` is that of what was followed, if it is one.
pub(crate) fn without_doubles(
    moments: &[Moment],
    followed: Vec<Followed>,
    path: &dyn Fn(&Followed) -> Option<Track>,
) -> Vec<Track> {
    let mut left: Vec<(Track, Followed)> = followed.into_iter().filter_map(|of| Some((path(&of)?, of))).collect();
    let mut found = Vec::new();
    while let Some(one) = left.pop() {
        let Some(at) = left.iter().position(|(other, _)| are_one(&one.0, other)) else {
            found.push(one.0);
            continue;
        };
        let two = left.swap_remove(at);
        let (surer, other) = if one.1.moved(moments) >= two.1.moved(moments) { (one, two) } else { (two, one) };
        let both = surer.1.with(&other.1);
        left.push(path(&both).map_or(surer, |path| (path, both)));
    }
    found
}

/// Whether two tracks are of one vehicle.
fn are_one(a: &Track, b: &Track) -> bool {
    if a.kind.is_narrow() || b.kind.is_narrow() {
        return false;
    }
    let size = 0.5 * IN_SHARE * (a.size + b.size).truncate();
    let mut others = b.path.iter().peekable();
    let (mut both, mut same) = (0, 0);
    for pose in &a.path {
        while others.next_if(|other| other.seconds < pose.seconds).is_some() {}
        let Some(other) = others.next_if(|other| other.seconds == pose.seconds) else { continue };
        both += 1;
        same += usize::from(is_in(pose, other, size));
    }
    same >= LEAST_TIMES && same as f64 > TIMES_SHARE * both as f64
}

/// Whether a place is this near to another, along its heading and across it, metres.
fn is_in(pose: &TrackPose, other: &TrackPose, near: DVec2) -> bool {
    let off = (other.place - pose.place).truncate();
    let ahead = DVec2::from_angle(pose.heading);
    off.dot(ahead).abs() < near.x && off.dot(ahead.perp()).abs() < near.y
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::tracking::filter::Place;
    use crate::tracking::follow::followed;
    use crate::tracking::kinds::Kind;
    use crate::tracking::path::path;
    use crate::tracking::sighting::Sighting;

    fn sighting(middle: DVec2, kind: Option<Kind>) -> Sighting {
        let place = Place::around(middle, 0.3);
        Sighting { place, points: Vec::new(), sensor: DVec2::ZERO, ground: 0.0, moves: true, kind }
    }

    /// What is seen every 0.2 s of objects that go along x: their places at first, speeds, and the times that they are seen.
    fn moments(objects: &[(DVec2, f64, std::ops::Range<u32>)]) -> Vec<Moment> {
        let moment = |i: u32| {
            let at = |start: DVec2, speed: f64| start + DVec2::X * speed * 0.2 * f64::from(i);
            let there = objects.iter().filter(|(_, _, times)| times.contains(&i));
            let sightings = there.map(|&(start, speed, _)| sighting(at(start, speed), None)).collect();
            Moment { seconds: 0.2 * f64::from(i), sightings, watches: Vec::new() }
        };
        (0..40).map(moment).collect()
    }

    #[test]
    fn a_track_goes_on_as_what_its_velocities_say() {
        // A car is hidden for 2 s. Someone walks where it would be later still, if it had been faster.
        let car = (DVec2::ZERO, 8.0, 0..15);
        let later = (DVec2::new(0.0, 0.5), 8.0, 25..40);
        let walker = (DVec2::new(32.0, 3.0), 1.3, 30..40);
        let joined_ends = |objects: &[(DVec2, f64, std::ops::Range<u32>)]| -> Vec<[usize; 2]> {
            let moments = moments(objects);
            let joined = joined(&moments, followed(&moments));
            joined.iter().map(|of| [of.seen[0].0, of.seen[of.seen.len() - 1].0]).collect()
        };
        assert_eq!(joined_ends(&[car.clone(), later, walker.clone()]), [[0, 39], [30, 39]]);
        assert_eq!(joined_ends(&[car, walker]), [[0, 14], [30, 39]]);
    }

    #[test]
    fn a_vehicle_that_was_followed_twice_is_one() {
        let moments = moments(&[(DVec2::ZERO, 8.0, 0..20), (DVec2::new(2.5, 0.2), 8.0, 10..30)]);
        let both: Vec<Followed> = followed(&moments);
        assert_eq!(both.len(), 2);
        let as_car = |of: &Followed| {
            let known: Vec<Moment> = moments
                .clone()
                .into_iter()
                .map(|moment| {
                    let sightings = moment.sightings.into_iter().map(|of| Sighting { kind: Some(Kind::Car), ..of });
                    Moment { sightings: sightings.collect(), ..moment }
                })
                .collect();
            path(&known, of, true, &|_| Some(0.0))
        };
        let found = without_doubles(&moments, both, &as_car);
        assert_eq!(found.len(), 1);
        let times = [found[0].path[0].seconds, found[0].path[found[0].path.len() - 1].seconds];
        assert!(times[0].abs() < 1e-9 && (times[1] - 5.8).abs() < 1e-9, "{times:?}");
    }

    /// At 10 m/s along x, from this place and time on.
    fn track(kind: Kind, place: DVec2, from: u32, times: u32) -> Track {
        let pose = |i: u32| {
            let seconds = 0.2 * f64::from(from + i);
            TrackPose { seconds, place: (place + DVec2::X * 10.0 * seconds).extend(0.0), heading: 0.0, slope: 0.0 }
        };
        Track { kind, size: DVec3::new(4.0, 2.0, 1.5), path: (0..times).map(pose).collect() }
    }

    #[test]
    fn vehicles_in_one_place_are_one() {
        let car = track(Kind::Car, DVec2::ZERO, 0, 10);
        let one = |x: f64, y: f64, from: u32| are_one(&car, &track(Kind::Truck, DVec2::new(x, y), from, 10));
        assert!(one(2.5, 0.5, 0) && one(-2.5, 0.5, 7), "nearer than boxes can be");
        assert!(!one(4.5, 0.0, 0) && !one(0.0, 2.5, 0), "behind and beside each other");
        assert!(!one(0.5, 0.0, 8) && !one(0.5, 0.0, 20), "seldom or never at the same time");
        assert!(!are_one(&car, &track(Kind::Person, DVec2::ZERO, 0, 10)), "people get in");
    }
}
