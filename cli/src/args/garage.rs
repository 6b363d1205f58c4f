//! The command lines of `plat garage`.

use std::path::PathBuf;
use std::str::FromStr;

use clap::{Args, Subcommand};
use glam::DVec3;

use super::values::numbers;

#[derive(Debug, Subcommand)]
pub(crate) enum GarageCommand {
    /// Take a vehicle out of a model: an object that moves, or what a box of the static scene holds
    Add(GarageAddArgs),
    /// List the vehicles
    List(GarageListArgs),
    /// Place a vehicle in a model, where it stands or drives along a path. Nothing else of the model changes
    Place(GaragePlaceArgs),
}

#[derive(Debug, Clone, Args)]
pub(crate) struct GarageAddArgs {
    /// Folder of the garage
    pub(crate) garage: PathBuf,
    /// The model: a folder that `plat train` wrote; with --box also a file whose z is up
    #[arg(long, value_name = "MODEL")]
    pub(crate) model: PathBuf,
    /// Take this object that moves
    #[arg(long, value_name = "ID", required_unless_present = "area", conflicts_with = "area")]
    pub(crate) object: Option<String>,
    /// Take the splats in a box of the static scene: the middle of its lower side, its heading (0 looks along x, to the left of
    /// it is more), its length, width and height; metres
    #[arg(long = "box", value_name = "X,Y,Z,DEGREES,L,W,H", id = "area")]
    #[arg(allow_hyphen_values = true)]
    pub(crate) area: Option<VehicleBox>,
    /// Its name in the garage; by default the object's
    #[arg(long, value_name = "NAME", required_unless_present = "object")]
    pub(crate) name: Option<String>,
    /// Its class, with --box
    #[arg(long, value_name = "CLASS", default_value = "car", conflicts_with = "object")]
    pub(crate) class: String,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct GarageListArgs {
    /// Folder of the garage
    pub(crate) garage: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct GaragePlaceArgs {
    /// Folder of the garage
    pub(crate) garage: PathBuf,
    /// Name of the vehicle
    pub(crate) vehicle: String,
    /// The model: a folder that `plat train` wrote
    #[arg(long, value_name = "MODEL")]
    pub(crate) model: PathBuf,
    /// It drives along the path of an object in this file, as tracks.json or as plat objects pose writes it
    #[arg(long, value_name = "FILE", required_unless_present = "at", conflicts_with = "at")]
    pub(crate) path: Option<PathBuf>,
    /// The object whose path that is; by default the only one in the file
    #[arg(long, value_name = "ID", requires = "path")]
    pub(crate) track: Option<String>,
    /// It stands here, its lower side's middle, with this heading (0 looks along x)
    #[arg(long, value_name = "X,Y,Z,DEGREES", allow_hyphen_values = true)]
    pub(crate) at: Option<Stand>,
    /// Its name in the model; by default that in the garage
    #[arg(long, value_name = "ID")]
    pub(crate) id: Option<String>,
}

/// A place on the ground with a heading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Stand {
    pub(crate) place: DVec3,
    pub(crate) degrees: f64,
}

impl FromStr for Stand {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let [x, y, z, degrees] = numbers(text).ok_or("give X,Y,Z,DEGREES, such as 12.5,-3,0.2,90")?;
        Ok(Self { place: DVec3::new(x, y, z), degrees })
    }
}

/// A box that stands on the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct VehicleBox {
    pub(crate) stand: Stand,
    /// Length, width, height.
    pub(crate) size: DVec3,
}

impl FromStr for VehicleBox {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let [x, y, z, degrees, l, w, h] =
            numbers(text).ok_or("give X,Y,Z,DEGREES,L,W,H, such as 12.5,-3,0.2,90,4.5,1.9,1.6")?;
        let size = DVec3::new(l, w, h);
        if size.min_element() <= 0.0 || size.max_element() > 100.0 {
            return Err("give a length, a width and a height above 0 and up to 100 metres".into());
        }
        Ok(Self { stand: Stand { place: DVec3::new(x, y, z), degrees }, size })
    }
}
