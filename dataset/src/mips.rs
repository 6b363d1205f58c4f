//! The mip pyramid of a view.
//!
//! A pixel of mip `m` is the mean of the `2^m × 2^m` pixels of mip 0 that it covers, rounded once from their exact sum, not once
//! per level. [`scene::Camera::mip`] gives the camera of a mip. Remainders at the right and bottom edges are dropped. With a
//! mask, a coarse pixel is usable only if all pixels that it covers are.

use scene::Pixels;

/// The pyramid ends with the last mip whose shorter side has at least this many pixels. Mip 0 always exists.
pub const MIN_MIP_SIDE: u32 = 16;

/// The number of mips of an image of this size, at least 1.
pub fn mip_count(width: u32, height: u32) -> u8 {
    let shorter = width.min(height);
    let count = (0..32).take_while(|&m| shorter >> m >= MIN_MIP_SIDE).count();
    count.max(1) as u8
}

/// Calls `each` with the mips of an image, mip 0 first. Only two mips are in memory at a time.
///
/// # Errors
/// The first error of `each`, which ends the iteration.
pub fn for_each_mip<E>(finest: Pixels, mut each: impl FnMut(&Pixels) -> Result<(), E>) -> Result<(), E> {
    each(&finest)?;
    let levels = mip_count(finest.width, finest.height);
    let mut sums = halve(finest.width, finest.height, &finest.rgb, finest.mask.as_deref());
    drop(finest);
    for m in 1..levels {
        each(&sums.mean(m))?;
        sums = halve(sums.width, sums.height, &sums.rgb, sums.mask.as_deref());
    }
    Ok(())
}

/// A mip before rounding: for each pixel the sum of the pixels of mip 0 that it covers. The sum of 2^24 pixels of 255 fits 32 bits.
struct PixelSums {
    width: u32,
    height: u32,
    rgb: Vec<u32>,
    mask: Option<Vec<u8>>,
}

impl PixelSums {
    fn mean(&self, m: u8) -> Pixels {
        let half = (1u64 << (2 * m)) / 2;
        let rgb = self.rgb.iter().map(|&sum| ((u64::from(sum) + half) >> (2 * m)) as u8).collect();
        Pixels { width: self.width, height: self.height, rgb, mask: self.mask.clone(), ..Pixels::default() }
    }
}

/// Sums of blocks of 2×2 pixels. A block is usable (255, else 0) if all of its pixels are.
fn halve<T: Copy + Into<u32>>(width: u32, height: u32, rgb: &[T], mask: Option<&[u8]>) -> PixelSums {
    let (from, w, h) = (width as usize, width / 2, height / 2);
    let mut sums = Vec::with_capacity(3 * w as usize * h as usize);
    for plane in rgb.chunks_exact(from * height as usize) {
        for_each_quad(plane, from, |[a, b, c, d]| sums.push(a.into() + b.into() + c.into() + d.into()));
    }
    let mask = mask.map(|mask| {
        let mut all = Vec::with_capacity(w as usize * h as usize);
        for_each_quad(mask, from, |[a, b, c, d]| all.push(a & b & c & d));
        all
    });
    PixelSums { width: w, height: h, rgb: sums, mask }
}

fn for_each_quad<T: Copy>(plane: &[T], width: usize, mut each: impl FnMut([T; 4])) {
    for rows in plane.chunks_exact(2 * width) {
        let (upper, lower) = rows.split_at(width);
        for (a, b) in upper.chunks_exact(2).zip(lower.chunks_exact(2)) {
            each([a[0], a[1], b[0], b[1]]);
        }
    }
}

/// The means of blocks of `factor × factor` pixels. Sides are divided and rounded down. A block is usable only if all of its
/// pixels are.
///
/// # Panics
/// With a factor of 0.
pub fn downscale(pixels: &Pixels, factor: u32) -> Pixels {
    let (width, height) = (pixels.width / factor, pixels.height / factor);
    let (n, stride) = (u64::from(factor).pow(2), pixels.width as usize);
    let mut sums = vec![0u64; width as usize];
    let mut shrink = |plane: &[u8], out: &mut Vec<u8>, value: fn(u64, u64) -> u8| {
        for rows in plane.chunks_exact(stride * factor as usize) {
            sums.fill(0);
            for row in rows.chunks_exact(stride) {
                for (sum, block) in sums.iter_mut().zip(row.chunks_exact(factor as usize)) {
                    *sum += block.iter().map(|&v| u64::from(v)).sum::<u64>();
                }
            }
            out.extend(sums.iter().map(|&sum| value(sum, n)));
        }
    };
    let mut rgb = Vec::with_capacity(3 * width as usize * height as usize);
    for plane in pixels.rgb.chunks_exact(pixels.area()) {
        shrink(plane, &mut rgb, |sum, n| ((sum + n / 2) / n) as u8);
    }
    let mask = pixels.mask.as_ref().map(|mask| {
        let mut all = Vec::with_capacity(width as usize * height as usize);
        shrink(mask, &mut all, |sum, n| if sum == 255 * n { 255 } else { 0 });
        all
    });
    Pixels { width, height, rgb, mask, ..Pixels::default() }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A texture with noise that differs between tiles.
    pub(crate) fn image(width: u32, height: u32, masked: bool) -> Pixels {
        let n = (width * height) as usize;
        let byte = |i: usize| ((i / 7) as u32 ^ (i as u32).wrapping_mul(2_654_435_761) >> 27) as u8;
        let mask = masked.then(|| (0..n).map(|i| if i % 97 < 5 { 0 } else { 255 }).collect());
        Pixels { width, height, rgb: (0..3 * n).map(byte).collect(), mask, ..Pixels::default() }
    }

    /// Reference implementation: means of `edge × edge` pixels, one pixel at a time.
    fn box_filtered(p: &Pixels, edge: u32) -> Pixels {
        let (width, height) = (p.width / edge, p.height / edge);
        let pool = |plane: &[u8], value: &dyn Fn(&[u8]) -> u8| -> Vec<u8> {
            let mut out = Vec::new();
            for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
                let at = |i: u32| plane[((y * edge + i / edge) * p.width + x * edge + i % edge) as usize];
                out.push(value(&(0..edge * edge).map(at).collect::<Vec<u8>>()));
            }
            out
        };
        let mean = |v: &[u8]| (v.iter().map(|&v| f64::from(v)).sum::<f64>() / v.len() as f64 + 0.5).floor() as u8;
        let all = |v: &[u8]| if v.iter().all(|&v| v == 255) { 255 } else { 0 };
        let rgb = p.rgb.chunks(p.area()).flat_map(|plane| pool(plane, &mean)).collect();
        Pixels { width, height, rgb, mask: p.mask.as_ref().map(|m| pool(m, &all)), ..Pixels::default() }
    }

    #[test]
    fn mips_and_downscaling_are_box_means_of_mip_0() {
        for masked in [false, true] {
            let finest = image(333, 150, masked);
            let mut m = 0;
            for_each_mip(finest.clone(), |mip| {
                assert!(*mip == box_filtered(&finest, 1 << m), "mip {m}");
                m += 1;
                Ok::<_, ()>(())
            })
            .unwrap();
            assert_eq!((m, mip_count(333, 150)), (4, 4));
            for factor in [1, 2, 3, 5] {
                assert!(downscale(&finest, factor) == box_filtered(&finest, factor), "factor {factor}");
            }
        }
        assert_eq!([mip_count(1, 1), mip_count(16, 16), mip_count(31, 4000), mip_count(32, 32)], [1, 1, 1, 2]);
    }
}
