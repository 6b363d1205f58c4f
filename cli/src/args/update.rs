//! The command line of `plat update`.

use std::path::PathBuf;
use std::str::FromStr;

use clap::Args;
use glam::DVec3;

use super::garage::VehicleBox;
use super::values::{Backend, numbers};

#[derive(Debug, Clone, Args)]
pub(crate) struct UpdateArgs {
    /// The model: a folder that `plat train` wrote, or a PLY or SPZ
    pub(crate) model: PathBuf,
    /// The place that has changed: a ball, in metres of the model's world
    #[arg(long, value_name = "X,Y,Z,RADIUS", allow_hyphen_values = true)]
    pub(crate) area: Ball,
    /// New photos of it: a capture with poses in the model's world, as of cameras that are fixed there
    #[arg(long, value_name = "CAPTURE")]
    pub(crate) photos: PathBuf,
    /// Where the updated model goes: a folder, or a file of the same format. Blocks that have not changed are copied byte for byte
    #[arg(long, value_name = "PATH")]
    pub(crate) out: PathBuf,
    /// Training steps, counted in photos; coarser levels of the model get half of the next finer one's
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub(crate) steps: u32,
    /// Hold out every K-th photo, and measure on these too; by default none
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u32).range(2..))]
    pub(crate) test_every: Option<u32>,
    /// Use photos at one N-th of their size; by default as in the model's training, else 1
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) downscale: Option<u32>,
    /// Also measure the pixels that show this box: the middle of its lower side, its heading (0 looks along x, to the left of it is
    /// more), its length, width and height; metres
    #[arg(long = "box", value_name = "X,Y,Z,DEGREES,L,W,H", id = "measured", allow_hyphen_values = true)]
    pub(crate) measured: Option<VehicleBox>,
    /// Add what the box holds to the garage in this folder
    #[arg(long, value_name = "DIR", requires_all = ["measured", "name"])]
    pub(crate) garage: Option<PathBuf>,
    /// Its name in the garage
    #[arg(long, value_name = "NAME", requires = "garage")]
    pub(crate) name: Option<String>,
    /// Its class in the garage
    #[arg(long, value_name = "CLASS", requires = "garage", default_value = "car")]
    pub(crate) class: String,
    /// Seed of all random choices
    #[arg(long, value_name = "S", default_value_t = 1)]
    pub(crate) seed: u64,
    /// Backend to train on
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Store of the photos; by default a temporary one
    #[arg(long, value_name = "URL")]
    pub(crate) store: Option<String>,
}

/// A ball in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Ball {
    pub(crate) centre: DVec3,
    pub(crate) radius: f64,
}

impl FromStr for Ball {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let [x, y, z, radius] = numbers::<4>(text)
            .filter(|[.., radius]| *radius > 0.0)
            .ok_or("give X,Y,Z,RADIUS, such as 12.5,-3,0.2,6; a radius above 0")?;
        Ok(Self { centre: DVec3::new(x, y, z), radius })
    }
}
