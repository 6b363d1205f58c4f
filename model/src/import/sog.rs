//! SOG as an archive, as files beside a `meta.json`, and many of them under a `lod-meta.json`.
//!
//! Source: as of [`scene::sog`] and of [`crate::write_streamed_sog`].

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use scene::{BadInput, CodecError, GeoOrigin, Splats, sog};
use serde::Deserialize;

use super::folder::{Folder, unreadable};
use super::imported::{Gathered, Imported};
use crate::files::load;

/// Name of the file with the tree.
pub(super) const LOD_META: &str = "lod-meta.json";

#[derive(Deserialize)]
struct LodMeta {
    #[serde(default)]
    asset: Asset,
    #[serde(default)]
    environment: Option<String>,
    filenames: Vec<String>,
    tree: Node,
}

/// What `plat export` says of the model.
#[derive(Default, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Asset {
    geo_origin: Option<GeoOrigin>,
}

#[derive(Deserialize)]
struct Node {
    #[serde(default)]
    children: Vec<Node>,
    /// By level of detail, 0 the finest.
    #[serde(default)]
    lods: BTreeMap<u32, Run>,
}

/// Splats that follow each other in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
struct Run {
    file: usize,
    offset: usize,
    count: usize,
}

/// Reads a `.sog` or a `meta.json`.
pub(super) fn read(path: &Path) -> Result<(Splats, bool), BadInput> {
    let (splats, antialiased, _) = read_new(path, &mut BTreeSet::new())?;
    Ok((splats, antialiased))
}

/// As [`read`], with the number of bytes that were read, less those of pictures that are known.
fn read_new(path: &Path, known: &mut BTreeSet<PathBuf>) -> Result<(Splats, bool, usize), BadInput> {
    let bytes = load(path)?;
    let mut length = bytes.len();
    let read = match bytes.starts_with(b"PK") {
        true => sog::read_bundle(&bytes),
        false => {
            let folder = Folder::of(path);
            sog::read(&bytes, |name| {
                let picture = folder.bytes(name)?;
                let is_new = folder.path(name)?.canonicalize().is_ok_and(|real| known.insert(real));
                length += if is_new { picture.len() } else { 0 };
                Ok(picture)
            })
        }
    };
    let (splats, antialiased) = read.map_err(|error| unreadable(path, &error))?;
    Ok((splats, antialiased, length))
}

/// Reads the finest level of every leaf and the environment.
pub(super) fn read_streamed(path: &Path) -> Result<Imported, BadInput> {
    let wrong = |problem: String| unreadable(path, &CodecError::new(problem));
    let meta: LodMeta = serde_json::from_slice(&load(path)?).map_err(|error| wrong(error.to_string()))?;
    let mut runs = Vec::new();
    finest(&meta.tree, &mut runs);
    runs.sort_unstable();
    // Else few bytes of JSON could ask for the same splats again and again.
    if let Some(pair) = runs.windows(2).find(|pair| {
        let [a, b] = [pair[0], pair[1]];
        a.file == b.file && a.offset.checked_add(a.count).is_none_or(|end| end > b.offset)
    }) {
        let file = meta.filenames.get(pair[0].file).map_or("", String::as_str);
        return Err(wrong(format!("has two leaves with the same splats of {file:?}")));
    }
    let (mut folder, mut known, mut all) = (Folder::of(path), BTreeSet::new(), Gathered::new());
    let mut load = |name: &str| read_new(&folder.take(name).map_err(|error| wrong(error.to_string()))?, &mut known);
    let mut add = |splats: &Splats, antialiased: bool, length: usize| {
        all.allow(length);
        all.add(splats, antialiased).map_err(|error| wrong(error.to_string()))
    };
    for of_file in runs.chunk_by(|a, b| a.file == b.file) {
        let index = of_file[0].file;
        let name = meta.filenames.get(index).ok_or_else(|| wrong(format!("has no name for file {index}")))?;
        let (splats, antialiased, length) = load(name)?;
        let mut rows = Vec::new();
        for run in of_file {
            let end = run.offset.checked_add(run.count).filter(|&end| end <= splats.len());
            let end = end.ok_or_else(|| wrong(format!("has a leaf beyond the {} splats of {name:?}", splats.len())))?;
            rows.extend(run.offset as u32..end as u32);
        }
        add(&splats.select(&rows), antialiased, length)?;
    }
    if let Some(name) = &meta.environment {
        let (splats, antialiased, length) = load(name)?;
        add(&splats, antialiased, length)?;
    }
    Ok(all.finish(meta.asset.geo_origin))
}

/// The finest run of every leaf.
fn finest(node: &Node, runs: &mut Vec<Run>) {
    node.children.iter().for_each(|child| finest(child, runs));
    if node.children.is_empty() {
        runs.extend(node.lods.values().next().filter(|run| run.count > 0));
    }
}
