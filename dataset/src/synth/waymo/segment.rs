//! A segment: a drive, frame by frame.

use std::path::Path;

use city::Waypoint;
use scene::Rigid;

use super::super::nuscenes::Sample;

/// The folder below the capture.
pub(super) const FOLDER: &str = "waymo";

/// When the city's clock begins: all times have the same number of digits then, as the data set's have.
pub(super) const START_SECONDS: i64 = 1_500_000_000;

/// A place of a drive with the vehicle's true pose.
pub(super) struct Frame<'a> {
    pub(super) sample: Sample<'a>,
    pub(super) world_from_vehicle: Rigid,
}

impl Frame<'_> {
    /// Its time, microseconds.
    pub(super) fn time(&self) -> i64 {
        START_SECONDS * 1_000_000 + self.sample.microseconds()
    }
}

/// A drive.
pub(super) struct Segment<'a> {
    pub(super) out: &'a Path,
    pub(super) name: String,
    pub(super) leg: &'a [Waypoint],
    pub(super) frames: Vec<Frame<'a>>,
}
