//! The data model of a city: classes, materials, meshes, actors.

use glam::{DVec3, Vec2, Vec3};
use scene::Rigid;
use serde::{Deserialize, Serialize};

/// Semantic class of a surface. The numbers are the `trainId` of Cityscapes, and continue from 32 for classes that
/// Cityscapes does not have. Label images hold these numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u8)]
pub enum Class {
    /// Carriageways, on the ground and on a deck.
    Road = 0,
    /// Pavements and their curbs, squares.
    Sidewalk = 1,
    /// Houses and everything fixed to them, including window glass.
    Building = 2,
    /// Free-standing walls, including those of ramps.
    Wall = 3,
    /// Fences and railings away from roads.
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
    /// Pixels whose ray hits nothing; no mesh has this class.
    Sky = 10,
    /// Pedestrians.
    Person = 11,
    /// Riders of bicycles and motorcycles.
    Rider = 12,
    /// Cars and vans.
    Car = 13,
    /// Lorries.
    Truck = 14,
    /// Buses.
    Bus = 15,
    /// Rail vehicles; none are generated.
    Train = 16,
    /// Motorcycles.
    Motorcycle = 17,
    /// Bicycles.
    Bicycle = 18,
    /// Paint on a road.
    RoadMarking = 32,
    /// Barriers along a road.
    GuardRail = 33,
    /// Pillars and sides of a deck.
    Bridge = 34,
    /// Benches, bins, shelters, bollards, hydrants.
    StreetFurniture = 35,
}

impl Class {
    /// All classes, in the order of their numbers.
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

/// Procedural texture of a material: a function of the surface's uv (metres), filtered over the footprint of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", tag = "kind")]
pub enum Pattern {
    /// One colour: textureless for stereo and structure from motion.
    Plain,
    /// Fractal noise: speckle and stains.
    Noise {
        /// Wavelength of the finest octave, metres.
        finest_metres: f32,
        /// Wavelength of the coarsest octave, metres.
        coarsest_metres: f32,
        /// Share by which the colour changes, 0 to 1.
        amount: f32,
    },
    /// Courses of bricks or tiles with joints.
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
    /// Text in a dot-matrix font, in `ink` on the base colour. The surface's uv run from 0 to 1, u in reading
    /// direction, v upwards.
    Text {
        /// Row of [`City::texts`].
        row: u32,
        /// Colour of the letters, linear RGB.
        ink: Vec3,
    },
}

/// A surface material. Colours are linear RGB, 0 to 1; roughness and metallic as in glTF.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Material {
    /// Readable name: "asphalt", "brick, red" ...
    pub name: String,
    /// Linear RGB, 0 to 1.
    pub base_colour: Vec3,
    /// glTF's perceptual roughness, 0 to 1.
    pub roughness: f32,
    /// glTF's metallic, 0 to 1.
    pub metallic: f32,
    /// Transmitted share of light; 0 for all but glass.
    pub transparency: f32,
    /// Reflectivity for a lidar pulse at normal incidence (905 nm), 0 to 1.
    pub lidar_reflectivity: f32,
    /// How the base colour varies.
    pub pattern: Pattern,
}

/// Triangles in the frame of an asset: metres, counter-clockwise seen from outside. Two-sided surfaces (leaves, panes)
/// have one triangle; the ray tracer flips its normal towards the ray.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// Corners.
    pub positions: Vec<Vec3>,
    /// Texture coordinates per corner, metres (0 to 1 on a [`Pattern::Text`]).
    pub uvs: Vec<Vec2>,
    /// Corner indices of each triangle.
    pub triangles: Vec<[u32; 3]>,
    /// Row of [`City::materials`] per triangle.
    pub materials: Vec<u16>,
    /// Class per triangle.
    pub classes: Vec<Class>,
}

/// A mesh shared by actors.
#[derive(Debug, Clone, PartialEq)]
pub struct Asset {
    /// Readable name: "house 17", "car, estate" ...
    pub name: String,
    /// Its triangles.
    pub mesh: Mesh,
}

/// A pose at a time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Waypoint {
    /// City time, seconds.
    pub seconds: f64,
    /// The pose at that time.
    pub world_from_asset: Rigid,
}

/// A motion: poses at increasing times, interpolated (translation linearly, rotation by slerp), constant before the
/// first and after the last.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trajectory {
    /// In order of time.
    pub waypoints: Vec<Waypoint>,
    /// Assets of the phases of a pedestrian's gait. Empty: the actor's own asset at all times.
    pub gait: Vec<u32>,
    /// Duration of one cycle of `gait`, seconds.
    pub gait_seconds: f64,
}

/// An asset placed in the city, static or moving.
#[derive(Debug, Clone, PartialEq)]
pub struct Actor {
    /// Row of [`City::assets`].
    pub asset: u32,
    /// Class of the actor as a whole, and of its bounding box.
    pub class: Class,
    /// Instance number from 1, unique per city, for countable things (houses, vehicles, people, trees, poles, signs); 0
    /// for ground, hedges, fences and walls.
    pub instance: u32,
    /// The pose of an actor without trajectory.
    pub world_from_asset: Rigid,
    /// The motion of a moving actor.
    pub trajectory: Option<Trajectory>,
}

/// A generated city.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct City {
    /// Side of the square city, metres.
    pub extent_metres: f64,
    /// Materials of the meshes' triangles.
    pub materials: Vec<Material>,
    /// Texts of signs.
    pub texts: Vec<String>,
    /// Meshes shared by actors.
    pub assets: Vec<Asset>,
    /// Everything in the city, static and moving.
    pub actors: Vec<Actor>,
    /// Lanes for cars with sensors: polylines on the road surface in driving direction (right-hand traffic), world
    /// metres. Generated traffic does not use these lanes.
    pub streets: Vec<Vec<DVec3>>,
}
