//! A sample: what nuScenes calls the readings of one place.

use city::sense::Shot;

use super::super::lidar_turn::LidarTurn;
use super::super::shots::Station;
use super::tables::token;

/// A place of a drive with its readings.
pub(crate) struct Sample<'a> {
    pub(crate) station: &'a Station,
    pub(crate) photos: Vec<&'a Shot>,
    pub(crate) turn: Option<&'a LidarTurn>,
}

impl Sample<'_> {
    pub(super) fn token(&self) -> String {
        token(&["sample", &self.station.name])
    }

    pub(crate) fn microseconds(&self) -> i64 {
        (self.station.seconds * 1e6).round() as i64
    }
}
