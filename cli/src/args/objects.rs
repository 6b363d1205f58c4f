//! The command lines of `plat objects`.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::zones::ZoneFinder;

#[derive(Debug, Subcommand)]
pub(crate) enum ObjectsCommand {
    /// Find the rotations and heights of vehicles from their positions: they head where they go, and their wheels touch the road
    Pose(PoseArgs),
    /// Find the objects that move, and their paths, in the sweeps and photos of a capture
    Track(TrackArgs),
}

/// Beside a capture, tracks.json is what plat train --objects takes.
#[derive(Debug, Clone, Args)]
pub(crate) struct PoseArgs {
    /// The static scene: a folder that `plat train` wrote, or a model as PLY, SPZ, SOG, streamed SOG, RAD or 3D Tiles, whose z is up
    pub(crate) model: PathBuf,
    /// Objects with their boxes and positions: a JSON file as tracks.json, in which "positions": [[seconds, [x, y, z]], ...] stand for
    /// "poses". Of poses the first one's heading is used, as a vehicle may drive backwards
    #[arg(long, value_name = "FILE")]
    pub(crate) positions: PathBuf,
    /// Where the paths go, as tracks.json
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
    /// Also measure the poses against the true ones in this tracks.json
    #[arg(long, value_name = "FILE")]
    pub(crate) against: Option<PathBuf>,
}

/// In the sweeps of a lidar objects are what other sweeps see through; on photos they are what --detector or --zones finds. Each has a
/// Kalman filter of constant turn rate; paths go on behind what hides them, and are smoothed. What never moves is no object.
#[derive(Debug, Clone, Args)]
pub(crate) struct TrackArgs {
    /// Folder of a capture that tells when its photos were taken (nuScenes, KITTI raw, Waymo, DGP, plat synth, or "seconds" in a
    /// tracks.json beside it)
    pub(crate) capture: PathBuf,
    /// Where the paths go, as tracks.json
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
    #[command(flatten)]
    pub(crate) finder: ZoneFinder,
    /// Leave out the lidar: objects on photos are where they touch the ground
    #[arg(long)]
    pub(crate) no_lidar: bool,
    /// Leave out the radar, whose velocities tell what moves, how fast, and which vehicles on photos do not
    #[arg(long)]
    pub(crate) no_radar: bool,
    /// Also measure the paths against the true ones in this tracks.json
    #[arg(long, value_name = "FILE")]
    pub(crate) against: Option<PathBuf>,
    /// Draw the paths from above, as SVG
    #[arg(long, value_name = "FILE")]
    pub(crate) svg: Option<PathBuf>,
    /// Store for the photos at all sizes and what is found on them; a temporary one by default
    #[arg(long, value_name = "URL", requires = "zone_source")]
    pub(crate) store: Option<String>,
}
