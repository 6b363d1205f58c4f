//! Writes a model that was read before with other splats, in the same format.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use scene::{ArtefactId, BadInput, BlockId, Splats, frame};
use store::file::save;

use crate::error::{ModelError, cannot};
use crate::files::{
    CAMERAS_FILE, EXPOSURES_FILE, MANIFEST_FILE, MERGED_FILE, OBJECTS_FOLDER, PATHS_FILE, POSES_FILE, SENSORS_FILE,
    block_file, save_json,
};
use crate::import::{Kind, kind};
use crate::read::{Opened, Tree, open, read_block, read_objects, read_tree};
use crate::write::{begin, save_objects, write_merged};
use crate::{BlockEntry, Manifest, Model, swing_file};

/// Checks where a rewritten model shall go.
///
/// # Errors
/// A model that is none, a path that would overwrite the model itself, or that is of another format.
pub fn check_out(path: &Path, out: &Path) -> Result<(), BadInput> {
    let bad = |problem: &str, advice: String| Err(BadInput::new(out.display().to_string(), problem, advice));
    // A folder and its `model` folder are the same model.
    let model_path = |path: &Path| {
        let path = path.canonicalize().ok()?;
        let is_inner = path.ends_with("model") && path.join(MANIFEST_FILE).is_file();
        if is_inner { path.parent().map(Path::to_path_buf) } else { Some(path) }
    };
    if model_path(path).is_some_and(|path| model_path(out) == Some(path)) {
        return bad("is the model itself", "give another --out".into());
    }
    let is = |wanted: &str| out.extension().is_some_and(|extension| extension.eq_ignore_ascii_case(wanted));
    match kind(path)?.0 {
        Kind::Trained if out.is_file() => bad("is a file", "give a folder, as the model is one".into()),
        Kind::Trained => Ok(()),
        _ if out.is_dir() => bad("has another format than the model", "give a .ply or a .spz".into()),
        Kind::Ply if !is("ply") => bad("has another format than the model", "give a .ply".into()),
        Kind::Spz if !is("spz") => bad("has another format than the model", "give a .spz".into()),
        // Of the others there is no writer of one set of splats.
        _ if !is("ply") && !is("spz") => bad("has a format that is not written here", "give a .ply or a .spz".into()),
        _ => Ok(()),
    }
}

/// Writes the model that was read from `path` with other splats as its finest cut: a `.ply` or `.spz` where it was a file, or a folder,
/// where each block keeps the splats that it does not own in the finest cut. Returns the bytes of the file or of `merged.ply`.
///
/// # Errors
/// A model that cannot be read again, or a file that cannot be written.
pub fn rewrite(path: &Path, out: &Path, model: Model, splats: Splats) -> Result<u64, ModelError> {
    let Some((manifest, _)) = &model.trained else {
        let model = Model { splats, ..model };
        let is_spz = out.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("spz"));
        let bytes = if is_spz { model.to_spz()? } else { model.to_ply() };
        if let Some(folder) = out.parent().filter(|folder| !folder.as_os_str().is_empty()) {
            fs::create_dir_all(folder).map_err(cannot("made", folder))?;
        }
        save(out, &bytes)?;
        return Ok(bytes.len() as u64);
    };
    let Opened::Trained { folder: from, .. } = open(path)? else {
        return Err(BadInput::new(path.display().to_string(), "is no folder any more", "train again").into());
    };
    let Tree { plan, mut results, antialiased } = read_tree(path)?;
    let leaves = plan.leaves();
    for (&block, result) in &mut results {
        let mut now = leaves.keep(&splats, &plan.ground, block).with_sh_degree(result.sh_degree());
        now.append(&result.filter(|i| leaves.owner_of(&plan.ground, result.mean(i).as_dvec3()) != Some(block)));
        *result = now;
    }
    let folder = begin(out, &plan)?;
    let mut blocks = Vec::new();
    for (&block, result) in &results {
        let bytes = frame::encode_splats(result);
        save(&folder.join("blocks").join(block_file(block)), &bytes)?;
        blocks.push(BlockEntry { block, artefact: ArtefactId::of(&bytes), splats: result.len() as u64 });
    }
    // The order in which `plat train` lists them.
    blocks.sort_by_key(|b| (b.block.level, b.block.y, b.block.x));
    let splats = Tree { plan, results, antialiased }.merged(&leaves);
    let manifest = Manifest { splats: splats.len() as u64, blocks, ..manifest.clone() };
    copy_cameras(outer(&from), out)?;
    finish(out, &folder, &manifest, &Model { splats, trained: None, ..model })
}

/// Writes the model in the folder `path` with other splats of some blocks (halo included) to another folder. All other blocks, objects,
/// exposures and poses are copied byte for byte. Returns the bytes of `merged.ply`.
///
/// # Errors
/// A model that is none, a block that cannot be read, or a file that cannot be written.
pub fn replace_blocks(path: &Path, out: &Path, changed: &BTreeMap<BlockId, Splats>) -> Result<u64, ModelError> {
    let (from, manifest, plan) = match open(path)? {
        Opened::Trained { folder, manifest, plan } => (folder, *manifest, *plan),
        Opened::File { .. } => {
            let advice = "give a folder that plat train wrote";
            return Err(BadInput::new(path.display().to_string(), "is one file, which has no blocks", advice).into());
        }
    };
    let outer = outer(&from);
    let leaves = plan.leaves();
    let folder = begin(out, &plan)?;
    let (mut blocks, mut count, mut attributes) = (Vec::new(), 0, BTreeSet::new());
    for BlockEntry { block, artefact, .. } in manifest.blocks {
        let name = Path::new("blocks").join(block_file(block));
        let (splats, artefact) = match changed.get(&block) {
            None => {
                copy(&name, &from, &folder)?;
                (Cow::Owned(read_block(&folder, block)?), artefact)
            }
            Some(splats) => {
                let bytes = frame::encode_splats(splats);
                save(&folder.join(&name), &bytes)?;
                (Cow::Borrowed(splats), ArtefactId::of(&bytes))
            }
        };
        attributes.extend(splats.attribute_names());
        count += leaves.keep(&splats, &plan.ground, block).len();
        blocks.push(BlockEntry { block, artefact, splats: splats.len() as u64 });
    }
    let attributes: Vec<String> = attributes.into_iter().collect();
    let bytes = write_merged(out, &folder, &plan, count, &attributes)?;
    copy_cameras(outer, out)?;
    for (name, about) in [(EXPOSURES_FILE, manifest.exposures), (POSES_FILE, manifest.poses)] {
        if about.is_some() {
            copy(Path::new(name), &from, &folder)?;
        }
    }
    let objects = read_objects(&outer.join(OBJECTS_FOLDER))?;
    if !objects.is_empty() {
        let made = out.join(OBJECTS_FOLDER);
        fs::create_dir_all(&made).map_err(cannot("made", &made))?;
        let splats = objects.iter().map(|object| format!("{}.ply", object.about.id));
        let swings = objects.iter().filter(|object| object.swing.is_some()).map(|object| swing_file(&object.about.id));
        // Last: objects without their paths are none.
        for name in splats.chain(swings).chain([PATHS_FILE.to_owned()]) {
            copy(&Path::new(OBJECTS_FOLDER).join(name), outer, out)?;
        }
    }
    let manifest = Manifest { splats: count as u64, blocks, ..manifest };
    save_json(&folder.join(MANIFEST_FILE), &manifest)?;
    Ok(bytes)
}

/// The folder of a job, given the one of its model.
fn outer(folder: &Path) -> &Path {
    folder.parent().filter(|_| folder.ends_with("model")).unwrap_or(folder)
}

/// Copies the refined cameras and what was found of sensors, where there are any.
fn copy_cameras(from: &Path, to: &Path) -> Result<(), ModelError> {
    let names = [CAMERAS_FILE, SENSORS_FILE].into_iter().filter(|name| from.join(name).exists());
    names.map(Path::new).try_for_each(|name| copy(name, from, to))
}

fn copy(name: &Path, from: &Path, to: &Path) -> Result<(), ModelError> {
    fs::copy(from.join(name), to.join(name)).map(|_| ()).map_err(cannot("copied", &from.join(name)))
}

/// Writes `merged.ply`, exposures, poses and at last the manifest; returns the bytes of `merged.ply`.
fn finish(out: &Path, folder: &Path, manifest: &Manifest, model: &Model) -> Result<u64, ModelError> {
    let merged = model.to_ply();
    save(&out.join(MERGED_FILE), &merged)?;
    save_objects(out, &model.objects, model.antialiased)?;
    if let Some(exposures) = &model.exposures {
        save(&folder.join(EXPOSURES_FILE), &exposures.to_frame())?;
    }
    if let Some(poses) = &model.poses {
        save(&folder.join(POSES_FILE), &poses.to_frame())?;
    }
    save_json(&folder.join(MANIFEST_FILE), manifest)?;
    Ok(merged.len() as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rewritten_model_goes_to_another_path_in_the_same_format() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir_all(at("trained/model")).unwrap();
        fs::write(at("trained/model/model.json"), "{}").unwrap();
        fs::write(at("a.ply"), "ply").unwrap();
        fs::write(at("a.rad"), "RAD0").unwrap();
        let problem = |path: &str, out: &str| check_out(&at(path), &at(out)).err().map(|error| error.problem);
        assert_eq!(problem("a.ply", "new/b.PLY"), None);
        assert_eq!(problem("trained", "pruned"), None);
        assert_eq!(problem("a.ply", "a.ply").as_deref(), Some("is the model itself"));
        assert_eq!(problem("trained/model", "trained").as_deref(), Some("is the model itself"));
        assert_eq!(problem("a.ply", "a.spz").as_deref(), Some("has another format than the model"));
        assert_eq!(problem("a.ply", "trained").as_deref(), Some("has another format than the model"));
        assert_eq!(problem("trained", "a.ply").as_deref(), Some("is a file"));
        assert_eq!(problem("a.rad", "b.ply"), None);
        assert_eq!(problem("a.rad", "b.rad").as_deref(), Some("has a format that is not written here"));
    }
}
