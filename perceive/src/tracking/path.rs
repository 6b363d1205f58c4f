//! The path of what was followed, and whether it is an object that moves.

use std::collections::BTreeMap;

use glam::DVec2;

use super::filter::{Motion, Place, smoothed};
use super::follow::{Followed, LEAST_SEEN};
use super::kinds::Kind;
use super::shape;
use super::sighting::Sighting;
use super::track::{Moment, Track, TrackPose};

/// An object was seen at this share of the times.
const LEAST_SHARE: f64 = 0.3;
/// At least this share of the sightings of an object say that it moves, and it went this far, metres.
const MOVING_SHARE: f64 = 0.3;
const LEAST_METRES: f64 = 1.5;
/// Otherwise it went this far, metres and standard deviations of its sightings, at least this share of its way straight on, and was seen
/// this near to its smoothed path, root mean square, in standard deviations: boxes of cars that stand make paths that jump.
const UNSURE_METRES: f64 = 5.0;
const UNSURE_SIGMAS: f64 = 2.0;
const UNSURE_STRAIGHT: f64 = 0.5;
const UNSURE_OFF_SIGMAS: f64 = 1.0;
/// Sightings of an object lie this near to its smoothed path, root mean square, metres, of narrow objects and of others: chance ones
/// that make a path lie farther off. Those that a photo or a radar confirms may lie farther off by how unsure they are.
const OFF_METRES: [f64; 2] = [0.4, 1.2];
/// A vehicle that radars should have heard at more than this share of its sightings, and did not, is none that moves.
const UNHEARD_SHARE: f64 = 0.5;
/// The slope of the road is taken over this length, metres, and is no larger than this, radians.
const SLOPE_METRES: f64 = 3.0;
const MAX_SLOPE: f64 = 0.35;
/// Below this speed an object keeps the heading that it had when it was last faster, metres per second.
const HEADING_SPEED: f64 = 0.5;

/// Something that was seen, and where the object was by all that was seen of it.
struct Fitted<'a> {
    at: usize,
    sighting: &'a Sighting,
    /// Where this sighting alone says that its box was.
    laid: Place,
    motion: Motion,
}

impl Fitted<'_> {
    /// Squared distance of both, m².
    fn off(&self) -> f64 {
        self.laid.middle.distance_squared(self.motion.middle)
    }
}

/// The path of what was followed, if it is an object that moves. `ground` is the height of the ground, where it is known; people and
/// cycles are only taken for such if photos show them, where `has_photos` says that somebody looked at photos.
pub(crate) fn path(
    moments: &[Moment],
    of: &Followed,
    has_photos: bool,
    ground: &dyn Fn(DVec2) -> Option<f64>,
) -> Option<Track> {
    let (from, to) = (of.seen.first()?.0, of.seen.last()?.0);
    let is_seen = of.seen.len() as f64 >= LEAST_SHARE * (to - from + 1) as f64;
    if of.seen.len() < LEAST_SEEN || !is_seen {
        return None;
    }
    let seen: Vec<(usize, &Sighting)> =
        of.seen.iter().map(|&(at, which)| (at, &moments[at].sightings[which])).collect();
    // At all times from the first to the last.
    let smooth = |places: Vec<Place>| {
        let mut left = seen.iter().zip(places).peekable();
        let place = |at: usize| left.next_if(|((seen, _), _)| *seen == at).map(|(_, place)| place);
        let places: Vec<_> = (moments[from..=to].iter().map(|of| of.seconds)).zip((from..=to).map(place)).collect();
        with_headings(smoothed(&of.first, &places))
    };
    let rough = smooth(seen.iter().map(|(_, of)| of.place).collect());
    let shown: Vec<(&Sighting, Motion)> = seen.iter().map(|&(at, of)| (of, rough[at - from])).collect();
    let known = most(seen.iter().filter_map(|(_, of)| of.kind));
    let (kind, size) = shape::shape(shape::sides(&shown), known)?;
    if has_photos && known.is_none() && kind.is_narrow() {
        return None;
    }
    let laid: Vec<Place> = shown.iter().map(|(of, motion)| shape::place(of, motion.heading, size)).collect();
    let motions = smooth(laid.clone());
    let fitted: Vec<Fitted> = (seen.iter().zip(laid))
        .map(|(&(at, sighting), laid)| Fitted { at, sighting, laid, motion: motions[at - from] })
        .collect();
    let is_too_fast = 2 * motions.iter().filter(|of| of.speed > kind.max_speed()).count() > motions.len();
    if is_too_fast || !is_near(&fitted, kind) || is_unheard(moments, &fitted, kind) || !moves(&fitted, &motions) {
        return None;
    }
    // The ground where it was seen says where it is not known otherwise.
    let beside = |now: usize| {
        let nearest = seen.iter().min_by_key(|(at, _)| at.abs_diff(now));
        nearest.map_or(0.0, |(_, of)| of.ground)
    };
    let pose = |(now, motion): (usize, &Motion)| {
        let z = ground(motion.middle).unwrap_or_else(|| beside(now));
        let half = 0.5 * SLOPE_METRES * DVec2::from_angle(motion.heading);
        let slope = match (ground(motion.middle - half), ground(motion.middle + half)) {
            (Some(behind), Some(ahead)) => ((ahead - behind) / SLOPE_METRES).atan().clamp(-MAX_SLOPE, MAX_SLOPE),
            _ => 0.0,
        };
        TrackPose { seconds: moments[now].seconds, place: motion.middle.extend(z), heading: motion.heading, slope }
    };
    Some(Track { kind, size, path: (from..).zip(&motions).map(pose).collect() })
}

/// Whether what was seen to move lies as near to its path as sightings of one object do.
fn is_near(fitted: &[Fitted], kind: Kind) -> bool {
    let near = OFF_METRES[usize::from(!kind.is_narrow())];
    let share = |of: &Fitted| {
        let is_confirmed = of.sighting.kind.is_some() || of.sighting.place.radial.is_some();
        of.off() / (near * near + if is_confirmed { of.sighting.place.variance() } else { 0.0 })
    };
    !fitted.iter().any(|of| of.sighting.moves) || mean(fitted.iter().map(share)) <= 1.0
}

/// Whether radars say that a vehicle does not move as it seems to.
fn is_unheard(moments: &[Moment], fitted: &[Fitted], kind: Kind) -> bool {
    let should_be_heard = |of: &&Fitted| {
        let velocity = DVec2::from_angle(of.motion.heading) * of.motion.speed;
        let mut watches = moments[of.at].watches.iter();
        !of.sighting.moves && watches.any(|watch| watch.hears(of.motion.middle, velocity))
    };
    let unheard = fitted.iter().filter(should_be_heard).count();
    !kind.is_narrow() && unheard as f64 > UNHEARD_SHARE * fitted.len() as f64
}

/// Whether an object was seen to move, or went so far so straight that it must have.
fn moves(fitted: &[Fitted], motions: &[Motion]) -> bool {
    let far = motions.iter().map(|at| at.middle.distance(motions[0].middle)).fold(0.0, f64::max);
    let moving = fitted.iter().filter(|of| of.sighting.moves).count();
    if moving as f64 >= MOVING_SHARE * fitted.len() as f64 {
        return far >= LEAST_METRES;
    }
    let way: f64 = motions.windows(2).map(|pair| pair[0].middle.distance(pair[1].middle)).sum();
    let sigma = mean(fitted.iter().map(|of| of.sighting.place.variance())).sqrt();
    let off = mean(fitted.iter().map(|of| of.off() / of.laid.variance())).sqrt();
    far >= UNSURE_METRES.max(UNSURE_SIGMAS * sigma) && far >= UNSURE_STRAIGHT * way && off <= UNSURE_OFF_SIGMAS
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len() as f64;
    values.sum::<f64>() / count
}

/// The value that comes most often, the larger one of two.
fn most(kinds: impl Iterator<Item = Kind>) -> Option<Kind> {
    let mut counts = BTreeMap::new();
    kinds.for_each(|kind| *counts.entry(kind).or_insert(0) += 1);
    counts.into_iter().max_by_key(|&(kind, count)| (count, kind)).map(|(kind, _)| kind)
}

/// Motions whose headings are those of the nearest time with speed, where they have too little.
fn with_headings(mut motions: Vec<Motion>) -> Vec<Motion> {
    let fast: Vec<usize> = (0..motions.len()).filter(|&i| motions[i].speed >= HEADING_SPEED).collect();
    for i in 0..motions.len() {
        if motions[i].speed < HEADING_SPEED
            && let Some(&near) = fast.iter().min_by_key(|near| near.abs_diff(i))
        {
            motions[i].heading = motions[near].heading;
        }
    }
    motions
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracking::follow::followed;
    use crate::tracking::watch::Watch;

    /// Boxes of a car on photos, every 0.2 s at 8 m/s along x and this far off to the sides; `ahead` is where a radar at the origin looks.
    fn moments(sideways: &dyn Fn(u32) -> f64, ahead: Option<DVec2>) -> Vec<Moment> {
        let moment = |i: u32| {
            let middle = DVec2::new(10.0 + 1.6 * f64::from(i), sideways(i));
            let place = Place::along(middle, DVec2::X, [1.0, 0.6]);
            let kind = Some(Kind::Car);
            let sighting = Sighting { place, points: Vec::new(), sensor: DVec2::ZERO, ground: 0.0, moves: false, kind };
            let watch = |ahead| Watch { sensor: DVec2::ZERO, ahead, half_angle: 0.8 };
            Moment {
                seconds: 0.2 * f64::from(i),
                sightings: vec![sighting],
                watches: ahead.map(watch).into_iter().collect(),
            }
        };
        (0..15).map(moment).collect()
    }

    fn found(moments: &[Moment]) -> Vec<Track> {
        followed(moments).iter().filter_map(|of| path(moments, of, true, &|_| Some(0.0))).collect()
    }

    #[test]
    fn what_only_photos_show_moves_smoothly() {
        let (straight, shaken) = (|_: u32| 0.0, |i: u32| if i.is_multiple_of(2) { 1.9 } else { -1.9 });
        let smooth = found(&moments(&straight, None));
        assert_eq!((smooth.len(), smooth[0].kind, smooth[0].path.len()), (1, Kind::Car, 15));
        assert!(found(&moments(&shaken, None)).is_empty(), "boxes of several cars that stand");
    }

    #[test]
    fn what_a_radar_should_hear_and_does_not_is_no_vehicle() {
        let straight = |_: u32| 0.0;
        assert!(found(&moments(&straight, Some(DVec2::X))).is_empty());
        assert_eq!(found(&moments(&straight, Some(-DVec2::X))).len(), 1, "it looks elsewhere");
        let mut heard = moments(&straight, Some(DVec2::X));
        heard.iter_mut().step_by(2).for_each(|moment| moment.sightings[0].moves = true);
        assert_eq!(found(&heard).len(), 1, "it hears it half of the time");
    }
}
