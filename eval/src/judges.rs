//! Further measures of each rendered view, on request: errors of its depth, and what a detector finds on it.

use blocks::{Part, ViewKind};
use dataset::ingest::{TrueDepth, ViewDepths};
use perceive::{Detector, SCORE};
use render::Frame;
use scene::{BadInput, Pixels, View};
use serde::Serialize;

use crate::depth::{DepthFigures, DepthSummary};
use crate::detections::{DetectionFigures, DetectionSummary};
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
    /// Least score of a detection.
    pub score: f32,
    /// By use and kind of the views.
    #[serde(flatten)]
    pub groups: Groups<DetectionSummary>,
    /// By view: held-out views, held-out stretches, views that were trained on.
    pub by_view: Vec<DetectionFigures>,
}

/// The judges of an evaluation, and their figures so far.
pub(crate) struct Judges<'a> {
    depth: Option<DepthJudge<'a>>,
    detector: Option<&'a Detector>,
    detections: Vec<(Part, u32, DetectionFigures)>,
}

struct DepthJudge<'a> {
    kind: &'static str,
    views: ViewDepths<'a>,
    figures: Vec<(Part, u32, DepthFigures)>,
}

/// What the judges found.
pub(crate) struct Judged {
    pub(crate) depth: Option<DepthReport>,
    pub(crate) detections: Option<DetectionReport>,
}

impl<'a> Judges<'a> {
    /// # Errors
    /// True depths of none of these views.
    pub(crate) fn new<'v>(
        depth: Option<&'a TrueDepth>,
        detector: Option<&'a Detector>,
        downscale: u32,
        mut views: impl Iterator<Item = &'v View>,
    ) -> Result<Self, BadInput> {
        let depth =
            depth.map(|depth| DepthJudge { kind: depth.kind(), views: depth.views(downscale), figures: Vec::new() });
        if depth.as_ref().is_some_and(|depth| !views.any(|view| depth.views.has(&view.name))) {
            let advice = "hold out other views with --test-every, or leave --depth";
            return Err(BadInput::new("--depth", "finds no depths of any held-out view", advice));
        }
        Ok(Self { depth, detector, detections: Vec::new() })
    }

    /// Whether frames need a depth.
    pub(crate) fn need_depth(&self) -> bool {
        self.depth.is_some()
    }

    /// Measures a frame of a view of this number.
    ///
    /// # Errors
    /// Depths that cannot be read, or a detector that cannot be run.
    pub(crate) fn add(
        &mut self,
        (part, index): (Part, u32),
        view: &View,
        photo: &Pixels,
        frame: &Frame,
    ) -> Result<(), BadInput> {
        if let Some(depth) = &mut self.depth {
            let truth = depth.views.of_view(view, photo.mask.as_deref())?;
            depth.figures.push((part, index, DepthFigures::new(&view.name, frame, &truth)));
        }
        if let Some(detector) = self.detector {
            let figures = DetectionFigures::new(&view.name, detector, photo, &frame.colour)?;
            self.detections.push((part, index, figures));
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
        let detections = self.detector.map(|_| DetectionReport {
            score: SCORE,
            groups: Groups::of(&self.detections, kinds, DetectionSummary::of),
            by_view: self.detections.into_iter().map(|(_, _, figures)| figures).collect(),
        });
        Judged { depth, detections }
    }
}
