//! How far a render is from a photo: PSNR, SSIM and SSIMULACRA2.
//!
//! Images are planes of sRGB values in 0..1: all red, all green, all blue, each `width · height`, rows from the top.
//! Sums are in f64 and in a fixed order, so a figure does not depend on the number of threads.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use ssimulacra2::{ColorPrimaries, Rgb, TransferCharacteristic, compute_frame_ssimulacra2};

/// PSNR of identical images is infinite; reports say this instead, in dB.
pub const PSNR_OF_EQUALS: f64 = 100.0;
/// The shortest image side that SSIMULACRA2 is defined for, pixels.
pub const SSIMULACRA2_SIDE: usize = 8;

const RADIUS: usize = 5;
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Peak signal-to-noise ratio in dB: `-10 log10` of the mean squared error over channels and pixels, at most
/// [`PSNR_OF_EQUALS`]. Where a mask (`width · height`, 255 = use, 0 = leave out) is given, only its pixels count;
/// `None` when none is left.
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
    (count > 0).then(|| (-10.0 * (sum / count as f64).log10()).min(PSNR_OF_EQUALS))
}

/// Colour-corrected PSNR, dB: as [`psnr`], after the affine transform of the render's colours (three by three, and an offset)
/// that comes nearest to the photo in squared error over the pixels that count, clamped to 0..1. It forgives what a view's
/// exposure and white balance do to all of its pixels and nothing else, as papers with appearance models measure it.
/// Where colours do not determine the transform, the smallest serves.
///
/// # Panics
/// As [`psnr`].
pub fn colour_corrected_psnr(render: &[f32], photo: &[f32], mask: Option<&[u8]>) -> Option<f64> {
    assert_eq!(render.len(), photo.len(), "images of one size");
    let area = render.len() / 3;
    assert!(mask.is_none_or(|m| m.len() == area), "a mask of the image's size");
    let pixels = || (0..area).filter(|&i| mask.is_none_or(|m| m[i] >= 128));
    let at = |image: &[f32], i: usize| [0, 1, 2].map(|c| f64::from(image[c * area + i]));
    let (mut count, mut means) = (0.0, [[0.0; 3]; 2]);
    for i in pixels() {
        count += 1.0;
        for (mean, image) in means.iter_mut().zip([render, photo]) {
            mean.iter_mut().zip(at(image, i)).for_each(|(mean, value)| *mean += value);
        }
    }
    let [mean_render, mean_photo] = means.map(|sums| DVec3::from_array(sums) / f64::max(count, 1.0));
    // About the means: photo = transform · render, (Σ r rᵀ) transformᵀ = Σ r pᵀ.
    let (mut rr, mut rp) = (DMat3::ZERO, DMat3::ZERO);
    for i in pixels() {
        let (r, p) = (DVec3::from_array(at(render, i)) - mean_render, DVec3::from_array(at(photo, i)) - mean_photo);
        rr += DMat3::from_cols(r * r.x, r * r.y, r * r.z);
        rp += DMat3::from_cols(r * p.x, r * p.y, r * p.z);
    }
    let least = 1e-9 * (rr.col(0)[0] + rr.col(1)[1] + rr.col(2)[2]) + 1e-9;
    let transform = ((rr + DMat3::from_diagonal(DVec3::splat(least))).inverse() * rp).transpose();
    let mut corrected = render.to_vec();
    for i in pixels() {
        let shown = mean_photo + transform * (DVec3::from_array(at(render, i)) - mean_render);
        (0..3).for_each(|c| corrected[c * area + i] = shown[c].clamp(0.0, 1.0) as f32);
    }
    psnr(&corrected, photo, mask)
}

/// Structural similarity (Wang et al. 2004): 11×11 Gaussian window with σ = 1.5, K1 = 0.01, K2 = 0.03, range 1, the mean
/// over all pixels and channels. At borders the window reaches into zeros and keeps its weights, as the padded
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

/// SSIMULACRA2 of a render against its photo: a perceptual measure that needs no download. 100 is identical, 90 hard to
/// tell apart, 70 high, 50 medium, 30 low quality, below 0 very bad. `None` where a side is under [`SSIMULACRA2_SIDE`].
/// Source: Sneyers, "SSIMULACRA 2" (Cloudinary, 2023), as ported by the rust-av project.
///
/// # Panics
/// If a length is not `3 · width · height`.
pub fn ssimulacra2(photo: &[f32], render: &[f32], width: usize, height: usize) -> Option<f64> {
    let area = width * height;
    assert!(photo.len() == 3 * area && render.len() == 3 * area, "three planes each");
    if width.min(height) < SSIMULACRA2_SIDE {
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
        assert_eq!(psnr(&a, &a, None), Some(PSNR_OF_EQUALS));
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

    #[test]
    fn correction_forgives_a_views_exposure_and_nothing_else() {
        let render = picture(40, 30, 0.0);
        let area = 40 * 30;
        let exposed = |i: usize| {
            let [r, g, b] = [0, 1, 2].map(|c| render[c * area + i % area]);
            [0.7 * r + 0.1 * g, 0.9 * g - 0.05 * b + 0.1, 0.2 * r + 0.6 * b][i / area]
        };
        let mut photo: Vec<f32> = (0..3 * area).map(exposed).collect();
        assert!(psnr(&render, &photo, None).unwrap() < 20.0);
        assert!(colour_corrected_psnr(&render, &photo, None).unwrap() > 80.0);
        // What the mask hides has no say in the transform.
        let mask: Vec<u8> = (0..area).map(|i| if i % 40 < 35 { 255 } else { 0 }).collect();
        (0..3 * area).filter(|i| i % 40 >= 35).for_each(|i| photo[i] = 1.0);
        assert!(colour_corrected_psnr(&render, &photo, Some(&mask)).unwrap() > 80.0);
        assert!(colour_corrected_psnr(&render, &photo, None).unwrap() < 30.0);
        assert_eq!(colour_corrected_psnr(&render, &photo, Some(&vec![0; area])), None);
        // An error that no transform of colours explains stays, and no view gets worse.
        let noisy: Vec<f32> = (render.iter().enumerate())
            .map(|(i, v)| v + 0.1 * (((i * 2_654_435_761) % 1009) as f32 / 504.5 - 1.0))
            .collect();
        let (plain, corrected) =
            (psnr(&render, &noisy, None).unwrap(), colour_corrected_psnr(&render, &noisy, None).unwrap());
        assert!(corrected >= plain && corrected < plain + 0.3, "{plain} {corrected}");
        // One colour only: its nearest is the photo's mean.
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
    fn ssim_is_its_definition() {
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
    fn ssimulacra2_orders_damage() {
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
