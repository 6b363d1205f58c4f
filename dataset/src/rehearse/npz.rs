//! Occupancy as NumPy's `.npz`: an archive of arrays.

use std::io::{Cursor, Write};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use city::City;
use city::occupancy::{Grid, GridError, Voxels, voxels};
use glam::DVec3;
use rayon::prelude::*;
use scene::npy;
use store::file::{SaveError, save};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipWriter};

use super::{Progress, RehearseError, impossible, make};

/// Side of a block, metres.
const BLOCK: f64 = 64.0;
/// Pixels^3, so to say: voxels that are in the making at once.
const VOXELS_AT_ONCE: f64 = 2e8;

/// Writes the whole city in blocks, `occupancy/X_Y.npz` where X and Y count blocks from the south-west: semantic (u8),
/// instance (u32), each by z, y, x; origin (f64, the lowest corner), voxel (f64, its side), both metres.
pub(super) fn blocks(out: &Path, city: &City, voxel: f64, progress: Progress) -> Result<(), RehearseError> {
    let folder = out.join("occupancy");
    make(&folder)?;
    let side = (city.extent_metres / BLOCK).ceil().max(1.0) as usize;
    let (low, high) = heights(city);
    let corner = |i: usize| -0.5 * city.extent_metres + i as f64 * BLOCK;
    let done = AtomicUsize::new(0);
    let one = |&(x, y): &(usize, usize)| -> Result<(), RehearseError> {
        let from = DVec3::new(corner(x), corner(y), low);
        let grid = Grid::of_block(from, DVec3::new(corner(x + 1), corner(y + 1), high), voxel);
        let filled = grid.and_then(|grid| voxels(city, 0.0, &grid)).map_err(|e: GridError| impossible(&e))?;
        let path = folder.join(format!("{x:03}_{y:03}.npz"));
        let bytes = pack(&filled).map_err(|e| SaveError::new(&path, &e))?;
        save(&path, &bytes)?;
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
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Deflated)
        .last_modified_time(DateTime::default());
    for (name, bytes) in [
        ("semantic.npy", npy::write(&shape, &filled.semantic)),
        ("instance.npy", npy::write(&shape, &filled.instance)),
        ("origin.npy", npy::write(&[3], &grid.low.to_array())),
        ("voxel.npy", npy::write(&[], &[grid.voxel_metres])),
    ] {
        archive.start_file(name, options)?;
        archive.write_all(&bytes)?;
    }
    Ok(archive.finish()?.into_inner())
}
