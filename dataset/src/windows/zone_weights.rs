//! Pixel weights that make objects count more than their surroundings.

use scene::{Pinhole, Pixels, Rect, Zone};

/// The share of a photo that an object covers whose pixels count `1 + weight`.
const USUAL_SHARE: f32 = 0.01;
/// How much more than that the pixels of a smaller object can count, and how much less those of a larger one.
const FACTORS: [f32; 2] = [0.25, 16.0];

/// Gives the pixels of a window (`rect` of the mip with this pinhole, whose mip 0 is `finest`) the weight 1, and those whose
/// centre lies in a zone more: with a weighted mean, the object-zone loss L_visual + λ·L_visual(zones) of
/// perception-aware 3DGS, equations 8 and 9, up to its scale. Without a zone in the window nothing changes.
///
/// Every object has the same stake, whatever its size: `1 + weight` if it covers a hundredth of the photo, the smaller the
/// more. Where zones overlap the larger weight counts.
pub(super) fn weigh(pixels: &mut Pixels, zones: &[Zone], weight: f32, finest: &Pinhole, mip: &Pinhole, rect: Rect) {
    let scale = [mip.width as f32 / finest.width as f32, mip.height as f32 / finest.height as f32];
    let (width, height) = (pixels.width as usize, pixels.height as usize);
    // Pixels whose centres lie between two edges, at least the nearest one: small objects stay in coarse mips.
    let span = |from: f32, to: f32, scale: f32, start: u32, side: usize| {
        let (from, to) = (from * scale - start as f32, to * scale - start as f32);
        let first = (from - 0.5).ceil();
        let end = (to - 0.5).ceil().max(first + 1.0);
        (first.clamp(0.0, side as f32) as usize)..(end.clamp(0.0, side as f32) as usize)
    };
    for zone in zones {
        let [left, top, right, bottom] = zone.corners;
        let columns = span(left, right, scale[0], rect.x, width);
        let rows = span(top, bottom, scale[1], rect.y, height);
        if columns.is_empty() || rows.is_empty() {
            continue;
        }
        let share = (right - left) * (bottom - top) / (finest.width as f32 * finest.height as f32);
        let weight = 1.0 + weight * (USUAL_SHARE / share).clamp(FACTORS[0], FACTORS[1]);
        let weights = pixels.weights.get_or_insert_with(|| vec![1.0; width * height]);
        for y in rows {
            weights[y * width..][columns.clone()].iter_mut().for_each(|at| *at = at.max(weight));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_of_zones_count_more_at_every_mip() {
        let finest = Pinhole { width: 16, height: 8, fx: 9.0, fy: 9.0, cx: 8.0, cy: 4.0 };
        let zone = |corners| Zone { corners, class: 0, score: 1.0 };
        let zones = [zone([4.0, 2.0, 8.0, 6.0]), zone([15.0, 7.0, 16.0, 8.0])];
        let weights = |mip: Pinhole, rect: Rect| {
            let (width, height) = (rect.width, rect.height);
            let rgb = vec![0; 3 * (width * height) as usize];
            let mut pixels = Pixels { width, height, rgb, mask: None, weights: None, depth: None };
            weigh(&mut pixels, &zones, 3.0, &finest, &mip, rect);
            pixels.weights
        };
        let whole = |k: Pinhole| Rect { x: 0, y: 0, width: k.width, height: k.height };
        // An eighth of the photo counts least; a pixel of 128 is 0.78 of a hundredth.
        let (large, small) = (1.0 + 3.0 * 0.25, 1.0 + 3.0 * 1.28);
        let count = |of: &[f32], weight: f32| of.iter().filter(|at| (**at - weight).abs() < 1e-5).count();
        let full = weights(finest, whole(finest)).unwrap();
        assert_eq!([large, small, 1.0].map(|weight| count(&full, weight)), [16, 1, 128 - 17]);
        assert_eq!((full[2 * 16 + 4], full[2 * 16 + 3], full[0]), (large, 1.0, 1.0));
        assert!((full[7 * 16 + 15] - small).abs() < 1e-5);
        let half = Pinhole { width: 8, height: 4, ..finest };
        let weighed = weights(half, whole(half)).unwrap();
        assert_eq!([large, small].map(|weight| count(&weighed, weight)), [4, 1]);
        let window = weights(finest, Rect { x: 7, y: 5, width: 4, height: 2 }).unwrap();
        assert_eq!(window, [large, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]);
        assert_eq!(weights(finest, Rect { x: 9, y: 0, width: 4, height: 4 }), None);
    }
}
