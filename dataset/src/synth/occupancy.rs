//! Writes occupancy grids as NumPy's `.npz`, a zip archive of arrays.

use std::io::{Cursor, Write};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use city::City;
use city::occupancy::{Grid, GridError, Voxels, voxelize};
use glam::{DMat4, DVec3};
use rayon::prelude::*;
use scene::npy;
use store::file::{SaveError, save};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipWriter};

use super::output::create_folder;
use super::settings::{Progress, SynthError, VoxelRegion, unsupported};

/// Side of a block, metres.
const BLOCK_METRES: f64 = 64.0;
/// Maximum of voxels computed concurrently.
const MAX_VOXELS_IN_FLIGHT: f64 = 2e8;

/// Writes the whole city in blocks, `occupancy/X_Y.npz`, where X and Y count blocks from the south-west. Arrays: `semantic` (u8)
/// and `instance` (u32), each `[z, y, x]`; `origin` (f64, the lowest corner) and `voxel` (f64, its side), metres;
/// `world_from_grid` (f64, 4 × 4), here the identity.
pub(super) fn write_blocks(out: &Path, city: &City, voxel: f64, progress: Progress) -> Result<(), SynthError> {
    let folder = out.join("occupancy");
    create_folder(&folder)?;
    let side = (city.extent_metres / BLOCK_METRES).ceil().max(1.0) as usize;
    let (low, high) = heights(city);
    let corner = |i: usize| -0.5 * city.extent_metres + i as f64 * BLOCK_METRES;
    let done = AtomicUsize::new(0);
    let one = |&(x, y): &(usize, usize)| -> Result<(), SynthError> {
        let from = DVec3::new(corner(x), corner(y), low);
        let grid = Grid::world_aligned(from, DVec3::new(corner(x + 1), corner(y + 1), high), voxel);
        let filled = grid.and_then(|grid| voxelize(city, 0.0, &grid)).map_err(|e: GridError| unsupported(&e))?;
        let path = folder.join(format!("{x:03}_{y:03}.npz"));
        write(&path, &filled)?;
        progress("voxels", done.fetch_add(1, Ordering::Relaxed) + 1, side * side);
        Ok(())
    };
    let all: Vec<(usize, usize)> = (0..side).flat_map(|y| (0..side).map(move |x| (x, y))).collect();
    let voxels_per_block = (BLOCK_METRES / voxel).powi(2) * ((high - low) / voxel);
    let chunk = ((MAX_VOXELS_IN_FLIGHT / voxels_per_block) as usize).clamp(1, 2 * rayon::current_num_threads());
    for chunk in all.chunks(chunk) {
        let written: Vec<_> = chunk.par_iter().map(one).collect();
        written.into_iter().collect::<Result<(), _>>()?;
    }
    Ok(())
}

/// Writes the voxels of each region, `occupancy/around_N.npz` in the order of the regions. Arrays as in [`write_blocks`]; `origin` is
/// in the axes of the grid.
pub(super) fn write_regions(out: &Path, city: &City, voxel: f64, regions: &[VoxelRegion]) -> Result<(), SynthError> {
    let folder = out.join("occupancy");
    create_folder(&folder)?;
    for (i, region) in regions.iter().enumerate() {
        let filled = voxelize(city, region.seconds, &region.grid(voxel)?).map_err(|e| unsupported(&e))?;
        write(&folder.join(format!("around_{i:03}.npz")), &filled)?;
    }
    Ok(())
}

fn write(path: &Path, filled: &Voxels) -> Result<(), SaveError> {
    let bytes = pack(filled).map_err(|e| SaveError::new(path, &e))?;
    save(path, &bytes)
}

/// Lowest and highest vertex inside the city, rounded outwards to whole metres so that blocks share their heights.
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

/// The archive. Its entries have a fixed date, so that equal voxels give equal bytes.
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
