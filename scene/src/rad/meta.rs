//! The JSON of a file and of its chunks, and the bytes around it.

use serde::{Deserialize, Serialize};

use super::Order;
use super::bounds::Encoding;
use crate::error::CodecError;

/// Nodes of a chunk: a page of the viewer's texture. Node `k` of chunk `c` has the number `c * CHUNK_NODES + k`, whatever the chunks before it hold.
pub const CHUNK_NODES: usize = 1 << 16;
/// Nodes of the first chunk where there are several: enough for a first picture, and over a slow line it is there in a third of the time.
pub const FIRST_NODES: usize = 3 << 13;
pub(super) const MAGIC: [u8; 4] = *b"RAD0";
pub(super) const CHUNK_MAGIC: [u8; 4] = *b"RADC";
/// Bytes at most of the header: what viewers fetch of it.
pub(super) const MAX_HEADER: usize = 1 << 20;

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Meta {
    pub(super) version: u32,
    #[serde(rename = "type")]
    pub(super) kind: String,
    /// Numbers of nodes, those that no node has included.
    pub(super) count: u64,
    #[serde(default)]
    pub(super) max_sh: u8,
    #[serde(default)]
    pub(super) lod_tree: bool,
    #[serde(default)]
    pub(super) chunk_size: Option<u64>,
    pub(super) all_chunk_bytes: u64,
    pub(super) chunks: Vec<Range>,
    #[serde(skip_deserializing)]
    pub(super) splat_encoding: Option<Encoding>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) comment: Option<String>,
}

/// Where a chunk lies, from the end of the header on.
#[derive(Serialize, Deserialize)]
pub(super) struct Range {
    pub(super) offset: u64,
    pub(super) bytes: u64,
    /// The chunk's own file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) filename: Option<String>,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct ChunkMeta {
    pub(super) version: u32,
    /// The number of the first node.
    pub(super) base: u64,
    pub(super) count: u64,
    pub(super) payload_bytes: u64,
    #[serde(default)]
    pub(super) max_sh: u8,
    #[serde(default)]
    pub(super) lod_tree: bool,
    #[serde(skip_deserializing)]
    pub(super) splat_encoding: Option<Encoding>,
    pub(super) properties: Vec<Property>,
}

#[derive(Serialize, Deserialize)]
pub(super) struct Property {
    pub(super) offset: u64,
    pub(super) bytes: u64,
    pub(super) property: String,
    pub(super) encoding: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) compression: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) min: Option<f32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) max: Option<f32>,
}

/// The bytes before the chunks, whose lengths are given in order.
///
/// # Errors
/// More chunks than viewers read the header of.
pub fn header(
    order: Order,
    chunk_bytes: &[u64],
    encoding: &Encoding,
    sh_degree: u8,
    comment: Option<&str>,
) -> Result<Vec<u8>, CodecError> {
    let mut all_chunk_bytes = 0;
    let mut chunks = Vec::with_capacity(chunk_bytes.len());
    for &bytes in chunk_bytes {
        chunks.push(Range { offset: all_chunk_bytes, bytes, filename: None });
        all_chunk_bytes += bytes;
    }
    let meta = Meta {
        version: 1,
        kind: "gsplat".into(),
        count: order.numbers()?.into(),
        max_sh: sh_degree,
        lod_tree: true,
        chunk_size: Some(CHUNK_NODES as u64),
        all_chunk_bytes,
        chunks,
        splat_encoding: Some(*encoding),
        comment: comment.map(str::to_owned),
    };
    let bytes = prefixed(MAGIC, &meta)?;
    match bytes.len() <= MAX_HEADER {
        true => Ok(bytes),
        false => Err(CodecError::new(format!("more splats than a RAD header can list: {} chunks", chunk_bytes.len()))),
    }
}

/// Magic, length and JSON, up to a multiple of 8 bytes.
pub(super) fn prefixed(magic: [u8; 4], value: &impl Serialize) -> Result<Vec<u8>, CodecError> {
    let text = serde_json::to_vec(value).map_err(|error| CodecError::new(error.to_string()))?;
    let mut bytes = magic.to_vec();
    bytes.extend((text.len() as u32).to_le_bytes());
    bytes.extend(text);
    bytes.resize(bytes.len().next_multiple_of(8), 0);
    Ok(bytes)
}
