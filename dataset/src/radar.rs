//! Radar sweeps of a capture. They say where the road is in photos that do not: dark, in fog, or without texture (Street Detection
//! Gaussians, section 3.4). Photos get target depths there ([`crate::ingest`]), and training gets initial points.

pub(crate) mod road;

pub(crate) use self::road::MovingEcho;
pub use self::road::RoadStrip;

use std::fs::File;
use std::io::Read;
use std::path::PathBuf;

use glam::DVec3;
use scene::radar::{Detection, read_detections};
use scene::{BadInput, Rigid};

/// The largest file of a sweep.
const MAX_FILE_BYTES: u64 = 16 << 20;
/// Ranges that are used, metres.
const RANGE_METRES: std::ops::Range<f64> = 1.0..200.0;

/// One sweep of a radar.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct RadarSweep {
    /// Canonical path of its detections, inside the capture.
    pub(crate) path: PathBuf,
    /// The number of detections that the capture announces, if it does.
    pub(crate) readings: Option<u64>,
    /// Pose of the sensor: x ahead, y left, z up.
    pub(crate) world_from_sensor: Rigid,
    /// World metres per second.
    pub(crate) velocity: DVec3,
    /// Height of the sensor above the road, metres.
    pub(crate) height: f64,
    /// Indices of the views taken at its time, ascending.
    pub(crate) views: Vec<u32>,
}

impl RadarSweep {
    /// The detections within the range that is used.
    ///
    /// # Errors
    /// A file that cannot be read, is too large, lacks a column, or has a value that is not a finite number.
    pub(crate) fn read(&self) -> Result<Vec<Detection>, BadInput> {
        let bad = |problem: String| {
            let advice = "download the sweep again, or remove the folder radar";
            BadInput::new(self.path.display().to_string(), problem, advice)
        };
        let file = File::open(&self.path).map_err(|e| bad(format!("cannot be read ({e})")))?;
        let mut bytes = Vec::new();
        file.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes).map_err(|e| bad(format!("cannot be read ({e})")))?;
        if bytes.len() as u64 > MAX_FILE_BYTES {
            return Err(bad(format!("is larger than {} MB, too large for a sweep", MAX_FILE_BYTES >> 20)));
        }
        let found = read_detections(&bytes).map_err(|e| bad(e.to_string()))?;
        match self.readings.filter(|readings| *readings != found.len() as u64) {
            Some(readings) => Err(bad(format!("has {} detections, and the capture says {readings}", found.len()))),
            None => Ok(found.into_iter().filter(|of| RANGE_METRES.contains(&of.range)).collect()),
        }
    }
}
