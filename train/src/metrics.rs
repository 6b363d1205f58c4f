//! Image metrics of a render against a photo: PSNR, colour-corrected PSNR, SSIM and SSIMULACRA2.
//!
//! Images are planes of sRGB values in 0..1: all red, all green, all blue, each `width · height`, rows from the top.
//! Sums are in f64 and in a fixed order, so results do not depend on the number of threads.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use ssimulacra2::{ColorPrimaries, Rgb, TransferCharacteristic, compute_frame_ssimulacra2};

/// Upper bound of reported PSNR, dB: that of identical images is infinite.
pub const MAX_PSNR_DB: f64 = 100.0;
/// Smallest image side for which SSIMULACRA2 is defined, pixels.
pub const SSIMULACRA2_MIN_SIDE: usize = 8;

const RADIUS: usize = 5;
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Peak signal-to-noise ratio in dB: `-10 log10` of the mean squared error over channels and pixels, at most
/// [`MAX_PSNR_DB`]. With a mask (`width · height`, 255 = use, 0 = leave out) only its pixels
/// count; `None` if none is left.
///
/// # Panics
/// If the images differ in length or the mask is not a third of it.
pub fn psnr(a: &[f32], b: &[f32], mask: Option<&[u8]>) -> Option<f64> {
    assert_eq!(a.len(), b.len(), "images of one size");
    let area = a.len() / 3;
    assert!(mask.is_none_or(|m| m.len() == area), "a mask of the image's size");
    let used = |i: usize| mask.is_none_or(|m| m[i % area] >= 128);
    let (mut sum, mut count) = (0.0, 0u64);
    for (i, (&a, &b)) in a.iter().zip(b).enumerate() {
        if used(i) {
            sum += (f64::from(a) - f64::from(b)).powi(2);
            count += 1;
        }
    }
    (count > 0).then(|| psnr_of(sum / count as f64))
}

/// PSNR of a mean squared error, dB, at most [`MAX_PSNR_DB`]. An error that is not a number counts as 1: 0 dB.
pub fn psnr_of(mse: f64) -> f64 {
    let mse = if mse.is_nan() { 1.0 } else { mse };
    (-10.0 * mse.log10()).min(MAX_PSNR_DB)
}

/// Colour-corrected PSNR in dB: [`psnr`] after the affine colour transform of the render (3×3 matrix and offset) that
/// minimises the squared error to the photo over the pixels that the mask leaves. The corrected render is clamped to
/// 0..1. This removes one exposure and white balance per view and nothing else, as papers with appearance models report
/// it.
///
/// The fit starts from the identity: colour directions in which the render does not vary (grey or single-colour images,
/// a few pixels) keep it. The clamped render without a fit is taken where it is nearer to the photo, so for photos in
/// 0..1 the result is never below [`psnr`] of the same pixels, clamped or not.
///
/// # Panics
/// As [`psnr`].
pub fn colour_corrected_psnr(render: &[f32], photo: &[f32], mask: Option<&[u8]>) -> Option<f64> {
    assert_eq!(render.len(), photo.len(), "images of one size");
    let area = render.len() / 3;
    assert!(mask.is_none_or(|m| m.len() == area), "a mask of the image's size");
    let pixels = || (0..area).filter(|&i| mask.is_none_or(|m| m[i] >= 128));
    let clamped: Vec<f32> = render.iter().map(|value| value.clamp(0.0, 1.0)).collect();
    let mut corrected = clamped.clone();
    ColourFit::of(render, photo, pixels()).correct(render, pixels(), &mut corrected);
    Some(psnr(&corrected, photo, mask)?.max(psnr(&clamped, photo, mask)?))
}

/// PSNR in dB of the right half of an image after the affine colour transform that brings the render's left half
/// closest to the photo's, clamped to 0..1. Nothing of the measured half enters the fit, so unlike
/// [`colour_corrected_psnr`] it may be below [`psnr`]. NeRF-W (Martin-Brualla et al. 2021) introduced the division, and
/// others with appearance models report it. `None` where the mask leaves no pixel of either half.
///
/// # Panics
/// If the images differ in length, or their pixels are no multiple of the width, or the mask is not a third of them.
pub fn half_fitted_psnr(render: &[f32], photo: &[f32], width: usize, mask: Option<&[u8]>) -> Option<f64> {
    assert_eq!(render.len(), photo.len(), "images of one size");
    let area = render.len() / 3;
    assert!(width > 0 && area.is_multiple_of(width), "rows of one width");
    assert!(mask.is_none_or(|m| m.len() == area), "a mask of the image's size");
    let is_left = |i: &usize| i % width < width / 2;
    let pixels = || (0..area).filter(|&i| mask.is_none_or(|m| m[i] >= 128));
    pixels().find(is_left)?;
    let mut corrected = render.to_vec();
    let fit = ColourFit::of(render, photo, pixels().filter(is_left));
    fit.correct(render, pixels().filter(|i| !is_left(i)), &mut corrected);
    let measured: Vec<u8> = (0..area).map(|i| if is_left(&i) { 0 } else { mask.map_or(255, |mask| mask[i]) }).collect();
    psnr(&corrected, photo, Some(&measured))
}

/// The affine colour transform of a render that minimises the squared error to a photo over some pixels.
struct ColourFit {
    mean_render: DVec3,
    mean_photo: DVec3,
    transform: DMat3,
}

impl ColourFit {
    /// Fits the transform to these pixels.
    fn of(render: &[f32], photo: &[f32], pixels: impl Iterator<Item = usize> + Clone) -> Self {
        let (mut count, mut sums) = (0.0, [DVec3::ZERO; 2]);
        for i in pixels.clone() {
            count += 1.0;
            sums = [sums[0] + colour_at(render, i), sums[1] + colour_at(photo, i)];
        }
        let [mean_render, mean_photo] = sums.map(|sum| sum / f64::max(count, 1.0));
        // Least squares about the means: transform = 1 + change, with (Σ r rᵀ) changeᵀ = Σ r (p - r)ᵀ.
        let (mut rr, mut rd) = (DMat3::ZERO, DMat3::ZERO);
        for i in pixels {
            let r = colour_at(render, i) - mean_render;
            let d = colour_at(photo, i) - mean_photo - r;
            rr += DMat3::from_cols(r * r.x, r * r.y, r * r.z);
            rd += DMat3::from_cols(r * d.x, r * d.y, r * d.z);
        }
        let transform = DMat3::IDENTITY + (pseudo_inverse(rr) * rd).transpose();
        Self { mean_render, mean_photo, transform }
    }

    /// Writes these pixels of the render, transformed and clamped to 0..1, to `out`.
    fn correct(&self, render: &[f32], pixels: impl Iterator<Item = usize>, out: &mut [f32]) {
        let area = render.len() / 3;
        for i in pixels {
            let colour = self.mean_photo + self.transform * (colour_at(render, i) - self.mean_render);
            (0..3).for_each(|c| out[c * area + i] = colour[c].clamp(0.0, 1.0) as f32);
        }
    }
}

/// The colour of a pixel of an image of three planes.
fn colour_at(image: &[f32], i: usize) -> DVec3 {
    let area = image.len() / 3;
    DVec3::from_array([0, 1, 2].map(|c| f64::from(image[c * area + i])))
}

/// Eigenvalues of a colour covariance below this share of its trace count as zero. Rounding to f32 leaves about 1e-14
/// in a direction without variation.
const MIN_EIGENVALUE_SHARE: f64 = 1e-10;

/// Moore-Penrose inverse of a symmetric positive semidefinite matrix.
fn pseudo_inverse(matrix: DMat3) -> DMat3 {
    let (values, vectors) = symmetric_eigen(matrix);
    let least = MIN_EIGENVALUE_SHARE * (values[0] + values[1] + values[2]);
    let mut inverse = DMat3::ZERO;
    for (value, v) in values.into_iter().zip([vectors.x_axis, vectors.y_axis, vectors.z_axis]) {
        if value > least {
            inverse += DMat3::from_cols(v * v.x, v * v.y, v * v.z) * (1.0 / value);
        }
    }
    inverse
}

/// Eigenvalues and eigenvectors (columns) of a symmetric matrix by cyclic Jacobi rotations (Golub and Van Loan, 8.5).
fn symmetric_eigen(matrix: DMat3) -> ([f64; 3], DMat3) {
    /// Convergence is quadratic: a 3×3 matrix takes at most about six sweeps.
    const SWEEPS: usize = 12;
    let (mut diagonal, mut vectors) = (matrix, DMat3::IDENTITY);
    for (p, q) in [(0, 1), (0, 2), (1, 2)].repeat(SWEEPS) {
        let off = diagonal.col(q)[p];
        if off == 0.0 {
            continue;
        }
        let theta = (diagonal.col(q)[q] - diagonal.col(p)[p]) / (2.0 * off);
        let tan = theta.signum() / (theta.abs() + theta.hypot(1.0));
        let cos = 1.0 / tan.hypot(1.0);
        let mut rotation = DMat3::IDENTITY;
        (rotation.col_mut(p)[p], rotation.col_mut(q)[q]) = (cos, cos);
        (rotation.col_mut(q)[p], rotation.col_mut(p)[q]) = (tan * cos, -tan * cos);
        diagonal = rotation.transpose() * diagonal * rotation;
        (diagonal.col_mut(q)[p], diagonal.col_mut(p)[q]) = (0.0, 0.0);
        vectors *= rotation;
    }
    ([0, 1, 2].map(|k| diagonal.col(k)[k]), vectors)
}

/// Structural similarity (Wang et al. 2004): 11×11 Gaussian window with σ = 1.5, K1 = 0.01, K2 = 0.03, range 1, the
/// mean over all pixels and channels. At borders the window reaches into zeros and keeps its weights, as the padded
/// convolution of the 3DGS code does; figures of papers that train with that code are comparable.
///
/// # Panics
/// If a length is not `3 · width · height`, or that is zero.
pub fn ssim(a: &[f32], b: &[f32], width: usize, height: usize) -> f64 {
    let area = width * height;
    assert!(area > 0 && a.len() == 3 * area && b.len() == 3 * area, "three planes each");
    let planes: Vec<(&[f32], &[f32])> = a.chunks_exact(area).zip(b.chunks_exact(area)).collect();
    let sums: Vec<f64> = planes.par_iter().map(|(a, b)| ssim_sum(a, b, width, height)).collect();
    sums.iter().sum::<f64>() / (3 * area) as f64
}

fn ssim_sum(a: &[f32], b: &[f32], width: usize, height: usize) -> f64 {
    let pixels = || a.iter().zip(b).map(|(&a, &b)| (f64::from(a), f64::from(b)));
    let blurred = |moment: fn((f64, f64)) -> f64| blur(&pixels().map(moment).collect::<Vec<_>>(), width, height);
    let (mean_a, mean_b) = (blurred(|(a, _)| a), blurred(|(_, b)| b));
    let (square_a, square_b, product) = (blurred(|(a, _)| a * a), blurred(|(_, b)| b * b), blurred(|(a, b)| a * b));
    (0..width * height)
        .map(|i| {
            let (ma, mb) = (mean_a[i], mean_b[i]);
            let (va, vb, cov) = (square_a[i] - ma * ma, square_b[i] - mb * mb, product[i] - ma * mb);
            (2.0 * ma * mb + C1) * (2.0 * cov + C2) / ((ma * ma + mb * mb + C1) * (va + vb + C2))
        })
        .sum()
}

/// The window's weights along one axis; they sum to 1.
fn window() -> [f64; 2 * RADIUS + 1] {
    let mut weights = std::array::from_fn(|i| (-(i as f64 - RADIUS as f64).powi(2) / (2.0 * SIGMA * SIGMA)).exp());
    let sum: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= sum);
    weights
}

/// Convolves a plane with the window, rows then columns, zeros outside.
fn blur(plane: &[f64], width: usize, height: usize) -> Vec<f64> {
    let weights = window();
    let mut across = vec![0.0; plane.len()];
    let mut padded = vec![0.0; width + 2 * RADIUS];
    for (row, out) in plane.chunks_exact(width).zip(across.chunks_exact_mut(width)) {
        padded[RADIUS..RADIUS + width].copy_from_slice(row);
        for (x, out) in out.iter_mut().enumerate() {
            *out = weights.iter().zip(&padded[x..]).map(|(w, v)| w * v).sum();
        }
    }
    let mut both = vec![0.0; plane.len()];
    for (y, out) in both.chunks_exact_mut(width).enumerate() {
        for (k, weight) in weights.iter().enumerate() {
            let from = (y + k).wrapping_sub(RADIUS);
            if from < height {
                let row = &across[from * width..(from + 1) * width];
                out.iter_mut().zip(row).for_each(|(out, v)| *out += weight * v);
            }
        }
    }
    both
}

/// SSIMULACRA2 of a render against its photo: a perceptual metric without a neural network. 100 is identical, 90 hard
/// to tell apart, 70 high, 50 medium, 30 low quality, below 0 very bad. `None` where a side is under
/// [`SSIMULACRA2_MIN_SIDE`]. Source: Sneyers, "SSIMULACRA 2" (Cloudinary, 2023), as ported by the rust-av project.
///
/// # Panics
/// If a length is not `3 · width · height`.
pub fn ssimulacra2(photo: &[f32], render: &[f32], width: usize, height: usize) -> Option<f64> {
    let area = width * height;
    assert!(photo.len() == 3 * area && render.len() == 3 * area, "three planes each");
    if width.min(height) < SSIMULACRA2_MIN_SIDE {
        return None;
    }
    let image = |planes: &[f32]| {
        let value = |i: usize| if planes[i].is_finite() { planes[i].clamp(0.0, 1.0) } else { 0.0 };
        let pixels = (0..area).map(|i| [value(i), value(area + i), value(2 * area + i)]).collect();
        Rgb::new(pixels, width, height, TransferCharacteristic::SRGB, ColorPrimaries::BT709).ok()
    };
    compute_frame_ssimulacra2(image(photo)?, image(render)?).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Smooth waves with a little grain, different per channel.
    fn picture(width: usize, height: usize, phase: f32) -> Vec<f32> {
        let value = |c: usize, x: usize, y: usize| {
            let wave = (0.31 * x as f32 + 0.17 * y as f32 + phase + c as f32).sin();
            let grain = ((x * 7919 + y * 104_729 + c * 31) % 97) as f32 / 97.0 - 0.5;
            (0.5 + 0.3 * wave + 0.1 * grain).clamp(0.0, 1.0)
        };
        let rows = (0..3).flat_map(|c| (0..height).map(move |y| (c, y)));
        rows.flat_map(|(c, y)| (0..width).map(move |x| (c, x, y))).map(|(c, x, y)| value(c, x, y)).collect()
    }

    #[test]
    fn psnr_of_an_offset_is_its_square_in_decibels() {
        let a = picture(20, 10, 0.0);
        let b: Vec<f32> = a.iter().map(|v| v + 0.1).collect();
        assert!((psnr(&a, &b, None).unwrap() - 20.0).abs() < 1e-4);
        assert_eq!(psnr(&a, &a, None), Some(MAX_PSNR_DB));
        assert_eq!(psnr(&vec![f32::NAN; a.len()], &a, None), Some(0.0), "a render of NaN is no perfect one");
    }

    #[test]
    fn psnr_counts_only_masked_in_pixels() {
        let a = vec![0.5; 3 * 4];
        let mut b = a.clone();
        for c in 0..3 {
            b[4 * c] = 0.9;
            b[4 * c + 1] = 0.6;
        }
        let masked = psnr(&a, &b, Some(&[0, 255, 0, 0])).unwrap();
        assert!((masked - 20.0).abs() < 1e-5, "{masked}");
        assert_eq!(psnr(&a, &b, Some(&[0; 4])), None);
    }

    /// Uniform noise in `±amplitude`.
    fn noise(i: usize, amplitude: f32) -> f32 {
        amplitude * (2.0 * crate::random::uniform(13, i as u64) - 1.0)
    }

    /// The same plane three times.
    fn grey(plane: impl Iterator<Item = f32>) -> Vec<f32> {
        plane.collect::<Vec<_>>().repeat(3)
    }

    #[test]
    fn colour_correction_of_grey_images_is_never_below_psnr() {
        let area = 40 * 30;
        let photo = grey(picture(40, 30, 0.0).into_iter().take(area));
        let render: Vec<f32> = photo.iter().enumerate().map(|(i, v)| v + noise(i, 0.08)).collect();
        let grey_noise = grey((0..area).map(|i| photo[i] + noise(i, 0.08)));
        for render in [render, grey_noise] {
            let plain = psnr(&render, &photo, None).unwrap();
            let corrected = colour_corrected_psnr(&render, &photo, None).unwrap();
            assert!((25.0..28.0).contains(&plain), "{plain}");
            // The fit may average the noise of the three channels, which gains 10 log10(3) = 4.8 dB.
            assert!(corrected >= plain && corrected < plain + 5.5, "{plain} {corrected}");
        }
    }

    #[test]
    fn colour_correction_recovers_gain_and_offset_of_grey_renders() {
        let photo = grey(picture(40, 30, 0.0).into_iter().take(40 * 30));
        for (gain, offset) in [(1.0, 0.0), (0.7, 0.1), (1.3, -0.2), (0.02, 0.4)] {
            let render: Vec<f32> = photo.iter().map(|v| gain * v + offset).collect();
            let corrected = colour_corrected_psnr(&render, &photo, None).unwrap();
            assert!(corrected > 80.0, "{gain} {offset}: {corrected}");
        }
    }

    #[test]
    fn colour_correction_of_a_single_colour_photo_is_exact() {
        let area = 40 * 30;
        let photo = [[0.2; 1200], [0.5; 1200], [0.9; 1200]].concat();
        let renders = [picture(40, 30, 0.0), grey(picture(40, 30, 0.0).into_iter().take(area)), vec![0.4; 3 * area]];
        for render in renders {
            let corrected = colour_corrected_psnr(&render, &photo, None).unwrap();
            assert!(corrected > 80.0, "{corrected}");
        }
    }

    #[test]
    fn colour_correction_of_two_pixels_is_exact_or_the_mean() {
        let area = 40 * 30;
        let (render, photo) = (picture(40, 30, 0.0), picture(40, 30, 0.9));
        for (a, b) in [(0, 1), (17, 900), (600, 1199)] {
            let mut mask = vec![0; area];
            (mask[a], mask[b]) = (255, 255);
            // Two different colours determine an affine map.
            let corrected = colour_corrected_psnr(&render, &photo, Some(&mask)).unwrap();
            assert!(corrected > 80.0, "{a} {b}: {corrected}");
            // Two equal ones only an offset.
            let flat = vec![0.5; 3 * area];
            let [plain, corrected] =
                [psnr, colour_corrected_psnr].map(|measure| measure(&flat, &photo, Some(&mask)).unwrap());
            assert!(corrected.is_finite() && corrected >= plain, "{a} {b}: {plain} {corrected}");
        }
    }

    #[test]
    fn the_exposure_of_one_half_is_measured_on_the_other() {
        let photo = picture(40, 30, 0.0);
        let dimmed: Vec<f32> = photo.iter().map(|v| 0.6 * v + 0.1).collect();
        let fitted = half_fitted_psnr(&dimmed, &photo, 40, None).unwrap();
        assert!(fitted > 80.0, "{fitted}");
        // Another exposure on the right is not corrected, however well the left fits.
        let mut uneven = dimmed.clone();
        uneven.iter_mut().enumerate().filter(|(i, _)| i % 40 >= 20).for_each(|(_, v)| *v = (*v - 0.1) / 0.6 * 0.8);
        assert!(half_fitted_psnr(&uneven, &photo, 40, None).unwrap() < 25.0);
        assert!(colour_corrected_psnr(&uneven, &photo, None).unwrap() > 20.0);
        // What the mask hides counts in neither half.
        let mut mask = vec![255; 40 * 30];
        for i in (0..40 * 30).filter(|i| i % 7 == 0) {
            mask[i] = 0;
            (0..3).for_each(|c| uneven[1200 * c + i] = 5.0);
        }
        let mut hidden = dimmed;
        (0..1200).filter(|i| mask[*i] == 0).for_each(|i| (0..3).for_each(|c| hidden[1200 * c + i] = 5.0));
        assert!(half_fitted_psnr(&hidden, &photo, 40, Some(&mask)).unwrap() > 80.0);
        for empty in [|i: usize| i % 40 < 20, |i: usize| i % 40 >= 20] {
            let mask: Vec<u8> = (0..1200).map(|i| if empty(i) { 0 } else { 255 }).collect();
            assert_eq!(half_fitted_psnr(&photo, &photo, 40, Some(&mask)), None);
        }
    }

    #[test]
    fn colour_correction_is_never_below_psnr_of_the_clamped_render() {
        let photo = picture(40, 30, 0.0);
        // Far out of range where the photo is brightest: a fit of unclamped values would dim all others.
        let glare = |v: &f32| if *v > 0.85 { 9.0 } else { *v };
        let render: Vec<f32> = photo.iter().map(glare).collect();
        let clamped: Vec<f32> = render.iter().map(|v| v.clamp(0.0, 1.0)).collect();
        let corrected = colour_corrected_psnr(&render, &photo, None).unwrap();
        assert!(corrected >= psnr(&clamped, &photo, None).unwrap(), "{corrected}");
        // Masked pixels may be NaN.
        let mut mask = vec![255; 40 * 30];
        mask[7] = 0;
        let mut broken = picture(40, 30, 0.0);
        broken[7] = f32::NAN;
        assert!(colour_corrected_psnr(&broken, &photo, Some(&mask)).unwrap() > 80.0);
    }

    /// The same fit by normal equations with an explicit inverse, which is accurate for well-conditioned colours only.
    fn psnr_by_normal_equations(render: &[f32], photo: &[f32]) -> f64 {
        let area = render.len() / 3;
        let at = |image: &[f32], i: usize| DVec3::from_array([0, 1, 2].map(|c| f64::from(image[c * area + i])));
        let mean = |image: &[f32]| (0..area).map(|i| at(image, i)).sum::<DVec3>() / area as f64;
        let (mean_render, mean_photo) = (mean(render), mean(photo));
        let (mut rr, mut rp) = (DMat3::ZERO, DMat3::ZERO);
        for i in 0..area {
            let (r, p) = (at(render, i) - mean_render, at(photo, i) - mean_photo);
            rr += DMat3::from_cols(r * r.x, r * r.y, r * r.z);
            rp += DMat3::from_cols(r * p.x, r * p.y, r * p.z);
        }
        let ridge = 1e-9 * (rr.col(0)[0] + rr.col(1)[1] + rr.col(2)[2]) + 1e-9;
        let transform = ((rr + DMat3::from_diagonal(DVec3::splat(ridge))).inverse() * rp).transpose();
        let mut corrected = render.to_vec();
        for i in 0..area {
            let colour = mean_photo + transform * (at(render, i) - mean_render);
            (0..3).for_each(|c| corrected[c * area + i] = colour[c].clamp(0.0, 1.0) as f32);
        }
        psnr(&corrected, photo, None).unwrap()
    }

    #[test]
    fn colour_correction_agrees_with_normal_equations_on_well_conditioned_colours() {
        let photo = picture(40, 30, 0.0);
        for (phase, amplitude, gain) in [(0.0, 0.02, 1.0), (0.0, 0.1, 0.7), (0.3, 0.05, 1.2), (0.9, 0.0, 1.0)] {
            let shifted = picture(40, 30, phase);
            let render: Vec<f32> =
                shifted.iter().enumerate().map(|(i, v)| gain * v + 0.05 + noise(i, amplitude)).collect();
            let (found, expected) =
                (colour_corrected_psnr(&render, &photo, None).unwrap(), psnr_by_normal_equations(&render, &photo));
            assert!((found - expected).abs() < 1e-6, "{phase} {amplitude} {gain}: {found} against {expected}");
        }
    }

    #[test]
    fn the_pseudo_inverse_inverts_the_range() {
        let rank_three = DMat3::from_cols_array(&[4.0, 1.0, 0.5, 1.0, 3.0, -0.2, 0.5, -0.2, 2.0]);
        let difference = pseudo_inverse(rank_three) - rank_three.inverse();
        assert!(difference.to_cols_array().iter().all(|v| v.abs() < 1e-14), "{difference}");
        let (a, b) = (DVec3::new(1.0, 1.0, 1.0), DVec3::new(0.3, -0.2, 0.9));
        let outer = |v: DVec3| DMat3::from_cols(v * v.x, v * v.y, v * v.z);
        for deficient in [DMat3::ZERO, outer(a), outer(a) * 1e6, outer(a) + outer(b)] {
            let inverse = pseudo_inverse(deficient);
            let again = deficient * inverse * deficient - deficient;
            assert!(again.to_cols_array().iter().all(|v| v.abs() < 1e-8), "{deficient}: {again}");
            assert!(inverse.to_cols_array().iter().all(|v| v.abs() < 1e2), "{inverse}");
        }
    }

    #[test]
    fn colour_correction_removes_exposure_and_nothing_else() {
        let render = picture(40, 30, 0.0);
        let area = 40 * 30;
        let exposed = |i: usize| {
            let [r, g, b] = [0, 1, 2].map(|c| render[c * area + i % area]);
            [0.7 * r + 0.1 * g, 0.9 * g - 0.05 * b + 0.1, 0.2 * r + 0.6 * b][i / area]
        };
        let mut photo: Vec<f32> = (0..3 * area).map(exposed).collect();
        assert!(psnr(&render, &photo, None).unwrap() < 20.0);
        assert!(colour_corrected_psnr(&render, &photo, None).unwrap() > 80.0);
        // Masked pixels do not affect the fit.
        let mask: Vec<u8> = (0..area).map(|i| if i % 40 < 35 { 255 } else { 0 }).collect();
        (0..3 * area).filter(|i| i % 40 >= 35).for_each(|i| photo[i] = 1.0);
        assert!(colour_corrected_psnr(&render, &photo, Some(&mask)).unwrap() > 80.0);
        assert!(colour_corrected_psnr(&render, &photo, None).unwrap() < 30.0);
        assert_eq!(colour_corrected_psnr(&render, &photo, Some(&vec![0; area])), None);
        // Noise cannot be corrected, and the fit makes no view worse.
        let noisy: Vec<f32> = (render.iter().enumerate())
            .map(|(i, v)| v + 0.1 * (((i * 2_654_435_761) % 1009) as f32 / 504.5 - 1.0))
            .collect();
        let (plain, corrected) =
            (psnr(&render, &noisy, None).unwrap(), colour_corrected_psnr(&render, &noisy, None).unwrap());
        assert!(corrected >= plain && corrected < plain + 0.3, "{plain} {corrected}");
        // A single colour is mapped to the photo's mean.
        let grey = colour_corrected_psnr(&vec![0.2; 3 * area], &vec![0.7; 3 * area], None).unwrap();
        assert!(grey > 80.0, "{grey}");
    }

    /// The definition, pixel by pixel, with a two-dimensional window: O(n · 121).
    fn ssim_by_definition(a: &[f32], b: &[f32], width: usize, height: usize) -> f64 {
        let area = width * height;
        let mut total = 0.0;
        let norm: f64 = (-5..=5).flat_map(|j| (-5..=5).map(move |i| (i, j))).map(|(i, j)| weight(i, j)).sum();
        fn weight(i: i32, j: i32) -> f64 {
            (-f64::from(i * i + j * j) / (2.0 * 1.5 * 1.5)).exp()
        }
        for c in 0..3 {
            for y in 0..height as i32 {
                for x in 0..width as i32 {
                    let mut m = [0.0; 5];
                    for j in -5..=5 {
                        for i in -5..=5 {
                            let (u, v) = (x + i, y + j);
                            if u < 0 || v < 0 || u >= width as i32 || v >= height as i32 {
                                continue;
                            }
                            let at = c * area + v as usize * width + u as usize;
                            let (p, q, w) = (f64::from(a[at]), f64::from(b[at]), weight(i, j) / norm);
                            for (m, value) in m.iter_mut().zip([p, q, p * p, q * q, p * q]) {
                                *m += w * value;
                            }
                        }
                    }
                    let [ma, mb, aa, bb, ab] = m;
                    let (va, vb, cov) = (aa - ma * ma, bb - mb * mb, ab - ma * mb);
                    total +=
                        (2.0 * ma * mb + 1e-4) * (2.0 * cov + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4));
                }
            }
        }
        total / (3 * area) as f64
    }

    #[test]
    fn ssim_agrees_with_its_definition() {
        for (width, height) in [(1, 1), (3, 17), (24, 13)] {
            let (a, b) = (picture(width, height, 0.0), picture(width, height, 0.7));
            let (fast, slow) = (ssim(&a, &b, width, height), ssim_by_definition(&a, &b, width, height));
            assert!((fast - slow).abs() < 1e-12, "{width}×{height}: {fast} against {slow}");
            assert!((ssim(&a, &a, width, height) - 1.0).abs() < 1e-12);
            assert!(fast < 0.999);
        }
    }

    #[test]
    fn ssim_of_one_pixel_by_hand() {
        // One pixel a against b: the window's centre weight is w = g0², moments are w·a and so on.
        let (a, b, w) = (0.8f64, 0.4f64, window()[RADIUS].powi(2));
        let (ma, mb) = (w * a, w * b);
        let (va, vb, cov) = (w * a * a - ma * ma, w * b * b - mb * mb, w * a * b - ma * mb);
        let hand = (2.0 * ma * mb + 1e-4) * (2.0 * cov + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4));
        assert!((ssim(&[0.8; 3], &[0.4; 3], 1, 1) - hand).abs() < 1e-7);
        assert!((w - 0.0707).abs() < 1e-3, "g0 = 0.26601 for σ = 1.5, g0² = 0.0708: {w}");
    }

    #[test]
    fn ssimulacra2_falls_with_noise() {
        let (width, height) = (64, 48);
        let photo = picture(width, height, 0.0);
        let damaged = |by: f32| -> Vec<f32> {
            let noise = |i: usize| by * (((i * 2_654_435_761) % 1009) as f32 / 504.5 - 1.0);
            photo.iter().enumerate().map(|(i, v)| v + noise(i)).collect()
        };
        let score = |render: &[f32]| ssimulacra2(&photo, render, width, height).unwrap();
        let (same, little, much) = (score(&photo), score(&damaged(0.02)), score(&damaged(0.2)));
        assert!((same - 100.0).abs() < 1e-6, "{same}");
        assert!(same > little && little > much, "{same} {little} {much}");
        let hostile = vec![f32::NAN; photo.len()];
        assert!(score(&hostile).is_finite());
    }

    #[test]
    fn ssimulacra2_needs_eight_pixels_a_side() {
        let (small, tiny) = (picture(8, 8, 0.0), picture(7, 8, 0.0));
        assert!(ssimulacra2(&small, &small, 8, 8).is_some());
        assert_eq!(ssimulacra2(&tiny, &tiny, 7, 8), None);
    }
}
