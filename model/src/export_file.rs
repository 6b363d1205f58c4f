//! Writes the finest cut of a model as one PLY or SPZ, one block at a time.
//!
//! SPZ has the positions of all splats, then all opacities, and so on, in one gzip stream: the blocks are read once for each of these
//! planes. Scratch files would be read as often as they are written, and need a place.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::path::Path;

use blocks::{Cut, Ground};
use scene::{BadInput, BlockId, CodecError, Splats, ply, spz};
use store::file::AtomicFile;

use crate::error::ModelError;
use crate::export::{Exported, finite_splats};
use crate::ply_comments;
use crate::read::{self, Opened};

/// Writes the model at `path` as PLY, with the attributes of its splats; `report` is called after each block with the number of blocks
/// that are done and that of all.
///
/// # Errors
/// A path that holds no model, a file that cannot be written.
pub fn write_ply(path: &Path, out: &Path, report: &mut dyn FnMut(usize, usize)) -> Result<Exported, ModelError> {
    let opened = read::open(path)?;
    let parts = Parts::of(&opened);
    let (mut count, mut sh_degree, mut attributes) = (0, 0, BTreeSet::new());
    for &block in &parts.blocks {
        let splats = parts.splats(opened.splats(block)?, block);
        count += splats.len();
        sh_degree = sh_degree.max(splats.sh_degree());
        attributes.extend(splats.attribute_names());
    }
    let attributes: Vec<String> = attributes.into_iter().collect();
    let mut file = Counted { file: AtomicFile::create(out)?, bytes: 0 };
    file.write(&ply::header(count, sh_degree, &attributes, ply_comments(opened.antialiased())))?;
    for (done, &block) in parts.blocks.iter().enumerate() {
        let splats = parts.splats(opened.splats(block)?, block);
        if splats.sh_degree() == sh_degree && splats.attribute_names() == attributes {
            file.write_rows(&splats)?;
        } else {
            file.write_rows(&splats.with_sh_degree(sh_degree).with_attributes(&attributes))?;
        }
        report(done + 1, parts.blocks.len());
    }
    file.commit(count as u64, opened.antialiased())
}

/// Writes the model at `path` as SPZ of version 3; `report` is called after each block of each plane with the number of these that are
/// done and that of all.
///
/// # Errors
/// A path that holds no model, a splat that is not finite or too far out, a file that cannot be written.
pub fn write_spz(path: &Path, out: &Path, report: &mut dyn FnMut(usize, usize)) -> Result<Exported, ModelError> {
    let opened = read::open(path)?;
    let parts = Parts::of(&opened);
    let bad = |error: CodecError| {
        let problem = format!("cannot be written as SPZ: {error}");
        BadInput::new(path.display().to_string(), problem, "use PLY or repair the model")
    };
    let (mut count, mut sh_degree, mut farthest) = (0, 0, 0.0f32);
    for &block in &parts.blocks {
        let splats = parts.splats(finite_splats(&opened, block, path)?, block);
        count += splats.len() as u64;
        sh_degree = sh_degree.max(splats.sh_degree());
        farthest = splats.columns()[..3].iter().flatten().fold(farthest, |far, v| far.max(v.abs()));
    }
    let layout = spz::Layout::new(count, sh_degree, farthest, opened.antialiased(), spz::Version::V3).map_err(bad)?;
    let mut file = Counted { file: AtomicFile::create(out)?, bytes: 0 };
    let mut zipper = spz::Zipper::new();
    file.write(&zipper.add(&layout.header()).map_err(bad)?)?;
    let all = spz::PLANES * parts.blocks.len();
    for plane in 0..spz::PLANES {
        for (done, &block) in parts.blocks.iter().enumerate() {
            let splats = parts.splats(opened.splats(block)?, block);
            file.write(&zipper.add(&layout.plane(&splats, plane)).map_err(bad)?)?;
            report(plane * parts.blocks.len() + done + 1, all);
        }
    }
    file.write(&zipper.finish().map_err(bad)?)?;
    file.commit(count, opened.antialiased())
}

/// What each block gives to the finest cut.
struct Parts {
    /// In the order of the merged model.
    blocks: Vec<BlockId>,
    cut: Cut,
    ground: Ground,
    /// A file is taken as it is, with splats at places that no block owns.
    is_whole: bool,
}

impl Parts {
    fn of(opened: &Opened) -> Self {
        let mut blocks = opened.blocks();
        blocks.sort_unstable();
        let is_whole = matches!(opened, Opened::File { .. });
        Self { blocks, cut: opened.leaves(), ground: opened.ground(), is_whole }
    }

    fn splats<'a>(&self, splats: Cow<'a, Splats>, block: BlockId) -> Cow<'a, Splats> {
        if self.is_whole { splats } else { Cow::Owned(self.cut.keep(&splats, &self.ground, block)) }
    }
}

/// A file and its length.
struct Counted {
    file: AtomicFile,
    bytes: u64,
}

/// Splats whose rows are made at once.
const ROWS: usize = 1 << 18;

impl Counted {
    fn write(&mut self, bytes: &[u8]) -> Result<(), ModelError> {
        self.bytes += bytes.len() as u64;
        Ok(self.file.write(bytes)?)
    }

    fn write_rows(&mut self, splats: &Splats) -> Result<(), ModelError> {
        if splats.len() <= ROWS {
            return self.write(&ply::rows(splats));
        }
        let rows: Vec<u32> = (0..splats.len() as u32).collect();
        rows.chunks(ROWS).try_for_each(|rows| self.write(&ply::rows(&splats.select(rows))))
    }

    fn commit(self, splats: u64, antialiased: bool) -> Result<Exported, ModelError> {
        self.file.commit()?;
        Ok(Exported { splats, levels: 1, files: 1, bytes: self.bytes, antialiased })
    }
}

#[cfg(test)]
mod tests {
    use scene::Splat;

    use super::*;
    use crate::Model;

    #[test]
    fn files_have_the_bytes_of_a_model_in_memory() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let mut splats = Splats::new(2);
        for i in 0..ROWS + 1000 {
            let place = glam::Vec3::new(i as f32 * 0.01, (i % 700) as f32, 2.0);
            splats.push(&Splat::round(place, -1.0, glam::Vec3::splat(0.4), 0.9));
        }
        splats.set_attribute("block", (0..splats.len() as u32).collect());
        let model = Model::of(splats, true);
        std::fs::write(at("a.ply"), model.to_ply()).unwrap();
        let ply = write_ply(&at("a.ply"), &at("b.ply"), &mut |_, _| ()).unwrap();
        let spz = write_spz(&at("a.ply"), &at("b.spz"), &mut |_, _| ()).unwrap();
        let bytes = |name: &str| std::fs::read(at(name)).unwrap();
        assert!(bytes("b.ply") == model.to_ply() && bytes("b.spz") == model.to_spz().unwrap());
        assert_eq!([ply.bytes, spz.bytes], ["b.ply", "b.spz"].map(|name| bytes(name).len() as u64));
        assert_eq!(ply.splats, model.splats.len() as u64);
    }
}
