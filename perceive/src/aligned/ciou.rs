//! Complete intersection over union (Zheng et al. 2021): overlap less distance of the centres less difference of the
//! sides' ratio.

use std::f64::consts::PI;

/// The least side of a box, pixels.
const LEAST: f64 = 1e-6;

/// CIoU of two boxes (left, top, right, bottom), at most 1, and its gradient with respect to the second.
///
/// CIoU = IoU − ρ²/c² − αv, with ρ the distance of the centres, c the diagonal of the box around both,
/// v = (2/π · difference of atan(width/height))², α = v / (1 − IoU + v). The derivative of α is included.
pub(super) fn ciou(to: [f64; 4], of: [f64; 4]) -> (f64, [f64; 4]) {
    let side = |corners: [f64; 4], axis: usize| (corners[axis + 2] - corners[axis]).max(LEAST);
    let sizes = |corners| [side(corners, 0), side(corners, 1)];
    let ([w, h], [to_w, to_h]) = (sizes(of), sizes(to));

    // Along each axis: overlap, extent of both, distance of the centres, with the slopes along start and end of `of`.
    let axis = |axis: usize| {
        let [start, end, to_start, to_end] = [of[axis], of[axis + 2], to[axis], to[axis + 2]];
        let common = end.min(to_end) - start.max(to_start);
        let is_common = f64::from(common > 0.0);
        let common_slopes = [-is_common * f64::from(start > to_start), is_common * f64::from(end < to_end)];
        let extent = (end.max(to_end) - start.min(to_start)).max(LEAST);
        let extent_slopes = [-f64::from(start < to_start), f64::from(end > to_end)];
        (common.max(0.0), common_slopes, extent, extent_slopes, 0.5 * (start + end - to_start - to_end))
    };
    let both = [axis(0), axis(1)];
    let common = both[0].0 * both[1].0;
    let union = w * h + to_w * to_h - common;
    let iou = common / union;
    let diagonal = both[0].2.powi(2) + both[1].2.powi(2);
    let distance = both[0].4.powi(2) + both[1].4.powi(2);
    let bend = (to_w / to_h).atan() - (w / h).atan();
    let v = (2.0 / PI * bend).powi(2);
    let rest = (1.0 - iou + v).max(1e-12);
    let value = iou - distance / diagonal - v * v / rest;

    let mut gradient = [0.0; 4];
    for (i, slope) in gradient.iter_mut().enumerate() {
        let (along, end) = (i % 2, i / 2);
        let sign = if end == 0 { -1.0 } else { 1.0 };
        let other = both[1 - along].0;
        let d_common = both[along].1[end] * other;
        let d_union = sign * [h, w][along] - d_common;
        let d_iou = (d_common - iou * d_union) / union;
        let d_distance = both[along].4;
        let d_diagonal = 2.0 * both[along].2 * both[along].3[end];
        let d_bend = -sign * [h, -w][along] / (w * w + h * h);
        let d_v = 8.0 / (PI * PI) * bend * d_bend;
        let d_ratio = (2.0 * v * d_v - v * v / rest * (d_v - d_iou)) / rest;
        *slope = d_iou - (d_distance - distance / diagonal * d_diagonal) / diagonal - d_ratio;
    }
    (value, gradient)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_boxes_are_at_the_maximum() {
        let (value, gradient) = ciou([1.0, 2.0, 5.0, 4.0], [1.0, 2.0, 5.0, 4.0]);
        assert_eq!(value, 1.0);
        assert!(gradient.iter().all(|slope| slope.is_finite()));
        // Of half the area in the middle, by the definition: the centres are the same, the sides' ratio is not.
        let (value, _) = ciou([0.0, 0.0, 4.0, 4.0], [1.0, 0.0, 3.0, 4.0]);
        let v = 4.0 / (PI * PI) * (1.0f64.atan() - 0.5f64.atan()).powi(2);
        assert!((value - (0.5 - v * v / (0.5 + v))).abs() < 1e-12);
        // Without a common pixel the distance counts.
        assert_eq!(ciou([0.0, 0.0, 1.0, 1.0], [3.0, 0.0, 4.0, 1.0]).0, -9.0 / 17.0);
    }

    #[test]
    fn derivatives_are_those_of_differences() {
        let to = [10.0, 20.0, 50.0, 45.0];
        for of in [
            [12.0, 18.0, 47.0, 50.0],
            [5.0, 25.0, 60.0, 40.0],
            [15.0, 22.0, 40.0, 44.0],
            [70.0, 10.0, 90.0, 30.0],
            [-40.0, 60.0, -10.0, 61.0],
        ] {
            let (_, gradient) = ciou(to, of);
            for i in 0..4 {
                let at = |step: f64| {
                    let mut moved = of;
                    moved[i] += step;
                    ciou(to, moved).0
                };
                let slope = (at(1e-5) - at(-1e-5)) / 2e-5;
                assert!((slope - gradient[i]).abs() < 1e-8, "{of:?} {i}: {} against {slope}", gradient[i]);
            }
        }
    }

    #[test]
    fn degenerate_boxes_give_numbers() {
        for of in [[3.0, 3.0, 3.0, 3.0], [9.0, 9.0, 1.0, 1.0], [1e30, 0.0, 1e30, 1.0]] {
            let (value, gradient) = ciou([1.0, 2.0, 5.0, 4.0], of);
            assert!(value.is_finite() && gradient.iter().all(|slope| slope.is_finite()), "{of:?}");
        }
    }
}
