//! Decodes binary glTF of hostile origin: sizes are checked against the bytes at hand before memory is taken, and numbers are finite.

use std::collections::BTreeMap;

use glam::{DMat4, DQuat, DVec3};
use serde::Deserialize;
use serde::de::IgnoredAny;

use super::{BINARY_CHUNK, COMPRESSION, FLOAT, JSON_CHUNK, MAGIC, SPLATTING, STORED, UNSIGNED_BYTE};
use crate::error::CodecError;
use crate::splats::{Splats, column, log_scale, logit, sh_coefficients};
use crate::spz::{self, MEMORY_BYTES, MEMORY_FACTOR};

/// Bytes at most of the JSON, whose nodes take many times as much memory.
pub(super) const MAX_JSON: usize = 1 << 20;
const BYTE: u32 = 5120;
const SHORT: u32 = 5122;
const UNSIGNED_SHORT: u32 = 5123;
/// A primitive takes at most as much memory as this many splats, besides its own: the columns themselves.
const PRIMITIVE_ROWS: u64 = 16;
/// The mode of primitives of splats: points.
const POINTS: u32 = 0;
const KERNEL: &str = "ellipse";
const COLOUR_SPACE: &str = "srgb_rec709_display";

/// The splats of a primitive.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// In axes of their own; all are finite.
    pub splats: Splats,
    /// Whether they are to be rendered anti-aliased.
    pub antialiased: bool,
    /// Takes their axes, metres, to glTF's, whose y is up. It may be any matrix.
    pub place: DMat4,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Document {
    #[serde(default)]
    extensions_required: Vec<String>,
    #[serde(default)]
    scene: usize,
    #[serde(default)]
    scenes: Vec<Scene>,
    #[serde(default)]
    nodes: Vec<Node>,
    #[serde(default)]
    meshes: Vec<Mesh>,
    #[serde(default)]
    accessors: Vec<Accessor>,
    #[serde(default)]
    buffer_views: Vec<View>,
    #[serde(default)]
    buffers: Vec<Buffer>,
}

#[derive(Deserialize)]
struct Scene {
    #[serde(default)]
    nodes: Vec<usize>,
}

#[derive(Deserialize)]
struct Node {
    #[serde(default)]
    children: Vec<usize>,
    mesh: Option<usize>,
    matrix: Option<[f64; 16]>,
    translation: Option<DVec3>,
    rotation: Option<DQuat>,
    scale: Option<DVec3>,
}

impl Node {
    fn matrix(&self) -> DMat4 {
        match self.matrix {
            Some(matrix) => DMat4::from_cols_array(&matrix),
            None => DMat4::from_scale_rotation_translation(
                self.scale.unwrap_or(DVec3::ONE),
                self.rotation.unwrap_or(DQuat::IDENTITY),
                self.translation.unwrap_or(DVec3::ZERO),
            ),
        }
    }
}

#[derive(Deserialize)]
struct Mesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    mode: Option<u32>,
    #[serde(default)]
    attributes: BTreeMap<String, usize>,
    #[serde(default)]
    extensions: Extensions,
}

#[derive(Default, Deserialize)]
struct Extensions {
    #[serde(rename = "KHR_gaussian_splatting")]
    splatting: Option<Splatting>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Splatting {
    kernel: Option<String>,
    color_space: Option<String>,
    #[serde(default)]
    extensions: Compressions,
}

#[derive(Default, Deserialize)]
struct Compressions {
    #[serde(rename = "KHR_gaussian_splatting_compression_spz_2")]
    spz: Option<Packed>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Packed {
    buffer_view: usize,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    #[serde(default)]
    normalized: bool,
    count: usize,
    #[serde(rename = "type")]
    kind: String,
    sparse: Option<IgnoredAny>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct View {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

#[derive(Deserialize)]
struct Buffer {
    uri: Option<IgnoredAny>,
}

/// Decodes the splats that the file's scene shows.
///
/// # Errors
/// No binary glTF, an extension that is required and not read, a scene without splats or with anything else, splats of another kernel or
/// colour space, data in another file or beyond the end of this one, more splats than it can hold, a number that is not finite.
pub fn read(bytes: &[u8]) -> Result<Vec<Part>, CodecError> {
    let (text, binary) = chunks(bytes)?;
    let document: Document =
        serde_json::from_slice(text).map_err(|error| CodecError::new(format!("the JSON of glTF: {error}")))?;
    let is_known = |name: &String| [SPLATTING, COMPRESSION].contains(&name.as_str());
    if let Some(name) = document.extensions_required.iter().find(|name| !is_known(name)) {
        return Err(CodecError::new(format!("glTF that requires {name:?}, which is not read")));
    }
    let memory = MEMORY_BYTES + MEMORY_FACTOR * bytes.len() as u64;
    Reader { document: &document, binary, memory }.scene()
}

/// The JSON and the binary chunk, which may be missing.
pub(super) fn chunks(bytes: &[u8]) -> Result<(&[u8], &[u8]), CodecError> {
    let word = |at: usize| bytes.get(at..)?.first_chunk().map(|word| u32::from_le_bytes(*word));
    if word(0) != Some(MAGIC) || word(4) != Some(2) {
        return Err(CodecError::new("not binary glTF of version 2"));
    }
    let chunk = |at: usize, kind: u32| {
        let length = word(at).filter(|_| word(at + 4) == Some(kind))? as usize;
        bytes.get(at + 8..)?.get(..length)
    };
    let text = chunk(12, JSON_CHUNK).ok_or_else(|| CodecError::new("glTF without JSON, or cut short"))?;
    if text.len() > MAX_JSON {
        return Err(CodecError::new(format!("glTF with {} bytes of JSON; {MAX_JSON} at most are read", text.len())));
    }
    Ok((text, chunk(20 + text.len(), BINARY_CHUNK).unwrap_or_default()))
}

struct Reader<'a> {
    document: &'a Document,
    binary: &'a [u8],
    /// What splats may still take, bytes.
    memory: u64,
}

impl Reader<'_> {
    fn scene(mut self) -> Result<Vec<Part>, CodecError> {
        let Document { scenes, scene, nodes, meshes, .. } = self.document;
        let scene = scenes.get(*scene).ok_or_else(|| CodecError::new("glTF without a scene"))?;
        let mut open: Vec<(usize, DMat4)> = scene.nodes.iter().map(|&node| (node, DMat4::IDENTITY)).collect();
        let mut is_new = vec![true; nodes.len()];
        let mut parts = Vec::new();
        while let Some((index, above)) = open.pop() {
            if !is_new.get_mut(index).is_some_and(std::mem::take) {
                return Err(CodecError::new(format!("glTF whose node {index} is in two places or in none")));
            }
            let node = &nodes[index];
            let place = above * node.matrix();
            open.extend(node.children.iter().map(|&child| (child, place)));
            let Some(mesh) = node.mesh else { continue };
            let mesh = meshes.get(mesh).ok_or_else(|| CodecError::new(format!("glTF without its mesh {mesh}")))?;
            for primitive in &mesh.primitives {
                parts.push(self.part(primitive, place)?);
            }
        }
        match parts.is_empty() {
            true => Err(CodecError::new("glTF without splats")),
            false => Ok(parts),
        }
    }

    fn part(&mut self, primitive: &Primitive, place: DMat4) -> Result<Part, CodecError> {
        let splatting = primitive.extensions.splatting.as_ref().filter(|_| primitive.mode == Some(POINTS));
        let splatting = splatting.ok_or_else(|| CodecError::new("glTF with something else than splats"))?;
        for (found, wanted) in [(&splatting.kernel, KERNEL), (&splatting.color_space, COLOUR_SPACE)] {
            if let Some(found) = found.as_ref().filter(|found| *found != wanted) {
                return Err(CodecError::new(format!("splats of {found:?}; those of {wanted:?} can be read")));
            }
        }
        let part = match &splatting.extensions.spz {
            Some(packed) => {
                let (splats, antialiased) = spz::read(self.view(packed.buffer_view)?.0)?;
                self.take(splats.len(), splats.sh_degree())?;
                Part { splats, antialiased, place: place * DMat4::from_scale(STORED) }
            }
            None => Part { splats: self.plain(primitive)?, antialiased: false, place },
        };
        match (0..part.splats.len()).find(|&row| !part.splats.is_finite(row)) {
            Some(row) => Err(CodecError::new(format!("splat {row} has numbers that are not finite"))),
            None => Ok(part),
        }
    }

    /// Splats that have an accessor for each attribute. Scales and opacities are linear, as in the ratified text of the extension.
    fn plain(&mut self, primitive: &Primitive) -> Result<Splats, CodecError> {
        let coefficient = |degree: u8, n: usize| format!("{SPLATTING}:SH_DEGREE_{degree}_COEF_{n}");
        let is_there = |degree: &u8| primitive.attributes.contains_key(&coefficient(*degree, 0));
        let sh_degree = (1..=3).rev().find(is_there).unwrap_or(0);
        let [scale, rotation, opacity] = ["SCALE", "ROTATION", "OPACITY"].map(|name| format!("{SPLATTING}:{name}"));
        // In the order of the columns.
        let mut names = vec!["POSITION".to_owned(), scale.clone(), rotation.clone(), opacity.clone()];
        names.extend((0..=sh_degree).flat_map(|l| (0..=2 * usize::from(l)).map(move |n| coefficient(l, n))));
        let mut columns: Vec<Vec<f32>> = Vec::with_capacity(column::SH + 3 * sh_coefficients(sh_degree));
        for name in &names {
            let bad = |problem: &str| CodecError::new(format!("the attribute {name:?} of splats {problem}"));
            let accessor = primitive.attributes.get(name).and_then(|&index| self.document.accessors.get(index));
            let accessor = accessor.ok_or_else(|| bad("is missing"))?;
            match columns.first() {
                None => self.take(accessor.count, sh_degree)?,
                Some(first) if first.len() != accessor.count => return Err(bad("has another count than others")),
                Some(_) => {}
            }
            let components = if *name == rotation {
                4
            } else if *name == opacity {
                1
            } else {
                3
            };
            let mut read = self.columns(accessor, components).map_err(|problem| bad(&problem))?;
            if *name == scale {
                read.iter_mut().flatten().for_each(|value| *value = log_scale(*value));
            } else if *name == opacity {
                read.iter_mut().flatten().for_each(|value| *value = logit(*value));
            } else if *name == rotation {
                // From xyzw to wxyz.
                read.rotate_right(1);
            }
            columns.extend(read);
        }
        Splats::from_columns(columns).ok_or_else(|| CodecError::new("splats without attributes"))
    }

    /// The numbers of an accessor by component; all are finite.
    fn columns(&self, accessor: &Accessor, components: usize) -> Result<Vec<Vec<f32>>, String> {
        let (size, largest) = match accessor.component_type {
            FLOAT => (4, None),
            BYTE => (1, Some(127.0)),
            UNSIGNED_BYTE => (1, Some(255.0)),
            SHORT => (2, Some(32_767.0)),
            UNSIGNED_SHORT => (2, Some(65_535.0)),
            other => return Err(format!("has components of type {other}")),
        };
        let largest = largest.filter(|_| accessor.normalized);
        if accessor.kind != ["SCALAR", "VEC2", "VEC3", "VEC4"][components - 1] {
            return Err(format!("is of type {:?}", accessor.kind));
        }
        let view = accessor.buffer_view.filter(|_| accessor.sparse.is_none()).ok_or("is sparse or has no data")?;
        let (bytes, stride) = self.view(view).map_err(|error| error.to_string())?;
        let (row, bytes) = (size * components, bytes.get(accessor.byte_offset..).unwrap_or_default());
        let stride = stride.unwrap_or(row);
        let last = accessor.count.checked_sub(1).and_then(|last| last.checked_mul(stride));
        let end = last.and_then(|last| last.checked_add(row));
        if stride < row || end.is_none_or(|end| end > bytes.len()) {
            return Err("has no rows, or ends beyond its data".into());
        }
        let value = |at: usize| {
            let stored = match (accessor.component_type, &bytes[at..at + size]) {
                (FLOAT, &[a, b, c, d]) => f32::from_le_bytes([a, b, c, d]),
                (SHORT, &[a, b]) => f32::from(i16::from_le_bytes([a, b])),
                (_, &[a, b]) => f32::from(u16::from_le_bytes([a, b])),
                (BYTE, bytes) => f32::from(bytes[0] as i8),
                (_, bytes) => f32::from(bytes[0]),
            };
            largest.map_or(stored, |largest: f32| (stored / largest).max(-1.0))
        };
        let column = |k: usize| (0..accessor.count).map(|row| value(row * stride + k * size)).collect();
        let columns: Vec<Vec<f32>> = (0..components).map(column).collect();
        match columns.iter().flatten().all(|value| value.is_finite()) {
            true => Ok(columns),
            false => Err("has numbers that are not finite".into()),
        }
    }

    /// The bytes of a view, and how far apart its rows are if that is given.
    fn view(&self, index: usize) -> Result<(&[u8], Option<usize>), CodecError> {
        let wrong = |what: &str| CodecError::new(format!("glTF whose buffer view {index} {what}"));
        let view = self.document.buffer_views.get(index).ok_or_else(|| wrong("is missing"))?;
        if view.buffer != 0 || self.document.buffers.first().is_none_or(|buffer| buffer.uri.is_some()) {
            return Err(wrong("lies in another file"));
        }
        let bytes = self.binary.get(view.byte_offset..).and_then(|bytes| bytes.get(..view.byte_length));
        Ok((bytes.ok_or_else(|| wrong("ends beyond the file"))?, view.byte_stride))
    }

    /// Refuses more splats than a file of this length can hold.
    fn take(&mut self, count: usize, sh_degree: u8) -> Result<(), CodecError> {
        let columns = column::SH + 3 * sh_coefficients(sh_degree);
        let needed = (count as u64).saturating_add(PRIMITIVE_ROWS).saturating_mul(4 * columns as u64);
        let refused = || CodecError::new(format!("a file of this length cannot hold {count} splats and its others"));
        self.memory = self.memory.checked_sub(needed).ok_or_else(refused)?;
        Ok(())
    }
}
