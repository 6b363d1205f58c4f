//! Which pixels a box contains, and how much of it a photo's mask covers.

use std::ops::Range;

/// Columns and rows of the pixels whose centres a box (left, top, right, bottom, pixels) contains.
pub fn box_pixels([left, top, right, bottom]: [f32; 4], width: usize, height: usize) -> (Range<usize>, Range<usize>) {
    let range = |from: f32, to: f32, side: usize| {
        let end = ((to + 0.5).max(0.0) as usize).min(side);
        ((from - 0.5).ceil().max(0.0) as usize).min(end)..end
    };
    (range(left, right, width), range(top, bottom, height))
}

/// An object of which more is masked counts nowhere: moving objects, which no static model shows, are masked.
pub const MAX_MASKED: f64 = 0.5;

/// The share of masked pixels (under 128) among those of a row-major mask whose centre a box (left, top, right, bottom,
/// pixels) contains; 0 of none.
pub fn masked_share(mask: &[u8], width: usize, corners: [f32; 4]) -> f64 {
    let (columns, rows) = box_pixels(corners, width, mask.len() / width.max(1));
    let (mut masked, mut all) = (0u64, 0u64);
    for row in rows.map(|y| &mask[y * width..][..width]) {
        for &value in &row[columns.clone()] {
            masked += u64::from(value < 128);
            all += 1;
        }
    }
    if all > 0 { masked as f64 / all as f64 } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_has_the_pixels_whose_centres_it_contains() {
        let of = |corners| box_pixels(corners, 10, 8);
        assert_eq!(of([0.0, 0.0, 10.0, 8.0]), (0..10, 0..8));
        assert_eq!(of([1.4, 0.6, 2.6, 2.4]), (1..3, 1..2));
        assert_eq!(of([-5.0, -5.0, -1.0, 20.0]), (0..0, 0..8));
        assert_eq!(of([12.0, 3.0, 15.0, 2.0]), (10..10, 2..2));
        assert_eq!(of([f32::NAN; 4]).0.len(), 0);
    }

    #[test]
    fn the_share_of_a_box_that_is_masked_is_that_of_its_pixels() {
        // The left two of four columns are masked.
        let mask = [0, 0, 255, 255, 0, 0, 255, 255, 0, 0, 255, 255];
        let share = |corners| masked_share(&mask, 4, corners);
        assert_eq!(share([0.0, 0.0, 4.0, 3.0]), 0.5);
        assert_eq!(share([1.0, 0.0, 4.0, 3.0]), 1.0 / 3.0);
        assert_eq!((share([1.4, 0.2, 2.6, 1.0]), share([1.6, 0.2, 2.6, 1.0])), (0.5, 0.0));
        assert_eq!((share([3.0, 1.0, 9.0, 9.0]), share([-5.0, -5.0, 1.0, 9.0])), (0.0, 1.0));
        assert_eq!((share([9.0, 9.0, 10.0, 10.0]), share([1.1, 1.1, 1.2, 1.2])), (0.0, 0.0));
    }
}
