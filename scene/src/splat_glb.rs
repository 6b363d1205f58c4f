//! Writes splats as binary glTF, compressed as SPZ: what a tile of 3D Tiles holds. Reads them, compressed or not.
//!
//! Source: glTF 2.0 with the extensions `KHR_gaussian_splatting` and `KHR_gaussian_splatting_compression_spz_2`. The latter says
//! that SPZ's axes are converted on reading, and CesiumJS (1.145), its first reader, takes them as stored. The matrix follows CesiumJS.

mod read;

use glam::{DMat4, DVec3};
use serde_json::{Map, Value, json};

use crate::error::CodecError;
use crate::splats::{Splats, sh_coefficients};
use crate::spz::{self, Version};

pub use self::read::{Part, read};

/// The extension of splats.
pub const SPLATTING: &str = "KHR_gaussian_splatting";
/// The extension of their compression.
pub const COMPRESSION: &str = "KHR_gaussian_splatting_compression_spz_2";

const MAGIC: u32 = 0x4654_6c67;
const JSON_CHUNK: u32 = 0x4e4f_534a;
const BINARY_CHUNK: u32 = 0x004e_4942;
const FLOAT: u32 = 5126;
const UNSIGNED_BYTE: u32 = 5121;
/// SPZ turns y and z about.
const STORED: DVec3 = DVec3::new(1.0, -1.0, -1.0);

/// Encodes splats; `place` takes their axes, metres, to glTF's, whose y is up.
///
/// # Errors
/// As [`spz::write`], a file over 4 GiB, or no splat.
pub fn write(splats: &Splats, antialiased: bool, place: DMat4) -> Result<Vec<u8>, CodecError> {
    if splats.is_empty() {
        return Err(CodecError::new("glTF cannot hold a primitive without splats"));
    }
    let mut binary = spz::write(splats, antialiased, Version::V3)?;
    let length = binary.len();
    binary.resize(length.next_multiple_of(4), 0);
    let mut text = serde_json::to_vec(&document(splats, length, place)).map_err(|e| CodecError::new(e.to_string()))?;
    text.resize(text.len().next_multiple_of(4), b' ');
    let total = u32::try_from(12 + 8 + text.len() + 8 + binary.len());
    let total = total.map_err(|_| CodecError::new("more splats than a binary glTF can hold"))?;
    let mut bytes = Vec::with_capacity(total as usize);
    for word in [MAGIC, 2, total, text.len() as u32, JSON_CHUNK] {
        bytes.extend(word.to_le_bytes());
    }
    bytes.extend(text);
    for word in [binary.len() as u32, BINARY_CHUNK] {
        bytes.extend(word.to_le_bytes());
    }
    bytes.extend(binary);
    Ok(bytes)
}

fn document(splats: &Splats, length: usize, place: DMat4) -> Value {
    let count = splats.len();
    let (mut least, mut most) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for i in 0..count {
        let stored = STORED * splats.mean(i).as_dvec3();
        (least, most) = (least.min(stored), most.max(stored));
    }
    let mut attributes = Map::new();
    let mut accessors = Vec::new();
    let mut attribute = |name: String, accessor: Value| {
        attributes.insert(name, json!(accessors.len()));
        accessors.push(accessor);
    };
    let vector = |kind: &str| json!({ "componentType": FLOAT, "count": count, "type": kind });
    let mut positions = vector("VEC3");
    (positions["min"], positions["max"]) = (json!(least.to_array()), json!(most.to_array()));
    attribute("POSITION".into(), positions);
    let colour = json!({ "componentType": UNSIGNED_BYTE, "normalized": true, "count": count, "type": "VEC4" });
    attribute("COLOR_0".into(), colour);
    attribute(format!("{SPLATTING}:SCALE"), vector("VEC3"));
    attribute(format!("{SPLATTING}:ROTATION"), vector("VEC4"));
    for degree in (1..=3).filter(|&degree| sh_coefficients(degree) <= sh_coefficients(splats.sh_degree())) {
        for n in 0..=2 * degree {
            attribute(format!("{SPLATTING}:SH_DEGREE_{degree}_COEF_{n}"), vector("VEC3"));
        }
    }
    let unturned = place * DMat4::from_scale(STORED);
    json!({
        "asset": { "version": "2.0", "generator": concat!("plat ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": [SPLATTING, COMPRESSION],
        "extensionsRequired": [SPLATTING, COMPRESSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "matrix": unturned.to_cols_array() }],
        "meshes": [{ "primitives": [{
            "mode": 0,
            "attributes": attributes,
            "extensions": { SPLATTING: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "extensions": { COMPRESSION: { "bufferView": 0 } },
            } },
        }] }],
        "accessors": accessors,
        "bufferViews": [{ "buffer": 0, "byteOffset": 0, "byteLength": length }],
        "buffers": [{ "byteLength": length }],
    })
}

#[cfg(test)]
mod tests;
