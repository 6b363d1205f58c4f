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
    /// Carriageways, on the ground and on a deck.
    Road = 0,
    /// Pavements and their curbs, squares.
    Sidewalk = 1,
    /// Houses with all that is fixed to them, window glass too.
    Building = 2,
    /// Free-standing walls, also those of a ramp.
    Wall = 3,
    /// Fences and railings that are not a road's.
    Fence = 4,
    /// Posts of lamps, signs and signals.
    Pole = 5,
    /// Signal heads.
    TrafficLight = 6,
    /// Plates of signs.
    TrafficSign = 7,
    /// Trees and hedges.
    Vegetation = 8,
    /// Lawn, gravel, bare ground.
    Terrain = 9,
    /// Where no ray hits: no mesh has it.
    Sky = 10,
    /// Who walks or stands.
    Person = 11,
    /// Who rides a bicycle or a motorcycle.
    Rider = 12,
    /// Cars and vans.
    Car = 13,
    /// Lorries.
    Truck = 14,
    /// Buses.
    Bus = 15,
    /// Rail vehicles: none are generated.
    Train = 16,
    /// Motorcycles.
    Motorcycle = 17,
    /// Bicycles.
    Bicycle = 18,
    /// Paint on a road.
    RoadMarking = 32,
    /// Barriers along a road.
    GuardRail = 33,
    /// What carries a deck, and its sides.
    Bridge = 34,
    /// Benches, bins, shelters, bollards, hydrants.
    StreetFurniture = 35,
}

impl Class {
    /// All of them, in the order of their numbers.
    pub const ALL: [Self; 23] = [
        Self::Road,
        Self::Sidewalk,
        Self::Building,
        Self::Wall,
        Self::Fence,
        Self::Pole,
        Self::TrafficLight,
        Self::TrafficSign,
        Self::Vegetation,
        Self::Terrain,
        Self::Sky,
        Self::Person,
        Self::Rider,
        Self::Car,
        Self::Truck,
        Self::Bus,
        Self::Train,
        Self::Motorcycle,
        Self::Bicycle,
        Self::RoadMarking,
        Self::GuardRail,
        Self::Bridge,
        Self::StreetFurniture,
    ];
}

/// How a material's colour varies over a surface. Patterns are functions of the surface's own coordinates (`uv`, metres),
/// so that they stay with it, and are filtered to the footprint of a pixel: no detail finer than it is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", tag = "kind")]
pub enum Pattern {
    /// One colour: what stereo and structure from motion find nothing on.
    Plain,
    /// Speckle and stains over octaves of noise from `finest_metres` to `coarsest_metres`, `amount` 0 to 1.
    Noise {
        /// Wavelength of the finest octave, metres.
        finest_metres: f32,
        /// Wavelength of the coarsest octave, metres.
        coarsest_metres: f32,
        /// Share by which the colour changes, 0 to 1.
        amount: f32,
    },
    /// Courses of bricks or tiles of this size with joints of another shade, half a brick offset where `bond`.
    Bricks {
        /// Length along u and height along v of a brick with its joint, metres.
        size_metres: Vec2,
        /// Width of a joint, metres.
        joint_metres: f32,
        /// Factor on the base colour in a joint.
        joint_shade: f32,
        /// Every other course is shifted by half a brick.
        bond: bool,
        /// Share by which the colour of one brick differs from the next, 0 to 1.
        amount: f32,
    },
    /// Planks or panels along u.
    Panels {
        /// Width of a panel with its joint along u, metres.
        width_metres: f32,
        /// Width of a joint, metres.
        joint_metres: f32,
        /// Share by which the colour of one panel differs from the next, 0 to 1.
        amount: f32,
    },
    /// Text in a dot-matrix font, in `ink` on the base colour: the row of [`City::texts`]; the surface's uv run from 0 to 1,
    /// u with the writing and v upwards.
    Text {
        /// Row of [`City::texts`].
        row: u32,
        /// Colour of the letters, linear RGB.
        ink: Vec3,
    },
}

/// What a surface is made of. Colours are linear RGB, 0 to 1; roughness and metallic as in glTF.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Material {
    /// For people and files: "asphalt", "brick, red" ...
    pub name: String,
    /// Linear RGB, 0 to 1.
    pub base_colour: Vec3,
    /// glTF's perceptual roughness, 0 to 1.
    pub roughness: f32,
    /// glTF's metallic, 0 to 1.
    pub metallic: f32,
    /// Share of light that goes straight through: 0 for all but glass.
    pub transparency: f32,
    /// Share of a lidar's pulse that comes back from a surface it hits squarely (905 nm), 0 to 1.
    pub lidar_reflectivity: f32,
    /// How the base colour varies.
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
    /// Its triangles.
    pub mesh: Mesh,
}

/// Where something is at a moment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Waypoint {
    /// Seconds since the city's beginning.
    pub seconds: f64,
    /// The pose then.
    pub world_from_asset: Rigid,
}

/// A motion: poses at growing moments, interpolated (translation straight, rotation by slerp), held before the first
/// and after the last.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trajectory {
    /// In order of time.
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
    /// Instance, from 1, for what is counted (houses, vehicles, people, trees, poles, signs); 0 for ground and
    /// for what comes in pieces: hedges, fences, walls.
    pub instance: u32,
    /// Its pose where it has no trajectory.
    pub world_from_asset: Rigid,
    /// How it moves, if it does.
    pub trajectory: Option<Trajectory>,
}

/// A city: what stands where and what it is made of.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct City {
    /// Side of the square that is built on, metres.
    pub extent_metres: f64,
    /// What meshes' triangles are made of.
    pub materials: Vec<Material>,
    /// What signs say.
    pub texts: Vec<String>,
    /// The meshes that actors share.
    pub assets: Vec<Asset>,
    /// What stands, lies or moves in the city.
    pub actors: Vec<Actor>,
    /// Lanes for whoever drives with sensors: polylines on the road's surface in driving direction (on the right of the
    /// street), world metres. Generated traffic keeps off these lanes.
    pub streets: Vec<Vec<DVec3>>,
}
