//! Writes a synthetic capture: a generated city ([`city`]) is photographed and measured, and the result is written as a capture
//! that any trainer reads, with ground truth beside it.
//!
//! ```text
//! Settings ─shots→ shots ─photos→ photos, masks, ground truth ─sparse→ points with tracks ─cameras→ COLMAP, transforms.json
//!                    └──────── manifest.json: the settings and, once the capture is complete, its contents
//! ```
//! | module | writes |
//! |---|---|
//! | `shots` | nothing: plans the shots of aerial, street and fixed cameras |
//! | `photos` | `images/`, `masks/` |
//! | `ground_truth` | `depth/`, `normals/`, `semantic/`, `instance/`, `material/`, `behind/` |
//! | `sparse` | nothing: computes sparse points with their tracks |
//! | `sweeps` | `lidar/`, `radar/` |
//! | `tracks_and_boxes` | `tracks.json`, `boxes3d.json` |
//! | `nuscenes` | `nuscenes/` |
//! | `kitti_raw` | `kitti_raw/` |
//! | `waymo` | `waymo/` |
//! | `gltf` | `city.glb` |
//! | `occupancy` | `occupancy/` |
//! | `gallery` | nothing: draws an overview of layouts, labels and faults |
//! | `cameras` | `sparse/0/`, `transforms.json`, `sparse_pc.ply`, `reference_lla.json`, `truth/` |
//!
//! The cameras of the capture are the reported ones, with the errors of a real survey; the true ones are in `truth/`. Equal
//! settings give equal bytes for any number of threads.

mod cameras;
mod gallery;
mod gltf;
mod ground_truth;
mod kitti_raw;
mod lidar_turn;
mod manifest;
mod nuscenes;
mod occupancy;
mod output;
mod photos;
mod settings;
mod shots;
mod sparse;
mod sweeps;
mod tracks_and_boxes;
mod waymo;

use std::path::Path;

use city::City;
use city::faults;
use city::sense::watch::nearest_on_street;
use city::trace::World;
use glam::{DVec2, DVec3};
use scene::BadInput;

pub use gallery::gallery;
pub use settings::{CarRig, Driven, Progress, Settings, Summary, SynthError, VoxelRegion, Watched, WatchedPlace};
use settings::{SUBJECT, unsupported};
use shots::PlannedShots;

/// Generates the city and writes its capture into a folder, which has to be new, empty, or from a run with the same settings.
///
/// # Errors
/// Settings out of range, a folder with other contents, or a file that cannot be written.
pub fn write(out: &Path, settings: &Settings, progress: Progress) -> Result<Summary, SynthError> {
    settings.check()?;
    manifest::begin(out, settings)?;
    let mut city = City::generate(&settings.city)?;
    let watched = settings.watched.and_then(|place| watched_place(&mut city, place, settings.city.seed));
    let world = World::new(&city).map_err(|e| unsupported(&e))?;
    let PlannedShots { shots, legs, stations, driven } = shots::plan(&world, settings)?;
    let mut shots = faults::degrade_shots(shots, &settings.faults);
    if shots.is_empty() {
        return Err(BadInput::new(SUBJECT, "has no view left", "ask for more views or milder faults").into());
    }
    shots.sort_by(|a, b| a.name.cmp(&b.name));
    let turns = sweeps::write(out, &world, &legs, &stations, settings, progress)?;
    let rendered = photos::render_all(out, &world, &shots, settings, progress)?;
    let points = sparse::points(&world, &shots, rendered.features, settings.city.seed, progress);
    cameras::write(out, &shots, &points, photos::has_moving_actors(&city))?;
    tracks_and_boxes::write_tracks(out, &city, &shots)?;
    tracks_and_boxes::write_boxes(out, &rendered.boxes)?;
    if settings.nuscenes {
        nuscenes::write(out, &world, &shots, &stations, &turns, settings, progress)?;
    }
    if settings.kitti_raw {
        kitti_raw::write(out, &world, &shots, &legs, &stations, &turns, settings, progress)?;
    }
    if settings.waymo {
        waymo::write(out, &world, &shots, &legs, &stations, &turns, settings, progress)?;
    }
    if settings.mesh {
        gltf::write(out, &city)?;
    }
    if let Some(voxel) = settings.occupancy {
        match settings.around.as_slice() {
            [] => occupancy::write_blocks(out, &city, voxel, progress)?,
            regions => occupancy::write_regions(out, &city, voxel, regions)?,
        }
    }
    let meshes = city.actors.iter().map(|actor| &city.assets[actor.asset as usize].mesh);
    let summary = Summary {
        views: shots.len(),
        points: points.len(),
        mean_track: points.seen_by.len() as f64 / points.len().max(1) as f64,
        actors: city.actors.len(),
        moving: city.actors.iter().filter(|actor| actor.trajectory.is_some()).count(),
        triangles: meshes.map(|mesh| mesh.triangles.len()).sum(),
        driven,
        watched,
    };
    manifest::complete(out, settings, &city, &summary)?;
    Ok(summary)
}

/// The watched place of a street, where a car is parked if the settings say so.
fn watched_place(city: &mut City, settings: Watched, seed: u64) -> Option<WatchedPlace> {
    let pose = nearest_on_street(city, DVec2::new(settings.x, settings.y))?;
    let ahead = pose.rotation * DVec3::X;
    let degrees = ahead.y.atan2(ahead.x).to_degrees();
    let millimetres = |number: f64| (1e3 * number).round() / 1e3;
    let place = pose.translation.to_array().map(millimetres);
    let parked = settings.parked.then(|| {
        city.park(pose, seed);
        let asset = city.actors.last().map_or(0, |actor| actor.asset);
        let (low, high) = tracks_and_boxes::bounds(city, asset).unwrap_or_default();
        let middle = pose.apply((0.5 * (low + high)).with_z(low.z).as_dvec3());
        let [x, y, z] = middle.to_array();
        let [length, width, height] = (high - low).as_dvec3().to_array();
        [x, y, z, degrees, length, width, height].map(millimetres)
    });
    Some(WatchedPlace { place, degrees: millimetres(degrees), parked })
}

/// As [`write`], replacing a synthetic capture of other settings. A folder with anything else in it is refused.
///
/// # Errors
/// As [`write`].
pub fn replace(out: &Path, settings: &Settings, progress: Progress) -> Result<Summary, SynthError> {
    settings.check()?;
    manifest::remove_other(out, settings)?;
    write(out, settings, progress)
}

#[cfg(test)]
mod tests;
