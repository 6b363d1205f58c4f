//! A small hand-built scene with known geometry, for tests of sensors: ground, house, a pane of glass before a wall,
//! pole, a board with text, bush, and a van that passes at 10 m/s.
//!
//! ```text
//! y ▲            wall ▀▀▀▀▀▀▀ y = 12.0           house: x 14…24, y 6…18, 9 m high
//!   │            pane ─────── y = 10.0, transparent
//!   │  street ═══════════════════ y = 0, van: 4.5 × 1.8 × 2.0 m, x = −30 + 10 t, y = −2
//!   └──────▶ x
//! ```

use glam::{DQuat, DVec3, Vec2, Vec3, vec3};
use scene::Rigid;

use crate::{Actor, Asset, City, Class, Material, Mesh, Pattern, Trajectory, Waypoint};

/// Row of the ground's material.
pub const ASPHALT: u16 = 0;
/// Row of the house's walls.
pub const BRICK: u16 = 1;
/// Row of the pane.
pub const GLASS: u16 = 2;
/// Row of the wall behind the pane.
pub const PLASTER: u16 = 3;
/// Row of the van's paint.
pub const PAINT: u16 = 4;
/// Row of the pole.
pub const STEEL: u16 = 5;
/// Row of the board with a text.
pub const BOARD: u16 = 6;
/// Row of the bush.
pub const LEAF: u16 = 7;

/// The scene.
pub fn city() -> City {
    let mut city = City { extent_metres: 200.0, materials: materials(), texts: vec!["plat".into()], ..City::default() };
    let ground = rectangle(vec3(-100.0, -100.0, 0.0), Vec3::X * 200.0, Vec3::Y * 200.0, ASPHALT, Class::Road);
    add_actor(&mut city, "ground", ground, Class::Road, 0, DVec3::ZERO);
    let house = cuboid(vec3(-5.0, -6.0, 0.0), vec3(5.0, 6.0, 9.0), BRICK, Class::Building);
    add_actor(&mut city, "house", house, Class::Building, 1, DVec3::new(19.0, 12.0, 0.0));
    let wall = cuboid(vec3(-4.0, 0.0, 0.0), vec3(4.0, 0.3, 4.0), PLASTER, Class::Wall);
    add_actor(&mut city, "wall", wall, Class::Wall, 2, DVec3::new(0.0, 12.0, 0.0));
    let pane = rectangle(vec3(-3.0, 0.0, 0.5), Vec3::X * 6.0, Vec3::Z * 2.5, GLASS, Class::Building);
    add_actor(&mut city, "pane", pane, Class::Building, 3, DVec3::new(0.0, 10.0, 0.0));
    let pole = cuboid(vec3(-0.06, -0.06, 0.0), vec3(0.06, 0.06, 5.0), STEEL, Class::Pole);
    add_actor(&mut city, "pole", pole, Class::Pole, 4, DVec3::new(8.0, 4.0, 0.0));
    let mut board = rectangle(Vec3::ZERO, Vec3::X * 3.0, Vec3::Z * 0.8, BOARD, Class::TrafficSign);
    board.uvs = vec![Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
    add_actor(&mut city, "board", board, Class::TrafficSign, 5, DVec3::new(-9.0, 8.0, 2.0));
    add_actor(&mut city, "bush", bush(), Class::Vegetation, 6, DVec3::new(-12.0, 6.0, 0.0));
    let van = cuboid(vec3(-2.25, -0.9, 0.0), vec3(2.25, 0.9, 2.0), PAINT, Class::Truck);
    add_actor(&mut city, "van", van, Class::Truck, 7, DVec3::new(-30.0, -2.0, 0.0));
    let at = |seconds: f64| Waypoint {
        seconds,
        world_from_asset: pose_at_point(DVec3::new(10.0 * seconds - 30.0, -2.0, 0.0)),
    };
    let drive = Trajectory { waypoints: vec![at(0.0), at(6.0)], gait: Vec::new(), gait_seconds: 0.0 };
    city.actors.last_mut().expect("the van was added").trajectory = Some(drive);
    city.streets.push(vec![DVec3::new(-60.0, 0.0, 0.0), DVec3::new(60.0, 0.0, 0.0)]);
    city
}

/// A rectangle from a corner along two edges, counter-clockwise seen from outside; uv in metres.
pub fn rectangle(corner: Vec3, along: Vec3, up: Vec3, material: u16, class: Class) -> Mesh {
    let (width, height) = (along.length(), up.length());
    Mesh {
        positions: vec![corner, corner + along, corner + along + up, corner + up],
        uvs: vec![Vec2::ZERO, Vec2::new(width, 0.0), Vec2::new(width, height), Vec2::new(0.0, height)],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        materials: vec![material; 2],
        classes: vec![class; 2],
    }
}

/// A closed box.
pub fn cuboid(low: Vec3, high: Vec3, material: u16, class: Class) -> Mesh {
    let (x, y, z) = (Vec3::X * (high.x - low.x), Vec3::Y * (high.y - low.y), Vec3::Z * (high.z - low.z));
    let mut mesh = Mesh::default();
    let sides =
        [(low, x, z), (low + x, y, z), (low + x + y, -x, z), (low + y, -y, z), (low + z, x, y), (low + y, x, -y)];
    for (corner, along, up) in sides {
        append(&mut mesh, &rectangle(corner, along, up, material, class));
    }
    mesh
}

/// Appends a mesh to another.
pub fn append(mesh: &mut Mesh, other: &Mesh) {
    let first = mesh.positions.len() as u32;
    mesh.positions.extend(&other.positions);
    mesh.uvs.extend(&other.uvs);
    mesh.triangles.extend(other.triangles.iter().map(|t| t.map(|corner| corner + first)));
    mesh.materials.extend(&other.materials);
    mesh.classes.extend(&other.classes);
}

/// Adds an asset and an actor that uses it.
pub fn add_actor(city: &mut City, name: &str, mesh: Mesh, class: Class, instance: u32, at: DVec3) {
    let asset = city.assets.len() as u32;
    city.assets.push(Asset { name: name.into(), mesh });
    city.actors.push(Actor { asset, class, instance, world_from_asset: pose_at_point(at), trajectory: None });
}

/// A pose without rotation.
pub fn pose_at_point(at: DVec3) -> Rigid {
    Rigid { rotation: DQuat::IDENTITY, translation: at }
}

/// A ball of 400 leaves.
fn bush() -> Mesh {
    let mut mesh = Mesh::default();
    for i in 0..400 {
        let height = 1.0 - 2.0 * (i as f32 + 0.5) / 400.0;
        let angle = i as f32 * 2.399_963_2;
        let out = vec3(angle.cos(), angle.sin(), 0.0) * (1.0 - height * height).sqrt() + Vec3::Z * height;
        let side = out.any_orthonormal_vector() * 0.22;
        let leaf = rectangle(out * 1.1 + Vec3::Z * 1.2, side, out.cross(side) + 0.1 * out, LEAF, Class::Vegetation);
        append(&mut mesh, &leaf);
    }
    mesh
}

fn materials() -> Vec<Material> {
    let noise = |finest_metres, coarsest_metres, amount| Pattern::Noise { finest_metres, coarsest_metres, amount };
    let bricks = Pattern::Bricks {
        size_metres: Vec2::new(0.24, 0.08),
        joint_metres: 0.01,
        joint_shade: 1.6,
        bond: true,
        amount: 0.35,
    };
    let all = [
        ("asphalt", vec3(0.1, 0.1, 0.11), 0.9, 0.0, 0.0, 0.15, noise(0.01, 4.0, 0.3)),
        ("brick", vec3(0.33, 0.12, 0.08), 0.9, 0.0, 0.0, 0.35, bricks),
        ("glass", vec3(0.85, 0.95, 0.92), 0.02, 0.0, 0.85, 0.05, Pattern::Plain),
        ("plaster", vec3(0.68, 0.6, 0.45), 0.9, 0.0, 0.0, 0.5, noise(0.02, 2.0, 0.12)),
        ("paint", vec3(0.5, 0.03, 0.03), 0.25, 0.0, 0.0, 0.6, Pattern::Plain),
        ("steel", vec3(0.5, 0.5, 0.52), 0.35, 1.0, 0.0, 0.5, Pattern::Plain),
        ("board", vec3(0.02, 0.1, 0.4), 0.5, 0.0, 0.0, 0.7, Pattern::Text { row: 0, ink: vec3(0.9, 0.9, 0.9) }),
        ("leaf", vec3(0.07, 0.16, 0.03), 0.8, 0.0, 0.0, 0.4, noise(0.02, 0.3, 0.3)),
    ];
    let one = |(name, base_colour, roughness, metallic, transparency, lidar_reflectivity, pattern): (
        &str,
        _,
        _,
        _,
        _,
        _,
        _,
    )| {
        Material { name: name.into(), base_colour, roughness, metallic, transparency, lidar_reflectivity, pattern }
    };
    all.into_iter().map(one).collect()
}
