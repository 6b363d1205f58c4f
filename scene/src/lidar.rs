//! Reads `lidar/poses.jsonl` and `radar/poses.jsonl`, which list the sweeps of a capture's sensors: one JSON object a line.
//!
//! | key | value |
//! |---|---|
//! | `name` | of the file with the readings, without its extension |
//! | `world_from_sensor` | pose: `rotation` (quaternion x, y, z, w) and `translation` (metres) |
//! | `photos` | names of the photos taken during the sweep, without extensions; optional |
//! | `readings` | their number; optional |
//! | `height` | of the sensor above the road, metres; optional |
//! | `turn_seconds`, `velocity`, `spin` | duration of the sweep, clockwise, and the sensor's motion in the world (m/s, rad/s); optional |

use glam::{DQuat, DVec3};
use serde::Deserialize;

use crate::camera::Rigid;
use crate::error::CodecError;

/// The largest number of sweeps of a capture.
const MAX_SWEEPS: usize = 1_000_000;

/// A line of the file.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct SweepPose {
    /// Name of the file with the readings, without its extension.
    pub name: String,
    /// Pose at the middle of the sweep: x ahead, y left, z up.
    pub world_from_sensor: Rigid,
    /// Names of the photos taken during the sweep, without extensions.
    #[serde(default)]
    pub photos: Option<Vec<String>>,
    /// The number of readings.
    #[serde(default)]
    pub readings: Option<u64>,
    /// Height of the sensor above the road, metres.
    #[serde(default)]
    pub height: Option<f64>,
    /// Velocity of the sensor in the world, metres per second.
    #[serde(default)]
    pub velocity: Option<DVec3>,
    #[serde(default)]
    turn_seconds: f64,
    #[serde(default)]
    spin: DVec3,
}

/// The motion of a lidar during a sweep.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turn {
    /// Duration of the sweep: a turn from the rear, so that the middle of the sweep points ahead.
    pub seconds: f64,
    /// Whether it turns clockwise, seen from above.
    pub clockwise: bool,
    /// World metres per second.
    pub velocity: DVec3,
    /// Angular velocity in the world: axis times radians per second.
    pub spin: DVec3,
}

impl Turn {
    /// Seconds from the middle of the sweep to when the sensor measured `point`, which is in its own axes.
    pub fn delay(&self, point: DVec3) -> f64 {
        let turned = point.y.atan2(point.x) / std::f64::consts::TAU * self.seconds;
        if self.clockwise { -turned } else { turned }
    }

    /// The sensor's pose when it measured `point`, which is in its own axes. `middle` is the pose at the middle.
    pub fn pose(&self, middle: &Rigid, point: DVec3) -> Rigid {
        let delay = self.delay(point);
        Rigid {
            rotation: (DQuat::from_scaled_axis(self.spin * delay) * middle.rotation).normalize(),
            translation: middle.translation + self.velocity * delay,
        }
    }
}

impl SweepPose {
    /// The motion, if the file has it.
    pub fn turn(&self) -> Option<Turn> {
        let Self { turn_seconds: seconds, spin, .. } = *self;
        let velocity = self.velocity.unwrap_or_default();
        (seconds > 0.0).then_some(Turn { seconds, clockwise: true, velocity, spin })
    }

    fn check(&self) -> Result<(), &'static str> {
        let motion = [self.velocity.unwrap_or_default(), self.spin];
        match self {
            s if s.name.is_empty() => Err("has an empty name"),
            s if !s.world_from_sensor.is_sane() => Err("has a pose that is not finite or not a rotation"),
            _ if !motion.iter().all(|v| v.is_finite() && v.length() < 1e4) => Err("has a motion out of range"),
            s if !s.height.is_none_or(|height| height > 0.0 && height < 100.0) => Err("has a height out of range"),
            s if !(0.0..=10.0).contains(&s.turn_seconds) => Err("has a turn that takes under 0 or over 10 seconds"),
            _ => Ok(()),
        }
    }
}

/// Reads the file.
///
/// # Errors
/// A line that is not such an object, values out of range, or over a million lines.
pub fn read_poses(bytes: &[u8]) -> Result<Vec<SweepPose>, CodecError> {
    let text = std::str::from_utf8(bytes).map_err(|_| CodecError::new("is not UTF-8 text"))?;
    let mut sweeps = Vec::new();
    for (i, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let wrong = |what: String| CodecError::new(format!("line {} {what}", i + 1));
        let sweep: SweepPose = serde_json::from_str(line).map_err(|e| wrong(format!("is not a sweep ({e})")))?;
        sweep.check().map_err(|what| wrong(what.into()))?;
        if sweeps.len() == MAX_SWEEPS {
            return Err(wrong("is one sweep too many".into()));
        }
        sweeps.push(sweep);
    }
    Ok(sweeps)
}

/// Reads points of `floats` little-endian f32 each, of which the first three are x, y and z in metres (KITTI has four,
/// nuScenes five). Points that are not finite are dropped: scanners report them for pulses without a return.
///
/// # Errors
/// A length that is not a multiple of a point's.
pub fn read_points(bytes: &[u8], floats: usize) -> Result<Vec<DVec3>, CodecError> {
    let size = 4 * floats;
    if !bytes.len().is_multiple_of(size) {
        return Err(CodecError::new(format!("is cut short: its length is not a multiple of {size} bytes")));
    }
    let point = |bytes: &[u8]| {
        let [x, y, z] = [0, 4, 8].map(|at| f32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes")));
        DVec3::new(x.into(), y.into(), z.into())
    };
    Ok(bytes.chunks_exact(size).map(point).filter(|point| point.is_finite()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    const LINE: &str = r#"{"name":"a","seconds":3.0,"readings":2,"photos":["x","y"],"turn_seconds":0.1,
        "velocity":[10,0,0],"spin":[0,0,0],"world_from_sensor":{"rotation":[0,0,0,1],"translation":[1,2,3]}}"#;

    #[test]
    fn poses_are_read_and_points_are_moved_with_the_sensor() {
        let line = LINE.replace('\n', " ");
        let sweeps = read_poses(format!("{line}\n\n{line}\n").as_bytes()).unwrap();
        assert_eq!((sweeps.len(), sweeps[1].readings, sweeps[0].photos.as_ref().unwrap().len()), (2, Some(2), 2));
        let (turn, middle) = (sweeps[0].turn().unwrap(), sweeps[0].world_from_sensor);
        // Ahead at the middle; to the right a quarter of a turn later.
        assert_eq!(turn.pose(&middle, DVec3::X), middle);
        let right = turn.pose(&middle, DVec3::NEG_Y).translation;
        assert!((right - DVec3::new(1.25, 2.0, 3.0)).length() < 1e-12, "{right}");
        let still = line.replace("0.1", "0");
        assert_eq!(read_poses(still.as_bytes()).unwrap()[0].turn(), None);
    }

    #[test]
    fn invalid_lines_are_refused() {
        let line = LINE.replace('\n', " ");
        for (from, to) in [
            ("\"a\"", "\"\""),
            ("[0,0,0,1]", "[0,0,0,2]"),
            ("[1,2,3]", "[1,2,1e999]"),
            ("[10,0,0]", "[1e5,0,0]"),
            ("0.1", "-1"),
            ("0.1", "11"),
            ("{\"name\"", "[\"name\""),
            ("\"name\":\"a\",", ""),
            ("\"readings\":2", "\"readings\":-2"),
        ] {
            let error = read_poses(line.replacen(from, to, 1).as_bytes()).unwrap_err().to_string();
            assert!(error.starts_with("line 1 "), "{to}: {error}");
        }
        assert!(read_poses(b"\xff").is_err() && read_poses(b"").unwrap().is_empty());
    }
}
