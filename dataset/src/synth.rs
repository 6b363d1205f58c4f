//! A rehearsal of a capture: a generated city ([`city`]) photographed, measured and written down as a capture that any
//! trainer reads, with the truth beside it.
//!
//! ```text
//! Settings ─views→ shots ─images→ photos, masks (and truth) ─sparse→ points with tracks ─cameras→ COLMAP, transforms.json
//!                    └──────────── manifest.json says what was asked for and, when all is there, what is there
//! ```
//! | room | writes |
//! |---|---|
//! | `views` | nothing: chooses which shots are taken, from the air, from a car and from posts |
//! | `images` | `images/`, `masks/` |
//! | `truth` | `depth/`, `normals/`, `semantic/`, `instance/`, `material/`, `behind/` |
//! | `sparse` | nothing: finds which views truly see which points |
//! | `sweeps` | `lidar/`, `radar/` |
//! | `scene_files` | `tracks.json`, `boxes3d.json` |
//! | `gltf` | `city.glb` |
//! | `npz` | `occupancy/` |
//! | `gallery` | nothing: draws what there is to choose from |
//! | `cameras` | `sparse/0/`, `transforms.json`, `sparse_pc.ply`, `reference_lla.json`, `truth/` |
//!
//! What a capture is trained with is what a crew would have: the cameras in it are those that were reported. How it truly
//! was is in `truth/`. The same settings give the same bytes, whatever the number of threads.

mod cameras;
mod gallery;
mod gltf;
mod images;
mod manifest;
mod npz;
mod scene_files;
mod sparse;
mod sweeps;
mod truth;
mod views;

use std::fs;
use std::path::Path;

use city::faults::{self, Fault};
use city::trace::World;
use city::{City, CitySettings};
use scene::BadInput;
use serde::Serialize;
use store::file::SaveError;

pub use gallery::gallery;
pub use npz::Around;

/// Everything that a rehearsal follows from.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Settings {
    /// The city.
    pub city: CitySettings,
    /// Photos to take: 1 to 50,000. There are fewer where a fault loses some.
    pub views: u32,
    /// Photo width, pixels: 16 to 8,192.
    pub width: u32,
    /// Photo height, pixels: 16 to 8,192.
    pub height: u32,
    /// Share of the photos that is taken from the air, straight down and in four oblique directions: 0 to 1.
    pub aerial: f64,
    /// Share of the photos that cameras on posts take, ten each: 0 to 1 - `aerial`. All others are taken from cars.
    pub fixed: f64,
    /// What goes wrong.
    pub faults: Vec<Fault>,
    /// Whether depths, normals and labels of every photo are written.
    pub truth: bool,
    /// Whether cars carry a lidar.
    pub lidar: bool,
    /// Whether cars carry a radar.
    pub radar: bool,
    /// Whether the city itself is written.
    pub mesh: bool,
    /// Side of the voxels that are written, metres, 0.05 to 10; none where there is no number.
    pub occupancy: Option<f64>,
    /// Places around which voxels are written, rather than all over the city: 1,000 at most.
    pub around: Vec<Around>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            city: CitySettings::default(),
            views: 200,
            width: 480,
            height: 270,
            aerial: 0.5,
            fixed: 0.0,
            faults: Vec::new(),
            truth: false,
            lidar: false,
            radar: false,
            mesh: false,
            occupancy: None,
            around: Vec::new(),
        }
    }
}

impl Settings {
    /// # Errors
    /// What is out of range, in one line.
    pub fn check(&self) -> Result<(), BadInput> {
        self.city.check()?;
        let refuse =
            |what: &str, range: &str| Err(BadInput::new("rehearsal", format!("{what} is out of range"), range));
        match self {
            s if !(1..=50_000).contains(&s.views) => refuse("the number of views", "choose 1 to 50,000"),
            s if !(16..=8192).contains(&s.width) => refuse("the photo width", "choose 16 to 8,192 pixels"),
            s if !(16..=8192).contains(&s.height) => refuse("the photo height", "choose 16 to 8,192 pixels"),
            s if !(0.0..=1.0).contains(&s.aerial) => refuse("the share of aerial photos", "choose 0 to 1"),
            s if !(0.0..=1.0).contains(&s.fixed) => refuse("the share of fixed cameras", "choose 0 to 1"),
            s if s.aerial + s.fixed > 1.0 => refuse("the sum of both shares", "choose shares that sum to at most 1"),
            s if s.occupancy.is_some_and(|voxel| !(0.05..=10.0).contains(&voxel)) => {
                refuse("the side of a voxel", "choose 0.05 to 10 metres")
            }
            s if s.around.len() > 1000 => refuse("the number of places to fill with voxels", "choose 1,000 at most"),
            s if s.faults.iter().any(|f| !f.is_sane()) => refuse("the strength of a fault", "choose 0 to 1"),
            s => s.occupancy.map_or(Ok(()), |voxel| s.around.iter().try_for_each(|at| at.grid(voxel).map(|_| ()))),
        }
    }
}

/// What was written.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Number of photos.
    pub views: usize,
    /// Number of sparse points.
    pub points: usize,
    /// Mean number of views per point.
    pub mean_track: f64,
    /// Things that stand, lie or move in the city.
    pub actors: usize,
    /// Those of them that move.
    pub moving: usize,
    /// Triangles of the city, those of shared assets counted with each actor.
    pub triangles: usize,
}

/// Why there is no rehearsal.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SynthError {
    /// A setting is out of range, or the folder is not free.
    #[error(transparent)]
    BadInput(#[from] BadInput),
    /// A file or folder could not be written.
    #[error(transparent)]
    Save(#[from] SaveError),
}

/// Hears what is being done, how much of it is done and how much there is; from any thread.
pub type Progress<'a> = &'a (dyn Fn(&'static str, usize, usize) + Sync);

/// Builds the city and writes the capture of it into a folder, which has to be empty, new, or one of the same settings.
///
/// # Errors
/// Settings out of range, or a folder or file that cannot be written.
pub fn write(out: &Path, settings: &Settings, progress: Progress) -> Result<Summary, SynthError> {
    settings.check()?;
    manifest::claim(out, settings)?;
    let city = City::generate(&settings.city)?;
    let world = World::new(&city).map_err(|e| impossible(&e))?;
    let views::Views { shots, legs, stations } = views::views(&world, settings)?;
    let mut shots = faults::spoil_shots(shots, &settings.faults);
    if shots.is_empty() {
        return Err(BadInput::new("rehearsal", "has no view left", "ask for more views or milder faults").into());
    }
    shots.sort_by(|a, b| a.name.cmp(&b.name));
    sweeps::write(out, &world, &legs, &stations, settings, progress)?;
    let taken = images::take(out, &world, &shots, settings, progress)?;
    let points = sparse::points(&world, &shots, taken.seeds, settings.city.seed, progress);
    cameras::write(out, &shots, &points, city_moves(&city))?;
    scene_files::tracks(out, &city, &shots)?;
    scene_files::boxes(out, &taken.boxes)?;
    if settings.mesh {
        gltf::write(out, &city)?;
    }
    if let Some(voxel) = settings.occupancy {
        match settings.around.as_slice() {
            [] => npz::blocks(out, &city, voxel, progress)?,
            places => npz::around(out, &city, voxel, places)?,
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
    };
    manifest::complete(out, settings, &city, &summary)?;
    Ok(summary)
}

/// As [`write`], in the place of an older rehearsal, whatever its settings. A folder with anything else in it is refused.
///
/// # Errors
/// As those of [`write`].
pub fn replace(out: &Path, settings: &Settings, progress: Progress) -> Result<Summary, SynthError> {
    settings.check()?;
    manifest::forget(out, settings)?;
    write(out, settings, progress)
}

/// Whether anything moves, so that photos have masks: all or none, as readers of `transforms.json` ask.
fn city_moves(city: &City) -> bool {
    city.actors.iter().any(|actor| actor.trajectory.is_some())
}

/// What a sensor or the tracer refuses although the settings were checked: a line all the same, and no panic.
fn impossible(error: &dyn std::error::Error) -> BadInput {
    BadInput::new("rehearsal", error.to_string(), "change the settings")
}

fn make(folder: &Path) -> Result<(), SaveError> {
    fs::create_dir_all(folder).map_err(|e| SaveError::new(folder, &e))
}

#[cfg(test)]
mod tests;
