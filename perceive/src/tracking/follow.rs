//! Objects that are followed from moment to moment: sightings are assigned to where they are predicted, and what is left starts new ones.

use super::assignment::assigned;
use super::filter::{Belief, Radial};
use super::kinds::{Kind, may_be_same};
use super::track::Moment;

/// Squared distance up to which a sighting may belong to a prediction, in units of its standard deviation: 99.7 % of them do.
pub(crate) const GATE: f64 = 12.0;
/// What was seen less often is no object.
pub(crate) const LEAST_SEEN: usize = 4;
/// A track ends when it was not seen for this long, seconds.
const UNSEEN_SECONDS: f64 = 1.5;
/// What begins a track was seen twice within this time, seconds, not faster than this, metres per second.
const START_SECONDS: f64 = 0.65;
const MAX_SPEED: f64 = 40.0;
/// Two sightings may be farther apart than that speed allows by this much, metres: other parts of an object are seen.
const SLACK_METRES: f64 = 0.5;
/// Their way along a ray of a radar may differ from what its velocity says by this much, metres.
const RADIAL_SLACK_METRES: f64 = 1.5;

/// A track that is being followed: the moments at which it was seen, and which sighting it was.
#[derive(Debug, Clone)]
pub(crate) struct Followed {
    /// Before the first sighting, at its time.
    pub(crate) first: Belief,
    belief: Belief,
    at: f64,
    pub(crate) seen: Vec<(usize, usize)>,
    /// What it was seen to be last.
    pub(crate) kind: Option<Kind>,
}

impl Followed {
    /// How often it was seen to move.
    pub(crate) fn moved(&self, moments: &[Moment]) -> usize {
        self.seen.iter().filter(|&&(at, which)| moments[at].sightings[which].moves).count()
    }

    /// With what another was seen as at times when this one was not seen.
    pub(crate) fn with(&self, other: &Self) -> Self {
        let mut both = if self.seen[0].0 <= other.seen[0].0 { self.clone() } else { other.clone() };
        let is_new = |(at, _): &&(usize, usize)| self.seen.binary_search_by_key(at, |seen| seen.0).is_err();
        both.seen = self.seen.iter().chain(other.seen.iter().filter(is_new)).copied().collect();
        both.seen.sort_unstable();
        both
    }
}

/// Follows objects from moment to moment.
pub(crate) fn followed(moments: &[Moment]) -> Vec<Followed> {
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
