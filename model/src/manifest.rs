//! `model.json`: the manifest of a trained model.

use blocks::Ground;
use scene::{ArtefactId, BlockId, GeoOrigin};
use serde::{Deserialize, Serialize};

/// The version of [`Manifest`] that is written and read.
pub(crate) const VERSION: u32 = 1;

/// `model.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Manifest {
    /// Version of the format.
    pub version: u32,
    /// Id of the plan that it was trained by.
    pub plan: ArtefactId,
    /// Whether opacity is compensated for the screen-space dilation.
    pub antialiased: bool,
    /// 0 to 3.
    pub sh_degree: u8,
    /// Where on Earth the world's origin lies, if known.
    pub geo_origin: Option<GeoOrigin>,
    /// The ground plane and root square of the plan.
    pub ground: Ground,
    /// Every how many views one was held out; 0 = none.
    pub test_every: u32,
    /// Width of the stretches of streets of which some were held out, metres; 0 = none.
    #[serde(default)]
    pub test_stretches: f64,
    /// Divisor of the photos' size.
    pub downscale: u32,
    /// Id of the file of the training views' exposures, if there is one.
    #[serde(default)]
    pub exposures: Option<ArtefactId>,
    /// Id of the file of the training views' refined poses, if there is one.
    #[serde(default)]
    pub poses: Option<ArtefactId>,
    /// Splats of the finest cut.
    pub splats: u64,
    /// By (level, y, x).
    pub blocks: Vec<BlockEntry>,
}

/// A block of the tree.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct BlockEntry {
    /// Its place in the tree.
    pub block: BlockId,
    /// Hash of the block's frame.
    pub artefact: ArtefactId,
    /// Splats, halo included.
    pub splats: u64,
}
