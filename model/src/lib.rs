//! Reads and writes models: the folder that `plat train` writes, PLY (INRIA's, and reads PlayCanvas' compressed), SPZ, SOG, RAD, 3D
//! Tiles.
//!
//! ```text
//! OUT/model/model.json          the manifest; written last, so a folder without it holds no model
//! OUT/model/plan.plat           the plan as a frame: ground, tree, tasks
//! OUT/model/exposures.plat      exposures of the training views, where they were trained
//! OUT/model/poses.plat          poses of the training views, where they were refined
//! OUT/model/blocks/L-x-y.plat   splats of one block with its halo, as a frame
//! OUT/merged.ply                the finest cut, merged
//! OUT/objects/paths.json        objects that move: names, boxes, paths
//! OUT/objects/ID.ply            splats of each, in its own axes
//! OUT/objects/ID.swing          how those of a person swing, as a frame
//! OUT/cameras.json              the refined cameras as transforms.json, where poses were refined
//! ```
//!
//! Architecture invariant: no terminal and no exit codes. Errors are [`BadInput`](scene::BadInput) where a file cannot be read
//! as a model, and [`ModelError`] where writing fails.

mod error;
mod export;
mod export_file;
mod files;
mod garage;
mod import;
mod manifest;
mod rad;
mod read;
mod rewrite;
mod streamed_sog;
mod tiles;
mod write;

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use blocks::{Ground, Split};
use scene::{BadInput, Capture, Exposures, GeoOrigin, MovingObject, Poses, Rigid, Splats, Swing, Way, ply, spz};

pub use error::ModelError;
pub use export::Exported;
pub use export_file::{write_ply, write_spz};
pub use files::save_json;
pub use garage::{Garage, Vehicle, cut_out, place};
pub use import::{Kind, kind};
pub use manifest::{BlockEntry, Manifest};
pub use rad::write_rad;
pub use read::{Tree, capture_of, ground_from_world, read, read_tree};
pub use rewrite::{check_out, replace_blocks, rewrite};
pub use streamed_sog::write_streamed_sog;
pub use tiles::write_tiles;
pub use write::{Written, write};

/// Comment in a model's PLY that says: draw it with opacity compensation.
const ANTIALIASED: &str = "antialiased";
/// `--test-every` of a model whose training is unknown.
const DEFAULT_TEST_EVERY: u32 = 8;

/// An object that moves.
#[derive(Debug, Clone)]
pub struct ModelObject {
    /// Its name, class, box and path.
    pub about: MovingObject,
    /// Its splats, in its own axes.
    pub splats: Splats,
    /// How they swing as it walks, of a person.
    pub swing: Option<Swing>,
}

impl ModelObject {
    /// Where it is at a time, and its splats then, in its own axes; `None` where that is unknown.
    pub fn at(&self, seconds: f64) -> Option<(Rigid, Cow<'_, Splats>)> {
        let pose = self.about.pose(seconds)?;
        let swung = |swing: &Swing| Cow::Owned(swing.swung(&self.splats, Way::of(&self.about.path).at(seconds)));
        Some((pose, self.swing.as_ref().map_or(Cow::Borrowed(&self.splats), swung)))
    }
}

/// The file of an object's swing.
fn swing_file(id: &str) -> String {
    format!("{id}.swing")
}

/// A model in memory.
#[derive(Debug)]
pub struct Model {
    /// The finest cut.
    pub splats: Splats,
    /// Objects that move, by name.
    pub objects: Vec<ModelObject>,
    /// Whether opacity is compensated for the screen-space dilation (Mip-Splatting's 2D filter).
    pub antialiased: bool,
    /// Where on Earth the origin lies, if known; x is east, y north, z up there.
    pub geo_origin: Option<GeoOrigin>,
    /// Exposures of the training views, by view of the plan's capture. Views are rendered without them.
    pub exposures: Option<Exposures>,
    /// Refined poses of the training views, by view of the plan's capture.
    pub poses: Option<Poses>,
    /// Of a trained model: its manifest and the folder that `plat train` wrote.
    pub trained: Option<(Manifest, PathBuf)>,
}

impl Model {
    /// Splats of which no more is known.
    pub(crate) fn of(splats: Splats, antialiased: bool) -> Self {
        Self { splats, objects: Vec::new(), antialiased, geo_origin: None, exposures: None, poses: None, trained: None }
    }

    /// The options to render it with.
    pub fn options(&self) -> render::Options {
        render::Options { antialiased: self.antialiased, sh_degree: self.splats.sh_degree(), ..Default::default() }
    }

    /// The bytes of an INRIA PLY.
    pub fn to_ply(&self) -> Vec<u8> {
        ply::write(&self.splats, ply_comments(self.antialiased))
    }

    /// The bytes of an SPZ of version 3.
    ///
    /// # Errors
    /// Splats that the format cannot hold.
    pub fn to_spz(&self) -> Result<Vec<u8>, BadInput> {
        spz::write(&self.splats, self.antialiased, spz::Version::V3).map_err(|error| {
            BadInput::new("the model", format!("cannot be written as SPZ: {error}"), "use PLY or repair the model")
        })
    }

    /// Which views of a capture are held out: as in the model's training, by default every 8th where that is unknown. What is given
    /// overrides either.
    pub fn split(&self, capture: &Capture, test_every: Option<u32>, stretch_metres: Option<f64>) -> Split {
        let (ground, own_every, own_metres) = match &self.trained {
            Some((manifest, _)) => (manifest.ground, manifest.test_every, manifest.test_stretches),
            None => (Ground::of(capture), DEFAULT_TEST_EVERY, 0.0),
        };
        Split::new(capture, &ground, test_every.unwrap_or(own_every), stretch_metres.unwrap_or(own_metres))
    }

    /// The divisor of the photos' size in training. 1 where the training is unknown.
    pub fn downscale(&self) -> u32 {
        self.trained.as_ref().map_or(1, |(manifest, _)| manifest.downscale)
    }

    /// Where reports on the model at `path` go: the folder `name` in the folder of a trained model, else `STEM-name` beside
    /// the file.
    pub fn report_folder(&self, path: &Path, name: &str) -> PathBuf {
        match &self.trained {
            Some((_, out)) => out.join(name),
            None => path.with_file_name(format!("{}-{name}", path.file_stem().unwrap_or_default().to_string_lossy())),
        }
    }
}

fn ply_comments(antialiased: bool) -> &'static [&'static str] {
    if antialiased { &[ANTIALIASED] } else { &[] }
}
