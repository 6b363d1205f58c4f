//! MODEL: the directory that `plat train` wrote, a `.ply` (INRIA's or PlayCanvas' compressed), or a `.spz`.
//!
//! ```text
//! OUT/model/model.json          what the model is, written last
//! OUT/model/plan.plat           the plan, as a frame: ground, tree, who owns what
//! OUT/model/blocks/L-x-y.plat   the splats of one block, halo included, as a frame
//! OUT/merged.ply                the finest cut, sewn together
//! ```

pub(crate) mod rewrite;

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::fs;
use std::path::{Path, PathBuf};

use blocks::{Cut, Ground, Plan};
use scene::{ArtefactId, BadInput, BlockId, CodecError, Exposures, GeoOrigin, Splats, frame, ply, spz};
use serde::{Deserialize, Serialize};
use store::file::{AtomicFile, save};
use store::{BlockingStore, Store};
use tempfile::TempDir;

use crate::failure::{Failure, cannot};

/// The version of [`Manifest`] that this program writes and reads.
const VERSION: u32 = 1;
/// Said in a PLY's comments of a model that is to be drawn anti-aliased.
const ANTIALIASED: &str = "antialiased";
const PLAN_FILE: &str = "plan.plat";
const MERGED_FILE: &str = "merged.ply";
const EXPOSURES_FILE: &str = "exposures.plat";

/// `model.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Manifest {
    pub(crate) version: u32,
    /// The plan that it was trained by.
    pub(crate) plan: ArtefactId,
    /// Draw with opacity compensated for the pixel's blur.
    pub(crate) antialiased: bool,
    pub(crate) sh_degree: u8,
    pub(crate) geo_origin: Option<GeoOrigin>,
    pub(crate) ground: Ground,
    /// Every how many views one was held out; 0 = none.
    pub(crate) test_every: u32,
    /// Photos were used at one over this of their size.
    pub(crate) downscale: u32,
    /// Hash of the file of the training views' exposures, where there are any.
    #[serde(default)]
    pub(crate) exposures: Option<ArtefactId>,
    /// Splats of the finest cut.
    pub(crate) splats: u64,
    /// By (level, y, x).
    pub(crate) blocks: Vec<Block>,
}

/// A block of the tree.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Block {
    pub(crate) block: BlockId,
    /// Hash of the block's frame.
    pub(crate) artefact: ArtefactId,
    /// Splats with the halo's.
    pub(crate) splats: u64,
}

/// A model in memory.
#[derive(Debug)]
pub(crate) struct Model {
    /// The finest cut.
    pub(crate) splats: Splats,
    pub(crate) antialiased: bool,
    /// What its training views are compared through, by view of the plan's capture; nobody draws a model with it.
    pub(crate) exposures: Option<Exposures>,
    /// Of a trained model: its manifest and the folder that `plat train` wrote.
    pub(crate) trained: Option<(Manifest, PathBuf)>,
}

impl Model {
    /// How the model is drawn.
    pub(crate) fn options(&self) -> render::Options {
        render::Options { antialiased: self.antialiased, sh_degree: self.splats.sh_degree(), ..Default::default() }
    }

    /// As an INRIA PLY.
    pub(crate) fn to_ply(&self) -> Vec<u8> {
        ply::write(&self.splats, comments(self.antialiased))
    }

    /// As SPZ of version 3.
    ///
    /// # Errors
    /// Splats that the format cannot hold.
    pub(crate) fn to_spz(&self) -> Result<Vec<u8>, BadInput> {
        spz::write(&self.splats, self.antialiased, spz::Version::V3).map_err(|error| {
            BadInput::new("the model", format!("cannot be written as SPZ: {error}"), "use PLY or repair the model")
        })
    }

    /// Every which view was held out of its training, and by how much photos were reduced; what is usual where it is unknown.
    pub(crate) fn photos_used(&self) -> (u32, u32) {
        self.trained.as_ref().map_or((8, 1), |(manifest, _)| (manifest.test_every, manifest.downscale))
    }

    /// The store for its photos: the one asked for, else its own where that is still there, else one in the temporary folder,
    /// with which it is gone.
    pub(crate) fn photo_store(&self, asked: Option<&str>) -> Result<(Store, TempDir), Failure> {
        let temporary = tempfile::tempdir().map_err(|e| Failure::Work(format!("no temporary folder: {e}")))?;
        let own = self.trained.as_ref().map(|(_, out)| out.join("store")).filter(|store| store.is_dir());
        let store = match asked {
            Some(url) => Store::open(url)?,
            None => Store::open(&own.unwrap_or_else(|| temporary.path().to_path_buf()).display().to_string())?,
        };
        Ok((store, temporary))
    }

    /// The folder for what is said about it.
    pub(crate) fn folder(&self, path: &Path, what: &str) -> PathBuf {
        match &self.trained {
            Some((_, out)) => out.join(what),
            None => path.with_file_name(format!("{}-{what}", path.file_stem().unwrap_or_default().to_string_lossy())),
        }
    }
}

/// Begins a model's folder under `out`: an older model is none from here on, nor what was said of it, and the new one is
/// none before its `model.json` is there.
fn begin(out: &Path, plan: &Plan) -> Result<PathBuf, Failure> {
    let folder = out.join("model");
    if folder.join("model.json").exists() {
        fs::remove_dir_all(&folder).map_err(cannot("replaced", &folder))?;
    }
    for file in [MERGED_FILE, "report.json"].map(|name| out.join(name)) {
        if file.exists() {
            fs::remove_file(&file).map_err(cannot("replaced", &file))?;
        }
    }
    let blocks = folder.join("blocks");
    fs::create_dir_all(&blocks).map_err(cannot("made", &blocks))?;
    save(&folder.join(PLAN_FILE), &plan.to_frame())?;
    Ok(folder)
}

/// What [`write`] wrote.
pub(crate) struct Written {
    /// Splats of the finest cut.
    pub(crate) splats: u64,
    /// Bytes of `merged.ply`.
    pub(crate) bytes: u64,
}

/// Writes the results of all tasks of a plan, in its order, under `out`: one block in memory at a time, as the model may be
/// larger than that.
pub(crate) fn write(
    out: &Path,
    plan: &Plan,
    results: &[ArtefactId],
    store: &BlockingStore,
    geo_origin: Option<GeoOrigin>,
    downscale: u32,
) -> Result<Written, Failure> {
    let folder = begin(out, plan)?;
    let (leaves, sh_degree) = (plan.leaves(), plan.settings.sh_degree);
    let owned = |splats: &Splats, block| leaves.keep(splats, &plan.ground, block).with_sh_degree(sh_degree);

    let (mut blocks, mut exposures, mut count) = (Vec::new(), None, 0);
    for (index, task) in plan.tasks.iter().enumerate() {
        let block = task.block;
        let artefact = *results.get(index).ok_or_else(|| Failure::Work(format!("block {block} has no result")))?;
        let bytes = store.get(artefact)?;
        let damaged = |error: CodecError| Failure::Work(format!("block {block}: {error}"));
        let (splats, about) = frame::decode_result(&bytes).map_err(damaged)?;
        exposures = exposures.or(about.exposures);
        save(&folder.join("blocks").join(file_name(block)), &bytes)?;
        blocks.push(Block { block, artefact, splats: splats.len() as u64 });
        count += owned(&splats, block).len();
    }

    let mut order: Vec<BlockId> = blocks.iter().map(|of| of.block).collect();
    order.sort_unstable();
    let mut merged = AtomicFile::create(&out.join(MERGED_FILE))?;
    let header = ply::header(count, sh_degree, comments(plan.settings.antialiased));
    merged.write(&header)?;
    let mut bytes = header.len() as u64;
    for block in order {
        let rows = ply::rows(&owned(&read_block(&folder, block)?, block));
        merged.write(&rows)?;
        bytes += rows.len() as u64;
    }
    merged.commit()?;

    if let Some(id) = exposures {
        save(&folder.join(EXPOSURES_FILE), &store.get(id)?)?;
    }
    let manifest = Manifest {
        version: VERSION,
        plan: plan.id(),
        antialiased: plan.settings.antialiased,
        sh_degree,
        geo_origin,
        ground: plan.ground,
        test_every: plan.settings.test_every,
        downscale,
        exposures,
        splats: count as u64,
        blocks,
    };
    save_json(&folder.join("model.json"), &manifest)?;
    Ok(Written { splats: count as u64, bytes })
}

/// The comments of a model's PLY.
fn comments(antialiased: bool) -> &'static [&'static str] {
    if antialiased { &[ANTIALIASED] } else { &[] }
}

/// Ends what [`begin`] began, once the blocks are there; returns the bytes of `merged.ply`.
fn finish(out: &Path, model: &Model) -> Result<u64, Failure> {
    let merged = model.to_ply();
    save(&out.join(MERGED_FILE), &merged)?;
    if let Some(exposures) = &model.exposures {
        save(&out.join("model").join(EXPOSURES_FILE), &exposures.to_frame())?;
    }
    if let Some((manifest, _)) = &model.trained {
        save_json(&out.join("model/model.json"), manifest)?;
    }
    Ok(merged.len() as u64)
}

/// Reads a model: a folder that `plat train` wrote, its `model` folder, a `.ply` or a `.spz`.
///
/// # Errors
/// What is not there, not readable, or not a model.
pub(crate) fn read(path: &Path) -> Result<Model, BadInput> {
    let advice = "give a folder that plat train wrote, a .ply or a .spz";
    if path.is_dir() {
        let Some(folder) = trained_folder(path) else {
            return Err(BadInput::new(path.display().to_string(), "holds no model/model.json", advice));
        };
        return read_trained(&folder);
    }
    let is = |extension: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension));
    if !path.exists() || !(is("ply") || is("spz")) {
        let problem = if path.exists() { "is neither a folder nor a .ply or .spz" } else { "does not exist" };
        return Err(BadInput::new(path.display().to_string(), problem, advice));
    }
    let bytes = load(path)?;
    if is("spz") {
        let (splats, antialiased) = spz::read(&bytes).map_err(|error| damaged(path, &error))?;
        return Ok(Model { splats, antialiased, exposures: None, trained: None });
    }
    let splats = ply::read(&bytes).map_err(|error| damaged(path, &error))?;
    let antialiased = ply::comments(&bytes).iter().any(|comment| comment.trim() == ANTIALIASED);
    Ok(Model { splats, antialiased, exposures: None, trained: None })
}

fn read_trained(folder: &Path) -> Result<Model, BadInput> {
    let (manifest, plan) = read_plan(folder)?;
    let parts = plan.tasks.iter().map(|task| Ok((task.block, read_block(folder, task.block)?)));
    let splats = blocks::merge_cut(&plan.leaves(), &plan.ground, parts)?;
    let out = folder.parent().filter(|_| folder.ends_with("model")).unwrap_or(folder);
    let exposures = match manifest.exposures {
        Some(_) => {
            let path = folder.join(EXPOSURES_FILE);
            Some(Exposures::from_frame(&load(&path)?).map_err(|error| damaged(&path, &error))?)
        }
        None => None,
    };
    let antialiased = manifest.antialiased;
    Ok(Model { splats, antialiased, exposures, trained: Some((manifest, out.to_path_buf())) })
}

/// A trained model block by block.
#[derive(Debug)]
pub(crate) struct Tree {
    pub(crate) plan: Plan,
    /// Of every task, halo included.
    pub(crate) results: BTreeMap<BlockId, Splats>,
    pub(crate) antialiased: bool,
}

impl Tree {
    /// What a cut shows.
    pub(crate) fn sewn(&self, cut: &Cut) -> Splats {
        let parts = self.results.iter().map(|(&block, splats)| Ok((block, splats)));
        blocks::merge_cut(cut, &self.plan.ground, parts).unwrap_or_else(|never: Infallible| match never {})
    }
}

/// Reads the blocks of a folder that `plat train` wrote, or of its `model` folder.
///
/// # Errors
/// What is not there, not readable, or not a model of blocks.
pub(crate) fn read_tree(path: &Path) -> Result<Tree, BadInput> {
    let Some(folder) = trained_folder(path) else {
        let problem = "holds no model/model.json, and the blocks of a model are needed";
        return Err(BadInput::new(path.display().to_string(), problem, "give a folder that plat train wrote"));
    };
    let (manifest, plan) = read_plan(&folder)?;
    let results = (plan.tasks.iter().map(|task| task.block))
        .map(|block| Ok((block, read_block(&folder, block)?)))
        .collect::<Result<_, BadInput>>()?;
    Ok(Tree { plan, results, antialiased: manifest.antialiased })
}

/// The folder with `model.json`.
fn trained_folder(path: &Path) -> Option<PathBuf> {
    [path.join("model"), path.to_path_buf()].into_iter().find(|folder| folder.join("model.json").is_file())
}

fn read_plan(folder: &Path) -> Result<(Manifest, Plan), BadInput> {
    let path = folder.join("model.json");
    let manifest: Manifest =
        serde_json::from_slice(&load(&path)?).map_err(|error| damaged(&path, &CodecError::new(error.to_string())))?;
    if manifest.version != VERSION {
        let problem = format!("is of version {}, this program reads {VERSION}", manifest.version);
        return Err(BadInput::new(path.display().to_string(), problem, "train the model again"));
    }
    let path = folder.join(PLAN_FILE);
    let plan = Plan::from_frame(&load(&path)?).map_err(|error| damaged(&path, &error))?;
    Ok((manifest, plan))
}

fn read_block(folder: &Path, block: BlockId) -> Result<Splats, BadInput> {
    let path = folder.join("blocks").join(file_name(block));
    frame::decode_splats(&load(&path)?).map_err(|error| damaged(&path, &error))
}

fn file_name(block: BlockId) -> String {
    format!("{}-{}-{}.plat", block.level, block.x, block.y)
}

fn load(path: &Path) -> Result<Vec<u8>, BadInput> {
    fs::read(path).map_err(|error| {
        BadInput::new(path.display().to_string(), format!("cannot be read ({error})"), "check the path")
    })
}

fn damaged(path: &Path, error: &CodecError) -> BadInput {
    BadInput::new(path.display().to_string(), error.to_string(), "restore the file or train the model again")
}

/// Writes a file of JSON for people: indented, with a last newline.
pub(crate) fn save_json(path: &Path, value: &impl Serialize) -> Result<(), Failure> {
    let mut text = serde_json::to_vec_pretty(value).map_err(cannot("written", path))?;
    text.push(b'\n');
    Ok(save(path, &text)?)
}
