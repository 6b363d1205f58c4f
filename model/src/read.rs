//! Reads a model as one set of splats, or block by block.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::convert::Infallible;
use std::path::{Path, PathBuf};

use blocks::{Cut, Ground, Mode, Plan};
use glam::{DQuat, DVec3};
use scene::{
    ArtefactId, BLOCK_ATTRIBUTE, BadInput, BlockId, CodecError, Exposures, GeoOrigin, MovingObject, Poses, Splats,
    Swing, frame, ply,
};

use crate::files::{
    EXPOSURES_FILE, MANIFEST_FILE, OBJECTS_FOLDER, PATHS_FILE, PLAN_FILE, POSES_FILE, block_file, damaged, load,
};
use crate::import::{self, Imported, Kind};
use crate::manifest::{Manifest, VERSION};
use crate::{Model, ModelObject, swing_file};

/// Reads a model: a folder that `plat train` wrote, its `model` folder, or any file or folder that [`kind`](crate::kind) knows. A
/// model of another kind than the first is one set of splats, the finest.
///
/// # Errors
/// A path that does not exist, cannot be read, or holds no model.
pub fn read(path: &Path) -> Result<Model, BadInput> {
    let (kind, first) = import::kind(path)?;
    if kind == Kind::Trained {
        return read_trained(first.parent().unwrap_or(path));
    }
    let Imported { splats, antialiased, geo_origin } = import::read(kind, &first)?;
    Ok(Model { geo_origin, ..Model::of(splats, antialiased) })
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
    let poses = match manifest.poses {
        Some(_) => {
            let path = folder.join(POSES_FILE);
            Some(Poses::from_frame(&load(&path)?).map_err(|error| damaged(&path, &error))?)
        }
        None => None,
    };
    let Manifest { antialiased, geo_origin, .. } = manifest;
    let objects = read_objects(&out.join(OBJECTS_FOLDER))?;
    let trained = Some((manifest, out.to_path_buf()));
    Ok(Model { splats, objects, antialiased, geo_origin, exposures, poses, trained })
}

/// Turns the axes of a model's world to those of its ground, z up. A file says nothing of its ground: its z is taken for up.
///
/// # Errors
/// As [`read`], of a folder that `plat train` wrote.
pub fn ground_from_world(path: &Path) -> Result<DQuat, BadInput> {
    match trained_folder(path) {
        Some(folder) => read_plan(&folder).map(|(_, plan)| plan.ground.ground_from_world),
        None => Ok(DQuat::IDENTITY),
    }
}

/// The capture that a model was trained on; `None` for a file, which does not say. Reads no splats.
///
/// # Errors
/// As [`read`], of a folder that `plat train` wrote.
pub fn capture_of(path: &Path) -> Result<Option<ArtefactId>, BadInput> {
    trained_folder(path).map(|folder| Ok(read_plan(&folder)?.1.capture)).transpose()
}

/// The objects of a folder, by name; none without their paths.
pub(crate) fn read_objects(folder: &Path) -> Result<Vec<ModelObject>, BadInput> {
    let path = folder.join(PATHS_FILE);
    if !path.is_file() {
        return Ok(Vec::new());
    }
    let tracks = scene::objects::read(&load(&path)?).map_err(|error| damaged(&path, &error))?;
    let object = |about: MovingObject| {
        // Names have no separators, so that no path leads out of the folder.
        let path = folder.join(format!("{}.ply", about.id));
        let splats = ply::read(&load(&path)?).map_err(|error| damaged(&path, &error))?;
        let swing = read_swing(folder, &about.id, splats.len())?;
        Ok(ModelObject { about, splats, swing })
    };
    tracks.objects.into_iter().map(object).collect()
}

/// How the splats of an object swing, of which there are this many; `None` without a file of it.
pub(crate) fn read_swing(folder: &Path, id: &str, splats: usize) -> Result<Option<Swing>, BadInput> {
    let path = folder.join(swing_file(id));
    let read = || Swing::from_frame(&load(&path)?, splats).map_err(|error| damaged(&path, &error));
    path.is_file().then(read).transpose()
}

/// A model whose blocks are read one at a time. A file is one block.
pub(crate) enum Opened {
    Trained { folder: PathBuf, manifest: Box<Manifest>, plan: Box<Plan> },
    File { model: Box<Model>, ground: Ground },
}

/// Opens a model as [`read`] does.
///
/// # Errors
/// As [`read`].
pub(crate) fn open(path: &Path) -> Result<Opened, BadInput> {
    if let Some(folder) = trained_folder(path) {
        let (manifest, plan) = read_plan(&folder)?;
        return Ok(Opened::Trained { folder, manifest: Box::new(manifest), plan: Box::new(plan) });
    }
    let model = read(path)?;
    let places: Vec<DVec3> = (0..model.splats.len()).map(|i| model.splats.mean(i).as_dvec3()).collect();
    let ground = Ground::around(&places);
    Ok(Opened::File { model: Box::new(model), ground })
}

impl Opened {
    /// Ids of the blocks, parents before children.
    pub(crate) fn blocks(&self) -> Vec<BlockId> {
        match self {
            Self::Trained { plan, .. } => plan.tasks.iter().map(|task| task.block).collect(),
            Self::File { .. } => vec![BlockId::ROOT],
        }
    }

    /// The splats of a block, halo included.
    pub(crate) fn splats(&self, block: BlockId) -> Result<Cow<'_, Splats>, BadInput> {
        match self {
            Self::Trained { folder, .. } => read_block(folder, block).map(Cow::Owned),
            Self::File { model, .. } => Ok(Cow::Borrowed(&model.splats)),
        }
    }

    /// The finest cut.
    pub(crate) fn leaves(&self) -> Cut {
        match self {
            Self::Trained { plan, .. } => plan.leaves(),
            Self::File { .. } => [BlockId::ROOT].into_iter().collect(),
        }
    }

    pub(crate) fn ground(&self) -> Ground {
        match self {
            Self::Trained { plan, .. } => plan.ground,
            Self::File { ground, .. } => *ground,
        }
    }

    pub(crate) fn mode(&self) -> Mode {
        match self {
            Self::Trained { plan, .. } => plan.settings.mode,
            Self::File { .. } => Mode::Whole,
        }
    }

    /// Metres per pixel that a block was trained for; 0 of a file.
    pub(crate) fn rho_metres(&self, block: BlockId) -> f64 {
        match self {
            Self::Trained { plan, .. } => {
                plan.tasks.iter().find(|task| task.block == block).map_or(0.0, |task| task.rho_metres)
            }
            Self::File { .. } => 0.0,
        }
    }

    pub(crate) fn antialiased(&self) -> bool {
        match self {
            Self::Trained { manifest, .. } => manifest.antialiased,
            Self::File { model, .. } => model.antialiased,
        }
    }

    pub(crate) fn geo_origin(&self) -> Option<GeoOrigin> {
        match self {
            Self::Trained { manifest, .. } => manifest.geo_origin,
            Self::File { model, .. } => model.geo_origin,
        }
    }
}

/// A trained model block by block.
#[derive(Debug)]
pub struct Tree {
    /// The plan that it was trained by.
    pub plan: Plan,
    /// Splats of every task's block, halo included.
    pub results: BTreeMap<BlockId, Splats>,
    /// Whether opacity is compensated for the screen-space dilation.
    pub antialiased: bool,
}

impl Tree {
    /// The splats of a cut, merged.
    pub fn merged(&self, cut: &Cut) -> Splats {
        let parts = self.results.iter().map(|(&block, splats)| Ok((block, splats)));
        blocks::merge_cut(cut, &self.plan.ground, parts).unwrap_or_else(|never: Infallible| match never {})
    }
}

impl Tree {
    /// The finest cut, merged, with the block that each splat belongs to as its attribute [`BLOCK_ATTRIBUTE`].
    pub fn merged_with_blocks(&self) -> Splats {
        let leaves = self.plan.leaves();
        let parts = self.results.iter().map(|(&block, splats)| {
            let mut kept = leaves.keep(splats, &self.plan.ground, block);
            kept.set_attribute(BLOCK_ATTRIBUTE, vec![block.code().unwrap_or(0); kept.len()]);
            (block, kept)
        });
        blocks::merge(parts)
    }
}

/// Reads the blocks of a folder that `plat train` wrote, or of its `model` folder.
///
/// # Errors
/// A path that cannot be read or holds no model of blocks.
pub fn read_tree(path: &Path) -> Result<Tree, BadInput> {
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
    [path.join("model"), path.to_path_buf()].into_iter().find(|folder| folder.join(MANIFEST_FILE).is_file())
}

fn read_plan(folder: &Path) -> Result<(Manifest, Plan), BadInput> {
    let path = folder.join(MANIFEST_FILE);
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

/// The splats of one block of a model folder.
pub(crate) fn read_block(folder: &Path, block: BlockId) -> Result<Splats, BadInput> {
    let path = folder.join("blocks").join(block_file(block));
    frame::decode_splats(&load(&path)?).map_err(|error| damaged(&path, &error))
}

#[cfg(test)]
mod tests {
    use blocks::Split;
    use glam::Vec3;
    use scene::{Capture, Splat};

    use super::*;

    fn model(antialiased: bool) -> Model {
        let mut splats = Splats::new(0);
        splats.push(&Splat::round(Vec3::new(1.0, 2.0, 3.0), -1.0, Vec3::splat(0.5), 0.9));
        Model::of(splats, antialiased)
    }

    #[test]
    fn files_keep_splats_and_antialiasing() {
        let folder = tempfile::tempdir().unwrap();
        for antialiased in [false, true] {
            let written = model(antialiased);
            let [ply, spz] = ["a.PLY", "a.spz"].map(|name| folder.path().join(name));
            std::fs::write(&ply, written.to_ply()).unwrap();
            std::fs::write(&spz, written.to_spz().unwrap()).unwrap();
            let [ply, spz] = [ply, spz].map(|path| super::read(&path).unwrap());
            assert_eq!((&ply.splats, ply.antialiased), (&written.splats, antialiased));
            assert_eq!((spz.splats.len(), spz.antialiased), (1, antialiased));
            assert_eq!((ply.split(&Capture::default(), None, None), ply.downscale()), (Split::default(), 1));
        }
    }

    #[test]
    fn paths_without_a_model_are_named() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("notes.txt"), "").unwrap();
        std::fs::write(folder.path().join("cut.ply"), "ply\n").unwrap();
        for (name, wanted) in [
            ("", "holds no model/model.json"),
            ("none.ply", "does not exist"),
            ("notes.txt", "is no model that can be read"),
            ("cut.ply", "cut.ply"),
        ] {
            let error = super::read(&folder.path().join(name)).unwrap_err().to_string();
            assert!(error.contains(wanted) && error.contains(name), "{name}: {error}");
        }
        assert!(read_tree(folder.path()).is_err());
    }
}
