//! Figures of the parts of a picture where a detector finds something on the photo (the object zones of the
//! perception-aware paper, section 6).

use perceive::{Detection, box_pixels};
use serde::Serialize;
use train::metrics;

use crate::figures::Comparison;

/// Figures of the pixels of a view that lie in a detection on the photo and are not masked. The field names are keys of
/// `eval/report.json`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ZoneFigures {
    /// PSNR over these pixels, dB; null without any.
    pub zone_psnr: Option<f64>,
    /// Mean of the SSIM map over these pixels, 0..1; null without any.
    pub zone_ssim: Option<f64>,
}

impl ZoneFigures {
    /// The figures of these zones; `ssim` is the map of the view.
    pub(crate) fn new<'a>(zones: &[Detection], compared: &Comparison, ssim: impl FnOnce() -> &'a [f64]) -> Self {
        let Comparison { width, height, mask, .. } = *compared;
        let mut inside = vec![0u8; width * height];
        for zone in zones {
            let (columns, rows) = box_pixels(zone.corners, width, height);
            rows.for_each(|y| inside[y * width..][columns.clone()].fill(255));
        }
        if let Some(mask) = mask {
            inside.iter_mut().zip(mask).filter(|(_, mask)| **mask < 128).for_each(|(inside, _)| *inside = 0);
        }
        let count = inside.iter().filter(|inside| **inside > 0).count();
        if count == 0 {
            return Self::default();
        }
        let sum: f64 = ssim().iter().zip(&inside).filter(|(_, inside)| **inside > 0).map(|(value, _)| value).sum();
        Self {
            zone_psnr: metrics::psnr(&compared.render, &compared.truth, Some(&inside)),
            zone_ssim: Some(sum / count as f64),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metric_maps;

    #[test]
    fn zones_count_once_and_masked_pixels_do_not() {
        let (width, height) = (16, 12);
        let truth: Vec<f32> = (0..3 * width * height).map(|i| (i * 37 % 101) as f32 / 101.0).collect();
        // Off by 0.1 in columns 0 to 3, by 0.5 beyond column 8.
        let off = |i: usize| {
            if i % width < 4 {
                0.1
            } else if i % width > 8 {
                0.5
            } else {
                0.0
            }
        };
        let render: Vec<f32> = truth.iter().enumerate().map(|(i, value)| value + off(i)).collect();
        let zone = |corners| Detection { class: 0, score: 1.0, corners };
        let mask: Vec<u8> = (0..width * height).map(|i| if i % width > 8 { 0 } else { 255 }).collect();
        let compared = Comparison { name: "a", render, truth, mask: Some(&mask), width, height };
        let map = metric_maps::ssim(&compared.filled(), &compared.truth, width, height);
        let figures = |zones: &[Detection]| ZoneFigures::new(zones, &compared, || &map);
        let left = figures(&[zone([0.0, 2.0, 4.0, 6.0]), zone([0.0, 3.0, 4.0, 6.0])]);
        assert!((left.zone_psnr.unwrap() - 20.0).abs() < 1e-4, "{left:?}");
        let mean: f64 = (2..6).flat_map(|y| &map[y * width..][..4]).sum::<f64>() / 16.0;
        assert!((left.zone_ssim.unwrap() - mean).abs() < 1e-12);
        // Half of the pixels are exact: 3 dB more. What is masked is left out.
        let both = figures(&[zone([0.0, 2.0, 8.0, 6.0]), zone([9.0, 0.0, 16.0, 12.0])]);
        assert!((both.zone_psnr.unwrap() - 20.0 - 10.0 * 2f64.log10()).abs() < 1e-4, "{both:?}");
        for nothing in [&[][..], &[zone([9.0, 0.0, 16.0, 12.0])], &[zone([2.1, 2.1, 2.2, 2.2])]] {
            assert_eq!(figures(nothing), ZoneFigures::default());
        }
    }
}
