//! Decodes the outputs of the heads that [`Head`] describes: each anchor's likeliest class, its score and its box.

use crate::boxes::Detection;
use crate::card::{Card, Head};
use crate::placed::Placed;

/// The numbers of an anchor: rows one after the other, or planes.
struct Numbers<'a> {
    output: &'a [f32],
    first: usize,
    step: usize,
}

impl Numbers<'_> {
    fn at(&self, i: usize) -> f32 {
        self.output.get(self.first + i * self.step).copied().unwrap_or(f32::NAN)
    }

    /// The largest of `count` numbers from `first` on, with its place among them.
    fn largest(&self, first: usize, count: usize) -> (usize, f32) {
        let numbers = (0..count).map(|i| (i, self.at(first + i)));
        numbers.reduce(|best, next| if next.1 > best.1 { next } else { best }).unwrap_or((0, f32::NAN))
    }
}

/// An anchor's place: side of its cell in pixels of the input, and the cell's column and row.
#[derive(Clone, Copy)]
struct Cell {
    stride: f32,
    column: f32,
    row: f32,
}

/// An anchor's likeliest class of the network, its score, and corners in pixels of the input.
type Found = (usize, f32, [f32; 4]);

/// The detections in a network's output whose score is at least `threshold`, in the order of the anchors: grids from
/// the finest on, each by rows. Boxes that are not finite or empty are left out.
pub(crate) fn decode(output: &[f32], card: &Card, placed: &Placed, threshold: f32) -> Vec<Detection> {
    let size = card.head.numbers(card.outputs.len(), card.bins);
    let cell = |cell: [usize; 3]| {
        let [stride, column, row] = cell.map(|number| number as f32);
        Cell { stride, column, row }
    };
    let cells: Vec<Cell> = card.cells().map(cell).collect();
    let head: fn(&Numbers, Cell, &Card) -> Found = match card.head {
        Head::Yolox => yolox,
        Head::Yolov8 => yolov8,
        Head::Fastestdet => fastestdet,
        Head::Nanodet => nanodet,
    };
    let detection = |(i, cell): (usize, &Cell)| {
        let (first, step) = if card.head.is_in_planes() { (i, cells.len()) } else { (i * size, 1) };
        let (class, score, corners) = head(&Numbers { output, first, step }, *cell, card);
        if !(score >= threshold && score.is_finite() && corners.iter().all(|corner| corner.is_finite())) {
            return None;
        }
        let corners = placed.in_picture(corners);
        let is_there = corners[0] < corners[2] && corners[1] < corners[3];
        is_there.then_some(Detection { class: card.class_of[class], score, corners })
    };
    cells.iter().enumerate().filter_map(detection).collect()
}

fn around([x, y]: [f32; 2], [width, height]: [f32; 2]) -> [f32; 4] {
    [x - 0.5 * width, y - 0.5 * height, x + 0.5 * width, y + 0.5 * height]
}

/// Score: objectness times class.
fn yolox(of: &Numbers, Cell { stride, column, row }: Cell, card: &Card) -> Found {
    let (class, likely) = of.largest(5, card.outputs.len());
    let centre = [(of.at(0) + column) * stride, (of.at(1) + row) * stride];
    (class, of.at(4) * likely, around(centre, [2, 3].map(|i| stride * of.at(i).exp())))
}

/// Score: class.
fn yolov8(of: &Numbers, _: Cell, card: &Card) -> Found {
    let (class, likely) = of.largest(4, card.outputs.len());
    (class, likely, around([of.at(0), of.at(1)], [of.at(2), of.at(3)]))
}

/// Score: objectness^0.6 times class^0.4.
fn fastestdet(of: &Numbers, Cell { stride, column, row }: Cell, card: &Card) -> Found {
    let (class, likely) = of.largest(5, card.outputs.len());
    let centre = [(of.at(1).tanh() + column) * stride, (of.at(2).tanh() + row) * stride];
    let share = |i: usize| 1.0 / (1.0 + (-of.at(i)).exp());
    let [width, height] = card.input.map(|side| side as f32);
    (class, of.at(0).powf(0.6) * likely.powf(0.4), around(centre, [width * share(3), height * share(4)]))
}

/// Score: class. The box's sides lie at the mean distances of their distributions.
fn nanodet(of: &Numbers, Cell { stride, column, row }: Cell, card: &Card) -> Found {
    let (classes, bins) = (card.outputs.len(), card.bins);
    let (class, likely) = of.largest(0, classes);
    let distance = |side: usize| {
        let first = classes + side * bins;
        let (_, largest) = of.largest(first, bins);
        let (mut sum, mut total) = (0.0, 0.0);
        for bin in 0..bins {
            let weight = (of.at(first + bin) - largest).exp();
            (sum, total) = (sum + weight * bin as f32, total + weight);
        }
        stride * sum / total
    };
    let (x, y) = ((column + card.anchor) * stride, (row + card.anchor) * stride);
    (class, likely, [x - distance(0), y - distance(1), x + distance(2), y + distance(3)])
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::boxes::suppressed;
    use crate::card::Written;

    const PLACED: Placed = Placed { scale: [2.0, 2.0], offset: [0.0, 0.0], size: [64.0, 30.0] };

    /// Two classes, strides 8 and 16 (FastestDet's 16), an input of 32 × 16.
    fn card(head: Head) -> Card {
        let strides = if head == Head::Fastestdet { vec![16] } else { vec![8, 16] };
        let classes = Some(vec!["a".into(), "b".into()]);
        Card { input: [32, 16], ..Card::new(head, &Written { strides: Some(strides), classes, ..Written::default() }) }
    }

    proptest! {
        #[test]
        fn any_numbers_give_boxes_inside_the_picture(output in prop::collection::vec(any::<f32>(), 0..10 * 34)) {
            for card in Head::ALL.map(card) {
                for found in suppressed(decode(&output, &card, &PLACED, 0.3), 0.45) {
                    let [left, top, right, bottom] = found.corners;
                    prop_assert!(0.0 <= left && left < right && right <= 64.0, "{:?}", found);
                    prop_assert!(0.0 <= top && top < bottom && bottom <= 30.0, "{:?}", found);
                }
            }
        }
    }

    #[test]
    fn anchors_become_boxes_of_the_picture() {
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
        let found = decode(&output, &card(Head::Yolox), &PLACED, 0.3);
        assert_eq!(found.len(), 2, "{found:?}");
        assert_eq!((found[0].class, found[0].corners), (1, [32.0, 4.0, 48.0, 30.0]));
        assert!((found[0].score - 0.72).abs() < 1e-6);
        assert_eq!((found[1].class, found[1].score, found[1].corners), (0, 0.7, [32.0, 0.0, 64.0, 30.0]));
    }

    #[test]
    fn planes_and_distributions_are_read_as_their_heads_write_them() {
        // YOLOv8: planes of ten anchors. The fourth anchor has a box of 8 × 4 around (10, 6).
        let mut planes = vec![0.0f32; 6 * 10];
        [10.0, 6.0, 8.0, 4.0, 0.1, 0.9].into_iter().enumerate().for_each(|(k, value)| planes[10 * k + 3] = value);
        let mut card_of_one_class = card(Head::Yolov8);
        card_of_one_class.class_of = vec![0, 0];
        let found = decode(&planes, &card_of_one_class, &PLACED, 0.3);
        assert_eq!(found, [Detection { class: 0, score: 0.9, corners: [12.0, 8.0, 28.0, 16.0] }]);
        // FastestDet: two cells of 16. The second has a box a quarter as wide and half as high as the input.
        let cell = [0.5, 0.0, 0.5f32.atanh(), (0.25f32 / 0.75).ln(), 0.0, 0.25, 0.1];
        let mut planes = vec![0.0f32; 7 * 2];
        cell.into_iter().enumerate().for_each(|(k, value)| planes[2 * k + 1] = value);
        let found = decode(&planes, &card(Head::Fastestdet), &PLACED, 0.3);
        assert!((found[0].score - 0.5f32.powf(0.6) * 0.25f32.powf(0.4)).abs() < 1e-6 && found[0].class == 0);
        let expected = [2.0 * 12.0, 2.0 * 4.0, 2.0 * 20.0, 2.0 * 12.0];
        assert!(found[0].corners.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-4), "{found:?}");
        // NanoDet: left at 1 stride for sure, top between 0 and 1, right and bottom at 2. Cell 5 is column 1 of row 1.
        let mut rows = vec![0.0f32; 10 * 34];
        let row = &mut rows[5 * 34..6 * 34];
        (row[0], row[1]) = (0.2, 0.8);
        row[2..].fill(-100.0);
        [1, 8, 8 + 1, 16 + 2, 24 + 2].into_iter().for_each(|bin| row[2 + bin] = 5.0);
        let found = decode(&rows, &card(Head::Nanodet), &PLACED, 0.3);
        assert_eq!(found, [Detection { class: 1, score: 0.8, corners: [0.0, 8.0, 48.0, 30.0] }]);
    }
}
