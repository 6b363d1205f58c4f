//! Paths of objects that move, from where they were seen at many times (Street Detection Gaussians, section 3.3).
//!
//! ```text
//! sightings ─assignment→ tracks ─joined over gaps→ ─smoothed→ headings ─shape→ sizes, better places ─smoothed→ paths
//! ```
//! Each object has a Kalman filter of constant turn rate. At each time the sightings are assigned to the predicted places; what is left
//! starts a track with what was left shortly before. A track that is not seen for some time ends, and one that begins where it would
//! have been continues it. As all times are known before the first path is given, a smoother corrects early states by later ones.

mod assignment;
mod filter;
mod kinds;
mod score;
mod shape;
mod sighting;

use std::collections::BTreeMap;
use std::ops::Range;

use glam::{DVec2, DVec3};

use self::assignment::assigned;
use self::filter::{Belief, Motion, smoothed};
pub(crate) use self::filter::{Place, Radial};
pub use self::kinds::Kind;
pub use self::score::{Frame, Placed, Score, TrueObject, score};
pub use self::sighting::Sighting;

/// Squared distance up to which a sighting may belong to a prediction, in units of its standard deviation: 99.7 % of them do.
const GATE: f64 = 12.0;
/// A track ends when it was not seen for this long, seconds, and is continued by one that begins up to this much later.
const UNSEEN_SECONDS: f64 = 1.5;
const HIDDEN_SECONDS: f64 = 5.0;
/// What begins a track was seen twice within this time, seconds, not faster than this, metres per second.
const START_SECONDS: f64 = 0.65;
const MAX_SPEED: f64 = 40.0;
/// Two sightings may be farther apart than that speed allows by this much, metres: other parts of an object are seen.
const SLACK_METRES: f64 = 0.5;
/// Their way along a ray of a radar may differ from what its velocity says by this much, metres.
const RADIAL_SLACK_METRES: f64 = 1.5;
/// A track is an object if it was seen this often, at this share of the times, and went this far, metres.
const LEAST_SEEN: usize = 4;
const LEAST_SHARE: f64 = 0.3;
const LEAST_METRES: f64 = 1.5;
/// At least this share of the sightings of an object say that it moves. Otherwise it went this far, metres and standard deviations of its
/// sightings, and at least this share of its way straight on.
const MOVING_SHARE: f64 = 0.3;
/// Sightings of an object lie this near to its smoothed path, root mean square, metres, of narrow objects and of others: chance ones
/// that make a path lie farther off.
const OFF_METRES: [f64; 2] = [0.4, 1.2];
const UNSURE_METRES: f64 = 5.0;
const UNSURE_SIGMAS: f64 = 2.0;
const UNSURE_STRAIGHT: f64 = 0.5;
/// An object stands if it is seen at least this often up to this far away, metres, of narrow objects and of others, so much earlier or
/// later, seconds: one that moves has gone on.
const STANDING_TIMES: usize = 2;
const STANDING_METRES: [f64; 2] = [1.0, 2.0];
const STANDING_SECONDS: Range<f64> = 1.0..4.0;
/// A track continues another if their velocities differ by less than this, metres per second.
const SAME_VELOCITY: f64 = 5.0;
/// The slope of the road is taken over this length, metres, and is no larger than this, radians.
const SLOPE_METRES: f64 = 3.0;
const MAX_SLOPE: f64 = 0.35;
/// Below this speed an object keeps the heading that it had when it was last faster, metres per second.
const HEADING_SPEED: f64 = 0.5;

/// What was seen at a time.
#[derive(Debug, Clone, PartialEq)]
pub struct Moment {
    /// Seconds.
    pub seconds: f64,
    /// In any order.
    pub sightings: Vec<Sighting>,
}

/// An object that moves.
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    /// What it is.
    pub kind: Kind,
    /// Length, width and height of its box, metres.
    pub size: DVec3,
    /// Where the middle of its lower side was, at each moment from the first to the last that it was seen.
    pub path: Vec<TrackPose>,
}

/// Where a track was.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackPose {
    /// Seconds.
    pub seconds: f64,
    /// Ground metres.
    pub place: DVec3,
    /// Radians; 0 along x, to the left is more.
    pub heading: f64,
    /// Radians; uphill is more.
    pub slope: f64,
}

/// A track that is being followed: the moments at which it was seen, and which sighting it was.
#[derive(Debug, Clone)]
struct Followed {
    /// Before the first sighting, at its time.
    first: Belief,
    belief: Belief,
    at: f64,
    seen: Vec<(usize, usize)>,
    /// What it was seen to be last.
    kind: Option<Kind>,
}

/// The objects of these moments, which are in the order of time. `ground` is the height of the ground, where it is known. People and
/// cycles are only taken for such if photos show them, where `has_photos` says that somebody looked at photos.
pub fn tracks(moments: &[Moment], has_photos: bool, ground: &dyn Fn(DVec2) -> Option<f64>) -> Vec<Track> {
    let moments = &without_standing(moments);
    let followed = joined(moments, followed(moments));
    let mut found: Vec<Track> = followed.iter().filter_map(|of| finished(moments, of, has_photos, ground)).collect();
    found.sort_by(|a, b| a.path[0].seconds.total_cmp(&b.path[0].seconds));
    found
}

/// The moments without what stands: an object that only photos show, and that they show at the same place at other times.
fn without_standing(moments: &[Moment]) -> Vec<Moment> {
    let is_open = |of: &&Sighting| !of.moves && of.kind.is_some();
    let stands = |at: usize, of: &Sighting| {
        let near = STANDING_METRES[usize::from(!of.kind.is_some_and(Kind::is_narrow))];
        let from = moments.partition_point(|other| other.seconds < moments[at].seconds - STANDING_SECONDS.end);
        let to = moments.partition_point(|other| other.seconds <= moments[at].seconds + STANDING_SECONDS.end);
        let others = moments[from..to].iter().filter(|other| {
            let apart = (other.seconds - moments[at].seconds).abs();
            let mut same = other.sightings.iter().filter(is_open).filter(|other| may_be_same(other.kind, of.kind));
            apart >= STANDING_SECONDS.start && same.any(|other| other.middle().distance(of.middle()) <= near)
        });
        others.count() >= STANDING_TIMES
    };
    let kept = |(at, moment): (usize, &Moment)| Moment {
        seconds: moment.seconds,
        sightings: moment.sightings.iter().filter(|of| !(is_open(of) && stands(at, of))).cloned().collect(),
    };
    moments.iter().enumerate().map(kept).collect()
}

/// Follows objects from moment to moment.
fn followed(moments: &[Moment]) -> Vec<Followed> {
    let (mut live, mut ended): (Vec<Followed>, Vec<Followed>) = (Vec::new(), Vec::new());
    // Sightings without a track, by moment.
    let mut left: Vec<(usize, usize)> = Vec::new();
    for (now, moment) in moments.iter().enumerate() {
        let last_seen = |of: &Followed| of.seen.last().map_or(f64::NEG_INFINITY, |&(at, _)| moments[at].seconds);
        let (gone, still): (Vec<_>, Vec<_>) =
            live.into_iter().partition(|of| moment.seconds - last_seen(of) > UNSEEN_SECONDS);
        (live, ended) = (still, [ended, gone].concat());
        for of in &mut live {
            of.belief = of.belief.predicted(moment.seconds - of.at);
            of.at = moment.seconds;
        }
        let sightings = &moment.sightings;
        let partners = assigned(live.len(), sightings.len(), GATE, |of, to| {
            let may_be = may_be_same(live[of].kind, sightings[to].kind);
            if may_be { live[of].belief.distance(&sightings[to].place) } else { f64::INFINITY }
        });
        let mut is_taken = vec![false; sightings.len()];
        for (of, partner) in live.iter_mut().zip(&partners) {
            if let Some(to) = *partner {
                of.belief = of.belief.updated(&sightings[to].place);
                of.seen.push((now, to));
                of.kind = sightings[to].kind.or(of.kind);
                is_taken[to] = true;
            }
        }
        left.retain(|&(at, _)| moment.seconds - moments[at].seconds <= START_SECONDS);
        let free: Vec<usize> = (0..sightings.len()).filter(|&to| !is_taken[to]).collect();
        let pairs = assigned(free.len(), left.len(), MAX_SPEED * START_SECONDS + SLACK_METRES, |of, to| {
            let (at, which) = left[to];
            let before = &moments[at].sightings[which];
            let apart = sightings[free[of]].place.middle.distance(before.place.middle);
            let seconds = moment.seconds - moments[at].seconds;
            let kinds = [sightings[free[of]].kind, before.kind];
            let may_move = [&sightings[free[of]], before].iter().all(|of| of.moves || of.kind.is_some());
            let fastest = kinds.iter().flatten().map(|kind| kind.max_speed()).fold(MAX_SPEED, f64::min);
            let is_near = seconds > 0.0 && apart <= fastest * seconds + SLACK_METRES;
            let is_as_fast = [&sightings[free[of]], before].iter().all(|seen| {
                let way = sightings[free[of]].place.middle - before.place.middle;
                let off = |radial: Radial| (way.dot(radial.away) - radial.speed * seconds).abs();
                seen.place.radial.is_none_or(|radial| off(radial) <= RADIAL_SLACK_METRES)
            });
            if may_move && is_near && is_as_fast && may_be_same(kinds[0], kinds[1]) { apart } else { f64::INFINITY }
        });
        let mut is_used = vec![false; left.len()];
        let mut rest = Vec::new();
        for (&to, pair) in free.iter().zip(&pairs) {
            let Some(pair) = *pair else {
                rest.push((now, to));
                continue;
            };
            is_used[pair] = true;
            let (at, which) = left[pair];
            let (before, place) = (&moments[at].sightings[which].place, &sightings[to].place);
            let first = Belief::between(before, place, moment.seconds - moments[at].seconds);
            let belief = first.predicted(moment.seconds - moments[at].seconds).updated(place);
            let kind = sightings[to].kind.or(moments[at].sightings[which].kind);
            live.push(Followed { first, belief, at: moment.seconds, seen: vec![(at, which), (now, to)], kind });
        }
        let mut used = is_used.iter();
        left.retain(|_| used.next() == Some(&false));
        left.extend(rest);
    }
    [ended, live].concat()
}

/// Whether two sightings may be of one object: a van may be taken for a lorry, but not for a person.
fn may_be_same(a: Option<Kind>, b: Option<Kind>) -> bool {
    a.zip(b).is_none_or(|(a, b)| a.is_narrow() == b.is_narrow())
}

/// Joins tracks whose end and beginning are the same object, hidden in between: nearest ones first.
fn joined(moments: &[Moment], mut followed: Vec<Followed>) -> Vec<Followed> {
    followed.retain(|of| of.seen.len() >= LEAST_SEEN);
    let ends = |of: &Followed| (of.seen[0], of.seen[of.seen.len() - 1]);
    let seconds = |(at, _): (usize, usize)| moments[at].seconds;
    let mut pairs = Vec::new();
    for (i, a) in followed.iter().enumerate() {
        // Its belief when it was last seen.
        let (mut belief, mut at) = (a.first.clone(), seconds(ends(a).0));
        for &(now, which) in &a.seen {
            belief = belief.predicted(moments[now].seconds - at).updated(&moments[now].sightings[which].place);
            at = moments[now].seconds;
        }
        for (j, b) in followed.iter().enumerate() {
            let begins = seconds(ends(b).0);
            if i == j || begins <= at || begins - at > HIDDEN_SECONDS || !may_be_same(a.kind, b.kind) {
                continue;
            }
            let later = belief.predicted(begins - at);
            let (now, which) = ends(b).0;
            let distance = later.distance(&moments[now].sightings[which].place);
            if distance <= GATE && later.velocity().distance(b.first.velocity()) <= SAME_VELOCITY {
                pairs.push((distance, i, j));
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

/// The path of a track, if it is an object that moves.
fn finished(
    moments: &[Moment],
    of: &Followed,
    has_photos: bool,
    ground: &dyn Fn(DVec2) -> Option<f64>,
) -> Option<Track> {
    let (from, to) = (of.seen[0].0, of.seen[of.seen.len() - 1].0);
    let sighting = |&(at, which): &(usize, usize)| &moments[at].sightings[which];
    let moving = of.seen.iter().filter(|seen| sighting(seen).moves).count();
    let is_seen = of.seen.len() as f64 >= LEAST_SHARE * (to - from + 1) as f64;
    if of.seen.len() < LEAST_SEEN || !is_seen {
        return None;
    }
    let smooth = |place: &dyn Fn(usize, &Sighting) -> Place| {
        let mut seen = of.seen.iter().peekable();
        let at = (from..=to).map(|now| {
            let here = seen.next_if(|(at, _)| *at == now);
            (moments[now].seconds, here.map(|here| place(now, sighting(here))))
        });
        with_headings(smoothed(&of.first, &at.collect::<Vec<_>>()))
    };
    let rough = smooth(&|_, sighting| sighting.place);
    let shown: Vec<(&Sighting, Motion)> = of.seen.iter().map(|seen| (sighting(seen), rough[seen.0 - from])).collect();
    let known = most(of.seen.iter().filter_map(|seen| sighting(seen).kind));
    let (kind, size) = shape::shape(shape::sides(&shown), known)?;
    if has_photos && known.is_none() && kind.is_narrow() {
        return None;
    }
    let laid = |now: usize, sighting: &Sighting| shape::place(sighting, rough[now - from].heading, size);
    let motions = smooth(&laid);
    if of.seen.iter().any(|seen| sighting(seen).moves) {
        let square =
            |seen: &(usize, usize)| laid(seen.0, sighting(seen)).middle.distance_squared(motions[seen.0 - from].middle);
        let off = (of.seen.iter().map(square).sum::<f64>() / of.seen.len() as f64).sqrt();
        if off > OFF_METRES[usize::from(!kind.is_narrow())] {
            return None;
        }
    }
    let fast = motions.iter().filter(|motion| motion.speed > kind.max_speed()).count();
    if 2 * fast > motions.len() {
        return None;
    }
    let way: f64 = motions.windows(2).map(|pair| pair[0].middle.distance(pair[1].middle)).sum();
    let far = motions.iter().map(|at| at.middle.distance(motions[0].middle)).fold(0.0, f64::max);
    let sigma = (of.seen.iter().map(|seen| sighting(seen).place.variance()).sum::<f64>() / of.seen.len() as f64).sqrt();
    let was_seen_to_move = moving as f64 >= MOVING_SHARE * of.seen.len() as f64;
    let is_sure = if was_seen_to_move {
        far >= LEAST_METRES
    } else {
        far >= UNSURE_METRES.max(UNSURE_SIGMAS * sigma) && far >= UNSURE_STRAIGHT * way
    };
    if !is_sure {
        return None;
    }
    // The ground where it was seen says where it is not known otherwise.
    let beside = |now: usize| {
        let nearest = of.seen.iter().min_by_key(|(at, _)| at.abs_diff(now));
        nearest.map_or(0.0, |seen| sighting(seen).ground)
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
    let path = (from..).zip(&motions).map(pose).collect();
    Some(Track { kind, size, path })
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
