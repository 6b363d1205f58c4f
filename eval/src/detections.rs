//! What a detector finds on photos and on renders of the same views, and how far both agree: perception stability, as
//! the perception-aware 3DGS paper names it (its section 3.2).
//!
//! Both are pictures of the same size with 8 bits a channel. Masked pixels (moving objects, which no model shows) are
//! the photo's in both, and detections of which more than half is masked are left out of both.

use std::cell::OnceCell;

use perceive::{
    Agreement, Boxes, Counts, Detection, Detector, MAX_MASKED, Picture, Precision, TrueBox, agreement, masked_share,
    precision,
};
use scene::{BadInput, Pixels};
use serde::Serialize;

use crate::against_truth::{AgainstTruth, Objects, TruthBoxes};
use crate::correlation::{Correlation, correlation};
use crate::figures::{Comparison, ViewFigures, mean};
use crate::images::{colour_image, photo_image};
use crate::metric_maps;
use crate::zones::ZoneFigures;

/// Least score of a detection on a render that average precision sees, as COCO's evaluations choose it.
pub(crate) const LEAST_SCORE: f32 = 0.05;

/// A photo and a render of its view, as detectors see them.
pub(crate) struct Sight<'a> {
    compared: &'a Comparison<'a>,
    figures: &'a ViewFigures,
    photo: Vec<u8>,
    render: Vec<u8>,
    objects: Option<Objects>,
    ssim: OnceCell<Vec<f64>>,
}

impl<'a> Sight<'a> {
    pub(crate) fn new(
        photo: &Pixels,
        compared: &'a Comparison,
        figures: &'a ViewFigures,
        objects: Option<Objects>,
    ) -> Self {
        let render = colour_image(&compared.filled(), compared.width, compared.height).into_raw();
        Self { compared, figures, photo: photo_image(photo).into_raw(), render, objects, ssim: OnceCell::new() }
    }

    fn ssim(&self) -> &[f64] {
        let Comparison { truth, width, height, .. } = self.compared;
        self.ssim.get_or_init(|| metric_maps::ssim(&self.compared.filled(), truth, *width, *height))
    }

    /// What a detector finds on the photo and on the render.
    fn found(&self, detector: &Detector) -> Result<[Vec<Detection>; 2], BadInput> {
        let Comparison { width, height, mask, .. } = *self.compared;
        let found = |rgb: &[u8]| -> Result<Vec<Detection>, BadInput> {
            let mut found = detector.detect(&Picture { rgb, width, height }, LEAST_SCORE.min(detector.card().score))?;
            found.retain(|of| mask.is_none_or(|mask| masked_share(mask, width, of.corners) <= MAX_MASKED));
            Ok(found)
        };
        Ok([found(&self.photo)?, found(&self.render)?])
    }
}

/// Detections of one view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DetectionFigures {
    /// The view's name.
    pub view: String,
    /// By groups of classes.
    #[serde(flatten)]
    pub counts: Agreement,
    /// Of the render's detections, the photo's being the truth.
    #[serde(flatten)]
    pub precision: Precision,
    /// See [`Agreement::mean_overlap`].
    pub mean_iou: Option<f64>,
    /// Where the photo has detections.
    #[serde(flatten)]
    pub zones: ZoneFigures,
    #[serde(skip)]
    boxes: Boxes,
    #[serde(skip)]
    truth: Option<TruthBoxes>,
    /// PSNR, SSIM, LPIPS.
    #[serde(skip)]
    visual: [Option<f64>; 3],
}

/// Detections of several views. The field names are keys of `eval/report.json`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct DetectionSummary {
    /// Number of views.
    pub views: usize,
    /// Sums over the views.
    #[serde(flatten)]
    pub counts: Agreement,
    /// Share of the detections on photos that are kept, of all classes; null without detections.
    pub share_kept: Option<f64>,
    /// Detections on photos that are not kept.
    pub misses: u64,
    /// Detections on renders that keep none.
    pub extra: u64,
    /// Of the renders' detections, the photos' being the truth.
    #[serde(flatten)]
    pub precision: Precision,
    /// See [`Agreement::mean_overlap`].
    pub mean_iou: Option<f64>,
    /// Means over the views with zones.
    #[serde(flatten)]
    pub zones: ZoneFigures,
    /// Of the views' figures with their `map`.
    pub correlations: Correlations,
    /// Where the capture has true boxes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth: Option<AgainstTruth>,
}

/// Correlations of the views' visual figures with their mean average precision (table 2 of the perception-aware
/// paper); null where there are too few views, or all are alike.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Correlations {
    /// Views with detections on the photo.
    pub views: usize,
    /// With PSNR.
    pub psnr: Option<Correlation>,
    /// With SSIM.
    pub ssim: Option<Correlation>,
    /// With LPIPS, if there is a network for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<Correlation>,
}

impl DetectionFigures {
    /// Runs the detector on a photo and on its render.
    ///
    /// # Errors
    /// A network that cannot be run.
    pub(crate) fn new(detector: &Detector, sight: &Sight) -> Result<Self, BadInput> {
        let Sight { compared, figures, objects, .. } = sight;
        let card = detector.card();
        let [photo, render] = sight.found(detector)?;
        let certain = |found: &[Detection]| -> Vec<Detection> {
            found.iter().filter(|of| of.score >= card.score).copied().collect()
        };
        let zones = certain(&photo);
        let counts = agreement(&zones, &certain(&render), &card.classes);
        let is_there = |of: &Detection| TrueBox { class: of.class, corners: of.corners, counts: true };
        let boxes = Boxes { truth: zones.iter().map(is_there).collect(), found: render.clone(), least_height: 0.0 };
        let is_hidden =
            |corners| compared.mask.is_some_and(|mask| masked_share(mask, compared.width, corners) > MAX_MASKED);
        Ok(Self {
            view: compared.name.to_owned(),
            counts,
            precision: precision(&[&boxes]),
            mean_iou: counts.mean_overlap(),
            zones: ZoneFigures::new(&zones, compared, || sight.ssim()),
            boxes,
            truth: objects.as_ref().map(|objects| TruthBoxes::new(objects, card, is_hidden, [photo, render])),
            visual: [figures.psnr, Some(figures.ssim), figures.lpips],
        })
    }
}

impl DetectionSummary {
    /// The summary of these views.
    pub(crate) fn of(figures: &[&DetectionFigures]) -> Self {
        let mut counts = Agreement::default();
        figures.iter().for_each(|view| counts += view.counts);
        let Counts { photos, kept, extra, .. } = counts.all;
        let zones = ZoneFigures {
            zone_psnr: mean(figures.iter().map(|view| view.zones.zone_psnr)),
            zone_ssim: mean(figures.iter().map(|view| view.zones.zone_ssim)),
        };
        let truth: Vec<&TruthBoxes> = figures.iter().filter_map(|view| view.truth.as_ref()).collect();
        let with_map = |visual: usize| {
            let pairs = figures.iter().filter_map(|view| Some((view.visual[visual]?, view.precision.map?)));
            correlation(&pairs.collect::<Vec<_>>())
        };
        Self {
            views: figures.len(),
            counts,
            share_kept: (photos > 0).then(|| kept as f64 / photos as f64),
            misses: photos - kept,
            extra,
            precision: precision(&figures.iter().map(|view| &view.boxes).collect::<Vec<_>>()),
            mean_iou: counts.mean_overlap(),
            zones,
            correlations: Correlations {
                views: figures.iter().filter(|view| view.precision.map.is_some()).count(),
                psnr: with_map(0),
                ssim: with_map(1),
                lpips: with_map(2),
            },
            truth: (!truth.is_empty()).then(|| AgainstTruth::of(&truth)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(photos: u64, kept: u64, visual: f64) -> DetectionFigures {
        let all = Counts { photos, renders: 5, kept, extra: 5 - kept };
        let at = |i: u64| [20.0 * i as f32, 0.0, 20.0 * i as f32 + 10.0, 10.0];
        let boxes = Boxes {
            truth: (0..photos).map(|i| TrueBox { class: 0, corners: at(i), counts: true }).collect(),
            found: (0..kept).map(|i| Detection { class: 0, score: 0.5, corners: at(i) }).collect(),
            least_height: 0.0,
        };
        DetectionFigures {
            view: "a".into(),
            counts: Agreement { all, vehicles: all, overlaps: kept as f64, ..Agreement::default() },
            precision: precision(&[&boxes]),
            mean_iou: None,
            zones: ZoneFigures { zone_psnr: (photos > 0).then_some(visual), zone_ssim: None },
            boxes,
            truth: None,
            visual: [Some(visual), Some(0.5), None],
        }
    }

    #[test]
    fn sums_give_the_share_that_is_kept_and_what_goes_with_it() {
        let views = [view(4, 1, 20.0), view(6, 4, 25.0), view(0, 0, 1.0), view(2, 2, 28.0)];
        let all = DetectionSummary::of(&views.iter().collect::<Vec<_>>());
        assert_eq!((all.views, all.share_kept, all.counts.vehicles.extra), (4, Some(7.0 / 12.0), 13));
        assert_eq!((all.misses, all.extra, all.mean_iou), (5, 13, Some(7.0 / 12.0)));
        assert!((all.zones.zone_psnr.unwrap() - 73.0 / 3.0).abs() < 1e-9 && all.zones.zone_ssim.is_none());
        // 59 of the 101 recalls are at most 7/12.
        assert!((all.precision.map.unwrap() - 59.0 / 101.0).abs() < 1e-12);
        let Correlations { views: with_boxes, psnr, ssim, lpips } = all.correlations;
        assert!(with_boxes == 3 && psnr.unwrap().r > 0.99 && ssim.is_none() && lpips.is_none(), "{psnr:?}");
        let none = DetectionSummary::of(&[&views[2]]);
        let json = serde_json::to_value(none).unwrap();
        for key in ["share_kept", "map", "map50", "mean_iou", "zone_psnr", "zone_ssim"] {
            assert!(json[key].is_null(), "{json}");
        }
        assert!(json["correlations"]["psnr"].is_null() && json.get("truth").is_none());
    }
}
