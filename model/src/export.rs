//! What the exports of a model share: the folder, the splats of a block, their boxes and their order.

use std::borrow::Cow;
use std::path::Path;

use glam::{Mat3, Quat, Vec3};
use scene::{BadInput, BlockId, CodecError, Splats, column, morton};
use serde::Serialize;

use crate::error::{ModelError, cannot};
use crate::read::Opened;

/// What was written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Exported {
    /// Splats of the finest level, and of the backdrop.
    pub splats: u64,
    /// Levels of detail.
    pub levels: u8,
    /// Files.
    pub files: usize,
    /// Bytes of all files.
    pub bytes: u64,
    /// Whether the splats are rendered anti-aliased.
    pub antialiased: bool,
}

#[derive(Debug, Clone, Copy, Serialize)]
pub(crate) struct Bound {
    pub(crate) min: Vec3,
    pub(crate) max: Vec3,
}

impl Bound {
    pub(crate) const NOTHING: Self = Self { min: Vec3::INFINITY, max: Vec3::NEG_INFINITY };

    pub(crate) fn with(self, other: Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }
}

/// An error unless the folder is new or empty.
pub(crate) fn check_new(out: &Path) -> Result<(), ModelError> {
    let is_used = out.exists() && out.read_dir().map_err(cannot("read", out))?.next().is_some();
    match is_used {
        true => Err(BadInput::new(out.display().to_string(), "is not empty", "give a new folder with --out").into()),
        false => Ok(()),
    }
}

/// The splats of a block, halo included, of the model at `path`; an error if one is not finite.
pub(crate) fn finite_splats<'a>(opened: &'a Opened, block: BlockId, path: &Path) -> Result<Cow<'a, Splats>, BadInput> {
    let splats = opened.splats(block)?;
    match (0..splats.len()).find(|&row| !splats.is_finite(row)) {
        Some(row) => {
            let problem = format!("has numbers that are not finite, in splat {row} of block {block}");
            Err(BadInput::new(path.display().to_string(), problem, "repair the model or train it again"))
        }
        None => Ok(splats),
    }
}

/// The error of a block whose splats a format cannot hold.
pub(crate) fn bad(block: BlockId, error: &CodecError) -> BadInput {
    BadInput::new(format!("block {block}"), error.to_string(), "train it again")
}

/// The box of a splat's ellipsoid of one standard deviation, as other writers of the format take it.
pub(crate) fn extent(splats: &Splats, row: usize) -> Bound {
    let col = |k: usize| splats.col(k)[row];
    let [w, x, y, z] = [0, 1, 2, 3].map(|k| col(column::QUAT + k));
    let turn = Mat3::from_quat(Quat::from_xyzw(x, y, z, w).normalize());
    let size = Vec3::from_array([0, 1, 2].map(|k| col(column::LOG_SCALE + k).exp()));
    let half = turn.x_axis.abs() * size.x + turn.y_axis.abs() * size.y + turn.z_axis.abs() * size.z;
    let mean = splats.mean(row);
    let half = if half.is_finite() { half } else { Vec3::ZERO };
    Bound { min: mean - half, max: mean + half }
}

/// These rows along a Morton curve.
pub(crate) fn in_z_order(splats: &Splats, rows: &[u32]) -> Vec<u32> {
    let columns = [0, 1, 2].map(|axis| rows.iter().map(|&row| splats.col(axis)[row as usize]).collect::<Vec<f32>>());
    let order = morton::order([&columns[0], &columns[1], &columns[2]]);
    order.into_iter().map(|i| rows[i as usize]).collect()
}
