//! A capture as its files describe it, common to all formats.

use std::collections::BTreeMap;
use std::path::PathBuf;

use glam::DVec3;
use scene::lidar::Turn;
use scene::transforms::Intrinsics;
use scene::{GeoOrigin, MovingObject, Rigid, SparsePoints};

use super::files::CaptureRoot;
use crate::depth_maps::DepthMapOptions;
use crate::lidar::PointFormat;

/// How to open a capture.
#[derive(Debug, Clone, Default)]
pub struct OpenOptions {
    /// Folder of the photos, relative to the capture. `None` searches the usual ones.
    pub images: Option<String>,
    /// Reads cameras only: photos and points may be missing.
    pub cameras_only: bool,
    /// Uses the capture's lidar: sweeps give target depths and initial points.
    pub lidar: bool,
    /// Uses the capture's radar: sweeps give target depths.
    pub radar: bool,
    /// Finds depth maps in files, which give target depths. `None` leaves them out.
    pub depths: Option<DepthMapOptions>,
}

/// A capture as parsed from its files, before its photos are found.
#[derive(Default)]
pub(super) struct ParsedCapture {
    pub(super) format: &'static str,
    pub(super) images: Vec<PosedImage>,
    pub(super) points: RawPoints,
    pub(super) origin: Option<GeoOrigin>,
    /// Names of images that are not used, with the reason.
    pub(super) left_out: Vec<(String, String)>,
    /// Sweeps of its lidar.
    pub(super) sweeps: Vec<ParsedSweep>,
    /// Number of annotated boxes by class.
    pub(super) labels: BTreeMap<String, usize>,
    /// Objects that move, by name.
    pub(super) objects: Vec<MovingObject>,
    /// The folder that its paths are relative to, if not the one that was given.
    pub(super) root: Option<CaptureRoot>,
}

impl ParsedCapture {
    pub(super) fn new(format: &'static str, images: Vec<PosedImage>, points: RawPoints) -> Self {
        Self { format, images, points, ..Self::default() }
    }
}

/// A sweep of a capture's lidar.
pub(super) struct ParsedSweep {
    pub(super) path: PathBuf,
    pub(super) format: PointFormat,
    pub(super) world_from_sensor: Rigid,
    /// The sensor's motion, if points have to be corrected for it.
    pub(super) turn: Option<Turn>,
    /// The images taken during the sweep, by id.
    pub(super) images: Vec<u32>,
}

/// An image of the capture with its lens and pose.
pub(super) struct PosedImage {
    pub(super) id: u32,
    pub(super) name: String,
    /// Path of the image file, relative to the capture.
    pub(super) file: String,
    /// If the file is a table of photos, the row of this one.
    pub(super) row: Option<u64>,
    /// Path of its mask, relative to the capture, if the capture names one.
    pub(super) mask: Option<String>,
    /// Path of its depth map, relative to the capture, if the capture names one.
    pub(super) depth: Option<String>,
    pub(super) intrinsics: Intrinsics,
    pub(super) camera_from_world: Rigid,
    pub(super) boxes: Vec<LabelledBox>,
    /// When it was taken, seconds on the clock of the objects, if it is known.
    pub(super) seconds: Option<f64>,
}

/// An annotated object that may be in a photo.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelledBox {
    /// As the capture names it.
    pub class: String,
    /// Whether it moves: then its pixels are left out of the photo.
    pub moves: bool,
    /// Corners of its box in the camera's axes, numbered by the bits of their signs along its three sides.
    pub corners: [DVec3; 8],
}

/// Sparse points whose tracks hold ids of [`PosedImage`]s instead of indices of views.
#[derive(Default)]
pub(super) struct RawPoints(pub(super) SparsePoints);

impl RawPoints {
    /// Converts tracks of image ids to sorted tracks of view indices. `ids` are those of the views, in order; other images are
    /// dropped from the tracks.
    pub(super) fn with_view_indices(self, ids: impl Iterator<Item = u32>) -> SparsePoints {
        let index: BTreeMap<u32, u32> = ids.zip(0..).collect();
        let mut points = SparsePoints { track_start: vec![0], seen_by: Vec::new(), ..self.0 };
        let tracks = SparsePoints { track_start: self.0.track_start, seen_by: self.0.seen_by, ..Default::default() };
        for i in 0..points.len() {
            let ids = tracks.track(i).unwrap_or_default();
            let mut track: Vec<u32> = ids.iter().filter_map(|id| index.get(id).copied()).collect();
            track.sort_unstable();
            track.dedup();
            points.seen_by.extend(track);
            points.track_start.push(points.seen_by.len() as u32);
        }
        if points.seen_by.is_empty() {
            points.track_start.clear();
        }
        points
    }
}
