//! Boxes and scores of single anchors, and the derivatives of both with respect to the network's output.
//!
//! The formulas are those of [`heads`](crate::heads), which decodes whole pictures and only forwards. Scores are those
//! of the network's classes, before the card's map.

use crate::card::{Card, Head};
use crate::placed::Placed;

/// What a network says at one anchor.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Anchor {
    /// Left, top, right, bottom in pixels of the picture; not cut at its edges.
    pub(super) corners: [f64; 4],
    /// Of each class, 0..1.
    pub(super) scores: Vec<f64>,
}

/// Where the numbers of a picture's anchors lie in the output.
pub(super) struct Anchors<'a> {
    card: &'a Card,
    placed: Placed,
    /// Side of the cell in pixels of the input, column and row.
    cells: Vec<[f64; 3]>,
}

impl<'a> Anchors<'a> {
    pub(super) fn new(card: &'a Card, placed: Placed) -> Self {
        Self { card, placed, cells: card.cells().map(|cell| cell.map(|number| number as f64)).collect() }
    }

    pub(super) fn count(&self) -> usize {
        self.cells.len()
    }

    /// Width and height of the picture.
    pub(super) fn size(&self) -> [f64; 2] {
        self.placed.size.map(f64::from)
    }

    /// Place in the output of number `i` of an anchor.
    fn place(&self, anchor: usize, i: usize) -> usize {
        if self.card.head.is_in_planes() {
            return i * self.count() + anchor;
        }
        anchor * self.card.head.numbers(self.card.outputs.len(), self.card.bins) + i
    }

    pub(super) fn read(&self, output: &[f32], anchor: usize) -> Anchor {
        let at = |i: usize| f64::from(output[self.place(anchor, i)]);
        let [stride, column, row] = self.cells[anchor];
        let classes = self.card.outputs.len();
        let [width, height] = self.card.input.map(|side| side as f64);
        let (corners, scores) = match self.card.head {
            Head::Yolox => {
                let centre = [(at(0) + column) * stride, (at(1) + row) * stride];
                let corners = around(centre, [2, 3].map(|i| stride * at(i).exp()));
                (corners, (0..classes).map(|class| at(4) * at(5 + class)).collect())
            }
            Head::Yolov8 => (around([at(0), at(1)], [at(2), at(3)]), (0..classes).map(|class| at(4 + class)).collect()),
            Head::Fastestdet => {
                let centre = [(at(1).tanh() + column) * stride, (at(2).tanh() + row) * stride];
                let corners = around(centre, [width * logistic(at(3)), height * logistic(at(4))]);
                (corners, (0..classes).map(|class| at(0).powf(0.6) * at(5 + class).powf(0.4)).collect())
            }
            Head::Nanodet => {
                let [x, y] = [column, row].map(|cell| (cell + f64::from(self.card.anchor)) * stride);
                let [left, top, right, bottom] =
                    [0, 1, 2, 3].map(|side| stride * self.distances(output, anchor, side).0);
                ([x - left, y - top, x + right, y + bottom], (0..classes).map(at).collect())
            }
        };
        let of = |i: usize| (corners[i] - f64::from(self.placed.offset[i % 2])) * f64::from(self.placed.scale[i % 2]);
        Anchor { corners: [0, 1, 2, 3].map(of), scores }
    }

    /// Adds to the output's gradient that of a function of an anchor with these slopes along its corners and scores.
    pub(super) fn pull(&self, output: &[f32], anchor: usize, slopes: &Anchor, gradient: &mut [f32]) {
        let at = |i: usize| f64::from(output[self.place(anchor, i)]);
        let mut add = |i: usize, slope: f64| gradient[self.place(anchor, i)] += slope as f32;
        let stride = self.cells[anchor][0];
        let classes = self.card.outputs.len();
        let [width, height] = self.card.input.map(|side| side as f64);
        let corners: Vec<f64> = (0..4).map(|i| slopes.corners[i] * f64::from(self.placed.scale[i % 2])).collect();
        // Along the centre and the size.
        let centre = [corners[0] + corners[2], corners[1] + corners[3]];
        let size = [0.5 * (corners[2] - corners[0]), 0.5 * (corners[3] - corners[1])];
        match self.card.head {
            Head::Yolox => {
                for axis in 0..2 {
                    add(axis, stride * centre[axis]);
                    add(2 + axis, size[axis] * stride * at(2 + axis).exp());
                }
                let of_object = slopes.scores.iter().enumerate().map(|(class, slope)| slope * at(5 + class));
                add(4, of_object.sum());
                (0..classes).for_each(|class| add(5 + class, slopes.scores[class] * at(4)));
            }
            Head::Yolov8 => {
                (0..2).for_each(|axis| add(axis, centre[axis]));
                (0..2).for_each(|axis| add(2 + axis, size[axis]));
                (0..classes).for_each(|class| add(4 + class, slopes.scores[class]));
            }
            Head::Fastestdet => {
                for (axis, side) in [width, height].into_iter().enumerate() {
                    let (offset, share) = (at(1 + axis).tanh(), logistic(at(3 + axis)));
                    add(1 + axis, stride * centre[axis] * (1.0 - offset * offset));
                    add(3 + axis, side * size[axis] * share * (1.0 - share));
                }
                // Both powers are steep at 0, where neither can fall any further.
                let object = at(0).max(LEAST);
                let mut of_object = 0.0;
                for class in 0..classes {
                    let likely = at(5 + class).max(LEAST);
                    let slope = slopes.scores[class] * object.powf(0.6) * likely.powf(0.4);
                    of_object += 0.6 * slope / object;
                    add(5 + class, 0.4 * slope / likely);
                }
                add(0, of_object);
            }
            Head::Nanodet => {
                (0..classes).for_each(|class| add(class, slopes.scores[class]));
                for (side, sign) in [-1.0, -1.0, 1.0, 1.0].into_iter().enumerate() {
                    let (mean, shares) = self.distances(output, anchor, side);
                    for (bin, share) in shares.into_iter().enumerate() {
                        let slope = sign * stride * corners[side] * share * (bin as f64 - mean);
                        add(classes + side * self.card.bins + bin, slope);
                    }
                }
            }
        }
    }

    /// Mean and shares of the distances of a side of NanoDet's box, strides.
    fn distances(&self, output: &[f32], anchor: usize, side: usize) -> (f64, Vec<f64>) {
        let first = self.card.outputs.len() + side * self.card.bins;
        let logits = (0..self.card.bins).map(|bin| f64::from(output[self.place(anchor, first + bin)]));
        let largest = logits.clone().fold(f64::NEG_INFINITY, f64::max);
        let mut shares: Vec<f64> = logits.map(|logit| (logit - largest).exp()).collect();
        let sum: f64 = shares.iter().sum();
        shares.iter_mut().for_each(|share| *share /= sum);
        (shares.iter().enumerate().map(|(bin, share)| bin as f64 * share).sum(), shares)
    }
}

/// The least objectness and class whose powers are differentiated.
const LEAST: f64 = 1e-9;

fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

fn around([x, y]: [f64; 2], [width, height]: [f64; 2]) -> [f64; 4] {
    [x - 0.5 * width, y - 0.5 * height, x + 0.5 * width, y + 0.5 * height]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::card::Written;
    use crate::heads::decode;

    const PLACED: Placed = Placed { scale: [2.0, 1.5], offset: [3.0, 1.0], size: [58.0, 24.0] };

    fn card(head: Head) -> Card {
        let strides = if head == Head::Fastestdet { vec![16] } else { vec![8, 16] };
        let classes = Some(vec!["a".into(), "b".into()]);
        let written = Written { strides: Some(strides), classes, anchor: Some(0.5), ..Written::default() };
        Card { input: [32, 16], ..Card::new(head, &written) }
    }

    /// Numbers in 0.1..0.9.
    fn output(card: &Card) -> Vec<f32> {
        let numbers = card.cells().count() * card.head.numbers(2, card.bins);
        (0..numbers).map(|i| 0.1 + 0.8 * ((i * 7919 + 13) % 101) as f32 / 101.0).collect()
    }

    #[test]
    fn anchors_are_what_the_heads_decode() {
        for card in Head::ALL.map(card) {
            let output = output(&card);
            let anchors = Anchors::new(&card, PLACED);
            let cut = |corners: [f64; 4]| [0, 1, 2, 3].map(|i| corners[i].clamp(0.0, f64::from(PLACED.size[i % 2])));
            let mut decoded = decode(&output, &card, &PLACED, 0.0).into_iter();
            for anchor in (0..anchors.count()).map(|anchor| anchors.read(&output, anchor)) {
                let corners = cut(anchor.corners);
                if corners[0] < corners[2] && corners[1] < corners[3] {
                    let found = decoded.next().unwrap();
                    assert!(found.corners.iter().zip(corners).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-4));
                    assert!((f64::from(found.score) - anchor.scores[found.class]).abs() < 1e-6);
                }
            }
            assert!(decoded.next().is_none());
        }
    }

    #[test]
    fn derivatives_are_those_of_differences() {
        for card in Head::ALL.map(card) {
            let mut output = output(&card);
            let anchors = Anchors::new(&card, PLACED);
            let slopes = Anchor { corners: [0.3, -0.7, 1.1, 0.4], scores: vec![2.0, -3.0] };
            let value = |output: &[f32]| {
                let Anchor { corners, scores } = anchors.read(output, 1);
                let numbers = corners.iter().chain(&scores).zip(slopes.corners.iter().chain(&slopes.scores));
                numbers.map(|(a, b)| a * b).sum::<f64>()
            };
            let mut gradient = vec![0.0; output.len()];
            anchors.pull(&output, 1, &slopes, &mut gradient);
            for (i, gradient) in gradient.into_iter().enumerate() {
                let before = output[i];
                let [up, down] = [before + 1e-3, before - 1e-3];
                output[i] = up;
                let above = value(&output);
                output[i] = down;
                let slope = (above - value(&output)) / f64::from(up - down);
                output[i] = before;
                let off = (slope - f64::from(gradient)).abs();
                assert!(off < 1e-4 * (1.0 + slope.abs()), "{:?} {i}: {gradient}, by differences {slope}", card.head);
            }
        }
    }
}
