//! Writes a model as 3D Tiles 1.1 with splats in glTF, which CesiumJS streams and places on the globe.
//!
//! ```text
//! OUT/tileset.json     the tiles; written last, so that a folder without it is incomplete
//! OUT/L-x-y.glb        splats of one square of the ground, of level L of its quadtree
//! OUT/backdrop.glb     the backdrop, which is always drawn
//! ```
//!
//! A block is a tile, its children replace it. Where a block has some children only, the missing quarters are copies cut
//! from it, so that replacing leaves no hole. What no block replaces is quartered until a tile is small.
//!
//! The tileset's axes are those of the ground, z up: east, north and up if the capture says where it lies. Extras say how the
//! world was turned to them. A tile's splats are stored about the middle of its square. Source: OGC 22-025r4 (3D Tiles 1.1), and [`splat_glb`].

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use blocks::{Ground, Mode};
use glam::{DMat3, DMat4, DQuat, DVec3};
use scene::{BadInput, BlockId, GeoOrigin, Splats, column, splat_glb};
use serde::Serialize;
use serde_json::{Value, json};
use store::file::save;

use crate::error::{ModelError, cannot};
use crate::export::{Bound, Exported, bad, check_new, extent, finite_splats, in_z_order};
use crate::files::save_json;
use crate::read;

const TILESET: &str = "tileset.json";
const BACKDROP: &str = "backdrop.glb";
/// The extension for glTF without a wrapper, which must name the extensions that the glTF requires.
const CONTENT: &str = "3DTILES_content_gltf";
/// Splats at most of a tile that no block replaces.
const TILE_SPLATS: usize = 1 << 18;
/// Times at most that a square is quartered to hold no more: splats may coincide.
const MAX_QUARTERS: u8 = 8;
/// Pixels of error on the screen at which viewers refine a tile, unless told otherwise (CesiumJS): a tile is replaced where one
/// of its pixels is larger than one of the screen's.
const SCREEN_ERROR: f64 = 16.0;

/// Writes the model at `path` into the folder `out`, one block at a time; `report` is called after each, with the number of blocks
/// that are done and that of all.
///
/// # Errors
/// A path that holds no model, a splat that is not finite, a folder that is not empty, a file that cannot be written.
pub fn write_tiles(path: &Path, out: &Path, report: &mut dyn FnMut(usize, usize)) -> Result<Exported, ModelError> {
    let opened = read::open(path)?;
    check_new(out)?;
    let blocks = opened.blocks();
    let is_tree = opened.mode() == Mode::Tree;
    let mut writer = Writer::new(out, opened.ground(), is_tree, &blocks, opened.antialiased());
    for (done, &block) in blocks.iter().enumerate() {
        let splats = finite_splats(&opened, block, path)?;
        writer.add(block, &splats, opened.rho_metres(block))?;
        report(done + 1, blocks.len());
    }
    writer.finish(opened.geo_origin())
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Tile {
    bounding_volume: Value,
    geometric_error: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    refine: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    transform: Option<[f64; 16]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    content: Option<Uri>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    children: Vec<Tile>,
    /// In world axes.
    #[serde(skip)]
    bound: Bound,
}

#[derive(Serialize)]
struct Uri {
    uri: String,
}

/// A file of splats.
struct Content {
    uri: String,
    bound: Bound,
    /// Metres that it is coarser than what replaces it; 0 if nothing does.
    error: f64,
}

struct Writer<'a> {
    out: &'a Path,
    ground: Ground,
    is_tree: bool,
    blocks: BTreeSet<BlockId>,
    antialiased: bool,
    contents: BTreeMap<BlockId, Content>,
    backdrop: Option<Content>,
    exported: Exported,
}

impl<'a> Writer<'a> {
    fn new(out: &'a Path, ground: Ground, is_tree: bool, blocks: &[BlockId], antialiased: bool) -> Self {
        let levels: BTreeSet<u8> = blocks.iter().map(|block| block.level).collect();
        Self {
            out,
            ground,
            is_tree,
            blocks: blocks.iter().copied().collect(),
            antialiased,
            contents: BTreeMap::new(),
            backdrop: None,
            exported: Exported {
                levels: if is_tree { levels.len() as u8 } else { 1 },
                antialiased,
                ..Exported::default()
            },
        }
    }

    /// Adds the splats of a block, halo included; all are finite. `rho` is the size of its pixels, metres.
    fn add(&mut self, block: BlockId, splats: &Splats, rho: f64) -> Result<(), ModelError> {
        let place = |i: u32| splats.mean(i as usize).as_dvec3();
        let (background, near): (Vec<u32>, Vec<u32>) =
            (0..splats.len() as u32).partition(|&i| self.ground.is_background(place(i)));
        if block == BlockId::ROOT && !background.is_empty() {
            let middle = self.middle(block);
            self.backdrop = Some(self.save(block, BACKDROP.into(), splats, &background, middle, 0.0)?);
            self.exported.splats += background.len() as u64;
        }
        let rows: Vec<u32> = near.into_iter().filter(|&i| self.ground.owns(block, place(i))).collect();
        let is_replaced = self.is_tree && block.children().iter().any(|child| self.blocks.contains(child));
        if !is_replaced {
            return self.add_leaf(block, block, splats, rows, 0);
        }
        let missing: Vec<BlockId> = block.children().into_iter().filter(|child| !self.blocks.contains(child)).collect();
        for child in missing {
            let quarter = rows.iter().copied().filter(|&i| self.ground.owns(child, place(i))).collect();
            self.add_leaf(block, child, splats, quarter, 0)?;
        }
        self.add_content(block, block, splats, &rows, SCREEN_ERROR * rho)
    }

    /// Adds the splats of a square that nothing replaces, in several tiles if they are many.
    fn add_leaf(
        &mut self,
        block: BlockId,
        region: BlockId,
        splats: &Splats,
        rows: Vec<u32>,
        quarters: u8,
    ) -> Result<(), ModelError> {
        if rows.len() > TILE_SPLATS && quarters < MAX_QUARTERS && region.level < BlockId::MAX_LEVEL {
            for child in region.children() {
                let is_there = |&i: &u32| self.ground.owns(child, splats.mean(i as usize).as_dvec3());
                let quarter = rows.iter().copied().filter(is_there).collect();
                self.add_leaf(block, child, splats, quarter, quarters + 1)?;
            }
            return Ok(());
        }
        self.exported.splats += rows.len() as u64;
        self.add_content(block, region, splats, &rows, 0.0)
    }

    fn add_content(
        &mut self,
        block: BlockId,
        region: BlockId,
        splats: &Splats,
        rows: &[u32],
        error: f64,
    ) -> Result<(), ModelError> {
        if !rows.is_empty() {
            let uri = format!("{}-{}-{}.glb", region.level, region.x, region.y);
            let content = self.save(block, uri, splats, rows, self.middle(region), error)?;
            self.contents.insert(region, content);
        }
        Ok(())
    }

    /// The middle of a square, in ground axes.
    fn middle(&self, region: BlockId) -> DVec3 {
        self.ground.core(region).centre().extend(self.ground.height_metres)
    }

    /// Writes these rows of a block's splats, stored about a place in ground axes.
    fn save(
        &mut self,
        block: BlockId,
        uri: String,
        splats: &Splats,
        rows: &[u32],
        about: DVec3,
        error: f64,
    ) -> Result<Content, ModelError> {
        let mut part = splats.select(&in_z_order(splats, rows));
        let bound = (0..part.len()).fold(Bound::NOTHING, |bound, row| bound.with(extent(&part, row)));
        let middle = self.ground.to_world(about);
        for (column, shift) in part.columns_mut()[column::MEAN..].iter_mut().zip(middle.to_array()) {
            column.iter_mut().for_each(|value| *value = (f64::from(*value) - shift) as f32);
        }
        // glTF's y is up, the ground's z.
        let y_up = DMat4::from_mat3(DMat3::from_cols(DVec3::X, -DVec3::Z, DVec3::Y));
        let place = y_up * DMat4::from_rotation_translation(self.ground.ground_from_world, about);
        let bytes = splat_glb::write(&part, self.antialiased, place).map_err(|error| bad(block, &error))?;
        std::fs::create_dir_all(self.out).map_err(cannot("made", self.out))?;
        save(&self.out.join(&uri), &bytes)?;
        self.exported.files += 1;
        self.exported.bytes += bytes.len() as u64;
        Ok(Content { uri, bound, error })
    }

    fn finish(mut self, geo_origin: Option<GeoOrigin>) -> Result<Exported, ModelError> {
        let contents = std::mem::take(&mut self.contents);
        let above = |region: &BlockId| (0..region.level).map(|level| region.ancestor(level)).collect::<Vec<_>>();
        let inner: BTreeSet<BlockId> = contents.keys().flat_map(above).collect();
        let turn = self.ground.ground_from_world;
        let city = tile(BlockId::ROOT, &contents, &inner, turn, None);
        let backdrop = self.backdrop.take();
        let bounds = city.iter().map(|tile| tile.bound).chain(backdrop.iter().map(|backdrop| backdrop.bound));
        let bound = bounds.reduce(Bound::with).ok_or_else(|| {
            BadInput::new(self.out.display().to_string(), "would hold no splat", "give a model with splats")
        })?;
        let size = f64::from((bound.max - bound.min).length());
        let size = city.iter().fold(size, |size, tile| size.max(tile.geometric_error));
        let root = Tile {
            bounding_volume: volume(bound, turn),
            geometric_error: size,
            refine: Some("ADD"),
            transform: geo_origin.map(|origin| origin.ecef_from_local().to_cols_array()),
            content: backdrop.map(|backdrop| Uri { uri: backdrop.uri }),
            children: city.map(|tile| Tile { refine: Some("REPLACE"), ..tile }).into_iter().collect(),
            bound,
        };
        let extensions = [splat_glb::SPLATTING, splat_glb::COMPRESSION];
        let tileset = json!({
            "asset": { "version": "1.1", "extras": { "generator": concat!("plat ", env!("CARGO_PKG_VERSION")), "groundFromWorld": turn } },
            "extensionsUsed": [CONTENT],
            "extensionsRequired": [CONTENT],
            "extensions": { CONTENT: { "extensionsUsed": extensions, "extensionsRequired": extensions } },
            "geometricError": size,
            "root": serde_json::to_value(root).map_err(|error| store::file::SaveError::new(&self.out.join(TILESET), &error))?,
        });
        let path = self.out.join(TILESET);
        save_json(&path, &tileset)?;
        self.exported.files += 1;
        self.exported.bytes += path.metadata().map_err(cannot("read", &path))?.len();
        Ok(self.exported)
    }
}

/// The tile of a square with all below it; `None` without splats. `above` is the error of the nearest tile above it that has splats.
fn tile(
    region: BlockId,
    contents: &BTreeMap<BlockId, Content>,
    inner: &BTreeSet<BlockId>,
    turn: DQuat,
    above: Option<f64>,
) -> Option<Tile> {
    let content = contents.get(&region);
    let error = content.map(|content| content.error).or(above);
    let mut children: Vec<Tile> = match inner.contains(&region) {
        true => region.children().into_iter().filter_map(|child| tile(child, contents, inner, turn, error)).collect(),
        false => Vec::new(),
    };
    if content.is_none() && children.len() < 2 {
        return children.pop();
    }
    let bounds = content.iter().map(|content| content.bound).chain(children.iter().map(|child| child.bound));
    let bound = bounds.reduce(Bound::with)?;
    // A tile without splats that nothing stands for is refined wherever it is seen as more than a few pixels.
    let own = error.unwrap_or(f64::from((bound.max - bound.min).length()));
    let own = if children.is_empty() { 0.0 } else { own };
    Some(Tile {
        bounding_volume: volume(bound, turn),
        geometric_error: children.iter().fold(own, |most, child| most.max(child.geometric_error)),
        refine: None,
        transform: None,
        content: content.map(|content| Uri { uri: content.uri.clone() }),
        children,
        bound,
    })
}

/// A box in world axes as a box in ground axes: its middle and its half axes.
fn volume(bound: Bound, turn: DQuat) -> Value {
    let (min, max) = (bound.min.as_dvec3(), bound.max.as_dvec3());
    let half = 0.5 * (max - min);
    let axes = [DVec3::X * half.x, DVec3::Y * half.y, DVec3::Z * half.z].map(|axis| turn * axis);
    let numbers: Vec<f64> = [turn * (0.5 * (min + max))].into_iter().chain(axes).flat_map(|v| v.to_array()).collect();
    json!({ "box": numbers })
}

#[cfg(test)]
mod tests;
