//! Errors of rendered depth against true depth: AbsRel, RMSE and δ < 1.25 as Eigen et al. (2014) define them.
//!
//! The rendered depth of a pixel is the harmonic mean over its splats, Σ αT / Σ (αT / z), along the optical axis, which
//! the loss of target depths fits too. The mean of z itself would measure the sky: one percent of a dome at 1 km adds
//! 10 m to a wall.
//!
//! All unmasked pixels with a true depth count. A pixel whose alpha is not above [`MIN_ALPHA`] has no depth; it is
//! taken as 0, an error of all of the true depth: leaving such pixels out would reward holes. The sky has no true depth
//! and does not count.

use dataset::depth_samples::DepthSamples;
use render::Frame;
use scene::Pinhole;
use serde::Serialize;

use crate::figures::mean;
use crate::normals::angles_degrees;

/// Least alpha at which a pixel has a depth.
const MIN_ALPHA: f32 = 0.5;
/// Largest ratio between depths that agree.
const AGREES: f64 = 1.25;

/// Depth errors of one view; null without true depths.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DepthFigures {
    /// The view's name.
    pub view: String,
    /// Mean of |d - d*| / d*.
    pub absrel: Option<f64>,
    /// Root of the mean of (d - d*)², metres.
    pub rmse: Option<f64>,
    /// Share of pixels with max(d / d*, d* / d) < 1.25.
    pub delta1: Option<f64>,
    /// Share of pixels where nothing is rendered.
    pub empty: Option<f64>,
    /// Number of pixels that count.
    pub pixels: u64,
    /// Median of the angle between the normals of the rendered and of the true surface, degrees; null where true depths are sparse.
    pub normal_degrees: Option<f64>,
    /// Share of the normals that are less than 30° off.
    pub normal_30: Option<f64>,
}

impl DepthFigures {
    /// Compares a frame with [`inverse_depth`](render::Options::inverse_depth) with true depths of its view, whose camera has the
    /// frame's pixels.
    pub(crate) fn new(view: &str, frame: &Frame, truth: &DepthSamples, camera: &Pinhole) -> Self {
        // Splats beyond the range of floats have no inverse depth; they are as far as one can tell.
        let depth_of = |i: usize| {
            let alpha = 1.0 - frame.transmittance[i];
            (alpha > MIN_ALPHA).then(|| f64::from(alpha / frame.depth[i].max(f32::MIN_POSITIVE)))
        };
        let (mut relative, mut squares, mut agree, mut empty, mut pixels) = (0.0, 0.0, 0u64, 0u64, 0u64);
        for (x, y, truth) in truth.iter().filter(|&(x, y, _)| (x as usize) < frame.width && (y as usize) < frame.height)
        {
            let found = depth_of(y as usize * frame.width + x as usize);
            let depth = found.unwrap_or(0.0);
            let truth = f64::from(truth);
            relative += (depth - truth).abs() / truth;
            squares += (depth - truth).powi(2);
            agree += u64::from(depth < AGREES * truth && truth < AGREES * depth);
            empty += u64::from(found.is_none());
            pixels += 1;
        }
        let angles = angles_degrees(frame, depth_of, truth, camera);
        let over = |sum: f64| (pixels > 0).then(|| sum / pixels as f64);
        Self {
            view: view.to_owned(),
            absrel: over(relative),
            rmse: over(squares).map(f64::sqrt),
            delta1: over(agree as f64),
            empty: over(empty as f64),
            pixels,
            normal_degrees: angles.get(angles.len() / 2).copied(),
            normal_30: (!angles.is_empty())
                .then(|| angles.partition_point(|angle| *angle < 30.0) as f64 / angles.len() as f64),
        }
    }
}

/// Means of depth errors over views, each view weighted alike. The field names are keys of `eval/report.json`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DepthSummary {
    /// Number of views with true depths.
    pub views: usize,
    /// As in [`DepthFigures`].
    pub absrel: Option<f64>,
    /// Metres.
    pub rmse: Option<f64>,
    /// 0..1.
    pub delta1: Option<f64>,
    /// 0..1.
    pub empty: Option<f64>,
    /// Number of pixels of all views.
    pub pixels: u64,
    /// Mean of the views' medians, degrees.
    pub normal_degrees: Option<f64>,
    /// 0..1.
    pub normal_30: Option<f64>,
}

impl DepthSummary {
    /// The summary of these views.
    pub(crate) fn of(figures: &[&DepthFigures]) -> Self {
        let of = |figure: fn(&DepthFigures) -> Option<f64>| mean(figures.iter().map(|view| figure(view)));
        Self {
            views: figures.iter().filter(|view| view.pixels > 0).count(),
            absrel: of(|view| view.absrel),
            rmse: of(|view| view.rmse),
            delta1: of(|view| view.delta1),
            empty: of(|view| view.empty),
            pixels: figures.iter().map(|view| view.pixels).sum(),
            normal_degrees: of(|view| view.normal_degrees),
            normal_30: of(|view| view.normal_30),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Pinhole = Pinhole { width: 5, height: 1, fx: 5.0, fy: 5.0, cx: 2.5, cy: 0.5 };

    /// A frame of one row: alpha and mean depth of each pixel.
    fn frame(pixels: &[(f32, f32)]) -> Frame {
        Frame {
            width: pixels.len(),
            height: 1,
            transmittance: pixels.iter().map(|(alpha, _)| 1.0 - alpha).collect(),
            depth: pixels.iter().map(|(alpha, depth)| alpha / depth).collect(),
            ..Frame::default()
        }
    }

    #[test]
    fn errors_are_those_of_the_definitions() {
        // Exact; 10 % too far; half; nothing drawn; the sky, which does not count, behind a false surface.
        let frame = frame(&[(1.0, 10.0), (0.75, 22.0), (1.0, 4.0), (0.25, 5.0), (1.0, 3.0)]);
        let truth = [(0, 0, 10.0), (1, 0, 20.0), (2, 0, 8.0), (3, 0, 5.0)];
        let found = DepthFigures::new("a", &frame, &DepthSamples::new(5, 1, truth.into_iter()), &CAMERA);
        let near =
            |found: Option<f64>, wanted: f64| assert!((found.unwrap() - wanted).abs() < 1e-6, "{found:?} {wanted}");
        near(found.absrel, (0.0 + 0.1 + 0.5 + 1.0) / 4.0);
        near(found.rmse, ((0.0 + 4.0 + 16.0 + 25.0) / 4.0f64).sqrt());
        near(found.delta1, 0.5);
        near(found.empty, 0.25);
        assert_eq!(found.pixels, 4);
        // Both directions of the ratio count.
        let of = |depth: f32| {
            let truth = DepthSamples::new(1, 1, [(0, 0, 8.0)].into_iter());
            DepthFigures::new("a", &super::tests::frame(&[(1.0, depth)]), &truth, &CAMERA).delta1
        };
        assert_eq!([9.9, 10.1, 6.5, 6.3].map(of), [Some(1.0), Some(0.0), Some(1.0), Some(0.0)]);
    }

    #[test]
    fn views_weigh_alike_and_views_without_truth_not_at_all() {
        let one = DepthFigures::new(
            "a",
            &frame(&[(1.0, 12.0), (1.0, 12.0), (1.0, 12.0)]),
            &DepthSamples::new(3, 1, (0..3).map(|x| (x, 0, 10.0))),
            &CAMERA,
        );
        let truth = DepthSamples::new(1, 1, [(0, 0, 10.0)].into_iter());
        let two = DepthFigures::new("b", &frame(&[(1.0, 14.0)]), &truth, &CAMERA);
        let none =
            DepthFigures::new("c", &frame(&[(1.0, 14.0)]), &DepthSamples::new(1, 1, std::iter::empty()), &CAMERA);
        assert_eq!((none.absrel, none.pixels), (None, 0));
        let all = DepthSummary::of(&[&one, &two, &none]);
        assert!((all.absrel.unwrap() - 0.3).abs() < 1e-6 && (all.rmse.unwrap() - 3.0).abs() < 1e-6, "{all:?}");
        assert_eq!((all.views, all.pixels, all.delta1, all.normal_degrees), (2, 4, Some(0.5), None));
        assert_eq!(DepthSummary::of(&[&none]).absrel, None);
    }
}
