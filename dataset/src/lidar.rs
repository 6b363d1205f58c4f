//! Lidar sweeps of a capture.
//!
//! Training uses them twice. Each photo gets target depths from the sweeps taken at its time ([`crate::ingest`]), and the
//! sweeps of the whole capture, thinned, are initial points ([`seeds`]).

mod npz;
mod occlusion;
mod range_image;
pub(crate) mod seeds;

use std::fs::File;
use std::io::Read;
use std::path::PathBuf;

use glam::DVec3;
use scene::lidar::{Turn, read_points};
use scene::{BadInput, Rigid};

pub(crate) use self::occlusion::{Seen, visible};
pub use self::range_image::RangeImage;

/// The largest file of a sweep: ten times a turn of a scanner with 128 beams.
const MAX_FILE_BYTES: u64 = 64 << 20;
/// Ranges that are used, metres. Nearer points lie on the vehicle, and farther ones are sparse.
const RANGE_METRES: std::ops::Range<f64> = 2.0..120.0;

/// One turn of a lidar.
#[derive(Debug, Clone, PartialEq)]
pub struct Sweep {
    /// Canonical path of its points, inside the capture.
    pub path: PathBuf,
    /// How the file holds them.
    pub format: PointFormat,
    /// The number of points that the capture announces, if it does.
    pub readings: Option<u64>,
    /// Pose at the middle of the sweep.
    pub world_from_sensor: Rigid,
    /// The sensor's motion, if points have to be corrected for it.
    pub turn: Option<Turn>,
    /// Indices of the views taken during the sweep, ascending: it gives them target depths.
    pub views: Vec<u32>,
}

/// How a file holds the points of a sweep.
#[derive(Debug, Clone, PartialEq)]
pub enum PointFormat {
    /// This many f32 a point, of which the first three are x, y and z (KITTI: 4, nuScenes: 5).
    Floats(usize),
    /// The array `data` of an npz file, or its first one: a row a point, of which the first three columns are x, y and z (DGP).
    Npz,
    /// A range image in a table (Waymo).
    RangeImage(Box<RangeImage>),
}

/// A return of the lidar.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Return {
    /// World metres.
    pub(crate) place: DVec3,
    /// Distance from the sensor, metres.
    pub(crate) range: f32,
}

/// What initial points come from.
pub(crate) trait Scan: Sync {
    /// Where the sensor was, world metres.
    fn origin(&self) -> DVec3;
    /// The views taken at its time, ascending.
    fn views(&self) -> &[u32];
    /// What it measured.
    ///
    /// # Errors
    /// A file that cannot be used.
    fn returns(&self) -> Result<Vec<Return>, BadInput>;
}

impl Scan for Sweep {
    fn origin(&self) -> DVec3 {
        self.world_from_sensor.translation
    }

    fn views(&self) -> &[u32] {
        &self.views
    }

    fn returns(&self) -> Result<Vec<Return>, BadInput> {
        self.read()
    }
}

impl Sweep {
    /// The returns within the range that is used.
    ///
    /// # Errors
    /// A file that cannot be read, is too large, is damaged, or holds another number of points than announced.
    pub(crate) fn read(&self) -> Result<Vec<Return>, BadInput> {
        let bad = |problem: String| BadInput::new(self.path.display().to_string(), problem, "download the sweep again");
        let (bytes, floats) = match &self.format {
            PointFormat::Floats(floats) => (self.bytes(&bad)?, *floats),
            PointFormat::Npz => npz::rows(&self.bytes(&bad)?).map_err(|e| bad(e.to_string()))?,
            PointFormat::RangeImage(image) => {
                let is_used = |found: &Return| RANGE_METRES.contains(&f64::from(found.range));
                return Ok(image.read(&self.path)?.into_iter().filter(is_used).collect());
            }
        };
        let count = (bytes.len() / (4 * floats)) as u64;
        if let Some(readings) = self.readings.filter(|readings| *readings != count) {
            return Err(bad(format!("holds {count} points, and the capture says {readings}")));
        }
        let points = read_points(&bytes, floats).map_err(|e| bad(e.to_string()))?;
        if points.is_empty() && count > 0 {
            return Err(bad(format!("has {count} points, none of which is finite")));
        }
        let place = |point: DVec3| {
            let pose = self.turn.map_or(self.world_from_sensor, |turn| turn.pose(&self.world_from_sensor, point));
            Return { place: pose.apply(point), range: point.length() as f32 }
        };
        let used = points.into_iter().filter(|point| RANGE_METRES.contains(&point.length()));
        Ok(used.map(place).collect())
    }

    /// The bytes of its file; `bad` says what is wrong with it.
    fn bytes(&self, bad: &dyn Fn(String) -> BadInput) -> Result<Vec<u8>, BadInput> {
        let file = File::open(&self.path).map_err(|e| bad(format!("cannot be read ({e})")))?;
        let mut bytes = Vec::new();
        file.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes).map_err(|e| bad(format!("cannot be read ({e})")))?;
        if bytes.len() as u64 > MAX_FILE_BYTES {
            return Err(bad(format!("is larger than {} MB, too large for a sweep", MAX_FILE_BYTES >> 20)));
        }
        Ok(bytes)
    }
}
