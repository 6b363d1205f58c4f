//! What shines at night. Materials say so by their names, in want of a word of their own: "lamp" for lamps, "lit" for
//! rooms with a light on. Lamps on posts light what is around them; all others are only seen.

use std::collections::BTreeMap;

use glam::{IVec2, Quat, Vec3, vec3};

use crate::{Asset, City, Class, Material};

/// Metres beyond which a street lamp counts for nothing.
const REACH: f32 = 24.0;
/// Light of a street lamp straight below, at a metre.
const STREET: Vec3 = vec3(26.0, 20.0, 13.0);

/// What shines in a city.
pub(crate) struct Lamps {
    /// How bright each material is, next to its base colour.
    glow: Vec<f32>,
    /// Street lamps by square of [`REACH`], world metres.
    cells: BTreeMap<[i32; 2], Vec<Vec3>>,
}

impl Lamps {
    pub(crate) fn new(city: &City) -> Self {
        let glow: Vec<f32> = city.materials.iter().map(glow).collect();
        let bulbs: Vec<Option<Vec3>> = city.assets.iter().map(|asset| bulb(asset, &glow)).collect();
        let mut cells: BTreeMap<[i32; 2], Vec<Vec3>> = BTreeMap::new();
        for actor in city.actors.iter().filter(|actor| actor.trajectory.is_none()) {
            if let Some(bulb) = bulbs[actor.asset as usize] {
                let pose = &actor.world_from_asset;
                let at = Quat::from_array(pose.rotation.as_quat().to_array()) * bulb + pose.translation.as_vec3();
                cells.entry(cell(at).to_array()).or_default().push(at);
            }
        }
        Self { glow, cells }
    }

    /// How bright a material is at night, next to its base colour.
    pub(crate) fn glow(&self, material: u16) -> f32 {
        self.glow[usize::from(material)]
    }

    /// Light of the street lamps on a surface; `is_free` says whether nothing stands between two points.
    pub(crate) fn shine(&self, point: Vec3, normal: Vec3, is_free: impl Fn(Vec3, Vec3) -> bool) -> Vec3 {
        let here = cell(point);
        let mut sum = Vec3::ZERO;
        for (x, y) in (0..9).map(|i| (i % 3 - 1, i / 3 - 1)) {
            for &lamp in self.cells.get(&[here.x + x, here.y + y]).into_iter().flatten() {
                let way = lamp - point;
                let square = way.length_squared().max(0.25);
                let towards = way / square.sqrt();
                // downwards most, a little to the sides, nothing up; fades out at its reach
                let lobe = (0.1 + 0.9 * towards.z).max(0.0);
                let fade = (1.0 - square / (REACH * REACH)).max(0.0);
                let share = normal.dot(towards).max(0.0) * lobe * fade * fade / square;
                if share > 1e-4 && is_free(point, lamp - 0.35 * towards) {
                    sum += share * STREET;
                }
            }
        }
        sum
    }
}

fn cell(at: Vec3) -> IVec2 {
    (at.truncate() / REACH).floor().as_ivec2()
}

fn glow(material: &Material) -> f32 {
    let named = |word: &str| material.name.split(|c: char| !c.is_alphabetic()).any(|part| part == word);
    if named("lamp") {
        2.5
    } else if named("lit") {
        0.9
    } else {
        0.0
    }
}

/// The middle of an asset's lamp, where it is one on a post.
fn bulb(asset: &Asset, glow: &[f32]) -> Option<Vec3> {
    let mesh = &asset.mesh;
    let (mut sum, mut corners) = (Vec3::ZERO, 0.0);
    for (i, triangle) in mesh.triangles.iter().enumerate() {
        if mesh.classes[i] == Class::Pole && glow[usize::from(mesh.materials[i])] > 0.0 {
            sum += triangle.iter().map(|&c| mesh.positions[c as usize]).sum::<Vec3>();
            corners += 3.0;
        }
    }
    (corners > 0.0).then(|| sum / corners)
}
