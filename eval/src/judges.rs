//! Further measures of each rendered view, on request: errors of its depth, and what detectors find on it.

use std::path::Path;

use blocks::{Part, ViewKind};
use dataset::ingest::{TrueDepth, ViewDepths};
use dataset::true_boxes::TrueBoxes;
use perceive::Detector;
use render::Frame;
use scene::{BadInput, Pixels, View};
use serde::Serialize;

use crate::depth::{DepthFigures, DepthSummary};
use crate::detections::{DetectionFigures, DetectionSummary, Sight};
use crate::figures::{Comparison, ViewFigures};
use crate::groups::Groups;

/// Depth errors of a model.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DepthReport {
    /// Where the true depths come from: `truth`, `lidar`, `depth maps`, or `lidar and depth maps`.
    pub source: &'static str,
    /// By use and kind of the views.
    #[serde(flatten)]
    pub groups: Groups<DepthSummary>,
    /// By view: held-out views, held-out stretches, views that were trained on.
    pub by_view: Vec<DepthFigures>,
}

/// Detections on photos and renders.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DetectionReport {
    /// The network's file, without its folder.
    pub detector: String,
    /// Least score of a detection.
    pub score: f32,
    /// By use and kind of the views.
    #[serde(flatten)]
    pub groups: Groups<DetectionSummary>,
    /// By view: held-out views, held-out stretches, views that were trained on.
    pub by_view: Vec<DetectionFigures>,
}

/// The network's file, without its folder.
pub(crate) fn file_name(detector: &Detector) -> String {
    Path::new(detector.file()).file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The judges of an evaluation, and their figures so far.
pub(crate) struct Judges<'a> {
    depth: Option<DepthJudge<'a>>,
    detectors: Vec<DetectionJudge<'a>>,
    true_boxes: Option<&'a TrueBoxes>,
}

struct DetectionJudge<'a> {
    detector: &'a Detector,
    figures: Vec<(Part, u32, DetectionFigures)>,
}

struct DepthJudge<'a> {
    kind: &'static str,
    views: ViewDepths<'a>,
    figures: Vec<(Part, u32, DepthFigures)>,
}

/// What the judges found.
pub(crate) struct Judged {
    pub(crate) depth: Option<DepthReport>,
    pub(crate) detections: Vec<DetectionReport>,
}

impl<'a> Judges<'a> {
    /// # Errors
    /// True depths of none of these views.
    pub(crate) fn new<'v>(
        depth: Option<&'a TrueDepth>,
        detectors: &'a [Detector],
        true_boxes: Option<&'a TrueBoxes>,
        downscale: u32,
        mut views: impl Iterator<Item = &'v View>,
    ) -> Result<Self, BadInput> {
        let depth =
            depth.map(|depth| DepthJudge { kind: depth.kind(), views: depth.views(downscale), figures: Vec::new() });
        if depth.as_ref().is_some_and(|depth| !views.any(|view| depth.views.has(&view.name))) {
            let advice = "hold out other views with --test-every, or leave --depth";
            return Err(BadInput::new("--depth", "finds no depths of any held-out view", advice));
        }
        let detectors = detectors.iter().map(|detector| DetectionJudge { detector, figures: Vec::new() }).collect();
        Ok(Self { depth, detectors, true_boxes })
    }

    /// Whether frames need a depth.
    pub(crate) fn need_depth(&self) -> bool {
        self.depth.is_some()
    }

    /// Measures a frame of a view of this number, whose other figures are known.
    ///
    /// # Errors
    /// Depths that cannot be read, or a detector that cannot be run.
    pub(crate) fn add(
        &mut self,
        (part, index): (Part, u32),
        view: &View,
        photo: &Pixels,
        frame: &Frame,
        (compared, figures): (&Comparison, &ViewFigures),
    ) -> Result<(), BadInput> {
        if let Some(depth) = &mut self.depth {
            let truth = depth.views.of_view(view, photo.mask.as_deref())?;
            depth.figures.push((part, index, DepthFigures::new(&view.name, frame, &truth, &view.camera.pinhole)));
        }
        if self.detectors.is_empty() {
            return Ok(());
        }
        let objects = self.true_boxes.and_then(|boxes| boxes.of_view(view));
        let sight = Sight::new(photo, compared, figures, objects);
        for judge in &mut self.detectors {
            judge.figures.push((part, index, DetectionFigures::new(judge.detector, &sight)?));
        }
        Ok(())
    }

    /// The reports; `kinds` are those of all views of the capture.
    pub(crate) fn finish(self, kinds: &[ViewKind]) -> Judged {
        let depth = self.depth.map(|DepthJudge { kind, figures, .. }| DepthReport {
            source: kind,
            groups: Groups::of(&figures, kinds, DepthSummary::of),
            by_view: figures.into_iter().map(|(_, _, figures)| figures).collect(),
        });
        let report = |DetectionJudge { detector, figures }: DetectionJudge| DetectionReport {
            detector: file_name(detector),
            score: detector.card().score,
            groups: Groups::of(&figures, kinds, DetectionSummary::of),
            by_view: figures.into_iter().map(|(_, _, figures)| figures).collect(),
        };
        let detections = self.detectors.into_iter().map(report).collect();
        Judged { depth, detections }
    }
}
