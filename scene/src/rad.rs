//! RAD, the format of Spark 2 that is loaded piece by piece: a tree of splats, each node standing for its children from afar.
//!
//! ```text
//! "RAD0"  u32 length  JSON [`Meta`]  zeros to 8 bytes
//! chunk of nodes:  "RADC"  u32 length  JSON [`ChunkMeta`]  zeros to 8 bytes  u64 length  properties, each from a multiple of 8 on
//! ```
//!
//! The root is node 0. A node comes before its children, and these are contiguous, so that a viewer reads the first chunk and then
//! those that it comes near to. Chunks have 65,536 nodes, but for the last and, where there are several, the first: that is shorter, so
//! that a picture is soon there, and the numbers from its end to 65,536 belong to no node ([`Order`]).
//!
//! A property has the first component of all nodes of the chunk, then the second, and so on, as raw deflate. Numbers are little-endian.
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

use std::ops::Range;

use glam::DVec3;

use crate::error::CodecError;
use crate::splats::Splats;

pub use bounds::{Bounds, Encoding};
pub use chunk::chunk;
pub use forest::Forest;
pub use gaussian::Gaussian;
pub use meta::{CHUNK_NODES, FIRST_NODES, header};
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

/// How the nodes of a file follow each other: those of the top, then those below, each reversed; and how many the first chunk has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Order {
    top: u64,
    below: u64,
    /// Nodes of the first chunk, if there are others.
    head: u64,
}

impl Order {
    /// The order of so many nodes of [`Part::Top`], the root last, and of [`Part::Below`]; `first` are the first nodes of the file,
    /// [`FIRST_NODES`] or all. The first chunk ends between two groups of siblings, for their numbers must follow each other.
    pub fn new(top: u64, below: u64, first: &[Node]) -> Self {
        let whole = Self { top, below, head: CHUNK_NODES as u64 };
        if whole.nodes() <= CHUNK_NODES as u64 {
            // One page: a second would take another whole one from the viewer.
            return whole;
        }
        let end = FIRST_NODES as u64;
        let divided = first
            .iter()
            .map(|node| (whole.place(node.children), node.children.count))
            .find(|&(place, count)| count > 0 && place < end && end < place + u64::from(count));
        Self { head: divided.map_or(end, |(place, _)| place), ..whole }
    }

    /// Nodes of the file.
    pub fn nodes(self) -> u64 {
        self.top + self.below
    }

    /// Which nodes each chunk has.
    pub fn chunks(self) -> impl Iterator<Item = Range<u64>> {
        let ends = (self.head..self.nodes()).step_by(CHUNK_NODES).chain([self.nodes()]);
        ends.scan(0, |start, end| Some(std::mem::replace(start, end)..end)).filter(|chunk| !chunk.is_empty())
    }

    /// How many numbers there are: 65,536 a chunk, as many as nodes in the last.
    ///
    /// # Errors
    /// More than the format has.
    pub fn numbers(self) -> Result<u32, CodecError> {
        let count = self.number(self.nodes());
        u32::try_from(count).map_err(|_| CodecError::new("more splats than RAD can number (4,294,967,295)"))
    }

    /// The number of the node that is so many places from the root.
    fn number(self, place: u64) -> u64 {
        if place < self.head { place } else { place - self.head + CHUNK_NODES as u64 }
    }

    /// How many nodes come before the first child; 0 of a leaf.
    fn place(self, children: Children) -> u64 {
        let last = children.start + u64::from(children.count);
        match children.part {
            _ if children.count == 0 => 0,
            Part::Top => self.top - last,
            Part::Below => self.top + self.below - last,
        }
    }

    /// The number of the first child; 0 of a leaf.
    fn first(self, children: Children) -> u32 {
        self.number(self.place(children)) as u32
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
    let (top, nodes) = tree(splats, origin)?;
    let order = Order::new(top, nodes.len() as u64 - top, &nodes[..nodes.len().min(FIRST_NODES)]);
    encode(&nodes, order, splats.sh_degree(), comment)
}

/// All nodes in the order of the file, and how many of them are the top's.
fn tree(splats: &Splats, origin: DVec3) -> Result<(u64, Vec<Node>), CodecError> {
    let leaf = |i| Node { gaussian: Gaussian::of(splats, i, origin), children: Children::NONE };
    let mut forest = Forest::new((0..splats.len()).map(leaf).collect());
    forest.merge(1);
    let mut nodes: Vec<Node> = Vec::with_capacity(2 * splats.len());
    let root = forest.finish(|group| {
        let start = nodes.len() as u64;
        nodes.extend_from_slice(group);
        Ok::<_, CodecError>(Children { start, count: group.len() as u16, part: Part::Below })
    })?;
    nodes.extend(&root);
    nodes.reverse();
    Ok((root.len() as u64, nodes))
}

fn encode(nodes: &[Node], order: Order, sh_degree: u8, comment: Option<&str>) -> Result<Vec<u8>, CodecError> {
    let mut bounds = Bounds::new();
    nodes.iter().for_each(|node| bounds.add(&node.gaussian));
    let encoding = bounds.encoding();
    let part = |Range { start, end }| chunk(start, &nodes[start as usize..end as usize], order, &encoding, sh_degree);
    let chunks: Vec<Vec<u8>> = order.chunks().map(part).collect::<Result<_, _>>()?;
    let lengths: Vec<u64> = chunks.iter().map(|chunk| chunk.len() as u64).collect();
    let mut bytes = header(order, &lengths, &encoding, sh_degree, comment)?;
    chunks.iter().for_each(|chunk| bytes.extend_from_slice(chunk));
    Ok(bytes)
}

#[cfg(test)]
mod tests;
