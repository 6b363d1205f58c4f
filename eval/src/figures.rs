//! Compares one rendered view with its photo.
//!
//! Renders are compared as floats clamped to 0..1, not rounded to 8 bits. PSNR counts unmasked pixels only. For the other measures
//! masked pixels of the render are replaced by the photo's.

use scene::frame::{self, Kind};
use scene::{BadInput, CodecError, Pixels};
use serde::{Deserialize, Serialize};
use train::metrics;

use crate::lpips::Lpips;

/// The frame kind of a list of [`ViewFigures`].
pub const FIGURES: Kind = Kind(*b"figs", 2);

/// Figures of one view. The field names are keys of `eval/report.json`; their order is part of the frame's format.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewFigures {
    /// The view's name.
    pub view: String,
    /// dB; null where a mask leaves no pixel.
    pub psnr: Option<f64>,
    /// dB, after the affine colour transform that brings the render closest to the photo.
    pub cc_psnr: Option<f64>,
    /// 0..1.
    pub ssim: f64,
    /// SSIMULACRA2; null below 8 pixels a side.
    pub perceptual: Option<f64>,
    /// Null without a network.
    pub lpips: Option<f64>,
    /// dB, from the pose that fits the photo best; null where poses are not fitted.
    pub psnr_refined: Option<f64>,
    /// dB of the right half, after the affine colour transform that brings the left half closest to the photo, from the
    /// fitted pose where poses are fitted; null where exposures are not.
    pub psnr_fitted: Option<f64>,
}

/// Encodes figures as a frame: the result of an evaluation task.
pub fn figures_to_frame(figures: &[ViewFigures]) -> Vec<u8> {
    frame::encode(FIGURES, &figures, &[])
}

/// Decodes [`figures_to_frame`].
///
/// # Errors
/// A damaged frame or another version.
pub fn figures_from_frame(bytes: &[u8]) -> Result<Vec<ViewFigures>, CodecError> {
    Ok(frame::decode(FIGURES, bytes)?.0)
}

/// A photo and a render of the same size, each as three planes of sRGB values in 0..1.
pub(crate) struct Comparison<'a> {
    pub(crate) name: &'a str,
    pub(crate) render: Vec<f32>,
    pub(crate) truth: Vec<f32>,
    pub(crate) mask: Option<&'a [u8]>,
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl<'a> Comparison<'a> {
    pub(crate) fn new(name: &'a str, colour: &[f32], photo: &'a Pixels) -> Self {
        Self {
            name,
            render: clamped(colour),
            truth: photo.rgb.iter().map(|&value| f32::from(value) / 255.0).collect(),
            mask: photo.mask.as_deref(),
            width: photo.width as usize,
            height: photo.height as usize,
        }
    }

    /// # Errors
    /// A network that refuses the pictures.
    pub(crate) fn figures(&self, lpips: Option<&Lpips>) -> Result<ViewFigures, BadInput> {
        let Self { truth, width, height, .. } = self;
        let psnr = metrics::psnr(&self.render, truth, self.mask);
        let cc_psnr = metrics::colour_corrected_psnr(&self.render, truth, self.mask);
        let render = self.filled();
        Ok(ViewFigures {
            view: self.name.to_owned(),
            psnr,
            cc_psnr,
            ssim: metrics::ssim(&render, truth, *width, *height),
            perceptual: metrics::ssimulacra2(truth, &render, *width, *height),
            lpips: lpips.map(|lpips| lpips.distance(&render, truth, *width, *height)).transpose()?,
            psnr_refined: None,
            psnr_fitted: None,
        })
    }
}

impl Comparison<'_> {
    /// The render with the photo's pixels where it is masked.
    pub(crate) fn filled(&self) -> Vec<f32> {
        let mut render = self.render.clone();
        if let Some(mask) = self.mask {
            let pixels = render.iter_mut().zip(&self.truth).enumerate();
            pixels.filter(|(i, _)| mask[i % mask.len()] < 128).for_each(|(_, (render, truth))| *render = *truth);
        }
        render
    }
}

/// Values clamped to 0..1.
pub(crate) fn clamped(colour: &[f32]) -> Vec<f32> {
    colour.iter().map(|value| value.clamp(0.0, 1.0)).collect()
}

/// Means over the held-out views.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Means {
    /// dB.
    pub psnr: Option<f64>,
    /// 0..1.
    pub ssim: Option<f64>,
    /// SSIMULACRA2.
    pub perceptual: Option<f64>,
}

impl Means {
    pub(crate) fn of(figures: &[ViewFigures]) -> Self {
        Self {
            psnr: mean(figures.iter().map(|f| f.psnr)),
            ssim: mean(figures.iter().map(|f| Some(f.ssim))),
            perceptual: mean(figures.iter().map(|f| f.perceptual)),
        }
    }
}

/// Mean of the values that are there; `None` without any.
pub fn mean(values: impl Iterator<Item = Option<f64>>) -> Option<f64> {
    let (sum, count) = values.flatten().fold((0.0, 0u32), |(sum, count), value| (sum + value, count + 1));
    (count > 0).then(|| sum / f64::from(count))
}
