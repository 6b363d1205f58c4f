//! Encodes a chunk: nodes that follow each other in the file.

use std::io::Write;

use flate2::Compression;
use flate2::write::DeflateEncoder;

use super::bounds::Encoding;
use super::meta::{CHUNK_MAGIC, ChunkMeta, Property, prefixed};
use super::quantise::{f16_of, r8_of, rotation_of, s8_of, scale_of};
use super::{Node, Order};
use crate::error::CodecError;

/// Encodes nodes in the order of the file, `place` of which come before them.
///
/// # Errors
/// None that is known: those of writing JSON and deflate to memory.
pub fn chunk(
    place: u64,
    nodes: &[Node],
    order: Order,
    bounds: &Encoding,
    sh_degree: u8,
) -> Result<Vec<u8>, CodecError> {
    let mut properties = Properties { metas: Vec::new(), payload: Vec::new() };
    properties.add("center", "f32_lebytes", None, &centres(nodes))?;
    properties.add("alpha", "f16", None, &words(nodes, |node| f16_of(alpha(node))))?;
    let (min, max) = (bounds.rgb_min, bounds.rgb_max);
    let colour = |node: &Node, k: usize| r8_of(node.gaussian.colour()[k], min, max);
    properties.add("rgb", "r8_delta", Some((min, max)), &differences(planes(nodes, 3, colour), nodes.len()))?;
    let (min, max) = (bounds.ln_scale_min, bounds.ln_scale_max);
    let scale = |node: &Node, k: usize| scale_of(node.gaussian.scale[k], min, max);
    properties.add("scales", "ln_0r8", Some((min, max)), &planes(nodes, 3, scale))?;
    let rotations: Vec<u8> = nodes.iter().flat_map(|node| rotation_of(node.gaussian.quat)).collect();
    properties.add("orientation", "oct88r8", None, &rotations)?;
    let of_degree = [("sh1", bounds.sh1_max), ("sh2", bounds.sh2_max), ("sh3", bounds.sh3_max)];
    for (degree, (name, max)) in (1..=usize::from(sh_degree)).zip(of_degree) {
        let first = 3 * degree * degree;
        let value = |node: &Node, k: usize| s8_of(node.gaussian.sh.as_flattened()[first + k], max);
        properties.add(name, "s8", Some((-max, max)), &planes(nodes, 6 * degree + 3, value))?;
    }
    properties.add("child_count", "u16", None, &words(nodes, |node| node.children.count))?;
    let starts: Vec<u8> = nodes.iter().flat_map(|node| order.first(node.children).to_le_bytes()).collect();
    properties.add("child_start", "u32", None, &starts)?;

    let Properties { metas, payload } = properties;
    let meta = ChunkMeta {
        version: 1,
        base: order.number(place),
        count: nodes.len() as u64,
        payload_bytes: payload.len() as u64,
        max_sh: sh_degree,
        lod_tree: true,
        splat_encoding: Some(*bounds),
        properties: metas,
    };
    let mut bytes = prefixed(CHUNK_MAGIC, &meta)?;
    bytes.extend((payload.len() as u64).to_le_bytes());
    bytes.extend(payload);
    Ok(bytes)
}

/// An opacity above 1 as 1 to 2.
fn alpha(node: &Node) -> f32 {
    match node.gaussian.opacity {
        opacity if opacity > 1.0 => (1.0 + 0.25 * (node.gaussian.reach() - 1.0)).clamp(1.0, 2.0),
        opacity => opacity,
    }
}

/// All first bytes of x, y and z, then all second bytes, and so on: the upper ones repeat.
fn centres(nodes: &[Node]) -> Vec<u8> {
    let byte = |byte: usize, axis: usize| nodes.iter().map(move |node| node.gaussian.mean[axis].to_le_bytes()[byte]);
    (0..12).flat_map(|plane| byte(plane / 3, plane % 3)).collect()
}

fn planes(nodes: &[Node], planes: usize, value: impl Fn(&Node, usize) -> u8) -> Vec<u8> {
    (0..planes).flat_map(|plane| nodes.iter().map(move |node| (node, plane))).map(|(node, k)| value(node, k)).collect()
}

fn words(nodes: &[Node], value: impl Fn(&Node) -> u16) -> Vec<u8> {
    nodes.iter().flat_map(|node| value(node).to_le_bytes()).collect()
}

/// Each byte less the one before it in its plane.
fn differences(mut planes: Vec<u8>, length: usize) -> Vec<u8> {
    for plane in planes.chunks_exact_mut(length) {
        let mut last = 0;
        for byte in plane {
            last = std::mem::replace(byte, byte.wrapping_sub(last));
        }
    }
    planes
}

struct Properties {
    metas: Vec<Property>,
    payload: Vec<u8>,
}

impl Properties {
    fn add(
        &mut self,
        property: &str,
        encoding: &str,
        bounds: Option<(f32, f32)>,
        values: &[u8],
    ) -> Result<(), CodecError> {
        let offset = self.payload.len();
        let mut deflate = DeflateEncoder::new(&mut self.payload, Compression::default());
        let written = deflate.write_all(values).and_then(|()| deflate.finish().map(drop));
        written.map_err(|error| CodecError::new(format!("deflate: {error}")))?;
        self.metas.push(Property {
            offset: offset as u64,
            bytes: (self.payload.len() - offset) as u64,
            property: property.into(),
            encoding: encoding.into(),
            compression: Some("gz".into()),
            min: bounds.map(|(min, _)| min),
            max: bounds.map(|(_, max)| max),
        });
        self.payload.resize(self.payload.len().next_multiple_of(8), 0);
        Ok(())
    }
}
