//! Light sources at night. A material emits if its name has the word "lamp" (lamps) or "lit" (lit rooms). Only lamps on
//! posts illuminate other surfaces.

use std::collections::BTreeMap;

use glam::{IVec2, Quat, Vec3, vec3};

use crate::{Asset, City, Class, Material};

/// Range of a street lamp, metres.
const REACH_METRES: f32 = 24.0;
/// Irradiance one metre straight below a street lamp.
const LAMP_INTENSITY: Vec3 = vec3(26.0, 20.0, 13.0);

/// The light sources of a city.
pub(crate) struct Lamps {
    /// Emission of each material, as a factor on its base colour.
    emission: Vec<f32>,
    /// Street lamps by grid cell of [`REACH_METRES`], world metres.
    cells: BTreeMap<[i32; 2], Vec<Vec3>>,
}

impl Lamps {
    pub(crate) fn new(city: &City) -> Self {
        let emission: Vec<f32> = city.materials.iter().map(emission_of).collect();
        let positions: Vec<Option<Vec3>> = city.assets.iter().map(|asset| lamp_position(asset, &emission)).collect();
        let mut cells: BTreeMap<[i32; 2], Vec<Vec3>> = BTreeMap::new();
        for actor in city.actors.iter().filter(|actor| actor.trajectory.is_none()) {
            if let Some(position) = positions[actor.asset as usize] {
                let pose = &actor.world_from_asset;
                let at = Quat::from_array(pose.rotation.as_quat().to_array()) * position + pose.translation.as_vec3();
                cells.entry(cell(at).to_array()).or_default().push(at);
            }
        }
        Self { emission, cells }
    }

    /// Emission of a material, as a factor on its base colour.
    pub(crate) fn emission(&self, material: u16) -> f32 {
        self.emission[usize::from(material)]
    }

    /// Irradiance of the street lamps on a surface; `is_free` tells whether the segment between two points is
    /// unobstructed.
    pub(crate) fn irradiance(&self, point: Vec3, normal: Vec3, is_free: impl Fn(Vec3, Vec3) -> bool) -> Vec3 {
        let here = cell(point);
        let mut sum = Vec3::ZERO;
        for (x, y) in (0..9).map(|i| (i % 3 - 1, i / 3 - 1)) {
            for &lamp in self.cells.get(&[here.x + x, here.y + y]).into_iter().flatten() {
                let way = lamp - point;
                let square = way.length_squared().max(0.25);
                let towards = way / square.sqrt();
                // strongest downwards, none upwards, fading to zero at the range
                let lobe = (0.1 + 0.9 * towards.z).max(0.0);
                let fade = (1.0 - square / (REACH_METRES * REACH_METRES)).max(0.0);
                let share = normal.dot(towards).max(0.0) * lobe * fade * fade / square;
                if share > 1e-4 && is_free(point, lamp - 0.35 * towards) {
                    sum += share * LAMP_INTENSITY;
                }
            }
        }
        sum
    }
}

fn cell(at: Vec3) -> IVec2 {
    (at.truncate() / REACH_METRES).floor().as_ivec2()
}

fn emission_of(material: &Material) -> f32 {
    let named = |word: &str| material.name.split(|c: char| !c.is_alphabetic()).any(|part| part == word);
    if named("lamp") {
        2.5
    } else if named("lit") {
        0.9
    } else {
        0.0
    }
}

/// The centre of an asset's lamp, if it is a street lamp.
fn lamp_position(asset: &Asset, emission: &[f32]) -> Option<Vec3> {
    let mesh = &asset.mesh;
    let (mut sum, mut corners) = (Vec3::ZERO, 0.0);
    for (i, triangle) in mesh.triangles.iter().enumerate() {
        if mesh.classes[i] == Class::Pole && emission[usize::from(mesh.materials[i])] > 0.0 {
            sum += triangle.iter().map(|&c| mesh.positions[c as usize]).sum::<Vec3>();
            corners += 3.0;
        }
    }
    (corners > 0.0).then(|| sum / corners)
}
