//! Computes the importance of splats for pruning, and the PSNR and residual of splats on a set of views.
//!
//! [`Order::Surface`] needs only the splats. The other measures sum each splat's contribution to the rendered views
//! ([`render::Contributions`]).

use render::cpu::Renderer;
use render::{Frame, Options, Part};
use scene::{Exposures, Pixels, Splats, column};
use serde::{Deserialize, Serialize};

use crate::error::TrainError;
use crate::exposure::{expose, square_gain};
use crate::metrics::psnr_of;
use crate::source::{self, WindowSource};
use crate::view::TrainView;

/// An importance measure by which splats are ordered for pruning.
///
/// [`Order::Energy`] is used; the others are what it is compared with. More were tried (decision 0012).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// Opacity times surface area. Needs no views.
    Surface,
    /// Opacity. Needs no views.
    Opacity,
    /// Σ αT over pixels and views, times a power of the volume (LightGaussian, Fan et al. 2024, equations 3 and 4).
    LightGaussian,
    /// Σ (dI/dg)² over pixels and views, where g is the splat's projected value (Speedy-Splat, Hanson et al. 2025).
    Squared,
    /// Σ δ² over pixels and views, in units of each view's squared error, where δ is the change of the render without
    /// the splat.
    Energy,
}

impl Order {
    /// All measures, in the order of tables.
    pub const ALL: [Self; 5] = [Self::Surface, Self::Opacity, Self::LightGaussian, Self::Squared, Self::Energy];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Surface => "surface",
            Self::Opacity => "opacity",
            Self::LightGaussian => "light-gaussian",
            Self::Squared => "squared",
            Self::Energy => "energy",
        }
    }
}

/// Opacity times surface area of each splat, up to a constant factor, m².
pub fn surfaces(splats: &Splats) -> Vec<f64> {
    let area = |i: usize| {
        let [a, b, c] = scales(splats, i);
        opacity(splats, i) * (a * b + b * c + c * a)
    };
    (0..splats.len()).map(area).collect()
}

/// LightGaussian's factor for each splat: its volume as a share of one that nine of ten fall below, at most 1, to the
/// power of 0.1.
fn volume_factors(splats: &Splats) -> Vec<f64> {
    let volumes: Vec<f64> = (0..splats.len()).map(|i| scales(splats, i).iter().product()).collect();
    let mut sorted = volumes.clone();
    sorted.sort_by(f64::total_cmp);
    let large = sorted.get(splats.len() * 9 / 10).map_or(1.0, |volume| volume.max(f64::MIN_POSITIVE));
    volumes.iter().map(|volume| (volume / large).min(1.0).powf(0.1)).collect()
}

fn opacity(splats: &Splats, i: usize) -> f64 {
    1.0 / (1.0 + (-f64::from(splats.col(column::OPACITY)[i])).exp())
}

/// Standard deviations, metres.
fn scales(splats: &Splats, i: usize) -> [f64; 3] {
    [0, 1, 2].map(|k| f64::from(splats.col(column::LOG_SCALE + k)[i]).exp())
}

/// Views on which splats are evaluated, with what rendering them needs.
#[derive(Clone, Copy)]
pub struct EvaluationViews<'a> {
    /// The windows.
    pub views: &'a [TrainView],
    /// Frozen splats that are rendered with the evaluated ones.
    pub context: Option<&'a Splats>,
    /// Compensates opacity for the low-pass filter (anti-aliased mode).
    pub antialiased: bool,
    /// Exposures of the views, applied to renders before they are compared.
    pub exposures: Option<&'a Exposures>,
    /// The photos.
    pub source: &'a dyn WindowSource,
}

/// The comparison of a rendered view with its photo.
struct Comparison<'a> {
    /// The view's number.
    view: u32,
    photo: &'a Pixels,
    /// Three planes, exposed.
    picture: &'a [f32],
    /// Pixel weights; empty where all are 1.
    weights: &'a [f32],
    /// Weighted mean squared error over pixels and channels.
    mse: f64,
    /// Sum of the pixel weights.
    pixels: f64,
    /// Errors over all pixels and over those of the photo's zones, without the weights of zones.
    parts: [Squares; 2],
    /// Factor by which the view's exposure scales the square of a change.
    square_gain: f64,
}

/// Squared errors over pixels and channels.
#[derive(Clone, Copy, Default)]
struct Squares {
    sum: f64,
    /// Sum of the pixels' weights.
    pixels: f64,
}

/// Fixed pixel weights of a set of views, 0 to 255; empty where all are 1. Recomputing them after pruning would give a
/// hole in front of the context no weight and so hide it.
#[derive(Debug, Clone, Default)]
pub struct OwnershipWeights(Vec<Vec<u8>>);

impl<'a> EvaluationViews<'a> {
    /// At most `count` of the views, evenly spaced.
    pub fn some(&self, count: usize) -> Vec<TrainView> {
        self.views.iter().step_by(self.views.len().div_ceil(count.max(1)).max(1)).copied().collect()
    }

    /// The pixel weights of each view: the share of the pixel that these splats explain, as opposed to the context.
    ///
    /// # Errors
    /// A window that cannot be read.
    pub fn ownership_weights(&self, splats: &Splats) -> Result<OwnershipWeights, TrainError> {
        let mut weights = OwnershipWeights::default();
        if self.context.is_some() {
            self.compare(splats, None, |renderer, _| weights.0.push(explained_share(renderer.frame())))?;
        }
        Ok(weights)
    }

    /// PSNR over all pixels and over those of zones, dB, each a mean over the views that have such pixels. Without any zone both are the
    /// same.
    ///
    /// # Errors
    /// A window that cannot be read.
    pub fn psnr(&self, splats: &Splats, weights: &OwnershipWeights) -> Result<[f64; 2], TrainError> {
        let mut sums = [(0.0, 0.0f64); 2];
        self.compare(splats, Some(weights), |_, compared| {
            for ((sum, count), part) in sums.iter_mut().zip(compared.parts) {
                if part.pixels >= 1.0 {
                    *sum += psnr_of(part.sum / (3.0 * part.pixels));
                    *count += 1.0;
                }
            }
        })?;
        let [all, zones] = sums.map(|(sum, count)| sum / count.max(1.0));
        Ok([all, if sums[1].1 > 0.0 { zones } else { all }])
    }

    /// Shows the photo and the render of each view, with its number: three planes, exposed.
    ///
    /// # Errors
    /// A window that cannot be read.
    pub fn pictures(&self, splats: &Splats, mut visit: impl FnMut(u32, &Pixels, &[f32])) -> Result<(), TrainError> {
        self.compare(splats, None, |_, compared| visit(compared.view, compared.photo, compared.picture))
    }

    /// Root of the weighted mean squared error over all views, 0 to 1; `None` where the weights sum to less than 64
    /// pixels.
    ///
    /// # Errors
    /// A window that cannot be read.
    pub fn residual(&self, splats: &Splats, weights: &OwnershipWeights) -> Result<Option<f64>, TrainError> {
        /// Fewer pixels give no meaningful error.
        const MIN_PIXELS: f64 = 64.0;
        let (mut sum, mut pixels) = (0.0, 0.0);
        self.compare(splats, Some(weights), |_, compared| {
            sum += compared.mse * compared.pixels;
            pixels += compared.pixels;
        })?;
        Ok((pixels >= MIN_PIXELS).then(|| (sum / pixels).sqrt()))
    }

    /// The importance of each splat by a measure. Invisible splats have the lowest.
    ///
    /// # Errors
    /// A window that cannot be read.
    pub fn importance(&self, order: Order, splats: &Splats) -> Result<Vec<f64>, TrainError> {
        match order {
            Order::Surface => return Ok(surfaces(splats)),
            Order::Opacity => return Ok((0..splats.len()).map(|i| opacity(splats, i)).collect()),
            _ => {}
        }
        let mut total = vec![0.0; splats.len()];
        self.compare(splats, None, |renderer, compared| {
            let contributions = renderer.contributions(compared.weights);
            let (values, unit) = match order {
                Order::Squared => (&contributions.squared, 1.0),
                Order::LightGaussian => (&contributions.weight, compared.square_gain.max(1e-9)),
                _ => (&contributions.energy, (3.0 * compared.pixels * compared.mse).max(1e-9)),
            };
            let unit = unit / compared.square_gain.max(1e-9);
            total.iter_mut().zip(values).for_each(|(total, value)| *total += f64::from(*value) / unit);
        })?;
        if order == Order::LightGaussian {
            total.iter_mut().zip(volume_factors(splats)).for_each(|(total, factor)| *total *= factor);
        }
        Ok(total)
    }

    /// Renders every view and compares it with its photo. Views whose weights are all zero have no error and no pixels.
    fn compare(
        &self,
        splats: &Splats,
        fixed: Option<&OwnershipWeights>,
        mut visit: impl FnMut(&mut Renderer, Comparison),
    ) -> Result<(), TrainError> {
        let mut renderer = Renderer::default();
        let (mut weights, mut picture) = (Vec::new(), Vec::new());
        let windows = self.views.iter().filter_map(|view| view.at(0).map(|(mip, rect, _)| (view.view, mip, rect)));
        for ((n, view), photo) in self.views.iter().enumerate().zip(source::each(self.source, windows)) {
            let (_, _, camera) = view.at(0).expect("at(0) is always Some");
            let photo = photo.map_err(TrainError::Source)?;
            let extras = self.context.is_some();
            let sh_degree = splats.sh_degree();
            let options = Options {
                antialiased: self.antialiased,
                sh_degree,
                background: [0.0; 3],
                extras,
                ..Options::default()
            };
            let camera_from_part = view.camera_from_context;
            let context = self.context.map(|splats| Part { splats, camera_from_part });
            let frame = renderer.forward(splats, context.as_slice(), &camera, &options);
            pixel_weights(frame, &photo, fixed.and_then(|fixed| fixed.0.get(n)), &mut weights);
            let area = photo.area();
            let weight = |i: usize| if weights.is_empty() { 1.0 } else { f64::from(weights[i % area]) };
            let exposure = self.exposures.and_then(|exposures| exposures.of(view.view));
            match exposure {
                Some(exposure) => expose(exposure, &frame.colour, &mut picture),
                None => picture.clone_from(&frame.colour),
            }
            // Clamped to the range of a display.
            let pairs = picture.iter().map(|colour| colour.clamp(0.0, 1.0)).zip(&photo.rgb);
            let squares = pairs.map(|(colour, photo)| f64::from(colour - f32::from(*photo) / 255.0).powi(2));
            let pixels = if weights.is_empty() { area as f64 } else { weights.iter().map(|w| f64::from(*w)).sum() };
            let (error, parts) = match &photo.weights {
                None => {
                    let sum = squares.enumerate().map(|(i, square)| weight(i) * square).sum();
                    (sum, [Squares { sum, pixels }, Squares::default()])
                }
                Some(of_photo) => by_zones(squares, of_photo, weight),
            };
            let mse = error / (3.0 * pixels).max(1e-9);
            let square_gain = exposure.map_or(1.0, |exposure| f64::from(square_gain(exposure)));
            let (view, photo, picture) = (view.view, &*photo, &picture);
            visit(
                &mut renderer,
                Comparison { view, photo, picture, weights: &weights, mse, pixels, parts, square_gain },
            );
        }
        Ok(())
    }
}

/// The weighted sum of the squares (three planes), and the squares of all pixels and of those in zones without the photo's weights.
fn by_zones(
    squares: impl Iterator<Item = f64>,
    of_photo: &[f32],
    weight: impl Fn(usize) -> f64,
) -> (f64, [Squares; 2]) {
    let (mut error, mut parts) = (0.0, [Squares::default(); 2]);
    for (i, square) in squares.enumerate() {
        let of_photo = f64::from(of_photo[i % of_photo.len()]);
        let own = weight(i) / of_photo;
        error += weight(i) * square;
        for part in &mut parts[..if of_photo > 1.0 { 2 } else { 1 }] {
            part.sum += own * square;
            part.pixels += own / 3.0;
        }
    }
    (error, parts)
}

/// The share of each pixel that the trainable splats explain, 0 to 255.
fn explained_share(frame: &Frame) -> Vec<u8> {
    let share = frame.trainable_alpha.iter().zip(&frame.transmittance).map(|(own, rest)| own / (1.0 - rest).max(1e-4));
    share.map(|share| (share.clamp(0.0, 1.0) * 255.0).round() as u8).collect()
}

/// Pixel weights: the fixed weight, or the explained share of the frame, times the photo's weight; zero under a mask.
fn pixel_weights(frame: &Frame, photo: &Pixels, fixed: Option<&Vec<u8>>, weights: &mut Vec<f32>) {
    weights.clear();
    match fixed {
        Some(fixed) => weights.extend(fixed.iter().map(|share| f32::from(*share) / 255.0)),
        None => weights.extend(explained_share(frame).iter().map(|share| f32::from(*share) / 255.0)),
    }
    if let Some(of_photo) = &photo.weights {
        weights.resize(of_photo.len(), 1.0);
        weights.iter_mut().zip(of_photo).for_each(|(weight, of_photo)| *weight *= of_photo);
    }
    if let Some(mask) = &photo.mask {
        weights.resize(mask.len(), 1.0);
        weights.iter_mut().zip(mask).filter(|(_, mask)| **mask < 128).for_each(|(weight, _)| *weight = 0.0);
    }
}
