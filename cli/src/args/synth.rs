//! The command line of `plat synth`.

use std::path::PathBuf;

use city::faults::Fault;
use city::{Layout, Traffic};
use clap::{Args, ValueEnum};
use dataset::synth::VoxelRegion;
use glam::DVec3;

use super::values::{Size, metres, numbers};

/// Cameras of a car.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Rig {
    /// Two ahead, two to the sides, two to the rear
    Six,
    /// One ahead
    Front,
}

#[derive(Debug, Clone, Args)]
#[command(after_long_help = SYNTH_HELP)]
pub(crate) struct SynthArgs {
    /// Folder for the capture: new, empty, or of the same settings
    #[arg(long, value_name = "DIR", required_unless_present = "gallery")]
    pub(crate) out: Option<PathBuf>,
    /// Only draw an overview picture of layouts, labels and faults for this city and size
    #[arg(long, value_name = "FILE", conflicts_with = "out")]
    pub(crate) gallery: Option<PathBuf>,
    /// Area of the square city, km²: 0.005 to 25
    #[arg(long, value_name = "A", default_value_t = 0.2)]
    pub(crate) area_km2: f64,
    /// Number of photos, spread evenly over the city; with --spacing at most
    #[arg(long, value_name = "N", default_value_t = 400)]
    pub(crate) views: u32,
    /// Size of a photo, pixels
    #[arg(long, value_name = "WxH", default_value = "480x270")]
    pub(crate) size: Size,
    /// Seed of all random choices
    #[arg(long, value_name = "S", default_value_t = 1, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub(crate) seed: u64,
    /// Street layout: grid, curved-corridor, alley, winding, deck or mixed
    #[arg(long, value_name = "L", default_value_t = Layout::Mixed)]
    pub(crate) layout: Layout,
    /// Traffic: none, light, medium or heavy
    #[arg(long, value_name = "T", default_value_t = Traffic::Medium)]
    pub(crate) traffic: Traffic,
    /// Share of the city that is a bare plain, from its west side: 0 to 0.8
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    pub(crate) plain: f64,
    /// Share of the photos taken from the air, straight down and in four oblique directions: 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.5)]
    pub(crate) aerial: f64,
    /// Share of the photos taken by fixed cameras on posts, ten each. Photos that are neither aerial nor fixed are taken by cars
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    pub(crate) fixed: f64,
    /// Take the cars' photos this far apart: cars drive whole streets, from the middle of the city outwards, in both directions, and
    /// all cameras take a photo at every stop, as far as the photos suffice. Without it the photos are spread evenly over all
    /// streets, and the cameras take turns
    #[arg(long, value_name = "METRES", value_parser = metres)]
    pub(crate) spacing: Option<f64>,
    /// Take all photos of one place of a street, the nearest to this one, by fixed cameras on posts around it, one
    /// each, or a film with --film
    #[arg(
        long,
        value_name = "X,Y,RADIUS",
        value_parser = watched,
        allow_hyphen_values = true,
        conflicts_with_all = ["aerial", "fixed", "spacing", "rig", "lidar", "radar", "nuscenes", "kitti_raw", "waymo"]
    )]
    pub(crate) watch: Option<[f64; 3]>,
    /// Film the watched place for this long, 0.1 to 60 seconds: each camera takes ten photos a second, and --views counts those of all
    #[arg(long, value_name = "SECONDS", requires = "watch")]
    pub(crate) film: Option<f64>,
    /// Park a car at the watched place that the city does not have without it: a scene that has changed
    #[arg(long, requires = "watch")]
    pub(crate) parked: bool,
    /// Cameras of a car: six, or one that looks ahead
    #[arg(long, value_name = "RIG", value_enum, default_value_t = Rig::Six)]
    pub(crate) rig: Rig,
    /// A capture fault and its strength, 0 to 1 (default 1). May be given more than once
    #[arg(long, value_name = "KIND[=STRENGTH]")]
    pub(crate) fault: Vec<Fault>,
    /// Write ground truth of every pixel: depth, normals, classes, instances and materials, also behind glass
    #[arg(long)]
    pub(crate) truth: bool,
    /// Add a lidar to cars; it makes one turn at every place where a photo of the car is kept
    #[arg(long)]
    pub(crate) lidar: bool,
    /// Add a forward radar to cars, read at the same places
    #[arg(long)]
    pub(crate) radar: bool,
    /// Write the drives of the cars in the layout of nuScenes too: photos, boxes and, with --lidar, sweeps
    #[arg(long)]
    pub(crate) nuscenes: bool,
    /// Write the drives of the cars in the layout of KITTI raw too: photos of the cameras that look ahead and, with --lidar, sweeps
    #[arg(long)]
    pub(crate) kitti_raw: bool,
    /// Write the drives of the cars in the layout of the Waymo Open Dataset (Perception, version 2) too: photos of the cameras that
    /// do not look to the rear, boxes and, with --lidar, range images
    #[arg(long)]
    pub(crate) waymo: bool,
    /// Write the city as glTF
    #[arg(long)]
    pub(crate) mesh: bool,
    /// Write the occupancy of the city at second 0 in voxels of this side, in blocks of 64 m
    #[arg(long, value_name = "METRES", value_parser = metres)]
    pub(crate) occupancy: Option<f64>,
    /// Write occupancy around a pose instead: a cube that extends RADIUS metres from its centre, its x axis turned HEADING
    /// degrees from east to north, at the time SECONDS. May be given more than once
    #[arg(
        long,
        value_name = "X,Y,Z,RADIUS[,HEADING[,SECONDS]]",
        value_parser = around,
        requires = "occupancy",
        allow_hyphen_values = true
    )]
    pub(crate) occupancy_around: Vec<VoxelRegion>,
}

fn watched(text: &str) -> Result<[f64; 3], String> {
    numbers::<3>(text)
        .filter(|[_, _, radius]| *radius > 0.0)
        .ok_or("give it as 10,-20,8: metres, the last above 0".into())
}

fn around(text: &str) -> Result<VoxelRegion, String> {
    let numbers: Option<Vec<f64>> =
        text.split(',').map(|n| n.trim().parse().ok().filter(|n: &f64| n.is_finite())).collect();
    let numbers = numbers.filter(|n| (4..=6).contains(&n.len()) && n[3] > 0.0);
    let numbers = numbers.ok_or("give it as 10,-20,1.5,25: metres, the last above 0; then degrees and seconds")?;
    let rest = |i: usize| numbers.get(i).copied().unwrap_or(0.0);
    let place = DVec3::new(numbers[0], numbers[1], numbers[2]);
    Ok(VoxelRegion { place, radius: numbers[3], heading_degrees: rest(4), seconds: rest(5) })
}

/// What `plat synth --help` adds to its options.
const SYNTH_HELP: &str = "\
Faults: exposure-drift, night, rain, fog, motion-blur, pose-noise, sparse-views, sensor-dropout, moving-unmasked,
textureless-road, lens-dirt, clock-skew, wrong-calibration

Files, of every photo NAME; the world is in metres, x east, y north, z up, the city centred on the origin:
  images/NAME.png        the photo
  masks/NAME.png         black on moving objects (only if there are any)
  sparse/0/*.bin         COLMAP: reported cameras, points with tracks
  transforms.json        nerfstudio: the same cameras, with masks; sparse_pc.ply has its points
  reference_lla.json     geographic origin (OpenSfM): 0° N 0° E, in the open sea
  truth/transforms.json  the true cameras
  truth/shots.jsonl      each shot: sensor, time, motion, exposure, shutter, reported and true camera
  tracks.json            every moving object: class, instance, box and path; the times of the photos
  boxes3d.json           for every photo the visible objects, with boxes in the world and in the picture
  manifest.json          settings, counts, names of classes and materials; written last
with --truth:
  depth/NAME.npy         float32, metres along the optical axis; 0 for the sky
  normals/NAME.npy       float32 x 3, in the world, turned to the camera; 0 for the sky
  semantic/NAME.png      class, 8 bit (Cityscapes' trainId, more from 32)
  instance/NAME.png      instance as red + 256 green + 65536 blue; 0 = not an instance
  material/NAME.png      index into the manifest's materials, 16 bit; 65535 for the sky
  behind/*/NAME.*        depth, semantic, instance and material of the surface behind glass; class 255 where there is no glass
with --lidar, for every place NAME (street-LEG-NUMBER) where a photo of the car is kept:
  lidar/NAME.bin         float32 x 4 (KITTI): x ahead, y left, z up in the sensor's axes at the firing, and intensity
  lidar/NAME.label       uint32 (SemanticKITTI): class, and the lower 16 bits of the instance << 16
  lidar/NAME.npy         float64 x 7, ground truth of each point: world position, range, intensity, seconds since the
                         middle of the turn, 1 if it was seen through glass
  lidar/poses.jsonl      each turn: time, pose, motion, and the photos taken during it; plat train reads it
with --radar: radar/NAME.csv (readings, then their ground truth), radar/poses.jsonl; plat train reads the readings
with --nuscenes, in nuscenes/, which plat and the nuScenes devkit read (a scene is a drive of a car, scene-LEG):
  v1.0-mini/*.json       thirteen tables; the boxes are of vehicles and people within 70 m, seen or hit by the lidar
  samples/CAM_*/NAME.png, samples/LIDAR_TOP/NAME.pcd.bin (float32 x 5, corrected for the car's motion), maps/none.png
with --kitti-raw, in kitti_raw/1970_01_01/, which plat and pykitti read (a drive of a car is 1970_01_01_drive_LEG_sync):
  calib_*.txt, and of each drive image_02 and image_03 (the cameras that look ahead), oxts (the car on the road under its
  centre) and velodyne_points (float32 x 4, counter-clockwise, in the sensor's axes at the firing), each with data/FRAME.*
with --waymo, in waymo/, which plat and the owners' devkit read (a segment is a drive of a car, drive_LEG):
  COMPONENT/drive_LEG.parquet  camera_calibration, camera_image (JPEG), vehicle_pose, lidar_box, stats and, with --lidar,
                         lidar_calibration, lidar (range images of the top laser) and lidar_pose; the cameras that look to
                         the rear have no number there
with --mesh:  city.glb   glTF 2: a node for each actor (class, instance), a mesh for each asset, materials without patterns
with --occupancy: occupancy/X_Y.npz for each block: semantic (uint8, 255 free) and instance (uint32) by z, y, x;
              origin (the lowest corner) and voxel (its side) in metres, world_from_grid (4 x 4; the identity)
with --occupancy-around: occupancy/around_N.npz, the same for each pose, the origin in its axes

The same settings give the same bytes, whatever the number of threads.";
