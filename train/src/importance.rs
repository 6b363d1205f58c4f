//! What a splat is worth: orders by which to prune, and the measure that pruning is held to.
//!
//! Orders that look at the splats alone serve where there are no photos; the others ask the renderer what each splat does in
//! each view ([`render::Contributions`]).

use render::cpu::Renderer;
use render::{Frame, Options};
use scene::{Exposures, Pixels, Splats, column};
use serde::{Deserialize, Serialize};

use crate::exposure::{expose, square_gain};
use crate::metrics::PSNR_OF_EQUALS;
use crate::source;
use crate::{TrainError, TrainView, WindowSource};

/// An order of splats by what they are worth.
///
/// Opacity, opacity times volume, Σ αT, largest αT (RadSplat), Σ αT times a power of the volume (LightGaussian), the determinant of
/// the Fisher information (PUP 3D-GS) and the exact growth of the error by each removal alone were measured and lost:
/// ARCHITECTURE has the figures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// Opacity times surface: needs no views.
    Surface,
    /// Σ (dI/dg)² over pixels and views, g the splat's projected value (Speedy-Splat, Hanson et al. 2025).
    Squared,
    /// Σ δ² over pixels and views, in units of each view's squared error, δ what the picture changes by without the splat.
    Energy,
}

impl Order {
    /// All, in the order of a table.
    pub const ALL: [Self; 3] = [Self::Surface, Self::Squared, Self::Energy];

    /// As the command line says it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Surface => "surface",
            Self::Squared => "squared",
            Self::Energy => "energy",
        }
    }
}

/// Opacity times surface of each splat (but for a factor), square metres: its importance where there are no views.
pub fn surfaces(splats: &Splats) -> Vec<f64> {
    let of = |i: usize| {
        let opacity = 1.0 / (1.0 + (-f64::from(splats.col(column::OPACITY)[i])).exp());
        let [a, b, c] = scales(splats, i);
        opacity * (a * b + b * c + c * a)
    };
    (0..splats.len()).map(of).collect()
}

/// Standard deviations, metres.
fn scales(splats: &Splats, i: usize) -> [f64; 3] {
    [0, 1, 2].map(|k| f64::from(splats.col(column::LOG_SCALE + k)[i]).exp())
}

/// Views to judge splats by.
#[derive(Clone, Copy)]
pub struct Views<'a> {
    /// The windows.
    pub views: &'a [TrainView],
    /// What is drawn with the splats and not judged.
    pub context: Option<&'a Splats>,
    /// Opacity compensated for the pixel's blur.
    pub antialiased: bool,
    /// Of the views, where they have any: pictures are compared as the photos show them.
    pub exposures: Option<&'a Exposures>,
    /// The photos.
    pub source: &'a dyn WindowSource,
}

/// A view drawn beside its photo.
struct Compared<'a> {
    /// What each pixel counts; empty where all count 1.
    weights: &'a [f32],
    /// Mean squared error over channels of what counts, and how many pixels that is.
    mse: f64,
    pixels: f64,
    /// What the view's exposure makes of the square of a change.
    square_gain: f64,
}

/// What each pixel of some views counts, 0 to 255, none where all count alike: fixed, so that cutting a splat does not hide the hole.
#[derive(Debug, Clone, Default)]
pub struct Shares(Vec<Vec<u8>>);

impl<'a> Views<'a> {
    /// At most `count` of the views, evenly.
    pub fn some(&self, count: usize) -> Vec<TrainView> {
        self.views.iter().step_by(self.views.len().div_ceil(count.max(1)).max(1)).copied().collect()
    }

    /// What the pixels of each view count: the share of it that these splats explain, not the context.
    ///
    /// # Errors
    /// A window that cannot be read.
    pub fn shares(&self, splats: &Splats) -> Result<Shares, TrainError> {
        let mut shares = Shares::default();
        if self.context.is_some() {
            self.compare(splats, None, |renderer, _| shares.0.push(explained(renderer.frame())))?;
        }
        Ok(shares)
    }

    /// Mean over the views of the PSNR of what counts, dB.
    ///
    /// # Errors
    /// A window that cannot be read.
    pub fn psnr(&self, splats: &Splats, shares: &Shares) -> Result<f64, TrainError> {
        let (mut sum, mut count) = (0.0, 0.0f64);
        self.compare(splats, Some(shares), |_, compared| {
            if compared.pixels >= 1.0 {
                sum += (-10.0 * compared.mse.log10()).min(PSNR_OF_EQUALS);
                count += 1.0;
            }
        })?;
        Ok(sum / count.max(1.0))
    }

    /// Root of the mean squared error over all that counts in the views, 0 to 1; `None` where that is next to nothing.
    ///
    /// # Errors
    /// A window that cannot be read.
    pub fn residual(&self, splats: &Splats, shares: &Shares) -> Result<Option<f64>, TrainError> {
        /// Pixels without which there is nothing to tell.
        const MIN_PIXELS: f64 = 64.0;
        let (mut sum, mut pixels) = (0.0, 0.0);
        self.compare(splats, Some(shares), |_, compared| {
            sum += compared.mse * compared.pixels;
            pixels += compared.pixels;
        })?;
        Ok((pixels >= MIN_PIXELS).then(|| (sum / pixels).sqrt()))
    }

    /// The importance of each splat in an order; not seen is the least.
    ///
    /// # Errors
    /// A window that cannot be read.
    pub fn importance(&self, order: Order, splats: &Splats) -> Result<Vec<f64>, TrainError> {
        if order == Order::Surface {
            return Ok(surfaces(splats));
        }
        let mut total = vec![0.0; splats.len()];
        self.compare(splats, None, |renderer, compared| {
            let said = renderer.contributions(compared.weights);
            let (values, unit) = match order {
                Order::Squared => (&said.squared, 1.0),
                _ => (&said.energy, (3.0 * compared.pixels * compared.mse).max(1e-9)),
            };
            let unit = unit / compared.square_gain.max(1e-9);
            total.iter_mut().zip(values).for_each(|(total, value)| *total += f64::from(*value) / unit);
        })?;
        Ok(total)
    }

    /// Draws every view beside its photo. Views of which nothing counts have no error and no pixels.
    fn compare(
        &self,
        splats: &Splats,
        shares: Option<&Shares>,
        mut see: impl FnMut(&mut Renderer, Compared),
    ) -> Result<(), TrainError> {
        let mut renderer = Renderer::default();
        let (mut weights, mut exposed) = (Vec::new(), Vec::new());
        let windows = self.views.iter().filter_map(|view| view.at(0).map(|(mip, rect, _)| (view.view, mip, rect)));
        for ((n, view), photo) in self.views.iter().enumerate().zip(source::each(self.source, windows)) {
            let (_, _, camera) = view.at(0).expect("at(0) always is");
            let photo = photo.map_err(TrainError::Source)?;
            let extras = self.context.is_some();
            let sh_degree = splats.sh_degree();
            let options = Options { antialiased: self.antialiased, sh_degree, background: [0.0; 3], extras };
            let frame = renderer.forward(splats, self.context, &camera, &options);
            pixel_weights(frame, &photo, shares.and_then(|shares| shares.0.get(n)), &mut weights);
            let area = photo.area();
            let weight = |i: usize| if weights.is_empty() { 1.0 } else { f64::from(weights[i % area]) };
            let exposure = self.exposures.and_then(|exposures| exposures.of(view.view));
            let shown = exposure.map_or(&frame.colour, |exposure| {
                expose(exposure, &frame.colour, &mut exposed);
                &exposed
            });
            // Clamped to what can be shown.
            let pairs = shown.iter().map(|colour| colour.clamp(0.0, 1.0)).zip(&photo.rgb);
            let squares = pairs.map(|(colour, photo)| f64::from(colour - f32::from(*photo) / 255.0).powi(2));
            let error: f64 = squares.enumerate().map(|(i, square)| weight(i) * square).sum();
            let pixels = if weights.is_empty() { area as f64 } else { weights.iter().map(|w| f64::from(*w)).sum() };
            let mse = error / (3.0 * pixels).max(1e-9);
            let square_gain = exposure.map_or(1.0, |exposure| f64::from(square_gain(exposure)));
            see(&mut renderer, Compared { weights: &weights, mse, pixels, square_gain });
        }
        Ok(())
    }
}

/// The share of what is drawn in each pixel that the trainable splats explain, 0 to 255.
fn explained(frame: &Frame) -> Vec<u8> {
    let share = frame.own.iter().zip(&frame.transmittance).map(|(own, rest)| own / (1.0 - rest).max(1e-4));
    share.map(|share| (share.clamp(0.0, 1.0) * 255.0).round() as u8).collect()
}

/// Nothing under a mask; else the share that is given, or that the frame says.
fn pixel_weights(frame: &Frame, photo: &Pixels, shares: Option<&Vec<u8>>, weights: &mut Vec<f32>) {
    weights.clear();
    match shares {
        Some(shares) => weights.extend(shares.iter().map(|share| f32::from(*share) / 255.0)),
        None => weights.extend(explained(frame).iter().map(|share| f32::from(*share) / 255.0)),
    }
    if let Some(mask) = &photo.mask {
        weights.resize(mask.len(), 1.0);
        weights.iter_mut().zip(mask).filter(|(_, mask)| **mask < 128).for_each(|(weight, _)| *weight = 0.0);
    }
}
