//! A model made of another: the same kind, other splats.

use std::fs;
use std::path::Path;

use scene::{ArtefactId, BadInput, Splats, frame};

use super::{Block, Manifest, Model, Tree, begin, file_name, read_tree, save, save_exposures, save_json};
use crate::failure::{Failure, cannot};

/// Refuses a place for a model made of another that would overwrite that, or that is of another kind.
///
/// # Errors
/// As said.
pub(crate) fn check_out(path: &Path, out: &Path) -> Result<(), BadInput> {
    let bad = |problem: &str, advice: String| Err(BadInput::new(out.display().to_string(), problem, advice));
    // A folder is the same model whether it is named itself or its `model` folder.
    let place = |path: &Path| {
        let path = path.canonicalize().ok()?;
        let is_inner = path.ends_with("model") && path.join("model.json").is_file();
        if is_inner { path.parent().map(Path::to_path_buf) } else { Some(path) }
    };
    if place(path).is_some_and(|path| place(out) == Some(path)) {
        return bad("is the model itself", "give another --out".into());
    }
    let kind = |path: &Path| path.extension().map(|extension| extension.to_ascii_lowercase());
    if path.is_dir() {
        return if out.is_file() { bad("is a file", "give a folder, as the model is one".into()) } else { Ok(()) };
    }
    if out.is_dir() || kind(path) != kind(out) {
        let kind = kind(path).unwrap_or_default();
        return bad("is of another kind than the model", format!("give a .{}", kind.to_string_lossy()));
    }
    Ok(())
}

/// Writes a model that was read from `path` with other splats as its finest cut, in the same kind: a file; or a folder, where
/// each block keeps what it does not own in the finest cut. Returns the bytes of the file or of `merged.ply`.
pub(crate) fn rewrite(path: &Path, out: &Path, model: Model, splats: Splats) -> Result<u64, Failure> {
    let Some((manifest, _)) = &model.trained else {
        let model = Model { splats, ..model };
        let is_spz = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("spz"));
        let bytes = if is_spz { model.to_spz()? } else { model.to_ply() };
        let folder = out.parent().filter(|folder| !folder.as_os_str().is_empty());
        folder.map_or(Ok(()), |folder| fs::create_dir_all(folder).map_err(cannot("made", folder)))?;
        save(out, &bytes)?;
        return Ok(bytes.len() as u64);
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
        save(&folder.join("blocks").join(file_name(block)), &bytes)?;
        blocks.push(Block { block, artefact: ArtefactId::of(&bytes), splats: result.len() as u64 });
    }
    // As `plat train` lists them.
    blocks.sort_by_key(|b| (b.block.level, b.block.y, b.block.x));
    let splats = Tree { plan, results, antialiased }.sewn(&leaves);
    save_exposures(&folder, model.exposures.as_ref())?;
    save_json(&folder.join("model.json"), &Manifest { splats: splats.len() as u64, blocks, ..manifest.clone() })?;
    let bytes = Model { splats, ..model }.to_ply();
    save(&out.join("merged.ply"), &bytes)?;
    Ok(bytes.len() as u64)
}
