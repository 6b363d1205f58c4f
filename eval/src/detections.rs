//! How many of the objects that a detector finds on a photo it still finds on the render of the same view.
//!
//! Both are pictures of the same size with 8 bits a channel. Masked pixels (moving objects, which no model shows) are
//! the photo's in both, and detections of which more than half is masked are left out of both.

use perceive::{Agreement, Counts, Detection, Detector, Picture, SCORE, agreement};
use scene::{BadInput, Pixels};
use serde::Serialize;

use crate::images::{colour_image, photo_image};

/// Largest share of a detection that may be masked.
const MAX_MASKED: f64 = 0.5;

/// Detections of one view.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct DetectionFigures {
    /// The view's name.
    pub view: String,
    /// By groups of classes.
    #[serde(flatten)]
    pub counts: Agreement,
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
}

impl DetectionFigures {
    /// Runs the detector on a photo and on a frame of its view (three planes of sRGB values).
    ///
    /// # Errors
    /// A network that cannot be run.
    pub(crate) fn new(view: &str, detector: &Detector, photo: &Pixels, colour: &[f32]) -> Result<Self, BadInput> {
        let (width, height) = (photo.width as usize, photo.height as usize);
        let (photo_pixels, mut render) =
            (photo_image(photo).into_raw(), colour_image(colour, width, height).into_raw());
        let mask = photo.mask.as_deref();
        if let Some(mask) = mask {
            let pixels = render.chunks_exact_mut(3).zip(photo_pixels.chunks_exact(3)).zip(mask);
            pixels.filter(|(_, mask)| **mask < 128).for_each(|((render, photo), _)| render.copy_from_slice(photo));
        }
        let found = |rgb: &[u8]| -> Result<Vec<Detection>, BadInput> {
            let mut found = detector.detect(&Picture { rgb, width, height }, SCORE)?;
            found.retain(|of| mask.is_none_or(|mask| masked_share(mask, width, of.corners) <= MAX_MASKED));
            Ok(found)
        };
        let counts = agreement(&found(&photo_pixels)?, &found(&render)?, &detector.card().written.classes);
        Ok(Self { view: view.to_owned(), counts })
    }
}

/// The share of masked pixels among those whose centre a box contains.
fn masked_share(mask: &[u8], width: usize, [left, top, right, bottom]: [f32; 4]) -> f64 {
    let pixels =
        |from: f32, to: f32, side: usize| ((from - 0.5).ceil().max(0.0) as usize)..((to + 0.5) as usize).min(side);
    let (columns, rows) = (pixels(left, right, width), pixels(top, bottom, mask.len() / width.max(1)));
    let (mut masked, mut all) = (0u64, 0u64);
    for row in rows.map(|y| &mask[y * width..][..width]) {
        for &value in row.get(columns.clone()).unwrap_or_default() {
            masked += u64::from(value < 128);
            all += 1;
        }
    }
    if all > 0 { masked as f64 / all as f64 } else { 0.0 }
}

impl DetectionSummary {
    /// The summary of these views.
    pub(crate) fn of(figures: &[&DetectionFigures]) -> Self {
        let mut counts = Agreement::default();
        figures.iter().for_each(|view| counts += view.counts);
        let Counts { photos, kept, .. } = counts.all;
        Self { views: figures.len(), counts, share_kept: (photos > 0).then(|| kept as f64 / photos as f64) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_share_of_a_box_that_is_masked_is_that_of_its_pixels() {
        // The left two of four columns are masked.
        let mask = [0, 0, 255, 255, 0, 0, 255, 255, 0, 0, 255, 255];
        let share = |corners| masked_share(&mask, 4, corners);
        assert_eq!(share([0.0, 0.0, 4.0, 3.0]), 0.5);
        assert_eq!(share([1.0, 0.0, 4.0, 3.0]), 1.0 / 3.0);
        assert_eq!((share([1.4, 0.2, 2.6, 1.0]), share([1.6, 0.2, 2.6, 1.0])), (0.5, 0.0));
        assert_eq!((share([3.0, 1.0, 9.0, 9.0]), share([-5.0, -5.0, 1.0, 9.0])), (0.0, 1.0));
        assert_eq!((share([9.0, 9.0, 10.0, 10.0]), share([1.1, 1.1, 1.2, 1.2])), (0.0, 0.0));
    }

    #[test]
    fn sums_give_the_share_that_is_kept() {
        let view = |photos, kept| {
            let all = Counts { photos, renders: 5, kept, extra: 5 - kept };
            DetectionFigures { view: "a".into(), counts: Agreement { all, vehicles: all, ..Agreement::default() } }
        };
        let all = DetectionSummary::of(&[&view(4, 1), &view(6, 4), &view(0, 0)]);
        assert_eq!((all.views, all.share_kept, all.counts.vehicles.extra), (3, Some(0.5), 10));
        assert_eq!(DetectionSummary::of(&[&view(0, 0)]).share_kept, None);
    }
}
