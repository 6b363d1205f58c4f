//! 3D Tiles with splats in binary glTF: the finest tiles.
//!
//! Source: as of [`crate::write_tiles`] and of [`splat_glb`].

use std::path::Path;

use glam::{DMat4, DQuat, DVec4};
use scene::{BadInput, CodecError, GeoOrigin, Similarity, splat_glb};
use serde::Deserialize;
use serde::de::IgnoredAny;

use super::folder::{Folder, unreadable};
use super::imported::{Gathered, Imported};
use crate::files::load;

/// Name of the file with the tiles.
pub(super) const TILESET: &str = "tileset.json";
/// Versions that are read. 1.0 has glTF by an extension.
const VERSIONS: [&str; 2] = ["1.0", "1.1"];
const CONTENT: &str = "3DTILES_content_gltf";
/// Takes glTF's axes, whose y is up, to those of tiles, whose z is.
const Z_UP: DMat4 = DMat4::from_cols(DVec4::X, DVec4::Z, DVec4::new(0.0, -1.0, 0.0, 0.0), DVec4::W);

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Tileset {
    asset: Asset,
    #[serde(default)]
    extensions_required: Vec<String>,
    root: Tile,
}

#[derive(Deserialize)]
struct Asset {
    version: String,
    /// What `plat export` says of the model; other programs say other things.
    #[serde(default)]
    extras: serde_json::Value,
}

#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
struct Extras {
    ground_from_world: DQuat,
}

/// serde_json refuses tiles more than 60 deep.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Tile {
    /// A tile must have one, so that many of them take many bytes.
    #[serde(rename = "geometricError")]
    _geometric_error: f64,
    transform: Option<[f64; 16]>,
    refine: Option<Refine>,
    content: Option<Uri>,
    #[serde(default)]
    contents: Vec<Uri>,
    #[serde(default)]
    children: Vec<Tile>,
    implicit_tiling: Option<IgnoredAny>,
}

#[derive(Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
enum Refine {
    Add,
    Replace,
}

#[derive(Deserialize)]
struct Uri {
    uri: String,
}

/// What the finest view of a tileset shows.
#[derive(Default)]
struct Finest<'a> {
    /// Files, and what takes their axes to the tileset's.
    files: Vec<(&'a str, DMat4)>,
    /// Where on Earth the first transform leads that leads to Earth.
    geo_origin: Option<GeoOrigin>,
}

impl<'a> Finest<'a> {
    fn add(&mut self, tile: &'a Tile, above: DMat4, refine: Refine) -> Result<(), CodecError> {
        if tile.implicit_tiling.is_some() {
            return Err(CodecError::new("has implicit tiles; explicit ones can be read"));
        }
        let place = above * tile.transform.map_or(DMat4::IDENTITY, |matrix| DMat4::from_cols_array(&matrix));
        let refine = tile.refine.unwrap_or(refine);
        self.geo_origin = self.geo_origin.or_else(|| geo_origin(place));
        if tile.children.is_empty() || refine == Refine::Add {
            self.files.extend(tile.content.iter().chain(&tile.contents).map(|content| (content.uri.as_str(), place)));
        }
        tile.children.iter().try_for_each(|child| self.add(child, place, refine))
    }
}

/// Where on Earth this matrix takes the origin to, if there.
fn geo_origin(ecef_from_local: DMat4) -> Option<GeoOrigin> {
    GeoOrigin::at_ecef(ecef_from_local.w_axis.truncate())
}

/// The name that a URI stands for: `%20` is a space.
fn file_name(uri: &str) -> Result<String, CodecError> {
    let wrong = || CodecError::new(format!("names {uri:?}, in which a % stands for no character"));
    let mut parts = uri.split('%');
    let mut bytes = parts.next().unwrap_or_default().as_bytes().to_vec();
    for part in parts {
        let code = part.get(..2).filter(|code| code.bytes().all(|digit| digit.is_ascii_hexdigit()));
        bytes.push(code.and_then(|code| u8::from_str_radix(code, 16).ok()).ok_or_else(wrong)?);
        bytes.extend(&part.as_bytes()[2..]);
    }
    String::from_utf8(bytes).map_err(|_| wrong())
}

/// Reads a `tileset.json`, one tile at a time. What lies on Earth comes in metres east, north and up of a place there.
pub(super) fn read(path: &Path) -> Result<Imported, BadInput> {
    let wrong = |problem: String| unreadable(path, &CodecError::new(problem));
    let tileset: Tileset = serde_json::from_slice(&load(path)?).map_err(|error| wrong(error.to_string()))?;
    let Asset { version, extras } = tileset.asset;
    if !VERSIONS.contains(&version.as_str()) {
        return Err(wrong(format!(
            "is 3D Tiles of version {version:?}; {} and {} can be read",
            VERSIONS[0], VERSIONS[1]
        )));
    }
    if let Some(name) = tileset.extensions_required.iter().find(|name| *name != CONTENT) {
        return Err(wrong(format!("requires {name:?}, which is not read")));
    }
    let mut finest = Finest::default();
    finest.add(&tileset.root, DMat4::IDENTITY, Refine::Replace).map_err(|error| wrong(error.to_string()))?;
    if finest.files.is_empty() {
        return Err(wrong("has no content in its finest tiles".into()));
    }

    let Extras { ground_from_world } = serde_json::from_value(extras).unwrap_or_default();
    let world_from_ground = DMat4::from_quat(ground_from_world.inverse());
    let (mut folder, mut all) = (Folder::of(path), Gathered::new());
    let mut world_from_tiles = None;
    for (uri, place) in finest.files {
        let file = file_name(uri).and_then(|name| folder.take(&name)).map_err(|error| wrong(error.to_string()))?;
        let bad = |error: CodecError| unreadable(&file, &error);
        let bytes = load(&file)?;
        if bytes.starts_with(b"{") {
            return Err(bad(CodecError::new("is JSON; tilesets as content and .gltf are not read, .glb is")));
        }
        let parts = splat_glb::read(&bytes).map_err(bad)?;
        all.allow(bytes.len());
        drop(bytes);
        for mut part in parts {
            let place = place * Z_UP * part.place;
            let world_from_tiles = *world_from_tiles.get_or_insert_with(|| {
                finest.geo_origin = finest.geo_origin.or_else(|| geo_origin(place));
                let local = finest.geo_origin.map_or(DMat4::IDENTITY, |origin| origin.ecef_from_local().inverse());
                world_from_ground * local
            });
            let moved = Similarity::from_matrix(world_from_tiles * place).ok_or_else(|| {
                bad(CodecError::new("is placed by more than a rotation, a uniform scale and a translation"))
            })?;
            moved.apply(&mut part.splats);
            if let Some(row) = (0..part.splats.len()).find(|&row| !part.splats.is_finite(row)) {
                return Err(bad(CodecError::new(format!("splat {row} is placed beyond what numbers can hold"))));
            }
            all.add(&part.splats, part.antialiased).map_err(|error| wrong(error.to_string()))?;
        }
    }
    Ok(all.finish(finest.geo_origin))
}

#[cfg(test)]
mod tests;
