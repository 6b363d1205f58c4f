//! RAD, the format of Spark 2 that is loaded piece by piece: a tree of splats, each node standing for its children from afar.
//!
//! ```text
//! "RAD0"  u32 length  JSON [`Meta`]  zeros to 8 bytes
//! chunk of 65,536 nodes:  "RADC"  u32 length  JSON [`ChunkMeta`]  zeros to 8 bytes  u64 length  properties, each from a multiple of 8 on
//! ```
//!
//! The root is node 0. A node comes before its children, and these are contiguous, so that a viewer reads the first chunk and then
//! those that it comes near to. A property has the first component of all nodes of the chunk, then the second, and so on, as raw
//! deflate. Numbers are little-endian.
//!
//! The tree is made from the leaves up, so it is written backwards: nodes are handed out in groups of siblings before their parents, and the
//! file has them in the reverse order ([`Order`]). [`write()`] does that in memory; a city goes by way of a file (`model::write_rad`).
//!
//! Source: `rad.rs`, `lod_tree.rs` and `SplatPager.ts` of sparkjsdev/spark, 2.2.0, which has no other specification.

mod bounds;
mod chunk;
mod forest;
mod gaussian;
mod meta;
mod quantise;
mod read;
mod view_cut;

use glam::DVec3;

use crate::error::CodecError;
use crate::splats::Splats;

pub use bounds::{Bounds, Encoding};
pub use chunk::chunk;
pub use forest::Forest;
pub use gaussian::Gaussian;
pub use meta::{CHUNK_NODES, header};
pub use read::{Rad, read};

/// A splat of the tree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Node {
    /// The splat.
    pub gaussian: Gaussian,
    /// What it stands for.
    pub children: Children,
}

/// Where a node's children lie, among those that were handed out with them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Children {
    /// How many were handed out before the first.
    pub start: u64,
    /// How many there are; 0 for a leaf.
    pub count: u16,
    /// Where they were handed out.
    pub part: Part,
}

impl Children {
    /// Those of a leaf.
    pub const NONE: Self = Self { start: 0, count: 0, part: Part::Below };
}

/// A sequence of nodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// The root and what is seen from afar, first in the file.
    Top,
    /// The rest.
    Below,
}

/// How many nodes each part has: in the file those of the top come first, and each part is reversed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Order {
    /// Nodes of [`Part::Top`], the root last.
    pub top: u64,
    /// Nodes of [`Part::Below`].
    pub below: u64,
}

impl Order {
    /// Nodes of the file.
    ///
    /// # Errors
    /// More than the format can number.
    pub fn count(self) -> Result<u32, CodecError> {
        let count = self.top.checked_add(self.below).and_then(|count| u32::try_from(count).ok());
        count.ok_or_else(|| CodecError::new("more splats than RAD can number (4,294,967,295)"))
    }

    /// The index of the first child in the file; 0 of a leaf.
    fn first(self, children: Children) -> u32 {
        let last = children.start + u64::from(children.count);
        let first = match children.part {
            _ if children.count == 0 => 0,
            Part::Top => self.top - last,
            Part::Below => self.top + self.below - last,
        };
        first as u32
    }
}

/// Encodes splats with levels of detail, places relative to `origin` (metres): viewers keep places as f16 in their trees, so it should lie among
/// the splats. `comment` may be anything, JSON by custom.
///
/// # Errors
/// No splat, one with a number that is not finite, or more than the format can hold.
pub fn write(splats: &Splats, origin: DVec3, comment: Option<&str>) -> Result<Vec<u8>, CodecError> {
    if splats.is_empty() {
        return Err(CodecError::new("RAD needs at least one splat"));
    }
    if let Some(row) = (0..splats.len()).find(|&i| !splats.is_finite(i)) {
        return Err(CodecError::new(format!("splat {row} has numbers that are not finite, which RAD cannot hold")));
    }
    let leaf = |i| Node { gaussian: Gaussian::of(splats, i, origin), children: Children::NONE };
    let mut forest = Forest::new((0..splats.len()).map(leaf).collect());
    forest.merge(1);
    let mut nodes: Vec<Node> = Vec::with_capacity(2 * splats.len());
    let root = forest.finish(|group| {
        let start = nodes.len() as u64;
        nodes.extend_from_slice(group);
        Ok::<_, CodecError>(Children { start, count: group.len() as u16, part: Part::Below })
    })?;
    let order = Order { top: root.len() as u64, below: nodes.len() as u64 };
    nodes.extend(root);
    nodes.reverse();
    let mut bounds = Bounds::new();
    nodes.iter().for_each(|node| bounds.add(&node.gaussian));
    let encoding = bounds.encoding();
    let chunks = nodes.chunks(CHUNK_NODES).enumerate().map(|(index, nodes)| {
        let base = (index * CHUNK_NODES) as u64;
        chunk(base, nodes, order, &encoding, splats.sh_degree())
    });
    let chunks: Vec<Vec<u8>> = chunks.collect::<Result<_, _>>()?;
    let lengths: Vec<u64> = chunks.iter().map(|chunk| chunk.len() as u64).collect();
    let mut bytes = header(order, &lengths, &encoding, splats.sh_degree(), comment)?;
    chunks.iter().for_each(|chunk| bytes.extend_from_slice(chunk));
    Ok(bytes)
}

#[cfg(test)]
mod tests;
