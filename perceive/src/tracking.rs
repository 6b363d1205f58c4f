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
mod follow;
mod join;
mod kinds;
mod path;
mod score;
mod shape;
mod sighting;
mod track;
mod watch;

use std::ops::Range;

use glam::DVec2;

pub(crate) use self::filter::{Place, Radial};
use self::follow::followed;
use self::join::{joined, without_doubles};
pub use self::kinds::Kind;
use self::kinds::may_be_same;
use self::path::path;
pub use self::score::{Frame, Placed, Score, TrueObject, score};
pub use self::sighting::Sighting;
pub use self::track::{Moment, Track, TrackPose};
pub use self::watch::Watch;

/// An object stands if it is seen at least this often up to this far away, metres, of narrow objects and of others, so much earlier or
/// later, seconds: one that moves has gone on.
const STANDING_TIMES: usize = 2;
const STANDING_METRES: [f64; 2] = [1.0, 2.0];
const STANDING_SECONDS: Range<f64> = 1.0..4.0;

/// The objects of these moments, which are in the order of time. `ground` is the height of the ground, where it is known. People and
/// cycles are only taken for such if photos show them, where `has_photos` says that somebody looked at photos.
pub fn tracks(moments: &[Moment], has_photos: bool, ground: &dyn Fn(DVec2) -> Option<f64>) -> Vec<Track> {
    let moments = &without_standing(moments);
    let followed = joined(moments, followed(moments));
    let mut found = without_doubles(moments, followed, &|of| path(moments, of, has_photos, ground));
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
        watches: moment.watches.clone(),
    };
    moments.iter().enumerate().map(kept).collect()
}
