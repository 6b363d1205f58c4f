//! Sweeps of the Waymo Open Dataset: range images in a table, with the vehicle's pose at each of their pixels in another one.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use scene::waymo::{self, PIXEL_POSES, RANGES, WaymoLaser, WaymoReturn};
use scene::{BadInput, Rigid};

use super::Return;
use crate::tables;

/// Where a range image lies, and how it was measured.
#[derive(Debug, Clone, PartialEq)]
pub struct RangeImage {
    /// Its row.
    pub row: u64,
    /// Numbers of values of all rows.
    pub lengths: Arc<[u32]>,
    /// Height, width, 4.
    pub shape: [u32; 3],
    /// Its laser.
    pub laser: WaymoLaser,
    /// The table of poses, the row, and the numbers of values of all rows. `None` if the vehicle's pose is that of the frame.
    pub poses: Option<(PathBuf, u64, Arc<[u32]>)>,
    /// The vehicle's pose of the frame.
    pub world_from_vehicle: Rigid,
}

impl RangeImage {
    /// The returns, from the table of range images.
    ///
    /// # Errors
    /// A table that cannot be read or is damaged.
    pub(super) fn read(&self, path: &Path) -> Result<Vec<Return>, BadInput> {
        let list = |path: &Path, column, row, lengths| {
            tables::open(path)?.list(column, row, lengths).map_err(|e| tables::bad(path, &e))
        };
        let ranges = list(path, RANGES, self.row, &self.lengths)?;
        let poses =
            self.poses.as_ref().map(|(path, row, lengths)| list(path, PIXEL_POSES, *row, lengths)).transpose()?;
        let found = waymo::returns(&ranges, self.shape, &self.laser, poses.as_deref(), &self.world_from_vehicle);
        let found = found.map_err(|e| tables::bad(path, &e))?;
        Ok(found.into_iter().map(|WaymoReturn { place, range, .. }| Return { place, range }).collect())
    }
}
