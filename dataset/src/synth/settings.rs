//! Settings, results and errors of a synthetic capture.

use city::CitySettings;
use city::faults::Fault;
use city::occupancy::Grid;
use city::sense::rig::Rig;
use glam::{DQuat, DVec3};
use scene::{BadInput, Rigid};
use serde::Serialize;
use store::file::SaveError;

/// Subject of errors about settings.
pub(super) const SUBJECT: &str = "the synthetic capture";

/// Settings of a synthetic capture. Equal settings give equal bytes.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Settings {
    /// The city.
    pub city: CitySettings,
    /// Number of photos, 1 to 50,000, before faults remove some.
    pub views: u32,
    /// Photo width, pixels: 16 to 8,192.
    pub width: u32,
    /// Photo height, pixels: 16 to 8,192.
    pub height: u32,
    /// Share of aerial photos, 0 to 1: nadir and four oblique directions.
    pub aerial: f64,
    /// Share of photos from fixed cameras on posts, ten each: 0 to 1 - `aerial`. The rest are taken from cars.
    pub fixed: f64,
    /// Faults to apply.
    pub faults: Vec<Fault>,
    /// Whether to write depths, normals and labels of every photo.
    pub truth: bool,
    /// Whether cars carry a lidar.
    pub lidar: bool,
    /// Whether cars carry a radar.
    pub radar: bool,
    /// Whether to write the city's mesh.
    pub mesh: bool,
    /// Whether to write the drives of the cars in the layout of nuScenes too.
    #[serde(skip_serializing_if = "is_unset")]
    pub nuscenes: bool,
    /// Whether to write the drives of the cars in the layout of KITTI raw too.
    #[serde(skip_serializing_if = "is_unset")]
    pub kitti_raw: bool,
    /// Whether to write the drives of the cars in the layout of the Waymo Open Dataset too.
    #[serde(skip_serializing_if = "is_unset")]
    pub waymo: bool,
    /// Voxel size of the occupancy grids, metres, 0.05 to 10. `None` writes no grids.
    pub occupancy: Option<f64>,
    /// Regions of the occupancy grids, 1,000 at most. Empty covers the whole city.
    pub around: Vec<VoxelRegion>,
    /// Metres between the stops of a car along its street, 0.1 to 100: cars then drive whole streets in both directions, as far as
    /// the photos suffice. `None` spreads the photos evenly over all streets.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spacing: Option<f64>,
    /// Cameras of a car.
    #[serde(skip_serializing_if = "CarRig::is_default")]
    pub rig: CarRig,
    /// Takes all photos of one place by fixed cameras around it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub watched: Option<Watched>,
}

fn is_unset(flag: &bool) -> bool {
    !flag
}

/// A place that fixed cameras around it watch: the place of a street that is nearest to this one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Watched {
    /// World metres.
    pub x: f64,
    /// World metres.
    pub y: f64,
    /// Distance of the cameras from it, metres, 2 to 200.
    pub radius: f64,
    /// Whether a car is parked there that other captures of the city do not have.
    pub parked: bool,
    /// The cameras film it for this long, ten photos a second each, 0.1 to 60; `None`: one photo each.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub film_seconds: Option<f64>,
}

/// Photos a second of a camera that films a place.
pub(super) const FILM_HZ: f64 = 10.0;

impl Watched {
    /// Photos of each camera.
    pub(super) fn frames(self) -> u32 {
        self.film_seconds.map_or(1, |seconds| (seconds * FILM_HZ).round().max(1.0) as u32)
    }
}

/// Cameras of a car.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum CarRig {
    /// Two ahead, two to the sides, two to the rear.
    #[default]
    Six,
    /// One ahead.
    Front,
}

impl CarRig {
    fn is_default(&self) -> bool {
        *self == Self::default()
    }

    pub(super) fn rig(self) -> Rig {
        match self {
            Self::Six => Rig::default(),
            Self::Front => Rig::front(),
        }
    }
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
            nuscenes: false,
            kitti_raw: false,
            waymo: false,
            occupancy: None,
            around: Vec::new(),
            spacing: None,
            rig: CarRig::Six,
            watched: None,
        }
    }
}

impl Settings {
    /// Checks all ranges.
    ///
    /// # Errors
    /// The first setting out of range, in one line.
    pub fn check(&self) -> Result<(), BadInput> {
        self.city.check()?;
        let refuse = |what: &str, range: &str| Err(BadInput::new(SUBJECT, format!("{what} is out of range"), range));
        match self {
            s if !(1..=50_000).contains(&s.views) => refuse("the number of views", "choose 1 to 50,000"),
            s if !(16..=8192).contains(&s.width) => refuse("the photo width", "choose 16 to 8,192 pixels"),
            s if !(16..=8192).contains(&s.height) => refuse("the photo height", "choose 16 to 8,192 pixels"),
            s if !(0.0..=1.0).contains(&s.aerial) => refuse("the share of aerial photos", "choose 0 to 1"),
            s if !(0.0..=1.0).contains(&s.fixed) => refuse("the share of fixed cameras", "choose 0 to 1"),
            s if s.aerial + s.fixed > 1.0 => refuse("the sum of both shares", "choose shares that sum to at most 1"),
            s if s.spacing.is_some_and(|metres| !(0.1..=100.0).contains(&metres)) => {
                refuse("the spacing of the cars' stops", "choose 0.1 to 100 metres")
            }
            s if s.occupancy.is_some_and(|voxel| !(0.05..=10.0).contains(&voxel)) => {
                refuse("the side of a voxel", "choose 0.05 to 10 metres")
            }
            s if s.nuscenes && s.aerial + s.fixed >= 1.0 => {
                refuse("the number of photos from cars, for nuScenes,", "choose shares that sum to less than 1")
            }
            s if s.kitti_raw && s.aerial + s.fixed >= 1.0 => {
                refuse("the number of photos from cars, for KITTI raw,", "choose shares that sum to less than 1")
            }
            s if s.waymo && s.aerial + s.fixed >= 1.0 => {
                refuse("the number of photos from cars, for Waymo,", "choose shares that sum to less than 1")
            }
            s if s.watched.is_some_and(|place| !place.x.is_finite() || !place.y.is_finite()) => {
                refuse("the watched place", "give finite coordinates")
            }
            s if s.watched.is_some_and(|place| !(2.0..=200.0).contains(&place.radius)) => {
                refuse("the radius around the watched place", "choose 2 to 200 metres")
            }
            s if s.watched.and_then(|place| place.film_seconds).is_some_and(|long| !(0.1..=60.0).contains(&long)) => {
                refuse("the duration of the film", "choose 0.1 to 60 seconds")
            }
            s if s.watched.is_some_and(|place| place.frames() > s.views) => {
                refuse("the number of views of a film", "choose ten times its seconds for each camera")
            }
            s if s.around.len() > 1000 => refuse("the number of places to fill with voxels", "choose 1,000 at most"),
            s if s.faults.iter().any(|f| !f.is_valid()) => refuse("the strength of a fault", "choose 0 to 1"),
            s => s
                .occupancy
                .map_or(Ok(()), |voxel| s.around.iter().try_for_each(|region| region.grid(voxel).map(|_| ()))),
        }
    }
}

/// A cube of which voxels are written.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct VoxelRegion {
    /// Centre, world metres.
    pub place: DVec3,
    /// Half of the cube's side, metres.
    pub radius: f64,
    /// Direction of the cube's x axis, degrees from east towards north.
    pub heading_degrees: f64,
    /// City time, which determines the poses of moving actors.
    pub seconds: f64,
}

impl VoxelRegion {
    /// The grid of the cube in the cube's axes.
    ///
    /// # Errors
    /// A value out of range, or more voxels than a grid may have.
    pub(super) fn grid(&self, voxel: f64) -> Result<Grid, BadInput> {
        let refuse = |problem: String| BadInput::new(SUBJECT, problem, "choose another place, radius or voxel");
        if !(self.radius > 0.0 && self.heading_degrees.is_finite() && self.seconds.abs() <= 1e9) {
            return Err(refuse("a place to fill with voxels is out of range".into()));
        }
        let rotation = DQuat::from_rotation_z(self.heading_degrees.to_radians());
        let half = DVec3::splat(self.radius);
        Grid::new(Rigid { rotation, translation: self.place }, -half, half, voxel)
            .map_err(|e| refuse(format!("voxels around a place: {e}")))
    }
}

/// Contents of a written capture.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Number of photos.
    pub views: usize,
    /// Number of sparse points.
    pub points: usize,
    /// Mean number of views per point.
    pub mean_track: f64,
    /// Actors: objects that stand, lie or move in the city.
    pub actors: usize,
    /// Moving actors.
    pub moving: usize,
    /// Triangles of the city; those of shared assets count once per actor.
    pub triangles: usize,
    /// With [`Settings::spacing`]: what the cars drove.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub driven: Option<Driven>,
    /// With [`Settings::watched`]: where that is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub watched: Option<WatchedPlace>,
}

/// The place that fixed cameras watch.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct WatchedPlace {
    /// On the road, world metres.
    pub place: [f64; 3],
    /// Direction of the street, degrees from x to y.
    pub degrees: f64,
    /// The box of the parked car: the middle of its lower side, its heading in degrees, its length, width and height in metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub parked: Option<[f64; 7]>,
}

/// What the cars of a capture with [`Settings::spacing`] drove.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Driven {
    /// Metres between stops along a street.
    pub spacing_metres: f64,
    /// Cameras of a car.
    pub rig: CarRig,
    /// Stops of all cars; every camera takes a photo at each.
    pub stops: usize,
    /// Length of the drives, metres; each direction counts.
    pub metres: f64,
    /// Share of the length of all streets in both directions, 0 to 1.
    pub share: f64,
}

/// A synthetic capture that could not be written.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SynthError {
    /// A setting is out of range, or the folder holds something else.
    #[error(transparent)]
    BadInput(#[from] BadInput),
    /// A file or folder could not be written.
    #[error(transparent)]
    Save(#[from] SaveError),
}

/// Called from any thread with the name of a stage, the items done and the items in total.
pub type Progress<'a> = &'a (dyn Fn(&'static str, usize, usize) + Sync);

/// The error of a sensor or the ray tracer that refuses settings which passed [`Settings::check`].
pub(super) fn unsupported(error: &dyn std::error::Error) -> BadInput {
    BadInput::new(SUBJECT, error.to_string(), "change the settings")
}
