//! The command line of `plat synth`.

use std::path::PathBuf;

use city::faults::Fault;
use city::{Layout, Traffic};
use clap::Args;
use dataset::synth::Around;
use glam::DVec3;

use super::{Size, metres};

#[derive(Debug, Clone, Args)]
#[command(after_long_help = SYNTH_HELP)]
pub(crate) struct SynthArgs {
    /// Folder for the capture: new, empty, or of the same settings
    #[arg(long, value_name = "DIR", required_unless_present = "gallery")]
    pub(crate) out: Option<PathBuf>,
    /// Only draw a picture of what there is to choose from, of this city and size: layouts, labels, faults
    #[arg(long, value_name = "FILE", conflicts_with = "out")]
    pub(crate) gallery: Option<PathBuf>,
    /// Area of the square city, km²: 0.005 to 25
    #[arg(long, value_name = "A", default_value_t = 0.2)]
    pub(crate) area_km2: f64,
    /// Photos, spread over the city as evenly as their number allows
    #[arg(long, value_name = "N", default_value_t = 400)]
    pub(crate) views: u32,
    /// Size of a photo, pixels
    #[arg(long, value_name = "WxH", default_value = "480x270")]
    pub(crate) size: Size,
    /// Everything random follows from it
    #[arg(long, value_name = "S", default_value_t = 1, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub(crate) seed: u64,
    /// How streets run: grid, curved-corridor, alley, winding, deck or mixed
    #[arg(long, value_name = "L", default_value_t = Layout::Mixed)]
    pub(crate) layout: Layout,
    /// How much moves: none, light, medium or heavy
    #[arg(long, value_name = "T", default_value_t = Traffic::Medium)]
    pub(crate) traffic: Traffic,
    /// Share of the city, from its west side, that is a bare plain: 0 to 0.8
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    pub(crate) plain: f64,
    /// Share of the photos taken from the air, straight down and in four oblique directions: 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.5)]
    pub(crate) aerial: f64,
    /// Share of the photos that cameras on posts take, ten each. What neither they nor the air has is taken by cars with
    /// six cameras
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    pub(crate) fixed: f64,
    /// Something that goes wrong, and how badly, 0 to 1 (alone: 1). May be given more than once
    #[arg(long, value_name = "KIND[=STRENGTH]")]
    pub(crate) fault: Vec<Fault>,
    /// Write depth, normals, classes, instances and materials of every pixel, and what is behind glass
    #[arg(long)]
    pub(crate) truth: bool,
    /// Cars carry a lidar, which turns once wherever one of their photos is kept
    #[arg(long)]
    pub(crate) lidar: bool,
    /// Cars carry a radar, which looks ahead there
    #[arg(long)]
    pub(crate) radar: bool,
    /// Write the city itself as glTF
    #[arg(long)]
    pub(crate) mesh: bool,
    /// Write which voxels of this side the city takes up, as it stands at second 0, in blocks of 64 m
    #[arg(long, value_name = "METRES", value_parser = metres)]
    pub(crate) occupancy: Option<f64>,
    /// Write these voxels around a pose instead: in a cube that reaches RADIUS metres from its middle, its x axis turned
    /// HEADING degrees from east to north, as the city stands at SECONDS. May be given more than once
    #[arg(
        long,
        value_name = "X,Y,Z,RADIUS[,HEADING[,SECONDS]]",
        value_parser = around,
        requires = "occupancy",
        allow_hyphen_values = true
    )]
    pub(crate) occupancy_around: Vec<Around>,
}

fn around(text: &str) -> Result<Around, String> {
    let numbers: Option<Vec<f64>> =
        text.split(',').map(|n| n.trim().parse().ok().filter(|n: &f64| n.is_finite())).collect();
    let numbers = numbers.filter(|n| (4..=6).contains(&n.len()) && n[3] > 0.0);
    let numbers = numbers.ok_or("give it as 10,-20,1.5,25: metres, the last above 0; then degrees and seconds")?;
    let rest = |i: usize| numbers.get(i).copied().unwrap_or(0.0);
    let place = DVec3::new(numbers[0], numbers[1], numbers[2]);
    Ok(Around { place, radius: numbers[3], heading_degrees: rest(4), seconds: rest(5) })
}

/// What `plat synth --help` adds to its options.
const SYNTH_HELP: &str = "\
Faults: exposure-drift, night, rain, fog, motion-blur, pose-noise, sparse-views, sensor-dropout, moving-unmasked,
textureless-road, lens-dirt

Files, of every photo NAME; the world is in metres, x east, y north, z up, the city centred on the origin:
  images/NAME.png        the photo
  masks/NAME.png         black on what moves (only where something moves)
  sparse/0/*.bin         COLMAP: cameras as reported, points with tracks
  transforms.json        nerfstudio: the same cameras, with masks; sparse_pc.ply has its points
  reference_lla.json     where on Earth the origin lies (OpenSfM): 0° N 0° E, in the open sea
  truth/transforms.json  the cameras as they were
  truth/shots.jsonl      all about each shot: sensor, time, motion, exposure, shutter, both cameras
  tracks.json            every moving thing: class, instance and its poses while photos are taken
  boxes3d.json           of every photo: the things that it shows, their boxes in the world and in the picture
  manifest.json          settings, counts, what the numbers of classes and materials mean; complete once all is there
with --truth:
  depth/NAME.npy         float32, metres along the optical axis; 0 for the sky
  normals/NAME.npy       float32 x 3, in the world, turned to the camera; 0 for the sky
  semantic/NAME.png      class, 8 bit (Cityscapes' trainId, more from 32)
  instance/NAME.png      instance as red + 256 green + 65536 blue; 0 is not counted
  material/NAME.png      row of the manifest's materials, 16 bit; 65535 for the sky
  behind/*/NAME.*        depth, semantic, instance and material of what is seen through glass; class 255 where there is none
with --lidar, of every place NAME (street-LEG-NUMBER) where a car's photo was kept:
  lidar/NAME.bin         float32 x 4 (KITTI): x ahead, y left, z up in the sensor's axes at the firing, and intensity
  lidar/NAME.label       uint32 (SemanticKITTI): class, and the lower 16 bits of the instance << 16
  lidar/NAME.npy         float64 x 7, the truth of each point: its place in the world, range, intensity, seconds since the
                         middle of the turn, 1 where it was seen through glass
  lidar/poses.jsonl      when and where each turn was
with --radar: radar/NAME.csv (readings, then their truth), radar/poses.jsonl
with --mesh:  city.glb   glTF 2: a node for each actor (class, instance), a mesh for each asset, materials without patterns
with --occupancy: occupancy/X_Y.npz for each block: semantic (uint8, 255 free) and instance (uint32) by z, y, x;
              origin (the lowest corner) and voxel (its side) in metres, world_from_grid (4 x 4; the identity)
with --occupancy-around: occupancy/around_N.npz, the same for each pose, the origin in its axes

The same settings give the same bytes, whatever the number of threads.";
