//! What was seen at times, and what was found in it.

use glam::DVec3;

use super::kinds::Kind;
use super::sighting::Sighting;
use super::watch::Watch;

/// What was seen at a time.
#[derive(Debug, Clone, PartialEq)]
pub struct Moment {
    /// Seconds.
    pub seconds: f64,
    /// In any order.
    pub sightings: Vec<Sighting>,
    /// What radars watched.
    pub watches: Vec<Watch>,
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
