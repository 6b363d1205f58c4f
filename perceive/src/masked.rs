//! How much of a box a photo's mask covers.

/// The share of masked pixels (under 128) among those of a row-major mask whose centre a box (left, top, right, bottom,
/// pixels) contains; 0 of none.
pub fn masked_share(mask: &[u8], width: usize, [left, top, right, bottom]: [f32; 4]) -> f64 {
    let pixels =
        |from: f32, to: f32, side: usize| ((from - 0.5).ceil().max(0.0) as usize)..((to + 0.5) as usize).min(side);
    let (columns, rows) = (pixels(left, right, width), pixels(top, bottom, mask.len() / width.max(1)));
    let (mut masked, mut all) = (0u64, 0u64);
    for row in rows.map(|y| &mask[y * width..][..width]) {
        for &value in row.get(columns.clone()).unwrap_or_default() {
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
