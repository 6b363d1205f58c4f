//! A sample: what nuScenes calls the readings of one place.

use city::sense::Shot;

use super::super::lidar_turn::LidarTurn;
use super::super::shots::Station;
use super::tables::token;

/// A place of a drive with its readings.
pub(in crate::synth) struct Sample<'a> {
    pub(in crate::synth) station: &'a Station,
    pub(in crate::synth) photos: Vec<&'a Shot>,
    pub(in crate::synth) turn: Option<&'a LidarTurn>,
}

impl Sample<'_> {
    pub(super) fn token(&self) -> String {
        token(&["sample", &self.station.name])
    }

    pub(in crate::synth) fn microseconds(&self) -> i64 {
        (self.station.seconds * 1e6).round() as i64
    }
}
