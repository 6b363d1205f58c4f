//! Three planes of a render placed in a network's input, and the adjoint of that.

use rayon::prelude::*;

use crate::card::Card;
use crate::placed::{Placed, taps};

/// Where the pixels of pictures of one size go.
pub(super) struct Placement {
    /// Width and height of the picture.
    size: [usize; 2],
    /// Width and height of the input.
    input: [usize; 2],
    /// Upper left corner in the input.
    offset: [usize; 2],
    /// For each column and each row of the placed picture the two of the picture, and the share of the second.
    columns: Vec<(usize, usize, f32)>,
    rows: Vec<(usize, usize, f32)>,
    /// For each plane of the input the plane of the picture, and what 0 and 1 become.
    planes: [(usize, f32, f32); 3],
    /// What each plane has around the picture.
    around: [f32; 3],
    placed: Placed,
}

impl Placement {
    /// The placement of [`place`](crate::placed::place).
    pub(super) fn new(size: [usize; 2], card: &Card) -> Self {
        let ([width, height], offset) = card.area(size);
        let plane = |i: usize| (card.plane(i), -card.mean[i] / card.std[i], (255.0 - card.mean[i]) / card.std[i]);
        Self {
            size,
            input: card.input,
            offset,
            columns: taps(width, size[0]),
            rows: taps(height, size[1]),
            planes: [0, 1, 2].map(plane),
            around: [0, 1, 2].map(|i| (f32::from(card.pad) - card.mean[i]) / card.std[i]),
            placed: Placed::new(size, card),
        }
    }

    pub(super) fn placed(&self) -> Placed {
        self.placed
    }

    /// The input for a picture of three planes, red first, 0..1.
    pub(super) fn forward(&self, picture: &[f32]) -> Vec<f32> {
        let [width, height] = self.input;
        let area = self.size[0] * self.size[1];
        let mut input = vec![0.0; 3 * width * height];
        input.par_chunks_mut(width * height).zip(self.planes).zip(self.around).for_each(|((plane, of), around)| {
            plane.fill(around);
            let (channel, black, white) = of;
            let picture = &picture[channel * area..(channel + 1) * area];
            let [x, y] = self.offset;
            for (line, &(top, bottom, down)) in plane.chunks_exact_mut(width).skip(y).zip(&self.rows) {
                let [upper, lower] = [top, bottom].map(|row| &picture[row * self.size[0]..]);
                for (value, &(left, right, along)) in line[x..].iter_mut().zip(&self.columns) {
                    let mix = |row: &[f32]| row[left] + along * (row[right] - row[left]);
                    let level = mix(upper) + down * (mix(lower) - mix(upper));
                    *value = black + (white - black) * level;
                }
            }
        });
        input
    }

    /// The gradient with respect to the picture from that with respect to the input.
    pub(super) fn backward(&self, input: &[f32]) -> Vec<f32> {
        let [width, height] = self.input;
        let area = self.size[0] * self.size[1];
        let mut gradient = vec![0.0; 3 * area];
        gradient.par_chunks_mut(area).enumerate().for_each(|(channel, picture)| {
            let from = self.planes.iter().zip(input.chunks_exact(width * height));
            for (&(_, black, white), plane) in from.filter(|((of, _, _), _)| *of == channel) {
                let [x, y] = self.offset;
                for (line, &(top, bottom, down)) in plane.chunks_exact(width).skip(y).zip(&self.rows) {
                    for (slope, &(left, right, along)) in line[x..].iter().zip(&self.columns) {
                        let slope = (white - black) * slope;
                        let [upper, lower] = [top * self.size[0], bottom * self.size[0]];
                        picture[upper + left] += slope * (1.0 - down) * (1.0 - along);
                        picture[upper + right] += slope * (1.0 - down) * along;
                        picture[lower + left] += slope * down * (1.0 - along);
                        picture[lower + right] += slope * down * along;
                    }
                }
            }
        });
        gradient
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Picture;
    use crate::card::{Head, Written};
    use crate::placed::place;
    use crate::testing::dot;

    #[test]
    fn planes_are_placed_like_pictures_and_the_gradient_is_the_adjoint() {
        for (head, size) in Head::ALL.into_iter().zip([[31, 9], [9, 31], [70, 50], [5, 3]]) {
            let card = Card { input: [24, 16], ..Card::new(head, &Written::default()) };
            let count = 3 * size[0] * size[1];
            let rgb: Vec<u8> = (0..count).map(|i| (i * 7919 % 251) as u8).collect();
            let planes: Vec<f32> =
                (0..count).map(|i| f32::from(rgb[3 * (i % (count / 3)) + i / (count / 3)]) / 255.0).collect();
            let (expected, placed) = place(&Picture { rgb: &rgb, width: size[0], height: size[1] }, &card);
            let placement = Placement::new(size, &card);
            assert_eq!(placement.placed(), placed);
            let input = placement.forward(&planes);
            let off = input.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(off < 1e-4, "{off}");
            // ⟨A x, y⟩ = ⟨x, Aᵀ y⟩ of the linear part.
            let black = placement.forward(&vec![0.0; count]);
            let y: Vec<f32> = (0..input.len()).map(|i| (i * 31 % 17) as f32 - 8.0).collect();
            let forward = dot(&input, &y) - dot(&black, &y);
            let backward = dot(&planes, &placement.backward(&y));
            assert!((forward - backward).abs() < 1e-4 * (1.0 + forward.abs()), "{forward} against {backward}");
        }
    }
}
