//! Pixel weights that make objects count more than their surroundings.

use std::ops::Range;

use scene::{Pinhole, Pixels, Rect, Zone, ZoneMask};

/// The share of a photo that an object covers whose pixels count `1 + weight`.
const USUAL_SHARE: f32 = 0.01;
/// How much more than that the pixels of a smaller object can count, and how much less those of a larger one.
const FACTORS: [f32; 2] = [0.25, 16.0];

/// Gives the pixels of a window (`rect` of mip `m` of a view whose mip 0 is `finest`) the weight 1, and those of zones more:
/// with a weighted mean, the object-zone loss L_visual + λ·L_visual(zones) of perception-aware 3DGS, equations 8 and 9,
/// up to its scale. Without a zone in the window nothing changes.
///
/// A zone has the pixels whose centre lies in its box, or those of its mask; of a coarse pixel that the mask covers in part
/// the same part of the weight counts. Every object has the same stake, whatever its size: `1 + weight` if it covers a
/// hundredth of the photo, the smaller the more. Where zones overlap the larger weight counts.
pub(super) fn weigh(pixels: &mut Pixels, zones: &[Zone], weight: f32, finest: &Pinhole, m: u8, rect: Rect) {
    let width = pixels.width as usize;
    for zone in zones {
        let part = Part::of(zone, m, rect);
        if part.columns.is_empty() || part.rows.is_empty() {
            continue;
        }
        let share = zone.area() / (finest.width as f32 * finest.height as f32);
        let weight = weight * (USUAL_SHARE / share).clamp(FACTORS[0], FACTORS[1]);
        let weights = pixels.weights.get_or_insert_with(|| vec![1.0; width * pixels.height as usize]);
        let shares = zone.mask.as_ref().map(|mask| part.covered(mask, finest.width, m, rect));
        for (i, y) in part.rows.enumerate() {
            let row = &mut weights[y * width..][part.columns.clone()];
            match &shares {
                None => row.iter_mut().for_each(|at| *at = at.max(1.0 + weight)),
                Some(shares) => {
                    let shares = &shares[i * row.len()..];
                    row.iter_mut().zip(shares).for_each(|(at, share)| *at = at.max(1.0 + weight * share));
                }
            }
        }
    }
}

/// The part of a window where a zone's pixels are.
struct Part {
    columns: Range<usize>,
    rows: Range<usize>,
}

impl Part {
    fn of(zone: &Zone, m: u8, rect: Rect) -> Self {
        let scale = 1.0 / (1u32 << m) as f32;
        let inside = |first: f32, end: f32, side: u32| {
            let side = side as f32;
            (first.clamp(0.0, side) as usize)..(end.clamp(0.0, side) as usize)
        };
        let span = |from: f32, to: f32, start: u32, side: u32| {
            let (from, to) = (from * scale - start as f32, to * scale - start as f32);
            if zone.mask.is_some() {
                return inside(from.floor(), to.ceil(), side);
            }
            // Pixels whose centres lie between the edges, at least the nearest one: small objects stay in coarse mips.
            let first = (from - 0.5).ceil();
            inside(first, (to - 0.5).ceil().max(first + 1.0), side)
        };
        let [left, top, right, bottom] = zone.corners;
        Self { columns: span(left, right, rect.x, rect.width), rows: span(top, bottom, rect.y, rect.height) }
    }

    /// The share of each pixel of the part that a mask covers, row by row.
    fn covered(&self, mask: &ZoneMask, width: u32, m: u8, rect: Rect) -> Vec<f32> {
        let of_mip = |range: &Range<usize>, start: u32| start + range.start as u32..start + range.end as u32;
        let (columns, rows) = (of_mip(&self.columns, rect.x), of_mip(&self.rows, rect.y));
        let mut counts = vec![0u32; columns.len() * rows.len()];
        for (y, x) in mask.spans(width).skip_while(|(y, _)| y >> m < rows.start).take_while(|(y, _)| y >> m < rows.end)
        {
            let counts = &mut counts[((y >> m) - rows.start) as usize * columns.len()..];
            for column in (x.start >> m).max(columns.start)..(((x.end - 1) >> m) + 1).min(columns.end) {
                let covered = x.end.min((column + 1) << m) - x.start.max(column << m);
                counts[(column - columns.start) as usize] += covered;
            }
        }
        let all = (1u32 << (2 * m)) as f32;
        counts.iter().map(|&count| count as f32 / all).collect()
    }
}

#[cfg(test)]
mod tests {
    use scene::MaskBuilder;

    use super::*;

    /// The weights of a window with `weight` 3.
    fn weights(zones: &[Zone], finest: &Pinhole, m: u8, rect: Rect) -> Option<Vec<f32>> {
        let (width, height) = (rect.width, rect.height);
        let rgb = vec![0; 3 * (width * height) as usize];
        let mut pixels = Pixels { width, height, rgb, ..Pixels::default() };
        weigh(&mut pixels, zones, 3.0, finest, m, rect);
        pixels.weights
    }

    #[test]
    fn pixels_of_zones_count_more_at_every_mip() {
        let finest = Pinhole { width: 16, height: 8, fx: 9.0, fy: 9.0, cx: 8.0, cy: 4.0 };
        let zone = |corners| Zone { corners, class: 0, score: 1.0, mask: None };
        let zones = [zone([4.0, 2.0, 8.0, 6.0]), zone([15.0, 7.0, 16.0, 8.0])];
        let weights = |m: u8, rect: Rect| weights(&zones, &finest, m, rect);
        let whole = Rect { x: 0, y: 0, width: 16, height: 8 };
        // An eighth of the photo counts least; a pixel of 128 is 0.78 of a hundredth.
        let (large, small) = (1.0 + 3.0 * 0.25, 1.0 + 3.0 * 1.28);
        let count = |of: &[f32], weight: f32| of.iter().filter(|at| (**at - weight).abs() < 1e-5).count();
        let full = weights(0, whole).unwrap();
        assert_eq!([large, small, 1.0].map(|weight| count(&full, weight)), [16, 1, 128 - 17]);
        assert_eq!((full[2 * 16 + 4], full[2 * 16 + 3], full[0]), (large, 1.0, 1.0));
        assert!((full[7 * 16 + 15] - small).abs() < 1e-5);
        let weighed = weights(1, Rect { x: 0, y: 0, width: 8, height: 4 }).unwrap();
        assert_eq!([large, small].map(|weight| count(&weighed, weight)), [4, 1]);
        let window = weights(0, Rect { x: 7, y: 5, width: 4, height: 2 }).unwrap();
        assert_eq!(window, [large, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]);
        assert_eq!(weights(0, Rect { x: 9, y: 0, width: 4, height: 4 }), None);
    }
    #[test]
    fn only_the_pixels_of_a_mask_count_more() {
        let finest = Pinhole { width: 16, height: 8, fx: 9.0, fy: 9.0, cx: 8.0, cy: 4.0 };
        // A triangle below the diagonal of 4 × 4 pixels.
        let mut builder = MaskBuilder::new(16);
        (0..4).for_each(|i| builder.push(2 + i, 5..6 + i));
        let (mask, corners) = builder.finish().unwrap();
        let zone = Zone { corners, class: 0, score: 1.0, mask: Some(mask) };
        assert_eq!((zone.area(), corners), (10.0, [5.0, 2.0, 9.0, 6.0]));
        let of =
            |m, x, y, width, height| weights(std::slice::from_ref(&zone), &finest, m, Rect { x, y, width, height });
        // It covers 8 % of the photo, which counts least.
        let more = 3.0 * FACTORS[0];
        let full = of(0, 0, 0, 16, 8).unwrap();
        let count = |all: &[f32], weight: f32| all.iter().filter(|at| (**at - weight).abs() < 1e-6).count();
        assert_eq!((count(&full, 1.0 + more), count(&full, 1.0)), (10, 118));
        assert!(full[2 * 16 + 5] > 1.0 && full[2 * 16 + 6] == 1.0 && full[5 * 16 + 8] > 1.0);
        // Of a coarse pixel the part that is covered: the weights of both mips have the same mean.
        let half = of(1, 0, 0, 8, 4).unwrap();
        let sum = |all: &[f32]| all.iter().map(|at| at - 1.0).sum::<f32>();
        assert!((4.0 * sum(&half) - sum(&full)).abs() < 1e-5 && half[8 + 2] == 1.0 + 0.5 * more, "{half:?}");
        // Windows show parts of the same weights.
        let window = of(1, 3, 2, 4, 2).unwrap();
        let same: Vec<f32> = (2..4).flat_map(|y| half[y * 8 + 3..][..4].to_vec()).collect();
        assert_eq!((window, of(0, 9, 0, 4, 8)), (same, None));
    }
}
