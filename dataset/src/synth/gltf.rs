//! Writes the city as binary glTF 2.0: a mesh per asset with a primitive per material, and a node per actor.
//!
//! glTF has y up, the city z up: the root node rotates between them. Moving actors have their pose at second 0. Normals are
//! omitted; glTF then requires flat shading. Procedural patterns have no equivalent in glTF, so a material has its base colour
//! alone.
//!
//! Source: Khronos, "glTF 2.0 Specification".

use std::collections::BTreeMap;
use std::path::Path;

use city::trace::motion;
use city::{City, Material, Mesh};
use glam::Vec3;
use scene::BadInput;
use serde_json::{Value, json};
use store::file::save;

use super::cameras::ORIGIN;
use super::settings::SynthError;

const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

/// Writes `city.glb`.
pub(super) fn write(out: &Path, city: &City) -> Result<(), SynthError> {
    let path = out.join("city.glb");
    // Lengths in the file have 32 bits.
    let size = |mesh: &Mesh| 20 * mesh.positions.len() as u64 + 12 * mesh.triangles.len() as u64;
    let body: u64 = city.assets.iter().map(|asset| size(&asset.mesh)).sum();
    if body > u64::from(u32::MAX) / 2 {
        let problem = "would be larger than a glTF file can be";
        return Err(BadInput::new(path.display().to_string(), problem, "choose a smaller city, or do without").into());
    }
    save(&path, &glb(city))?;
    Ok(())
}

/// The file's bytes.
fn glb(city: &City) -> Vec<u8> {
    let mut writer = Writer::default();
    let meshes: Vec<Option<Value>> =
        city.assets.iter().map(|asset| writer.mesh(&asset.name, &asset.mesh, city.materials.len())).collect();
    // An asset without triangles has no mesh, and its actors have no nodes.
    let mut rows = Vec::with_capacity(meshes.len());
    let mut count = 0u32;
    for mesh in &meshes {
        rows.push(mesh.is_some().then_some(count));
        count += u32::from(mesh.is_some());
    }
    let node = |actor: &city::Actor| {
        let pose = motion::pose_at(actor, 0.0);
        let asset = motion::asset_at(actor, 0.0) as usize;
        let q = pose.rotation.as_quat();
        Some(json!({
            "name": city.assets.get(asset)?.name,
            "mesh": (*rows.get(asset)?)?,
            "translation": pose.translation.as_vec3().to_array(),
            "rotation": [q.x, q.y, q.z, q.w],
            "extras": { "class": actor.class, "instance": actor.instance, "moves": actor.trajectory.is_some() },
        }))
    };
    let mut nodes: Vec<Value> = city.actors.iter().filter_map(node).collect();
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let children: Vec<usize> = (0..nodes.len()).collect();
    nodes.push(json!({ "name": "city", "rotation": [-half, 0.0, 0.0, half], "children": children }));
    let root = nodes.len() - 1;
    let document = json!({
        "asset": {
            "version": "2.0",
            "generator": concat!("plat ", env!("CARGO_PKG_VERSION")),
            "extras": { "origin": {
                "latitude_degrees": ORIGIN.latitude_degrees,
                "longitude_degrees": ORIGIN.longitude_degrees,
                "altitude_metres": ORIGIN.altitude_metres,
                "axes": "of the city's nodes: x east, y north, z up, metres",
            }},
        },
        "scene": 0,
        "scenes": [{ "nodes": [root] }],
        "nodes": nodes,
        "meshes": meshes.into_iter().flatten().collect::<Vec<Value>>(),
        "materials": city.materials.iter().map(material).collect::<Vec<Value>>(),
        "accessors": writer.accessors,
        "bufferViews": writer.views,
        "buffers": [{ "byteLength": writer.bytes.len() }],
    });
    let mut text = serde_json::to_vec(&document).expect("plain data");
    text.resize(text.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + text.len() + 8 + writer.bytes.len();
    let mut glb = Vec::with_capacity(total);
    let word = |value: usize| u32::try_from(value).expect("checked before").to_le_bytes();
    glb.extend(b"glTF");
    glb.extend(word(2));
    glb.extend(word(total));
    glb.extend(word(text.len()));
    glb.extend(b"JSON");
    glb.extend(text);
    glb.extend(word(writer.bytes.len()));
    glb.extend(b"BIN\0");
    glb.extend(writer.bytes);
    glb
}

fn material(material: &Material) -> Value {
    let [r, g, b] = material.base_colour.to_array();
    let clear = material.transparency > 0.0;
    json!({
        "name": material.name,
        "doubleSided": true,
        "alphaMode": if clear { "BLEND" } else { "OPAQUE" },
        "pbrMetallicRoughness": {
            "baseColorFactor": [r, g, b, 1.0 - material.transparency],
            "metallicFactor": material.metallic,
            "roughnessFactor": material.roughness,
        },
        "extras": { "pattern": material.pattern, "lidar_reflectivity": material.lidar_reflectivity },
    })
}

/// The binary chunk with its buffer views and accessors. All numbers have four bytes, so everything is aligned.
#[derive(Default)]
struct Writer {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Writer {
    /// Appends a mesh; `None` if it has no triangles.
    fn mesh(&mut self, name: &str, mesh: &Mesh, materials: usize) -> Option<Value> {
        let mut parts: BTreeMap<u16, Vec<u32>> = BTreeMap::new();
        for (triangle, &row) in mesh.triangles.iter().zip(&mesh.materials).filter(|(_, m)| usize::from(**m) < materials)
        {
            parts.entry(row).or_default().extend(triangle);
        }
        let first = mesh.positions.first().filter(|_| !parts.is_empty())?;
        let (low, high) = mesh.positions.iter().fold((*first, *first), |(l, h), p: &Vec3| (l.min(*p), h.max(*p)));
        let positions = mesh.positions.iter().flat_map(|p| p.to_array());
        let positions = self.put(positions.map(f32::to_le_bytes), ARRAY_BUFFER, FLOAT, "VEC3", 3);
        self.accessors[positions]["min"] = json!(low.to_array());
        self.accessors[positions]["max"] = json!(high.to_array());
        // The v axis of glTF points down.
        let uvs = mesh.uvs.iter().flat_map(|uv| [uv.x, 1.0 - uv.y]);
        let uvs = self.put(uvs.map(f32::to_le_bytes), ARRAY_BUFFER, FLOAT, "VEC2", 2);
        let primitive = |(row, corners): (&u16, &Vec<u32>)| {
            let indices = corners.iter().map(|corner| corner.to_le_bytes());
            let indices = self.put(indices, ELEMENT_ARRAY_BUFFER, UNSIGNED_INT, "SCALAR", 1);
            json!({
                "attributes": { "POSITION": positions, "TEXCOORD_0": uvs },
                "indices": indices,
                "material": row,
            })
        };
        let primitives: Vec<Value> = parts.iter().map(primitive).collect();
        Some(json!({ "name": name, "primitives": primitives }))
    }

    /// Appends numbers with a buffer view and an accessor, and returns the accessor's index.
    fn put(
        &mut self,
        numbers: impl Iterator<Item = [u8; 4]>,
        target: u32,
        component: u32,
        shape: &str,
        width: usize,
    ) -> usize {
        let start = self.bytes.len();
        self.bytes.extend(numbers.flatten());
        let length = self.bytes.len() - start;
        self.views.push(json!({ "buffer": 0, "byteOffset": start, "byteLength": length, "target": target }));
        self.accessors.push(json!({
            "bufferView": self.views.len() - 1,
            "componentType": component,
            "type": shape,
            "count": length / 4 / width,
        }));
        self.accessors.len() - 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use city::CitySettings;

    #[test]
    fn the_file_follows_the_specification_and_has_every_triangle() {
        let city = City::generate(&CitySettings::default()).unwrap();
        let bytes = glb(&city);
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
        let json: Value = serde_json::from_slice(&bytes[20..20 + word(12)]).unwrap();
        let body = &bytes[20 + word(12) + 8..];
        assert_eq!((body.len() % 4, json["buffers"][0]["byteLength"].as_u64().unwrap() as usize), (0, body.len()));
        let list = |name: &str| json[name].as_array().unwrap().clone();
        let (accessors, views, meshes) = (list("accessors"), list("bufferViews"), list("meshes"));
        let number = |value: &Value| value.as_u64().unwrap() as usize;
        // Accessors fill their buffer views, which are contiguous in the body.
        let mut end = 0;
        for (accessor, view) in accessors.iter().zip(&views) {
            let width = match accessor["type"].as_str().unwrap() {
                "VEC3" => 3,
                "VEC2" => 2,
                _ => 1,
            };
            assert_eq!(number(&view["byteOffset"]), end);
            assert_eq!(4 * width * number(&accessor["count"]), number(&view["byteLength"]));
            end += number(&view["byteLength"]);
        }
        assert_eq!(end, body.len());
        // All indices and materials are in range, and no triangle is missing.
        let mut triangles = Vec::new();
        for mesh in &meshes {
            let mut count = 0;
            for part in mesh["primitives"].as_array().unwrap() {
                let corners = number(&accessors[number(&part["attributes"]["POSITION"])]["count"]);
                let indices = number(&part["indices"]);
                let (from, n) = (number(&views[indices]["byteOffset"]), number(&accessors[indices]["count"]));
                let index = |i: usize| u32::from_le_bytes(body[from + 4 * i..][..4].try_into().unwrap()) as usize;
                assert!((0..n).all(|i| index(i) < corners));
                assert!(number(&part["material"]) < city.materials.len());
                count += n / 3;
            }
            triangles.push(count);
        }
        assert_eq!(triangles.iter().sum::<usize>(), city.assets.iter().map(|a| a.mesh.triangles.len()).sum::<usize>());
        let nodes = list("nodes");
        let actor_nodes = nodes.iter().filter(|node| node["mesh"].is_u64()).count();
        let full = |actor: &&city::Actor| !city.assets[motion::asset_at(actor, 0.0) as usize].mesh.triangles.is_empty();
        assert_eq!(actor_nodes, city.actors.iter().filter(full).count());
        assert_eq!(nodes.last().unwrap()["children"].as_array().unwrap().len(), actor_nodes);
    }
}
