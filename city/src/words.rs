//! The nouns of a city.

use glam::{DVec3, Vec2, Vec3};
use scene::Rigid;
use serde::{Deserialize, Serialize};

/// What a surface is part of. The numbers are those of Cityscapes' evaluation where it has the class (`trainId`),
/// and go on from 32 where it has not; they are what label images hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum Class {
    Road = 0,
    Sidewalk = 1,
    Building = 2,
    Wall = 3,
    Fence = 4,
    Pole = 5,
    TrafficLight = 6,
    TrafficSign = 7,
    Vegetation = 8,
    Terrain = 9,
    Sky = 10,
    Person = 11,
    Rider = 12,
    Car = 13,
    Truck = 14,
    Bus = 15,
    Train = 16,
    Motorcycle = 17,
    Bicycle = 18,
    RoadMarking = 32,
    GuardRail = 33,
    Bridge = 34,
    StreetFurniture = 35,
}

/// How a material's colour varies over a surface. Patterns are functions of the surface's own coordinates (`uv`, metres),
/// so that they stay with it, and are filtered to the footprint of a pixel: no detail finer than it is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", tag = "kind")]
pub enum Pattern {
    /// One colour: what stereo and structure from motion find nothing on.
    Plain,
    /// Speckle and stains over octaves of noise from `finest_metres` to `coarsest_metres`, `amount` 0 to 1.
    Noise { finest_metres: f32, coarsest_metres: f32, amount: f32 },
    /// Courses of bricks or tiles of this size with joints of another shade, half a brick offset where `bond`.
    Bricks { size_metres: Vec2, joint_metres: f32, joint_shade: f32, bond: bool, amount: f32 },
    /// Planks or panels along u.
    Panels { width_metres: f32, joint_metres: f32, amount: f32 },
    /// Text in a dot-matrix font, in `ink` on the base colour: the row of [`City::texts`]; the surface's uv run from 0 to 1.
    Text { row: u32, ink: Vec3 },
}

/// What a surface is made of. Colours are linear RGB, 0 to 1; roughness and metallic as in glTF.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Material {
    /// For people and files: "asphalt", "brick, red" ...
    pub name: String,
    pub base_colour: Vec3,
    pub roughness: f32,
    pub metallic: f32,
    /// Share of light that goes straight through: 0 for all but glass.
    pub transparency: f32,
    /// Share of a lidar's pulse that comes back from a surface it hits squarely (905 nm), 0 to 1.
    pub lidar_reflectivity: f32,
    pub pattern: Pattern,
}

/// Triangles in the frame of an asset: metres, counter-clockwise seen from outside. A surface that is seen from both sides
/// (a leaf, a pane) has one triangle; whoever traces turns its normal to the ray.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// Corners.
    pub positions: Vec<Vec3>,
    /// Metres along the surface, one for each corner (0 to 1 on a [`Pattern::Text`]).
    pub uvs: Vec<Vec2>,
    /// Corners of each triangle.
    pub triangles: Vec<[u32; 3]>,
    /// Row of [`City::materials`], one for each triangle.
    pub materials: Vec<u16>,
    /// Class, one for each triangle.
    pub classes: Vec<Class>,
}

/// A mesh that actors share.
#[derive(Debug, Clone, PartialEq)]
pub struct Asset {
    /// For people and files: "house 17", "car, estate" ...
    pub name: String,
    pub mesh: Mesh,
}

/// Where something is at a moment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Waypoint {
    pub seconds: f64,
    pub world_from_asset: Rigid,
}

/// A motion: poses at growing moments, interpolated (translation straight, rotation by slerp), held before the first
/// and after the last.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trajectory {
    pub waypoints: Vec<Waypoint>,
    /// Assets in turn, for what changes its shape as it moves: a walker's, one for each part of its gait. Empty: always the
    /// actor's.
    pub gait: Vec<u32>,
    /// Seconds for one round of `gait`.
    pub gait_seconds: f64,
}

/// Something that stands, lies or moves in the city.
#[derive(Debug, Clone, PartialEq)]
pub struct Actor {
    /// Row of [`City::assets`].
    pub asset: u32,
    /// What it is as a whole: the class of its boxes.
    pub class: Class,
    /// Instance, from 1, for what is counted (houses, vehicles, people, trees, poles, signs); 0 for ground and the like.
    pub instance: u32,
    /// Its pose where it has no trajectory.
    pub world_from_asset: Rigid,
    pub trajectory: Option<Trajectory>,
}

/// A city: what stands where and what it is made of.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct City {
    /// Side of the square that is built on, metres.
    pub extent_metres: f64,
    pub materials: Vec<Material>,
    pub texts: Vec<String>,
    pub assets: Vec<Asset>,
    pub actors: Vec<Actor>,
    /// Centre lines of the streets that may be driven, for whoever drives: polylines on the road's surface, world metres.
    pub streets: Vec<Vec<DVec3>>,
}
