//! Occupancy as NumPy's `.npz`: an archive of arrays.

use std::io::{Cursor, Write};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use city::City;
use city::occupancy::{Grid, GridError, Voxels, voxelize};
use glam::{DMat4, DQuat, DVec3};
use rayon::prelude::*;
use scene::{BadInput, Rigid, npy};
use serde::Serialize;
use store::file::{SaveError, save};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipWriter};

use super::{Progress, SynthError, impossible, make};

/// A place of which voxels are asked for.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Around {
    /// World metres.
    pub place: DVec3,
    /// Half of the side of the cube that is filled, metres.
    pub radius: f64,
    /// Which way the cube's x axis points, degrees from east towards north.
    pub heading_degrees: f64,
    /// The city's clock: where things that move are.
    pub seconds: f64,
}

impl Around {
    /// The cube in its own axes.
    ///
    /// # Errors
    /// A place out of this world, or more voxels than a grid may have.
    pub(super) fn grid(&self, voxel: f64) -> Result<Grid, BadInput> {
        let refuse = |problem: String| BadInput::new("rehearsal", problem, "choose another place, radius or voxel");
        if !(self.radius > 0.0 && self.heading_degrees.is_finite() && self.seconds.abs() <= 1e9) {
            return Err(refuse("a place to fill with voxels is out of range".into()));
        }
        let rotation = DQuat::from_rotation_z(self.heading_degrees.to_radians());
        let half = DVec3::splat(self.radius);
        Grid::new(Rigid { rotation, translation: self.place }, -half, half, voxel)
            .map_err(|e| refuse(format!("voxels around a place: {e}")))
    }
}

/// Side of a block, metres.
const BLOCK: f64 = 64.0;
/// Pixels^3, so to say: voxels that are in the making at once.
const VOXELS_AT_ONCE: f64 = 2e8;

/// Writes the whole city in blocks, `occupancy/X_Y.npz` where X and Y count blocks from the south-west: semantic (u8),
/// instance (u32), each by z, y, x; origin (f64, the lowest corner), voxel (f64, its side), both metres; world_from_grid
/// (f64, 4 × 4): here the identity.
pub(super) fn blocks(out: &Path, city: &City, voxel: f64, progress: Progress) -> Result<(), SynthError> {
    let folder = out.join("occupancy");
    make(&folder)?;
    let side = (city.extent_metres / BLOCK).ceil().max(1.0) as usize;
    let (low, high) = heights(city);
    let corner = |i: usize| -0.5 * city.extent_metres + i as f64 * BLOCK;
    let done = AtomicUsize::new(0);
    let one = |&(x, y): &(usize, usize)| -> Result<(), SynthError> {
        let from = DVec3::new(corner(x), corner(y), low);
        let grid = Grid::world_aligned(from, DVec3::new(corner(x + 1), corner(y + 1), high), voxel);
        let filled = grid.and_then(|grid| voxelize(city, 0.0, &grid)).map_err(|e: GridError| impossible(&e))?;
        let path = folder.join(format!("{x:03}_{y:03}.npz"));
        put(&path, &filled)?;
        progress("voxels", done.fetch_add(1, Ordering::Relaxed) + 1, side * side);
        Ok(())
    };
    let all: Vec<(usize, usize)> = (0..side).flat_map(|y| (0..side).map(move |x| (x, y))).collect();
    let of_one = (BLOCK / voxel).powi(2) * ((high - low) / voxel);
    let chunk = ((VOXELS_AT_ONCE / of_one) as usize).clamp(1, 2 * rayon::current_num_threads());
    for chunk in all.chunks(chunk) {
        let written: Vec<_> = chunk.par_iter().map(one).collect();
        written.into_iter().collect::<Result<(), _>>()?;
    }
    Ok(())
}

/// Writes the voxels around each place, `occupancy/around_N.npz` in the order of the places: as blocks, and
/// world_from_grid (f64, 4 × 4), in whose axes the origin is.
pub(super) fn around(out: &Path, city: &City, voxel: f64, places: &[Around]) -> Result<(), SynthError> {
    let folder = out.join("occupancy");
    make(&folder)?;
    for (i, place) in places.iter().enumerate() {
        let filled = voxelize(city, place.seconds, &place.grid(voxel)?).map_err(|e| impossible(&e))?;
        put(&folder.join(format!("around_{i:03}.npz")), &filled)?;
    }
    Ok(())
}

fn put(path: &Path, filled: &Voxels) -> Result<(), SaveError> {
    let bytes = pack(filled).map_err(|e| SaveError::new(path, &e))?;
    save(path, &bytes)
}

/// Below and above everything that stands: whole metres, so that blocks fit each other.
fn heights(city: &City) -> (f64, f64) {
    let of_actor = |actor: &city::Actor| {
        let mesh = city.assets.get(actor.asset as usize).map(|asset| &asset.mesh);
        let place = |p: &glam::Vec3| actor.world_from_asset.apply(p.as_dvec3());
        let half = 0.5 * city.extent_metres;
        let inside = |p: &DVec3| p.truncate().abs().max_element() <= half;
        let ends = mesh.into_iter().flat_map(|mesh| &mesh.positions).map(place).filter(inside).map(|p| p.z);
        ends.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), z| (low.min(z), high.max(z)))
    };
    let all = city.actors.par_iter().map(of_actor);
    let (low, high) = all.reduce(|| (0.0, 0.0), |a, b| (a.0.min(b.0), a.1.max(b.1)));
    (low.floor(), high.ceil() + 1.0)
}

/// The archive: the same voxels give the same bytes, as it has no dates.
fn pack(filled: &Voxels) -> zip::result::ZipResult<Vec<u8>> {
    let grid = &filled.grid;
    let shape = [grid.size.z, grid.size.y, grid.size.x].map(|n| n as usize);
    let pose = DMat4::from_rotation_translation(grid.world_from_grid.rotation, grid.world_from_grid.translation);
    let rows = pose.transpose().to_cols_array();
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Deflated)
        .last_modified_time(DateTime::default());
    for (name, bytes) in [
        ("semantic.npy", npy::write(&shape, &filled.semantic)),
        ("instance.npy", npy::write(&shape, &filled.instance)),
        ("origin.npy", npy::write(&[3], &grid.low.to_array())),
        ("voxel.npy", npy::write(&[], &[grid.voxel_metres])),
        ("world_from_grid.npy", npy::write(&[4, 4], &rows)),
    ] {
        archive.start_file(name, options)?;
        archive.write_all(&bytes)?;
    }
    Ok(archive.finish()?.into_inner())
}
