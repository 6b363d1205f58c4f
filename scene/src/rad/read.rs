//! Decodes RAD of hostile origin: sizes are checked before memory is taken, numbers are finite, children follow their parents.

use std::io::Read;

use flate2::read::DeflateDecoder;
use glam::{Quat, Vec3};
use serde::de::DeserializeOwned;

use super::gaussian::{Gaussian, push};
use super::meta::{CHUNK_MAGIC, ChunkMeta, MAGIC, MAX_HEADER, Meta, Property};
use super::quantise::{f16_value, r8_value, rotation_value, s8_value, scale_value};
use crate::error::CodecError;
use crate::splats::{SH_C0, Splats, sh_coefficients};

/// Nodes at most that are read: 16 GB.
const MAX_READ: u64 = 1 << 26;
/// Nodes at most of a chunk: a page of the viewer.
const MAX_CHUNK: u64 = 1 << 16;
/// Nodes at most of a chunk of no bytes, and for each of its bytes: real ones take 10 bytes and more, and each takes memory.
const NODES: u64 = 1 << 10;
const NODES_PER_BYTE: u64 = 2;
/// What a chunk must have.
const NEEDED: [&str; 5] = ["center", "alpha", "rgb", "scales", "orientation"];

/// A file.
#[derive(Debug, Clone, PartialEq)]
pub struct Rad {
    /// The nodes. An opacity from 1 to 2 is that of a merged splat, as stored.
    pub nodes: Vec<Gaussian>,
    /// The first child of each node, as its place in `nodes`, and how many there are.
    pub children: Vec<(u32, u16)>,
    /// SH degree.
    pub sh_degree: u8,
    /// What the writer says of the file.
    pub comment: Option<String>,
}

impl Rad {
    /// The splats that have no children, in the file's axes.
    pub fn leaves(&self) -> Splats {
        let mut splats = Splats::new(self.sh_degree);
        for (node, _) in self.nodes.iter().zip(&self.children).filter(|(_, (_, count))| *count == 0) {
            push(&mut splats, node);
        }
        splats
    }
}

/// Decodes a file whose chunks lie in it.
///
/// # Errors
/// Another version, an encoding or a palette of SH that this reader does not know, a size that does not fit, a number that is not finite, a tree
/// whose nodes do not follow their parents.
pub fn read(bytes: &[u8]) -> Result<Rad, CodecError> {
    let (meta, start) = prefixed::<Meta>(bytes, MAGIC, "RAD")?;
    if meta.version != 1 || meta.kind != "gsplat" {
        return Err(CodecError::new("RAD of another version than 1 of gsplat"));
    }
    let size = meta.chunk_size.unwrap_or(meta.count).max(1);
    if meta.count > MAX_READ || meta.max_sh > 3 || meta.count.div_ceil(size) != meta.chunks.len() as u64 {
        return Err(CodecError::new(format!("RAD of {} splats in {} chunks", meta.count, meta.chunks.len())));
    }
    let mut rad = Rad { nodes: Vec::new(), children: Vec::new(), sh_degree: meta.max_sh, comment: meta.comment };
    // How many nodes come before those of each chunk.
    let mut places = Vec::new();
    for range in &meta.chunks {
        if range.filename.is_some() {
            return Err(CodecError::new("RAD with chunks in files of their own"));
        }
        let chunk = usize::try_from(range.offset).ok().and_then(|offset| bytes.get(start..)?.get(offset..));
        let chunk = chunk.and_then(|chunk| chunk.get(..usize::try_from(range.bytes).ok()?));
        let chunk = chunk.ok_or_else(|| CodecError::new("a RAD chunk ends beyond the file"))?;
        let base = places.len() as u64 * size;
        places.push(rad.nodes.len());
        read_chunk(chunk, base, size.min(meta.count - base), &mut rad)?;
    }
    let last = places.last().map_or(0, |place| (places.len() as u64 - 1) * size + (rad.nodes.len() - place) as u64);
    if last != meta.count {
        return Err(CodecError::new("RAD has other nodes than it says"));
    }
    places.push(rad.nodes.len());
    // A chunk may have fewer nodes than numbers.
    let place = |number: u64| {
        let (chunk, within) = ((number / size) as usize, (number % size) as usize);
        let place = places.get(chunk)? + within;
        (place < *places.get(chunk + 1)?).then_some(place)
    };
    for (index, (first, count)) in rad.children.iter_mut().enumerate().filter(|(_, (_, count))| *count > 0) {
        let (number, others) = (u64::from(*first), u64::from(*count) - 1);
        let places = place(number).zip(place(number + others));
        let follow = places.filter(|&(first, last)| first > index && (last - first) as u64 == others);
        let (place, _) =
            follow.ok_or_else(|| CodecError::new("RAD has children that are not there, or before their parent"))?;
        *first = place as u32;
    }
    Ok(rad)
}

fn read_chunk(bytes: &[u8], base: u64, most: u64, rad: &mut Rad) -> Result<(), CodecError> {
    let (meta, at) = prefixed::<ChunkMeta>(bytes, CHUNK_MAGIC, "a RAD chunk")?;
    if meta.base != base || meta.count > most.min(MAX_CHUNK) || meta.count == 0 {
        return Err(CodecError::new(format!("a RAD chunk of {} splats from {}", meta.count, meta.base)));
    }
    let names = || meta.properties.iter().map(|property| property.property.as_str());
    if meta.count > NODES + NODES_PER_BYTE * bytes.len() as u64
        || NEEDED.iter().any(|&name| !names().any(|n| n == name))
    {
        return Err(CodecError::new("a RAD chunk has too few bytes or properties for its splats"));
    }
    let count = meta.count as usize;
    let payload = bytes.get(at + 8..).unwrap_or_default();
    let blank = Gaussian { mean: Vec3::ZERO, scale: Vec3::ONE, quat: Quat::IDENTITY, opacity: 1.0, sh: [[0.0; 3]; 16] };
    let mut nodes = vec![blank; count];
    let mut children = vec![(0u32, 0u16); count];
    for property in &meta.properties {
        let stored = usize::try_from(property.offset).ok().and_then(|offset| payload.get(offset..));
        let stored = stored.and_then(|bytes| bytes.get(..usize::try_from(property.bytes).ok()?));
        let stored = stored.ok_or_else(|| wrong(property, "ends beyond its chunk"))?;
        let field = |components: usize| numbers(property, stored, count, components);
        match property.property.as_str() {
            "center" => set(&mut nodes, &field(3)?, |node, k| &mut node.mean[k]),
            "alpha" => set(&mut nodes, &field(1)?, |node, _| &mut node.opacity),
            "scales" => set(&mut nodes, &field(3)?, |node, k| &mut node.scale[k]),
            "rgb" => {
                let base: Vec<f32> = field(3)?.into_iter().map(|rgb| (rgb - 0.5) / SH_C0).collect();
                set(&mut nodes, &base, |node, k| &mut node.sh[0][k]);
            }
            "orientation" if property.encoding == "oct88r8" => {
                let codes = inflated(property, stored, 3 * count)?;
                let codes = nodes.iter_mut().zip(codes.as_chunks::<3>().0);
                codes.for_each(|(node, code)| node.quat = rotation_value(*code));
            }
            "sh1" | "sh2" | "sh3" => {
                let degree = usize::from(property.property.as_bytes()[2] - b'0');
                let first = 3 * degree * degree;
                set(&mut nodes, &field(6 * degree + 3)?, |node, k| &mut node.sh.as_flattened_mut()[first + k]);
            }
            "child_count" if property.encoding == "u16" => {
                let words = inflated(property, stored, 2 * count)?;
                let words = children.iter_mut().zip(words.as_chunks().0);
                words.for_each(|(child, word)| child.1 = u16::from_le_bytes(*word));
            }
            "child_start" if property.encoding == "u32" => {
                let words = inflated(property, stored, 4 * count)?;
                let words = children.iter_mut().zip(words.as_chunks().0);
                words.for_each(|(child, word)| child.0 = u32::from_le_bytes(*word));
            }
            _ => return Err(wrong(property, "is not known")),
        }
    }
    for node in &mut nodes {
        node.sh[sh_coefficients(rad.sh_degree)..].fill([0.0; 3]);
    }
    if let Some(index) = nodes.iter().position(|node| !node.is_finite()) {
        return Err(CodecError::new(format!("splat {} has numbers that are not finite", rad.nodes.len() + index)));
    }
    rad.nodes.extend(nodes);
    rad.children.extend(children);
    Ok(())
}

fn set(nodes: &mut [Gaussian], planes: &[f32], mut to: impl FnMut(&mut Gaussian, usize) -> &mut f32) {
    for (k, plane) in planes.chunks_exact(nodes.len()).enumerate() {
        nodes.iter_mut().zip(plane).for_each(|(node, &value)| *to(node, k) = value);
    }
}

/// The components of a property, one after another.
fn numbers(property: &Property, stored: &[u8], count: usize, components: usize) -> Result<Vec<f32>, CodecError> {
    let length = count * components;
    let bytes = |size: usize| inflated(property, stored, size * length);
    let bounds = || property.min.zip(property.max).ok_or_else(|| wrong(property, "has no bounds"));
    let words = |bytes: Vec<u8>| bytes.as_chunks().0.iter().map(|word| f16_value(u16::from_le_bytes(*word))).collect();
    let by_plane = |bytes: Vec<u8>, size: usize| -> Vec<u8> {
        (0..length)
            .flat_map(|i| (0..size).map(move |byte| (i, byte)))
            .map(|(i, byte)| bytes[byte * length + i])
            .collect()
    };
    let floats = |bytes: Vec<u8>| bytes.as_chunks().0.iter().map(|word| f32::from_le_bytes(*word)).collect();
    Ok(match property.encoding.as_str() {
        "f32" => floats(bytes(4)?),
        "f32_lebytes" => floats(by_plane(bytes(4)?, 4)),
        "f16" => words(bytes(2)?),
        "f16_lebytes" => words(by_plane(bytes(2)?, 2)),
        "ln_f16" => {
            let logarithms: Vec<f32> = words(bytes(2)?);
            logarithms.into_iter().map(f32::exp).collect()
        }
        encoding @ ("r8" | "r8_delta" | "s8" | "s8_delta" | "ln_0r8") => {
            let (min, max) = bounds()?;
            let mut codes = bytes(1)?;
            if encoding.ends_with("delta") {
                codes.chunks_exact_mut(count).for_each(sum);
            }
            let value = |code| match encoding {
                "ln_0r8" => scale_value(code, min, max),
                "s8" | "s8_delta" => s8_value(code, max),
                _ => r8_value(code, min, max),
            };
            codes.into_iter().map(value).collect()
        }
        _ => return Err(wrong(property, "is not known")),
    })
}

fn sum(plane: &mut [u8]) {
    let mut last = 0u8;
    for byte in plane {
        last = last.wrapping_add(*byte);
        *byte = last;
    }
}

/// The bytes of a property, of this length.
fn inflated(property: &Property, stored: &[u8], length: usize) -> Result<Vec<u8>, CodecError> {
    let mut bytes = Vec::new();
    match property.compression.as_deref() {
        None => bytes.extend_from_slice(stored),
        Some("gz") => {
            let read = DeflateDecoder::new(stored).take(length as u64 + 1).read_to_end(&mut bytes);
            read.map_err(|_| wrong(property, "is not deflate"))?;
        }
        Some(_) => return Err(wrong(property, "has an unknown compression")),
    }
    if bytes.len() == length { Ok(bytes) } else { Err(wrong(property, "has another length")) }
}

fn wrong(property: &Property, what: &str) -> CodecError {
    CodecError::new(format!("property {} as {} {what}", property.property, property.encoding))
}

/// The JSON after magic and length, and where what follows starts.
fn prefixed<T: DeserializeOwned>(bytes: &[u8], magic: [u8; 4], what: &str) -> Result<(T, usize), CodecError> {
    let length = bytes.get(4..8).and_then(|word| word.try_into().ok()).map_or(0, u32::from_le_bytes) as usize;
    let text = bytes.get(8..).and_then(|rest| rest.get(..length)).filter(|_| bytes.starts_with(&magic));
    let text = text.filter(|text| text.len() <= MAX_HEADER).ok_or_else(|| CodecError::new(format!("not {what}")))?;
    let value = serde_json::from_slice(text).map_err(|error| CodecError::new(format!("{what}: {error}")))?;
    Ok((value, 8 + length.next_multiple_of(8)))
}
