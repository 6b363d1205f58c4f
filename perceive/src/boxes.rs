//! Boxes of detected objects: overlap, and the suppression of boxes that repeat another.

/// An object that a detector found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Detection {
    /// Number of the class.
    pub class: usize,
    /// 0..1.
    pub score: f32,
    /// Left, top, right, bottom in pixels of the picture; pixel centres lie at +0.5.
    pub corners: [f32; 4],
}

/// Intersection over union of two boxes; 0 where they do not overlap.
pub fn iou(a: [f32; 4], b: [f32; 4]) -> f32 {
    overlap(a, b) as f32
}

/// As [`iou`], in double precision.
pub(crate) fn overlap(a: [f32; 4], b: [f32; 4]) -> f64 {
    let [a, b] = [a, b].map(|corners| corners.map(f64::from));
    let area = |[left, top, right, bottom]: [f64; 4]| (right - left).max(0.0) * (bottom - top).max(0.0);
    let common = area([a[0].max(b[0]), a[1].max(b[1]), a[2].min(b[2]), a[3].min(b[3])]);
    let union = area(a) + area(b) - common;
    if union > 0.0 { common / union } else { 0.0 }
}

/// Most boxes that are compared with each other; of more, those with the highest scores.
pub(crate) const MAX_BOXES: usize = 3000;

/// Non-maximum suppression by class: in order of their scores, boxes that overlap an earlier one of their class by more
/// than `limit` are dropped. Equal scores keep their order.
pub(crate) fn suppressed(mut found: Vec<Detection>, limit: f32) -> Vec<Detection> {
    found.sort_by(|a, b| b.score.total_cmp(&a.score));
    found.truncate(MAX_BOXES);
    let mut kept: Vec<Detection> = Vec::new();
    for next in found {
        if kept.iter().all(|of| of.class != next.class || iou(of.corners, next.corners) <= limit) {
            kept.push(next);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(class: usize, score: f32, corners: [f32; 4]) -> Detection {
        Detection { class, score, corners }
    }

    #[test]
    fn overlap_is_that_of_areas() {
        assert_eq!(overlap([0.0, 0.0, 4.0, 2.0], [2.0, 0.0, 6.0, 2.0]), 4.0 / 12.0);
        assert_eq!(iou([0.0, 0.0, 4.0, 2.0], [0.0, 0.0, 4.0, 2.0]), 1.0);
        // Apart, touching, empty, inside out.
        for other in [[5.0, 0.0, 6.0, 2.0], [4.0, 0.0, 6.0, 2.0], [1.0, 1.0, 1.0, 1.0], [3.0, 2.0, 1.0, 0.0]] {
            assert_eq!(iou([0.0, 0.0, 4.0, 2.0], other), 0.0);
        }
        assert_eq!(iou([1.0; 4], [1.0; 4]), 0.0);
    }

    #[test]
    fn repeated_boxes_of_a_class_are_suppressed_by_the_best() {
        let best = found(2, 0.9, [0.0, 0.0, 10.0, 10.0]);
        // Overlaps the best by 0.8; the next one overlaps the best by 0.33 only.
        let near = found(2, 0.8, [0.0, 2.0, 10.0, 10.0]);
        let next = found(2, 0.7, [0.0, 6.0, 10.0, 12.0]);
        let other_class = found(7, 0.6, [0.0, 0.0, 10.0, 10.0]);
        let kept = suppressed(vec![next, other_class, best, near], 0.45);
        assert_eq!(kept, [best, next, other_class]);
        assert!(iou(near.corners, next.corners) < 0.45 && iou(best.corners, near.corners) > 0.45);
        assert_eq!(suppressed(vec![next, best, near], 0.85), [best, near, next]);
        let many = (0..4000).map(|i| found(0, 0.5, [4.0 * i as f32, 0.0, 4.0 * i as f32 + 1.0, 1.0])).collect();
        assert_eq!(suppressed(many, 0.45).len(), MAX_BOXES);
    }
}
