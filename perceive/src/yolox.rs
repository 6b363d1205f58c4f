//! The head of YOLOX (Ge et al. 2021): a row of numbers an anchor, grids from the finest on, each by rows.

use crate::boxes::Detection;
use crate::card::{BOX_NUMBERS, Card};
use crate::letterbox::Placed;

/// The detections in a network's output (anchors × (5 + classes)) whose score, objectness times that of the likeliest
/// class, is at least `threshold`, in the order of the anchors. Boxes that are not finite or empty are left out.
pub(crate) fn decode(output: &[f32], card: &Card, placed: &Placed, threshold: f32) -> Vec<Detection> {
    let [width, height] = card.input;
    let cells = card.written.strides.iter().flat_map(|&stride| {
        let columns = width / stride;
        (0..columns * (height / stride))
            .map(move |cell| (stride as f32, (cell % columns) as f32, (cell / columns) as f32))
    });
    let numbers = BOX_NUMBERS + card.written.classes.len();
    let detection = |((stride, column, row), anchor): ((f32, f32, f32), &[f32])| {
        let (place, classes) = anchor.split_at(BOX_NUMBERS);
        let best = (0..classes.len()).reduce(|best, next| if classes[next] > classes[best] { next } else { best })?;
        let score = place[4] * classes[best];
        if !(score >= threshold && score.is_finite()) {
            return None;
        }
        let (x, y) = ((place[0] + column) * stride, (place[1] + row) * stride);
        let (half_width, half_height) = (0.5 * stride * place[2].exp(), 0.5 * stride * place[3].exp());
        let corners = [x - half_width, y - half_height, x + half_width, y + half_height];
        if !corners.iter().all(|corner| corner.is_finite()) {
            return None;
        }
        let corners = placed.in_picture(corners);
        let is_there = corners[0] < corners[2] && corners[1] < corners[3];
        is_there.then_some(Detection { class: best, score, corners })
    };
    cells.zip(output.chunks_exact(numbers)).filter_map(detection).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::boxes::suppressed;
    use crate::card::Written;

    proptest! {
        #[test]
        fn any_numbers_give_boxes_inside_the_picture(output in prop::collection::vec(any::<f32>(), 10 * 7)) {
            let written = Written { strides: vec![8, 16], classes: vec!["a".into(), "b".into()], ..Written::default() };
            let card = Card { input: [32, 16], written };
            let placed = Placed { scale: [2.0, 2.0], size: [64.0, 30.0] };
            for found in suppressed(decode(&output, &card, &placed, 0.3), 0.45) {
                let [left, top, right, bottom] = found.corners;
                prop_assert!(0.0 <= left && left < right && right <= 64.0, "{:?}", found);
                prop_assert!(0.0 <= top && top < bottom && bottom <= 30.0, "{:?}", found);
            }
        }
    }

    #[test]
    fn anchors_become_boxes_of_the_picture() {
        let written = Written { strides: vec![8, 16], classes: vec!["a".into(), "b".into()], ..Written::default() };
        let card = Card { input: [32, 16], written };
        // 4 × 2 anchors of stride 8, then 2 × 1 of stride 16.
        let mut output = vec![0.0f32; 10 * 7];
        let mut anchor = |i: usize, values: [f32; 7]| output[7 * i..7 * i + 7].copy_from_slice(&values);
        anchor(6, [0.5, 0.25, 0.0, 2.0f32.ln(), 0.8, 0.2, 0.9]); // column 2 of row 1
        anchor(9, [0.5, 0.5, 0.0, 0.0, 1.0, 0.7, 0.1]); // the second of the coarse grid
        anchor(1, [0.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5]); // too weak
        anchor(2, [0.0, 0.0, 200.0, 0.0, 1.0, 1.0, 0.0]); // infinite
        anchor(3, [f32::NAN, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0]);
        anchor(4, [0.0, 0.0, 0.0, 0.0, f32::NAN, 1.0, 0.0]);
        anchor(5, [-9.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0]); // left of the picture
        let placed = Placed { scale: [2.0, 2.0], size: [64.0, 30.0] };
        let found = decode(&output, &card, &placed, 0.3);
        assert_eq!(found.len(), 2, "{found:?}");
        assert_eq!((found[0].class, found[0].corners), (1, [32.0, 4.0, 48.0, 30.0]));
        assert!((found[0].score - 0.72).abs() < 1e-6);
        assert_eq!((found[1].class, found[1].score, found[1].corners), (0, 0.7, [32.0, 0.0, 64.0, 30.0]));
    }
}
