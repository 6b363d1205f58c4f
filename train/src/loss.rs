//! The photometric loss (1-λ)·L1 + λ·D-SSIM, with D-SSIM = 1 - SSIM, of a frame against a photo, and its gradient.
//!
//! SSIM (Wang et al. 2004) with an 11×11 Gaussian window of σ = 1.5 and zero padding, as 3DGS computes it. The window
//! is separable. Both passes stream rows through a ring buffer of eleven rows, which stays in cache: the forward pass
//! smooths (x, y, x², y², xy), the backward pass the three derivatives of SSIM.

use rayon::prelude::*;
use render::cpu::Isa;
use render::cpu::simd::{LANES, Lanes};
use render::kernel;
use scene::Pixels;

/// Taps of the window along one axis.
const TAPS: usize = 11;
/// Radius of the window, pixels.
const RADIUS: usize = TAPS / 2;
/// exp(-d² / (2·1.5²)) for d = 5, 4, … 0, normalised so that the eleven taps sum to one.
const WINDOW: [f32; RADIUS + 1] =
    [0.001_028_38, 0.007_598_758, 0.036_000_773, 0.109_360_69, 0.213_005_54, 0.266_011_72];
/// SSIM's stabilisers for values in 0..1.
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
/// Rows of a parallel job, which also reads five rows on either side.
const BAND: usize = 64;

/// The photometric loss with its buffers.
#[derive(Debug)]
pub struct PhotometricLoss {
    isa: Isa,
    /// Weight λ of D-SSIM.
    pub lambda: f32,
    /// dSSIM/dμ, dSSIM/dE[x²], dSSIM/dE[xy]; three colour planes each.
    partials: [Vec<f32>; 3],
    /// The mask of a photo with weights: also 0 where the weight is.
    mask: Vec<u8>,
}

/// The value of the loss.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LossValue {
    /// Weighted mean absolute difference.
    pub l1: f64,
    /// Weighted mean SSIM.
    pub ssim: f64,
    /// The loss: (1-λ)·L1 + λ·(1 - SSIM).
    pub total: f64,
}

impl PhotometricLoss {
    /// A loss with weight `lambda` of D-SSIM, computed with instruction set `isa`.
    pub fn new(isa: Isa, lambda: f32) -> Self {
        Self { isa, lambda, partials: Default::default(), mask: Vec::new() }
    }

    /// Computes the loss of `colour` (three planes) against `photo` and writes its gradient with respect to `colour` to
    /// `gradient` (three planes). `weights` (one plane, or empty for all ones) are the pixel weights. Photo pixels
    /// under the mask, or of weight 0 in the photo, are treated as outside the image. The loss is a weighted mean, so its scale does not depend on
    /// the size of the window.
    pub fn evaluate(&mut self, colour: &[f32], photo: &Pixels, weights: &[f32], gradient: &mut Vec<f32>) -> LossValue {
        let (width, height) = (photo.width as usize, photo.height as usize);
        let area = width * height;
        assert!(colour.len() == 3 * area && (weights.is_empty() || weights.len() == area));
        gradient.resize(3 * area, 0.0);
        self.partials.iter_mut().for_each(|plane| plane.resize(3 * area, 0.0));
        let total_weight: f64 =
            if weights.is_empty() { area as f64 } else { weights.iter().map(|&w| f64::from(w)).sum() };
        if total_weight <= 0.0 {
            gradient.fill(0.0);
            return LossValue::default();
        }
        let norm = 1.0 / (3.0 * total_weight);

        let isa = self.isa;
        if let Some(of_photo) = &photo.weights {
            self.mask.clear();
            self.mask.extend(of_photo.iter().map(|&weight| if weight > 0.0 { 255 } else { 0 }));
            if let Some(mask) = &photo.mask {
                self.mask.iter_mut().zip(mask).for_each(|(both, &mask)| *both = mask.min(*both));
            }
        }
        let mask = match &photo.weights {
            Some(_) => &self.mask[..],
            None => photo.mask.as_deref().unwrap_or(&[]),
        };
        let band = BAND * width;
        let plane = |all: usize| (all / area) * area..(all / area + 1) * area;
        // Jobs are (colour plane, band of rows), in a fixed order; sums are added in that order.
        let [mu, xx, xy] = &mut self.partials;
        let jobs: Vec<_> = (mu.chunks_mut(area).zip(xx.chunks_mut(area)).zip(xy.chunks_mut(area)).enumerate())
            .flat_map(|(c, ((mu, xx), xy))| {
                (mu.chunks_mut(band).zip(xx.chunks_mut(band)).zip(xy.chunks_mut(band)).enumerate())
                    .map(move |(b, ((mu, xx), xy))| (c * area, b * BAND, [mu, xx, xy]))
            })
            .collect();
        let sums: Vec<[f64; 2]> = jobs
            .into_par_iter()
            .with_max_len(1)
            .map(|(plane_at, first_row, partials)| {
                let (x, y) = (&colour[plane(plane_at)], &photo.rgb[plane(plane_at)]);
                let mut sums = [0.0; 2];
                ssim_rows(isa, x, y, weights, mask, width, first_row, partials, &mut sums);
                sums
            })
            .collect();
        let (l1, ssim) = sums.iter().fold((0.0, 0.0), |(a, b), s| (a + s[0] * norm, b + s[1] * norm));

        let scale = [(1.0 - f64::from(self.lambda)) * norm, -f64::from(self.lambda) * norm].map(|s| s as f32);
        let partials = &self.partials;
        let jobs: Vec<_> = (gradient.chunks_mut(area).enumerate())
            .flat_map(|(c, plane)| plane.chunks_mut(band).enumerate().map(move |(b, out)| (c * area, b * BAND, out)))
            .collect();
        jobs.into_par_iter().with_max_len(1).for_each(|(plane_at, first_row, out)| {
            let range = plane(plane_at);
            let (x, y) = (&colour[range.clone()], &photo.rgb[range.clone()]);
            let partials = [0, 1, 2].map(|k| &partials[k][range.clone()]);
            gradient_rows(isa, x, y, weights, mask, width, first_row, partials, scale, out);
        });
        let total = (1.0 - f64::from(self.lambda)) * l1 + f64::from(self.lambda) * (1.0 - ssim);
        LossValue { l1, ssim, total }
    }
}

/// A ring buffer of eleven horizontally smoothed rows of `N` quantities.
struct RowRing<const N: usize> {
    rows: Vec<f32>,
    stride: usize,
    /// Unsmoothed rows of each quantity, with zeros on both sides.
    raw: [Vec<f32>; N],
}

/// Zeros before a raw row: the radius, rounded up to a full vector.
const LEFT_PADDING: usize = LANES;

impl<const N: usize> RowRing<N> {
    fn new(width: usize) -> Self {
        let stride = width.next_multiple_of(LANES);
        let raw = std::array::from_fn(|_| vec![0.0; LEFT_PADDING + stride + LANES]);
        Self { rows: vec![0.0; TAPS * N * stride], stride, raw }
    }

    /// Clears the slot of a row outside the image.
    fn clear(&mut self, row: usize) {
        let at = row % TAPS * N * self.stride;
        self.rows[at..at + N * self.stride].fill(0.0);
    }

    /// Smooths the raw rows into the slot of `row`.
    #[inline(always)]
    fn smooth<L: Lanes>(&mut self, row: usize) {
        for (q, raw) in self.raw.iter().enumerate() {
            let at = (row % TAPS * N + q) * self.stride;
            for (n, out) in self.rows[at..at + self.stride].chunks_exact_mut(LANES).enumerate() {
                let i = LEFT_PADDING + n * LANES;
                let mut sum = lanes::<L>(raw, i) * L::splat(WINDOW[RADIUS]);
                for (t, tap) in WINDOW[..RADIUS].iter().enumerate() {
                    let d = RADIUS - t;
                    sum = (lanes::<L>(raw, i - d) + lanes::<L>(raw, i + d)).fma(L::splat(*tap), sum);
                }
                sum.store(out.try_into().expect("sixteen lanes"));
            }
        }
    }

    /// The vertically smoothed quantities of `row` at column `i`; rows `row - 5 ..= row + 5` must be in the buffer.
    #[inline(always)]
    fn column<L: Lanes>(&self, row: usize, i: usize) -> [L; N] {
        let mut out = [L::zero(); N];
        for (q, out) in out.iter_mut().enumerate() {
            let mut sum = lanes::<L>(&self.rows, self.at(row, q, i)) * L::splat(WINDOW[RADIUS]);
            for (t, tap) in WINDOW[..RADIUS].iter().enumerate() {
                let d = RADIUS - t;
                let above = lanes::<L>(&self.rows, self.at(row - d, q, i));
                let below = lanes::<L>(&self.rows, self.at(row + d, q, i));
                sum = (above + below).fma(L::splat(*tap), sum);
            }
            *out = sum;
        }
        out
    }

    /// Index of a smoothed value.
    #[inline(always)]
    fn at(&self, row: usize, quantity: usize, i: usize) -> usize {
        (row % TAPS * N + quantity) * self.stride + i
    }
}

/// Sixteen lanes of a slice.
#[inline(always)]
fn lanes<L: Lanes>(slice: &[f32], at: usize) -> L {
    L::load(slice[at..at + LANES].try_into().expect("sixteen lanes"))
}

kernel!(
    /// SSIM's derivatives (times the weights) for the rows that `partials` cover, from `first_row` on; adds Σ w|x-y|
    /// and Σ w·SSIM to `sums`.
    fn ssim_rows(
        x: &[f32], y: &[u8], weights: &[f32], mask: &[u8], width: usize, first_row: usize, partials: [&mut [f32]; 3], sums: &mut [f64; 2],
    ) = ssim_rows_lanes
);

#[inline(always)]
fn ssim_rows_lanes<L: Lanes>(
    x: &[f32],
    y: &[u8],
    weights: &[f32],
    mask: &[u8],
    width: usize,
    first_row: usize,
    partials: [&mut [f32]; 3],
    sums: &mut [f64; 2],
) {
    let height = x.len() / width;
    let rows = partials[0].len() / width;
    let [out_mu, out_xx, out_xy] = partials;
    let mut ring = RowRing::<5>::new(width);
    let (one, two) = (L::splat(1.0), L::splat(2.0));
    let (c1, c2) = (L::splat(C1), L::splat(C2));
    // Rows of the ring are numbered from `first_row - RADIUS`, as row 0.
    for r in 0..rows + 2 * RADIUS {
        let image_row = (first_row + r).checked_sub(RADIUS).filter(|&row| row < height);
        if let Some(row) = image_row {
            let (x, y) = (&x[row * width..(row + 1) * width], &y[row * width..(row + 1) * width]);
            let [rx, ry, rxx, ryy, rxy] = &mut ring.raw;
            let range = LEFT_PADDING..LEFT_PADDING + width;
            let (rx, ry) = (&mut rx[range.clone()], &mut ry[range.clone()]);
            let (rxx, ryy, rxy) = (&mut rxx[range.clone()], &mut ryy[range.clone()], &mut rxy[range]);
            for i in 0..width {
                let (x, y) = (x[i], f32::from(y[i]) * (1.0 / 255.0));
                (rx[i], ry[i], rxx[i], ryy[i], rxy[i]) = (x, y, x * x, y * y, x * y);
            }
            // SSIM treats masked pixels like those outside the image: zero in both images.
            if let Some(mask) = mask.get(row * width..(row + 1) * width) {
                for i in (0..width).filter(|&i| mask[i] < 128) {
                    (rx[i], ry[i], rxx[i], ryy[i], rxy[i]) = (0.0, 0.0, 0.0, 0.0, 0.0);
                }
            }
            ring.smooth::<L>(r);
        } else {
            ring.clear(r);
        }
        let Some(out_row) = r.checked_sub(2 * RADIUS) else { continue };
        let row = first_row + out_row;
        let mut row_sums = [L::zero(); 2];
        for i in (0..width).step_by(LANES) {
            let [mx, my, exx, eyy, exy] = ring.column::<L>(out_row + RADIUS, i);
            let (mxx, myy, mxy) = (mx * mx, my * my, mx * my);
            let a1 = two.fma(mxy, c1);
            let a2 = two.fma(exy - mxy, c2);
            let b1 = mxx + myy + c1;
            let b2 = (exx - mxx) + (eyy - myy) + c2;
            let (i1, i2) = (one / b1, one / b2);
            let i12 = i1 * i2;
            let ssim = a1 * a2 * i12;
            let in_row = (width - i).min(LANES);
            let inside = if in_row == LANES { u16::MAX } else { (1 << in_row) - 1 };
            let at = row * width + i;
            let w = if weights.is_empty() { one } else { L::load_from(&weights[..(row + 1) * width], at, 0.0) };
            let w = L::select(inside, w, L::zero());
            let d_mu = two * my * (a2 - a1) * i12 - two * mx * ssim * (i1 - i2);
            let d_xx = -(ssim * i2);
            let d_xy = two * a1 * i12;
            let out_at = out_row * width + i;
            let end = (out_row + 1) * width;
            (w * d_mu).store_to(&mut out_mu[..end], out_at);
            (w * d_xx).store_to(&mut out_xx[..end], out_at);
            (w * d_xy).store_to(&mut out_xy[..end], out_at);
            let x = L::load_from(&x[..(row + 1) * width], at, 0.0);
            let mut target = [0.0; LANES];
            for (t, &y) in target.iter_mut().zip(&y[at..at + in_row]) {
                *t = f32::from(y) * (1.0 / 255.0);
            }
            row_sums[0] = row_sums[0] + w * (x - L::load(&target)).abs();
            row_sums[1] = row_sums[1] + w * ssim;
        }
        for (sum, lanes) in sums.iter_mut().zip(row_sums) {
            *sum += lanes.to_array().iter().map(|&v| f64::from(v)).sum::<f64>();
        }
    }
}

kernel!(
    /// dL/dx for the rows that `out` covers: `scale[0]·w·sign(x-y) + scale[1]·dΣSSIM/dx`.
    fn gradient_rows(
        x: &[f32], y: &[u8], weights: &[f32], mask: &[u8], width: usize, first_row: usize, partials: [&[f32]; 3], scale: [f32; 2], out: &mut [f32],
    ) = gradient_rows_lanes
);

#[inline(always)]
fn gradient_rows_lanes<L: Lanes>(
    x: &[f32],
    y: &[u8],
    weights: &[f32],
    mask: &[u8],
    width: usize,
    first_row: usize,
    partials: [&[f32]; 3],
    scale: [f32; 2],
    out: &mut [f32],
) {
    let height = x.len() / width;
    let rows = out.len() / width;
    let mut ring = RowRing::<3>::new(width);
    for r in 0..rows + 2 * RADIUS {
        let image_row = (first_row + r).checked_sub(RADIUS).filter(|&row| row < height);
        if let Some(row) = image_row {
            for (raw, partial) in ring.raw.iter_mut().zip(partials) {
                raw[LEFT_PADDING..LEFT_PADDING + width].copy_from_slice(&partial[row * width..(row + 1) * width]);
            }
            ring.smooth::<L>(r);
        } else {
            ring.clear(r);
        }
        let Some(out_row) = r.checked_sub(2 * RADIUS) else { continue };
        let row = first_row + out_row;
        for i in (0..width).step_by(LANES) {
            let [d_mu, d_xx, d_xy] = ring.column::<L>(out_row + RADIUS, i);
            let at = row * width + i;
            let end = (row + 1) * width;
            let x = L::load_from(&x[..end], at, 0.0);
            let mut target = [0.0; LANES];
            let in_row = (width - i).min(LANES);
            for (t, &y) in target.iter_mut().zip(&y[at..at + in_row]) {
                *t = f32::from(y) * (1.0 / 255.0);
            }
            let y = L::load(&target);
            let w = if weights.is_empty() { L::splat(1.0) } else { L::load_from(&weights[..end], at, 0.0) };
            let sign = L::select(y.lt(x), w, L::select(x.lt(y), -w, L::zero()));
            let d_ssim = d_mu + L::splat(2.0) * x * d_xx + y * d_xy;
            let gradient = sign.fma(L::splat(scale[0]), d_ssim * L::splat(scale[1]));
            gradient.store_to(&mut out[..(out_row + 1) * width], out_row * width + i);
        }
        if let Some(mask) = mask.get(row * width..(row + 1) * width) {
            for i in (0..width).filter(|&i| mask[i] < 128) {
                out[out_row * width + i] = 0.0;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(n: usize, seed: u32) -> Vec<f32> {
        (0..n).map(|i| crate::random::uniform(u64::from(seed), i as u64)).collect()
    }

    /// The definition, pixel by pixel, in f64.
    fn naive(x: &[f64], photo: &Pixels, weights: &[f32], lambda: f64) -> f64 {
        let (w, h) = (photo.width as i64, photo.height as i64);
        let area = photo.area();
        let g: Vec<f64> = (-5..=5).map(|d| (-f64::from(d * d) / 4.5).exp()).collect();
        let sum: f64 = g.iter().sum();
        let (mut total, mut norm) = (0.0, 0.0);
        for c in 0..3 {
            for py in 0..h {
                for px in 0..w {
                    let mut m = [0.0; 5];
                    for dy in -5i64..=5 {
                        for dx in -5i64..=5 {
                            let (qx, qy) = (px + dx, py + dy);
                            if qx < 0 || qy < 0 || qx >= w || qy >= h {
                                continue;
                            }
                            let k = g[(dx + 5) as usize] * g[(dy + 5) as usize] / (sum * sum);
                            let i = c * area + (qy * w + qx) as usize;
                            let (a, b) = (x[i], f64::from(photo.rgb[i]) / 255.0);
                            for (m, v) in m.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                                *m += k * v;
                            }
                        }
                    }
                    let [mx, my, xx, yy, xy] = m;
                    let (c1, c2) = (f64::from(C1), f64::from(C2));
                    let ssim = (2.0 * mx * my + c1) * (2.0 * (xy - mx * my) + c2)
                        / ((mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2));
                    let i = (py * w + px) as usize;
                    let weight = f64::from(weights[i]);
                    let l1 = (x[c * area + i] - f64::from(photo.rgb[c * area + i]) / 255.0).abs();
                    total += weight * ((1.0 - lambda) * l1 + lambda * (1.0 - ssim));
                    norm += weight;
                }
            }
        }
        total / norm
    }

    #[test]
    fn value_and_gradient_agree_with_the_definition() {
        let (width, height) = (21, 70); // neither a multiple of the lanes, more than one band
        let area = width * height;
        let photo = Pixels {
            width: width as u32,
            height: height as u32,
            rgb: noise(3 * area, 1).iter().map(|v| (v * 255.0) as u8).collect(),
            mask: None,
            ..Pixels::default()
        };
        let x = noise(3 * area, 2);
        let weights = noise(area, 3);
        let exact: Vec<f64> = x.iter().map(|&v| f64::from(v)).collect();
        let expected = naive(&exact, &photo, &weights, 0.2);
        for isa in Isa::available() {
            let mut gradient = Vec::new();
            let value = PhotometricLoss::new(isa, 0.2).evaluate(&x, &photo, &weights, &mut gradient);
            assert!((value.total - expected).abs() < 1e-5, "{} against {expected}", value.total);
            for i in [0, 5, 300, area - 1, area + 640, 3 * area - 1] {
                let step = 1e-5;
                let (mut up, mut down) = (exact.clone(), exact.clone());
                up[i] += step;
                down[i] -= step;
                let slope = (naive(&up, &photo, &weights, 0.2) - naive(&down, &photo, &weights, 0.2)) / (2.0 * step);
                assert!((f64::from(gradient[i]) - slope).abs() < 2e-7, "{i}: {} against {slope}", gradient[i]);
            }
        }
    }
    #[test]
    fn a_pixel_of_weight_2_counts_twice() {
        let image = |values: &[u8], weights: Option<Vec<f32>>| Pixels {
            width: values.len() as u32,
            height: 1,
            rgb: [values; 3].concat(),
            mask: None,
            weights,
            ..Pixels::default()
        };
        let loss = |x: &[f32], photo: &Pixels| {
            let weights = photo.weights.clone().unwrap_or_default();
            PhotometricLoss::new(Isa::detect(), 0.0).evaluate(&[x; 3].concat(), photo, &weights, &mut Vec::new()).total
        };
        let twice = loss(&[0.1, 0.5, 0.5, 0.9], &image(&[100, 20, 20, 200], None));
        let weighted = loss(&[0.1, 0.5, 0.9], &image(&[100, 20, 200], Some(vec![1.0, 2.0, 1.0])));
        let alike = loss(&[0.1, 0.5, 0.9], &image(&[100, 20, 200], None));
        assert!((twice - weighted).abs() < 1e-7 && (twice - alike).abs() > 1e-3, "{twice} {weighted} {alike}");
    }
}
