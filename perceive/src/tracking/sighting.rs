//! Where something was seen.

use glam::{DVec2, DVec3};

use super::filter::Place;
use super::kinds::Kind;

/// Something that may be a moving object, at a time. Lengths are metres, in ground axes: z is up.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    pub(crate) place: Place,
    /// Points of its surface; none if they are not known.
    pub(crate) points: Vec<DVec3>,
    /// Where it was seen from.
    pub(crate) sensor: DVec2,
    /// Height of the ground under it.
    pub(crate) ground: f64,
    /// Whether it was seen to move.
    pub(crate) moves: bool,
    /// What it is, if a photo says so.
    pub(crate) kind: Option<Kind>,
}

impl Sighting {
    /// Whether it goes no faster than such objects do.
    pub(crate) fn may_be(&self, kind: Kind) -> bool {
        self.place.radial.is_none_or(|radial| radial.speed.abs() <= kind.max_speed())
    }

    /// The middle of what was seen, metres.
    pub fn middle(&self) -> DVec2 {
        self.place.middle
    }
}
