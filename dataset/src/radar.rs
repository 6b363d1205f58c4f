//! Radar sweeps of a capture. They say where the road is in photos that do not: dark, in fog, or without texture (Street Detection
//! Gaussians, section 3.4). Photos get target depths there ([`crate::ingest`]), and training gets initial points.
//!
//! `radar/NAME.csv` has a line of column names and a line per detection:
//!
//! | column | value |
//! |---|---|
//! | `range` | metres |
//! | `azimuth` | radians to the left of the sensor's x axis |
//! | `velocity` | radial, relative to the sensor, metres per second, positive away from it |
//!
//! Other columns are ignored.

pub(crate) mod road;

pub use self::road::RoadStrip;

use std::fs::File;
use std::io::Read;
use std::path::PathBuf;

use glam::DVec3;
use scene::{BadInput, Rigid};

/// The largest file of a sweep.
const MAX_FILE_BYTES: u64 = 16 << 20;
/// Most detections of a sweep.
const MAX_DETECTIONS: usize = 100_000;
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

/// A detection of a radar.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Detection {
    /// Metres.
    pub(crate) range: f64,
    /// Unit vector in the sensor's horizontal plane.
    pub(crate) direction: DVec3,
    /// Radial velocity relative to the sensor, metres per second.
    pub(crate) velocity: f64,
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
        let found = detections(&bytes).map_err(bad)?;
        match self.readings.filter(|readings| *readings != found.len() as u64) {
            Some(readings) => Err(bad(format!("has {} detections, and the capture says {readings}", found.len()))),
            None => Ok(found.into_iter().filter(|of| RANGE_METRES.contains(&of.range)).collect()),
        }
    }
}

/// Parses a table of detections; says what is wrong with it.
fn detections(bytes: &[u8]) -> Result<Vec<Detection>, String> {
    let text = std::str::from_utf8(bytes).map_err(|_| "is not UTF-8 text".to_owned())?;
    let mut lines = (1..).zip(text.lines()).filter(|(_, line)| !line.trim().is_empty());
    let (_, head) = lines.next().ok_or("has no line of column names")?;
    let head: Vec<&str> = head.split(',').map(str::trim).collect();
    let column = |name: &str| head.iter().position(|of| *of == name).ok_or_else(|| format!("has no column {name}"));
    let columns = [column("range")?, column("azimuth")?, column("velocity")?];
    let mut found = Vec::new();
    for (number, line) in lines {
        if found.len() == MAX_DETECTIONS {
            return Err(format!("has over {MAX_DETECTIONS} detections"));
        }
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        let mut values = [0.0f64; 3];
        for (value, column) in values.iter_mut().zip(columns) {
            let cell = cells.get(column).ok_or_else(|| format!("has too few columns in line {number}"))?;
            let number_in = cell.parse().ok().filter(|v: &f64| v.is_finite());
            *value = number_in.ok_or_else(|| format!("has no number in line {number}, column {}", head[column]))?;
        }
        let [range, azimuth, velocity] = values;
        let (sine, cosine) = azimuth.sin_cos();
        found.push(Detection { range, direction: DVec3::new(cosine, sine, 0.0), velocity });
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_found_by_name() {
        let table = "power, velocity ,azimuth,range\n9,-10,0,20\n\n8,0.5,1.5707963267948966,3\n";
        let found = detections(table.as_bytes()).unwrap();
        assert_eq!((found.len(), found[0].range, found[0].velocity), (2, 20.0, -10.0));
        assert!((found[1].direction - DVec3::Y).length() < 1e-12 && found[0].direction == DVec3::X);
    }

    #[test]
    fn tables_that_are_none_are_refused() {
        let long = format!("range,azimuth,velocity\n{}", "1,0,0\n".repeat(MAX_DETECTIONS + 1));
        for (table, problem) in [
            ("", "has no line of column names"),
            ("range,azimuth\n1,2\n", "has no column velocity"),
            ("range,azimuth,velocity\n1,2\n", "has too few columns in line 2"),
            ("range,azimuth,velocity\n\n1,NaN,2\n", "has no number in line 3, column azimuth"),
            ("range,azimuth,velocity\n1,0,inf\n", "has no number in line 2, column velocity"),
            (&long, "has over 100000 detections"),
        ] {
            assert_eq!(detections(table.as_bytes()).unwrap_err(), problem);
        }
        assert!(detections(b"range,\xff").is_err());
    }
}
