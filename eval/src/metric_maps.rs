//! Per-pixel maps of SSIM and ꟻLIP, for measuring parts of a picture.
//!
//! The mean of the SSIM map is [`train::metrics::ssim`]. ꟻLIP estimates how visible a difference is (Andersson et al., "ꟻLIP: A
//! Difference Evaluator for Alternating Images", HPG 2020), here for displays of ordinary range at the paper's viewing
//! conditions. Images are three planes of sRGB values in 0..1.

use std::f64::consts::PI;

/// Pixels per degree of visual angle, 0.7 m from a display of 3840 pixels on 0.7 m.
const PIXELS_PER_DEGREE: f64 = 0.7 * 3840.0 / 0.7 * PI / 180.0;
/// Contrast sensitivity of each opponent channel as a sum of Gaussians: weight and width (table 1).
const SENSITIVITY: [&[(f64, f64)]; 3] = [&[(1.0, 0.0047)], &[(1.0, 0.0053)], &[(34.1, 0.04), (13.5, 0.025)]];
/// Exponents of colour and feature differences.
const COLOUR_POWER: f64 = 0.7;
const FEATURE_POWER: f64 = 0.5;
/// Colour differences below the first share of the largest difference are mapped to the second share of the scale.
const KNEE: (f64, f64) = (0.4, 0.95);
/// Width of the feature detectors, degrees.
const FEATURE_DEGREES: f64 = 0.082;
/// Linear RGB with sRGB primaries to XYZ, as in the authors' code.
const XYZ_FROM_RGB: [[f64; 3]; 3] = [
    [10_135_552.0 / 24_577_794.0, 8_788_810.0 / 24_577_794.0, 4_435_075.0 / 24_577_794.0],
    [2_613_072.0 / 12_288_897.0, 8_788_810.0 / 12_288_897.0, 887_015.0 / 12_288_897.0],
    [1_425_312.0 / 73_733_382.0, 8_788_810.0 / 73_733_382.0, 70_074_185.0 / 73_733_382.0],
];
const RGB_FROM_XYZ: [[f64; 3]; 3] = [
    [3.241_003_275, -1.537_398_934, -0.498_615_861],
    [-0.969_224_334, 1.875_930_071, 0.041_554_224],
    [0.055_639_423, -0.204_011_202, 1.057_148_933],
];

/// SSIM of each pixel, the mean of its channels.
///
/// # Panics
/// If a length is not `3 · width · height`.
pub(crate) fn ssim(a: &[f32], b: &[f32], width: usize, height: usize) -> Vec<f64> {
    const C1: f64 = 0.01 * 0.01;
    const C2: f64 = 0.03 * 0.03;
    let area = width * height;
    assert!(a.len() == 3 * area && b.len() == 3 * area, "three planes each");
    let weights = normalised(&taps(5, |x| (-x * x / (2.0 * 1.5 * 1.5)).exp()), Sum::All);
    let mut map = vec![0.0; area];
    for channel in 0..3 {
        let plane = |image: &[f32]| Vec::from_iter(image[channel * area..][..area].iter().map(|&v| f64::from(v)));
        let (a, b) = (plane(a), plane(b));
        let blurred = |x: &[f64], y: &[f64]| {
            let product: Vec<f64> = x.iter().zip(y).map(|(x, y)| x * y).collect();
            convolve(&product, width, [&weights, &weights], Border::Zero)
        };
        let ones = vec![1.0; area];
        let (ma, mb) = (blurred(&a, &ones), blurred(&b, &ones));
        let (aa, bb, ab) = (blurred(&a, &a), blurred(&b, &b), blurred(&a, &b));
        for (i, out) in map.iter_mut().enumerate() {
            let (va, vb, cov) = (aa[i] - ma[i] * ma[i], bb[i] - mb[i] * mb[i], ab[i] - ma[i] * mb[i]);
            let (means, squares) = (ma[i] * mb[i], ma[i] * ma[i] + mb[i] * mb[i]);
            *out += (2.0 * means + C1) * (2.0 * cov + C2) / ((squares + C1) * (va + vb + C2)) / 3.0;
        }
    }
    map
}

/// ꟻLIP of each pixel: 0 = no visible difference, 1 = the largest.
///
/// # Panics
/// If a length is not `3 · width · height`.
pub(crate) fn flip(photo: &[f32], render: &[f32], width: usize, height: usize) -> Vec<f64> {
    let area = width * height;
    assert!(photo.len() == 3 * area && render.len() == 3 * area, "three planes each");
    let (photo, render) = (opponent(photo), opponent(render));
    let colour = [&photo, &render].map(|image| filtered_colour(image, width));
    let features = [&photo, &render].map(|image| features(&image[0], width));
    let extreme = {
        let of = |rgb| hunt_lab(linear_to_xyz(rgb));
        hyab(of([0.0, 1.0, 0.0]), of([0.0, 0.0, 1.0])).powf(COLOUR_POWER)
    };
    let knee = KNEE.0 * extreme;
    let difference = |i: usize| {
        let error = hyab(colour[0][i], colour[1][i]).powf(COLOUR_POWER);
        let colour = if error < knee {
            error * KNEE.1 / knee
        } else {
            KNEE.1 + (error - knee) / (extreme - knee) * (1.0 - KNEE.1)
        };
        let [(edge_a, point_a), (edge_b, point_b)] = [&features[0], &features[1]].map(|f| f[i]);
        let feature = (edge_a - edge_b).abs().max((point_a - point_b).abs());
        colour.powf(1.0 - (feature / 2f64.sqrt()).powf(FEATURE_POWER))
    };
    (0..area).map(difference).collect()
}

/// Luminance and two opponent colours (YCxCz) as planes.
fn opponent(image: &[f32]) -> [Vec<f64>; 3] {
    let area = image.len() / 3;
    let white = linear_to_xyz([1.0; 3]);
    let mut planes = [(); 3].map(|()| vec![0.0; area]);
    for i in 0..area {
        let linear = [0, 1, 2].map(|c| {
            let value = f64::from(image[c * area + i]);
            if value <= 0.040_45 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
        });
        let xyz = linear_to_xyz(linear);
        let [x, y, z] = [0, 1, 2].map(|c| xyz[c] / white[c]);
        (planes[0][i], planes[1][i], planes[2][i]) = (116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z));
    }
    planes
}

/// Colours filtered by the eye's contrast sensitivity, as Hunt-adjusted L*a*b*.
fn filtered_colour(image: &[Vec<f64>; 3], width: usize) -> Vec<[f64; 3]> {
    let radius = (3.0 * (0.04 / (2.0 * PI * PI)).sqrt() * PIXELS_PER_DEGREE).ceil() as usize;
    let filtered = [0, 1, 2].map(|channel| {
        let (mut sum, mut total) = (vec![0.0; image[channel].len()], 0.0);
        for &(a, b) in SENSITIVITY[channel] {
            let weights = taps(radius, |x| (-(PI * x / PIXELS_PER_DEGREE).powi(2) / b).exp());
            let amount = a * (PI / b).sqrt();
            let blurred = convolve(&image[channel], width, [&weights, &weights], Border::Nearest);
            sum.iter_mut().zip(blurred).for_each(|(sum, value)| *sum += amount * value);
            total += amount * weights.iter().sum::<f64>().powi(2);
        }
        sum.iter_mut().for_each(|value| *value /= total);
        sum
    });
    let white = linear_to_xyz([1.0; 3]);
    let colour = |i: usize| {
        let y = (filtered[0][i] + 16.0) / 116.0;
        let relative = [filtered[1][i] / 500.0 + y, y, y - filtered[2][i] / 200.0];
        let xyz = [0, 1, 2].map(|c| relative[c] * white[c]);
        let linear = RGB_FROM_XYZ.map(|row| dot(row, xyz).clamp(0.0, 1.0));
        hunt_lab(linear_to_xyz(linear))
    };
    (0..filtered[0].len()).map(colour).collect()
}

/// Magnitudes of the edge and the point detector on the luminance.
fn features(luminance: &[f64], width: usize) -> Vec<(f64, f64)> {
    let deviation = 0.5 * FEATURE_DEGREES * PIXELS_PER_DEGREE;
    let radius = (3.0 * deviation).ceil() as usize;
    let bell = |x: f64| (-x * x / (2.0 * deviation * deviation)).exp();
    let plain = normalised(&taps(radius, bell), Sum::All);
    let edge = taps(radius, |x| -x * bell(x));
    let point = taps(radius, |x| (x * x / (deviation * deviation) - 1.0) * bell(x));
    let luminance: Vec<f64> = luminance.iter().map(|y| (y + 16.0) / 116.0).collect();
    let length = |taps: &[f64]| -> Vec<f64> {
        let taps = normalised(taps, Sum::PerSign);
        let across = convolve(&luminance, width, [&taps, &plain], Border::Nearest);
        let down = convolve(&luminance, width, [&plain, &taps], Border::Nearest);
        across.into_iter().zip(down).map(|(x, y)| x.hypot(y)).collect()
    };
    length(&edge).into_iter().zip(length(&point)).collect()
}

fn linear_to_xyz(rgb: [f64; 3]) -> [f64; 3] {
    XYZ_FROM_RGB.map(|row| dot(row, rgb))
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// L*a*b* with chroma scaled by lightness (Hunt effect).
fn hunt_lab(xyz: [f64; 3]) -> [f64; 3] {
    let white = linear_to_xyz([1.0; 3]);
    let delta = 6.0f64 / 29.0;
    let curve = |t: f64| if t > delta.powi(3) { t.cbrt() } else { t / (3.0 * delta * delta) + 4.0 / 29.0 };
    let [x, y, z] = [0, 1, 2].map(|c| curve(xyz[c] / white[c]));
    let lightness = 116.0 * y - 16.0;
    [lightness, 0.01 * lightness * 500.0 * (x - y), 0.01 * lightness * 200.0 * (y - z)]
}

/// The HyAB distance: lightness by absolute value, chroma by Euclidean length.
fn hyab(a: [f64; 3], b: [f64; 3]) -> f64 {
    (a[0] - b[0]).abs() + (a[1] - b[1]).hypot(a[2] - b[2])
}

/// Samples of a function at the integers from -radius to radius.
fn taps(radius: usize, of: impl Fn(f64) -> f64) -> Vec<f64> {
    (0..=2 * radius).map(|i| of(i as f64 - radius as f64)).collect()
}

/// Taps normalised to a sum of one; or, for `Sum::PerSign`, positive taps to a sum of one and negative taps to minus one.
fn normalised(taps: &[f64], how: Sum) -> Vec<f64> {
    let sum = |of: fn(f64) -> f64| taps.iter().map(|&t| of(t)).sum::<f64>();
    let (positive, negative) = match how {
        Sum::All => (sum(|t| t), 1.0),
        Sum::PerSign => (sum(|t| t.max(0.0)), sum(|t| (-t).max(0.0))),
    };
    taps.iter().map(|&t| if t > 0.0 { t / positive } else { t / negative }).collect()
}

/// How taps are normalised.
#[derive(Clone, Copy)]
enum Sum {
    All,
    PerSign,
}

/// Values beyond the edges of the picture.
#[derive(Clone, Copy, PartialEq)]
enum Border {
    Zero,
    /// The value of the nearest pixel.
    Nearest,
}

/// Correlates a plane with taps along rows, then along columns.
fn convolve(plane: &[f64], width: usize, [across, down]: [&[f64]; 2], border: Border) -> Vec<f64> {
    let height = plane.len() / width.max(1);
    let place = |at: usize, tap: usize, radius: usize, len: usize| {
        let at = (at + tap) as isize - radius as isize;
        match border {
            Border::Zero => usize::try_from(at).ok().filter(|&at| at < len),
            Border::Nearest => Some(at.clamp(0, len as isize - 1) as usize),
        }
    };
    let mut rows = vec![0.0; plane.len()];
    for (row, out) in plane.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
        for (x, out) in out.iter_mut().enumerate() {
            for (tap, weight) in across.iter().enumerate() {
                *out += place(x, tap, across.len() / 2, width).map_or(0.0, |x| weight * row[x]);
            }
        }
    }
    let mut both = vec![0.0; plane.len()];
    for (y, out) in both.chunks_exact_mut(width).enumerate() {
        for (tap, weight) in down.iter().enumerate() {
            if let Some(from) = place(y, tap, down.len() / 2, height) {
                let row = &rows[from * width..(from + 1) * width];
                out.iter_mut().zip(row).for_each(|(out, value)| *out += weight * value);
            }
        }
    }
    both
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 48;
    const HEIGHT: usize = 32;

    /// Integer arithmetic only, so that other programs can make the same picture.
    fn picture(phase: usize) -> Vec<f32> {
        let value = |c: usize, x: usize, y: usize| {
            let sum = x * (3 + c) + y * (5 - c) + (x * y) % 7 * 9 + phase * (11 + c * 5) + (x / 8 + y / 8) % 2 * 60;
            (sum % 256) as f32 / 255.0
        };
        (0..3 * WIDTH * HEIGHT).map(|i| value(i / (WIDTH * HEIGHT), i % WIDTH, i / WIDTH % HEIGHT)).collect()
    }

    fn damaged() -> Vec<f32> {
        let mut image = picture(1);
        for (i, value) in image.iter_mut().enumerate() {
            if (20..40).contains(&(i % WIDTH)) && (10..20).contains(&(i / WIDTH % HEIGHT)) {
                *value = 0.5;
            }
        }
        image
    }

    #[test]
    fn flip_matches_its_authors_implementation() {
        // Values of the Python package flip-evaluator 1.7 on the same pictures.
        let map = flip(&picture(0), &damaged(), WIDTH, HEIGHT);
        let mean = map.iter().sum::<f64>() / map.len() as f64;
        assert!((mean - 0.416_304).abs() < 1e-4, "{mean}");
        let wanted = [(0, 0, 0.228_793), (5, 7, 0.293_931), (15, 30, 0.533_804), (31, 47, 0.277_413)];
        for (y, x, wanted) in wanted {
            assert!((map[y * WIDTH + x] - wanted).abs() < 1e-4, "{y} {x}: {}", map[y * WIDTH + x]);
        }
        assert!(flip(&picture(0), &picture(0), WIDTH, HEIGHT).iter().all(|&v| v == 0.0));
    }

    #[test]
    fn the_mean_of_the_ssim_map_is_ssim() {
        let (a, b) = (picture(0), damaged());
        let map = ssim(&a, &b, WIDTH, HEIGHT);
        let mean = map.iter().sum::<f64>() / map.len() as f64;
        assert!((mean - train::metrics::ssim(&a, &b, WIDTH, HEIGHT)).abs() < 1e-9, "{mean}");
    }
}
