//! Writes a model as RAD, the format of Spark 2 that is loaded piece by piece: one file with a tree of splats ([`scene::rad`]).
//!
//! ```text
//! cell      splats of one block: merged to at most 256 nodes      -> part "below"
//! square    nodes of its quarters: merged to 256 again             -> part "top"
//! city      with the backdrop: merged to the root                  -> part "top"
//! ```
//!
//! The leaves are the finest cut. Nodes above them are merged and not those of the trained coarser levels: a node is replaced by its
//! children alone, and a trained splat stands for no known set of finer ones.
//!
//! Nodes lie in two scratch files beside the output until their number is known. In memory is one block at a time, and what was
//! merged of the squares on the way to it.

mod scratch;

use std::borrow::Cow;
use std::ops::Range;
use std::path::Path;

use blocks::{Cells, Cut, Ground};
use glam::DVec3;
use rayon::prelude::*;
use scene::rad::{self, Bounds, Children, Forest, Gaussian, Node, Order, Part};
use scene::{BadInput, BlockId, GeoOrigin, Splats};
use serde::Serialize;
use store::file::{AtomicFile, SaveError};

use self::scratch::{Bytes, Nodes};
use crate::error::ModelError;
use crate::export::{Exported, finite_splats};
use crate::read::{self, Opened};

/// Nodes at most of a cell, and of a square, in the top of the tree.
const TOP_NODES: usize = 256;
/// Splats at most that are merged at once: more are quartered.
const FOREST_SPLATS: usize = 1 << 16;
/// Times at most that a cell is quartered to hold no more: splats may coincide.
const MAX_QUARTERS: u8 = 8;

/// The comment of the file.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Comment {
    generator: &'static str,
    /// Leaves of the tree.
    splats: u64,
    /// What was subtracted from all places, metres.
    origin: DVec3,
    up: DVec3,
    antialiased: bool,
    /// Where on Earth the point lies whose place is 0 before the origin was subtracted, if known.
    #[serde(skip_serializing_if = "Option::is_none")]
    geo_origin: Option<GeoOrigin>,
}

/// Writes the model at `path` into the file `out`, one block at a time; `report` is called after each part, with the number of parts that are done
/// and that of all.
///
/// # Errors
/// A path that holds no model, a splat that is not finite, a file that cannot be written, more splats than the format can hold.
pub fn write_rad(path: &Path, out: &Path, report: &mut dyn FnMut(usize, usize)) -> Result<Exported, ModelError> {
    let opened = read::open(path)?;
    let mut writer = Writer::new(&opened, path, out)?;
    let cells = writer.cells.iter().count() + 1;
    let mut done = 0;
    let mut tops = writer.square(BlockId::ROOT, &mut || {
        done += 1;
        report(done, cells);
    })?;
    tops.extend(writer.backdrop()?);
    let root = writer.joined(tops, 1, Part::Top)?;
    writer.emit(&root, Part::Top)?;
    report(cells, cells);
    writer.finish(opened.geo_origin(), opened.antialiased())
}

struct Writer<'a> {
    opened: &'a Opened,
    path: &'a Path,
    out: &'a Path,
    ground: Ground,
    leaves: Cut,
    cells: Cells,
    origin: DVec3,
    /// The block that was read last.
    block: Option<(BlockId, Cow<'a, Splats>)>,
    top: Nodes,
    below: Nodes,
    bounds: Bounds,
    sh_degree: u8,
    splats: u64,
}

impl<'a> Writer<'a> {
    fn new(opened: &'a Opened, path: &'a Path, out: &'a Path) -> Result<Self, ModelError> {
        let (ground, leaves) = (opened.ground(), opened.leaves());
        let middle = ground.core(BlockId::ROOT).centre().extend(ground.height_metres);
        Ok(Self {
            opened,
            path,
            out,
            ground,
            cells: Cells::of(&leaves),
            leaves,
            origin: ground.to_world(middle).round(),
            block: None,
            top: Nodes::create(out, "top")?,
            below: Nodes::create(out, "below")?,
            bounds: Bounds::new(),
            sh_degree: 0,
            splats: 0,
        })
    }

    /// The nodes that stand for a square of the ground.
    fn square(&mut self, region: BlockId, done: &mut dyn FnMut()) -> Result<Vec<Node>, ModelError> {
        if let Some(owner) = self.cells.owner(region) {
            let nodes = self.cell(region, owner)?;
            done();
            return Ok(nodes);
        }
        let mut nodes = Vec::new();
        if self.cells.iter().any(|(cell, _)| cell.ancestor(region.level) == region) {
            for quarter in region.children() {
                nodes.extend(self.square(quarter, done)?);
            }
        }
        self.joined(nodes, TOP_NODES, Part::Top)
    }

    /// The nodes that stand for a cell, which shows splats of one block.
    fn cell(&mut self, region: BlockId, owner: BlockId) -> Result<Vec<Node>, ModelError> {
        let splats = self.read(owner)?;
        let is_here = |row: u32| {
            let place = splats.mean(row as usize).as_dvec3();
            self.leaves.owner_of(&self.ground, place) == Some(owner)
                && !self.is_backdrop(owner, place)
                && self.cells.region_at(&self.ground, place) == Some(region)
        };
        let rows: Vec<u32> = (0..splats.len() as u32).filter(|&row| is_here(row)).collect();
        let mut quarters = Vec::new();
        self.quarter(region, &splats, rows, MAX_QUARTERS, &mut quarters);
        let nodes = self.merged(&splats, &quarters)?;
        self.block = Some((owner, splats));
        self.joined(nodes, TOP_NODES, Part::Below)
    }

    /// The nodes that stand for what is drawn behind everything.
    fn backdrop(&mut self) -> Result<Vec<Node>, ModelError> {
        if !self.leaves.blocks().contains(&BlockId::ROOT) {
            return Ok(Vec::new());
        }
        let splats = self.read(BlockId::ROOT)?;
        let is_here = |&row: &u32| self.is_backdrop(BlockId::ROOT, splats.mean(row as usize).as_dvec3());
        let rows: Vec<u32> = (0..splats.len() as u32).filter(is_here).collect();
        self.merged(&splats, &[rows])
    }

    fn is_backdrop(&self, block: BlockId, place: DVec3) -> bool {
        block == BlockId::ROOT && self.ground.is_background(place)
    }

    /// The splats of a block, halo included; all are finite.
    fn read(&mut self, block: BlockId) -> Result<Cow<'a, Splats>, ModelError> {
        let splats = match self.block.take().filter(|(held, _)| *held == block) {
            Some((_, splats)) => splats,
            None => finite_splats(self.opened, block, self.path)?,
        };
        self.sh_degree = self.sh_degree.max(splats.sh_degree());
        Ok(splats)
    }

    /// Rows by quarters of a square that hold few enough.
    fn quarter(&self, region: BlockId, splats: &Splats, rows: Vec<u32>, times: u8, quarters: &mut Vec<Vec<u32>>) {
        if rows.len() <= FOREST_SPLATS || times == 0 || region.level >= BlockId::MAX_LEVEL {
            quarters.push(rows);
            return;
        }
        let mut by_child = [(); 4].map(|()| Vec::new());
        let children = region.children();
        for row in rows {
            let place = splats.mean(row as usize).as_dvec3();
            let child = children.iter().position(|&child| self.ground.owns(child, place));
            by_child[child.unwrap_or(0)].push(row);
        }
        for (child, rows) in children.into_iter().zip(by_child) {
            self.quarter(child, splats, rows, times - 1, quarters);
        }
    }

    /// Merges each set of rows.
    fn merged(&mut self, splats: &Splats, sets: &[Vec<u32>]) -> Result<Vec<Node>, ModelError> {
        let origin = self.origin;
        let leaf = |&row: &u32| Node { gaussian: Gaussian::of(splats, row as usize, origin), children: Children::NONE };
        let forest = |rows: &Vec<u32>| {
            let mut forest = Forest::new(rows.iter().map(leaf).collect());
            forest.merge(TOP_NODES);
            forest
        };
        let mut nodes = Vec::new();
        for sets in sets.chunks(rayon::current_num_threads()) {
            for forest in sets.par_iter().map(forest).collect::<Vec<Forest>>() {
                nodes.extend(forest.finish(|group| self.emit(group, Part::Below))?);
            }
            self.splats += sets.iter().map(Vec::len).sum::<usize>() as u64;
        }
        Ok(nodes)
    }

    /// Merges nodes to at most this many.
    fn joined(&mut self, nodes: Vec<Node>, at_most: usize, part: Part) -> Result<Vec<Node>, ModelError> {
        let mut forest = Forest::new(nodes);
        forest.merge(at_most);
        forest.finish(|group| self.emit(group, part))
    }

    fn emit(&mut self, group: &[Node], part: Part) -> Result<Children, ModelError> {
        group.iter().for_each(|node| self.bounds.add(&node.gaussian));
        let nodes = if part == Part::Top { &mut self.top } else { &mut self.below };
        let start = nodes.append(group)?;
        Ok(Children { start, count: group.len() as u16, part })
    }

    /// Nodes in the order of the file.
    fn nodes(&mut self, range: Range<u64>) -> Result<Vec<Node>, ModelError> {
        let top = self.top.count();
        let mut nodes = self.top.backwards(range.start.min(top), range.end.min(top))?;
        nodes.extend(self.below.backwards(range.start.saturating_sub(top), range.end.saturating_sub(top))?);
        Ok(nodes)
    }

    fn finish(mut self, geo_origin: Option<GeoOrigin>, antialiased: bool) -> Result<Exported, ModelError> {
        let (top, below) = (self.top.count(), self.below.count());
        let first = self.nodes(0..(top + below).min(rad::FIRST_NODES as u64))?;
        let order = Order::new(top, below, &first);
        let bad = |error: scene::CodecError| BadInput::new(self.path.display().to_string(), error.to_string(), ADVICE);
        order.numbers().map_err(bad)?;
        if order.nodes() == 0 {
            return Err(BadInput::new(self.out.display().to_string(), "would hold no splat", ADVICE).into());
        }
        let encoding = self.bounds.encoding();
        let mut chunks = Bytes::create(self.out, "chunks")?;
        let parts: Vec<Range<u64>> = order.chunks().collect();
        let mut lengths = Vec::with_capacity(parts.len());
        for parts in parts.chunks(rayon::current_num_threads()) {
            let mut read = Vec::with_capacity(parts.len());
            for part in parts {
                read.push((part.start, self.nodes(part.clone())?));
            }
            let encode =
                |(place, nodes): &(u64, Vec<Node>)| rad::chunk(*place, nodes, order, &encoding, self.sh_degree);
            let encoded: Vec<Vec<u8>> = read.par_iter().map(encode).collect::<Result<_, _>>().map_err(bad)?;
            for chunk in encoded {
                lengths.push(chunk.len() as u64);
                chunks.append(&chunk)?;
            }
        }
        let comment = Comment {
            generator: concat!("plat ", env!("CARGO_PKG_VERSION")),
            splats: self.splats,
            origin: self.origin,
            up: self.ground.ground_from_world.inverse() * DVec3::Z,
            antialiased,
            geo_origin,
        };
        let comment = serde_json::to_string(&comment).map_err(|error| SaveError::new(self.out, &error))?;
        let header = rad::header(order, &lengths, &encoding, self.sh_degree, Some(&comment)).map_err(bad)?;
        let mut file = AtomicFile::create(self.out)?;
        file.write(&header)?;
        chunks.copy_to(&mut file)?;
        file.commit()?;
        let bytes = header.len() as u64 + lengths.iter().sum::<u64>();
        Ok(Exported { splats: self.splats, levels: 1, files: 1, bytes, antialiased })
    }
}

const ADVICE: &str = "give a model with splats, or a part of it";

#[cfg(test)]
mod tests;
