//! Writes a model as streamed SOG, the format of PlayCanvas and SuperSplat that is loaded piece by piece.
//!
//! ```text
//! OUT/lod-meta.json       the tree; written last, so that a folder without it is incomplete
//! OUT/0_0/meta.json ...   splats of the finest level; 1_0 those of the level above, and so on
//! OUT/env.sog             the backdrop, which is always drawn; in one file, as Babylon.js wants it
//! ```
//!
//! The tree is binary. Its leaves are cells ([`Cells`]), each with a run of splats for every level of detail: level 0 are those of
//! the block that owns the cell, level 1 those that the block's parent has there. Where a branch of the block tree ends early, its
//! finest block also is the finer levels, so that a viewer never finds a hole.
//!
//! Source: the specification of streamed SOG in PlayCanvas' user manual.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use blocks::{Cells, Cut, Ground, Mode};
use rayon::prelude::*;
use scene::{BadInput, BlockId, GeoOrigin, Splats, sog};
use serde::Serialize;
use store::file::save;

use crate::error::{ModelError, cannot};
use crate::export::{Bound, Exported, bad, check_new, extent, finite_splats, in_z_order};
use crate::files::save_json;
use crate::read;

const META: &str = "lod-meta.json";
const ENVIRONMENT: &str = "env.sog";
/// Splats at most of a cell at its finest level, and of the cells that share a file: what a viewer loads at once.
const FILE_SPLATS: usize = 1 << 16;
/// Times at most that a cell is quartered to hold no more: splats may coincide.
const MAX_QUARTERS: u8 = 8;

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct LodMeta {
    version: u32,
    asset: Asset,
    count: u64,
    counts: Vec<u64>,
    lod_levels: u8,
    #[serde(skip_serializing_if = "Option::is_none")]
    environment: Option<String>,
    filenames: Vec<String>,
    tree: Node,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Asset {
    generator: &'static str,
    /// Where on Earth the origin lies, if known.
    #[serde(skip_serializing_if = "Option::is_none")]
    geo_origin: Option<GeoOrigin>,
}

#[derive(Serialize)]
struct Node {
    bound: Bound,
    #[serde(skip_serializing_if = "Option::is_none")]
    children: Option<Vec<Node>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    lods: Option<BTreeMap<u8, Run>>,
}

/// Splats that follow each other in a file.
#[derive(Debug, Clone, Copy, Serialize)]
struct Run {
    file: usize,
    offset: usize,
    count: usize,
}

/// What is known of a cell.
struct Leaf {
    bound: Bound,
    /// By the level of the block.
    runs: BTreeMap<u8, Run>,
}

/// Writes the model at `path` into the folder `out`, one block at a time; `report` is called after each, with the number of blocks
/// that are done and that of all.
///
/// # Errors
/// A path that holds no model, a splat that is not finite, a folder that is not empty, a file that cannot be written.
pub fn write_streamed_sog(
    path: &Path,
    out: &Path,
    report: &mut dyn FnMut(usize, usize),
) -> Result<Exported, ModelError> {
    let opened = read::open(path)?;
    check_new(out)?;
    let blocks = opened.blocks();
    let deepest = blocks.iter().map(|block| block.level).max().filter(|_| opened.mode() == Mode::Tree);
    let mut writer = Writer::new(out, opened.ground(), &opened.leaves(), deepest, opened.antialiased());
    for (done, &block) in blocks.iter().rev().enumerate() {
        let splats = finite_splats(&opened, block, path)?;
        writer.add(block, &splats)?;
        report(done + 1, blocks.len());
    }
    writer.finish(opened.geo_origin())
}

struct Writer<'a> {
    out: &'a Path,
    ground: Ground,
    cells: Cells,
    /// The level of the finest blocks; `None` where blocks have no coarser ones above them.
    deepest: Option<u8>,
    antialiased: bool,
    leaves: BTreeMap<BlockId, Leaf>,
    filenames: Vec<String>,
    has_environment: bool,
    exported: Exported,
}

impl<'a> Writer<'a> {
    fn new(out: &'a Path, ground: Ground, cut: &Cut, deepest: Option<u8>, antialiased: bool) -> Self {
        Self {
            out,
            ground,
            cells: Cells::of(cut),
            deepest,
            antialiased,
            leaves: BTreeMap::new(),
            filenames: Vec::new(),
            has_environment: false,
            exported: Exported { levels: deepest.map_or(1, |deepest| deepest + 1), antialiased, ..Exported::default() },
        }
    }

    /// Adds the splats of a block, halo included; all are finite. Blocks come from the deepest level up.
    fn add(&mut self, block: BlockId, splats: &Splats) -> Result<(), ModelError> {
        let place = |i: u32| splats.mean(i as usize).as_dvec3();
        let (background, near): (Vec<u32>, Vec<u32>) =
            (0..splats.len() as u32).partition(|&i| self.ground.is_background(place(i)));
        if block == BlockId::ROOT && !background.is_empty() {
            let rows = in_z_order(splats, &background);
            let files = sog::write(&splats.select(&rows), self.antialiased).map_err(|error| bad(block, &error))?;
            let bytes = sog::bundle(&files).map_err(|error| bad(block, &error))?;
            std::fs::create_dir_all(self.out).map_err(cannot("made", self.out))?;
            save(&self.out.join(ENVIRONMENT), &bytes)?;
            self.exported.files += 1;
            self.exported.bytes += bytes.len() as u64;
            self.has_environment = true;
            self.exported.splats += rows.len() as u64;
        }
        let mut rows_of = self.rows_by_region(block, splats, &near);
        for _ in 0..MAX_QUARTERS {
            let is_crowded = |(region, rows): (&BlockId, &Vec<u32>)| {
                (self.cells.owner(*region) == Some(block) && rows.len() > FILE_SPLATS).then_some(*region)
            };
            let crowded: Vec<BlockId> = rows_of.iter().filter_map(is_crowded).collect();
            if crowded.is_empty() {
                break;
            }
            crowded.into_iter().for_each(|region| self.cells.divide(region));
            rows_of = self.rows_by_region(block, splats, &near);
        }

        let mut regions: Vec<(BlockId, Vec<u32>)> = rows_of.into_iter().collect();
        regions.sort_by_key(|(region, _)| z_order(*region));
        let mut files: Vec<Vec<(BlockId, Vec<u32>)>> = Vec::new();
        let mut held = usize::MAX;
        for (region, rows) in regions {
            held = held.saturating_add(rows.len());
            if held > FILE_SPLATS {
                files.push(Vec::new());
                held = rows.len();
            }
            files.last_mut().expect("one was pushed first").push((region, in_z_order(splats, &rows)));
        }
        let encode = |file: &Vec<(BlockId, Vec<u32>)>| {
            let rows: Vec<u32> = file.iter().flat_map(|(_, rows)| rows.iter().copied()).collect();
            sog::write(&splats.select(&rows), self.antialiased).map_err(|error| bad(block, &error))
        };
        let encoded: Vec<Vec<sog::File>> = files.par_iter().map(encode).collect::<Result<_, BadInput>>()?;
        let lod = self.deepest.map_or(0, |deepest| deepest - block.level);
        for (file, encoded) in files.into_iter().zip(encoded) {
            let index = self.filenames.len();
            let folder = format!("{lod}_{index}");
            self.save(&folder, &encoded)?;
            self.filenames.push(format!("{folder}/{}", sog::META));
            let mut offset = 0;
            for (region, rows) in file {
                let bound = rows.iter().fold(Bound::NOTHING, |bound, &row| bound.with(extent(splats, row as usize)));
                let leaf = self.leaves.entry(region).or_insert(Leaf { bound, runs: BTreeMap::new() });
                leaf.bound = leaf.bound.with(bound);
                leaf.runs.insert(block.level, Run { file: index, offset, count: rows.len() });
                offset += rows.len();
            }
        }
        Ok(())
    }

    /// The rows of a block's splats in each cell that it shows.
    fn rows_by_region(&self, block: BlockId, splats: &Splats, rows: &[u32]) -> BTreeMap<BlockId, Vec<u32>> {
        let mut by_region: BTreeMap<BlockId, Vec<u32>> = BTreeMap::new();
        for &row in rows {
            let region = self.cells.region_at(&self.ground, splats.mean(row as usize).as_dvec3());
            let is_shown = |region: &BlockId| match self.deepest {
                Some(_) => self.cells.is_shown_by(*region, block),
                None => self.cells.owner(*region) == Some(block),
            };
            if let Some(region) = region.filter(is_shown) {
                by_region.entry(region).or_default().push(row);
            }
        }
        by_region
    }

    fn save(&mut self, folder: &str, files: &[sog::File]) -> Result<(), ModelError> {
        let folder = self.out.join(folder);
        std::fs::create_dir_all(&folder).map_err(cannot("made", &folder))?;
        for file in files {
            save(&folder.join(&file.name), &file.bytes)?;
            self.exported.files += 1;
            self.exported.bytes += file.bytes.len() as u64;
        }
        Ok(())
    }

    fn finish(mut self, geo_origin: Option<GeoOrigin>) -> Result<Exported, ModelError> {
        let mut counts = vec![0u64; usize::from(self.exported.levels)];
        let mut nodes: BTreeMap<BlockId, Node> = BTreeMap::new();
        for (region, leaf) in &self.leaves {
            let owner = self.cells.owner(*region).map_or(0, |owner| owner.level);
            let mut lods = BTreeMap::new();
            for (lod, count) in counts.iter_mut().enumerate() {
                // The owner stands for finer levels that do not exist.
                let level = self.deepest.map_or(owner, |deepest| owner.min(deepest - lod as u8));
                if let Some(&run) = leaf.runs.get(&level) {
                    *count += run.count as u64;
                    lods.insert(lod as u8, run);
                }
            }
            nodes.insert(*region, Node { bound: leaf.bound, children: None, lods: Some(lods) });
        }
        let tree = tree_of(nodes).ok_or_else(|| {
            BadInput::new(self.out.display().to_string(), "would hold no splat", "give a model with splats")
        })?;
        self.exported.splats += counts[0];
        let meta = LodMeta {
            version: 1,
            asset: Asset { generator: concat!("plat ", env!("CARGO_PKG_VERSION")), geo_origin },
            count: counts.iter().sum(),
            counts,
            lod_levels: self.exported.levels,
            environment: self.has_environment.then(|| ENVIRONMENT.to_owned()),
            filenames: self.filenames,
            tree,
        };
        let path = self.out.join(META);
        save_json(&path, &meta)?;
        self.exported.files += 1;
        self.exported.bytes += path.metadata().map_err(cannot("read", &path))?.len();
        Ok(self.exported)
    }
}

/// The binary tree over cells, built up from the deepest; `None` without cells.
fn tree_of(mut nodes: BTreeMap<BlockId, Node>) -> Option<Node> {
    let deepest = nodes.keys().map(|region| region.level).max()?;
    for level in (1..=deepest).rev() {
        let of_level: Vec<BlockId> = nodes.keys().copied().filter(|region| region.level == level).collect();
        let parents: BTreeSet<BlockId> = of_level.into_iter().filter_map(BlockId::parent).collect();
        for parent in parents {
            let children: Vec<Node> = parent.children().iter().filter_map(|child| nodes.remove(child)).collect();
            nodes.extend(joined(children).map(|node| (parent, node)));
        }
    }
    nodes.remove(&BlockId::ROOT)
}

/// One node over one to four.
fn joined(mut nodes: Vec<Node>) -> Option<Node> {
    if nodes.len() < 2 {
        return nodes.pop();
    }
    let upper = nodes.split_off(nodes.len() / 2);
    let children: Vec<Node> = [nodes, upper].into_iter().filter_map(joined).collect();
    let bound = children.iter().fold(Bound::NOTHING, |bound, child| bound.with(child.bound));
    Some(Node { bound, children: Some(children), lods: None })
}

/// The place of a region along a Morton curve.
fn z_order(region: BlockId) -> u64 {
    let shift = BlockId::MAX_LEVEL - region.level;
    let spread = |v: u32| (0..BlockId::MAX_LEVEL).fold(0u64, |code, bit| code | u64::from(v >> bit & 1) << (2 * bit));
    (spread(region.x) | spread(region.y) << 1) << (2 * shift)
}

#[cfg(test)]
mod tests;
