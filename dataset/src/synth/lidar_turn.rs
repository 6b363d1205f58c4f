//! What is kept of a sweep for the formats that list it.

use std::collections::BTreeMap;

use scene::Rigid;

/// A turn of a car's lidar.
pub(super) struct LidarTurn {
    /// World from the sensor at the middle of the turn: x ahead, y left, z up.
    pub(super) pose: Rigid,
    /// Number of returns by instance.
    pub(super) hits: BTreeMap<u32, u32>,
}
