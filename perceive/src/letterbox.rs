//! Fits a picture into a network's input without changing its shape: YOLOX's way, in the upper left corner with grey
//! beside it.

use crate::Picture;
use crate::card::{Card, Channels};

/// Where a picture lies in the input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Placed {
    /// Pixels of the picture to one of the input, along x and y.
    pub(crate) scale: [f32; 2],
    /// Width and height of the picture.
    pub(crate) size: [f32; 2],
}

/// Width and height of a picture that is as large as fits; at least a pixel.
fn fitted([width, height]: [usize; 2], [w, h]: [usize; 2]) -> [usize; 2] {
    // In integers, so that the side that limits is hit exactly.
    if width * h <= height * w { [width, (h * width / w).max(1)] } else { [(w * height / h).max(1), height] }
}

/// The input (planes of the card's order and range) with the picture, resized bilinearly between pixel centres.
pub(crate) fn letterbox(picture: &Picture, card: &Card) -> (Vec<f32>, Placed) {
    let [width, height] = card.input;
    let sides = [picture.width, picture.height];
    let [w, h] = fitted(card.input, sides);
    let unit = card.written.white / 255.0;
    let mut input = vec![unit * f32::from(card.written.pad); 3 * width * height];
    let [columns, rows] = [(w, sides[0]), (h, sides[1])].map(|(to, from)| taps(to, from));
    for (channel, plane) in input.chunks_exact_mut(width * height).enumerate() {
        let channel = if card.written.channels == Channels::Bgr { 2 - channel } else { channel };
        let at = |x: usize, y: usize| f32::from(picture.rgb[3 * (y * picture.width + x) + channel]);
        for (line, &(top, bottom, down)) in plane.chunks_exact_mut(width).zip(&rows) {
            for (value, &(left, right, along)) in line.iter_mut().zip(&columns) {
                let mix = |y: usize| at(left, y) + along * (at(right, y) - at(left, y));
                let upper = mix(top);
                *value = unit * (upper + down * (mix(bottom) - upper));
            }
        }
    }
    let scale = [sides[0] as f32 / w as f32, sides[1] as f32 / h as f32];
    (input, Placed { scale, size: sides.map(|side| side as f32) })
}

/// For each of `to` pixels the two of `from` between whose centres its centre lies, and the share of the second.
fn taps(to: usize, from: usize) -> Vec<(usize, usize, f32)> {
    let tap = |i: usize| {
        let centre = ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64);
        let first = centre as usize;
        (first, (first + 1).min(from - 1), (centre - first as f64) as f32)
    };
    (0..to).map(tap).collect()
}

impl Placed {
    /// Corners in the input as corners in the picture, cut at its edges.
    pub(crate) fn in_picture(&self, corners: [f32; 4]) -> [f32; 4] {
        let [x, y] = self.scale;
        let [width, height] = self.size;
        let cut = |value: f32, side: f32| value.clamp(0.0, side);
        let [left, top, right, bottom] = corners;
        [cut(left * x, width), cut(top * y, height), cut(right * x, width), cut(bottom * y, height)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::card::Written;

    fn card(input: [usize; 2], written: Written) -> Card {
        Card { input, written }
    }

    #[test]
    fn a_wide_picture_lies_at_the_top_with_grey_below() {
        // Two pixels, red and white, fill the width of 4; the rest is grey.
        let picture = Picture { rgb: &[255, 0, 0, 255, 255, 255], width: 2, height: 1 };
        let (input, placed) = letterbox(&picture, &card([4, 4], Written::default()));
        let rows = |plane: usize| input[16 * plane..16 * plane + 12].to_vec();
        let grey = [114.0; 4];
        let ramp = [0.0, 63.75, 191.25, 255.0];
        assert_eq!(rows(0), [ramp, ramp, grey].concat(), "blue comes first");
        assert_eq!(rows(2), [[255.0; 4], [255.0; 4], grey].concat());
        assert_eq!(placed, Placed { scale: [0.5, 0.5], size: [2.0, 1.0] });
        assert_eq!(placed.in_picture([-1.0, 1.0, 3.0, 9.0]), [0.0, 0.5, 1.5, 1.0]);
        let rgb = Written { channels: Channels::Rgb, white: 1.0, ..Written::default() };
        assert_eq!(letterbox(&picture, &card([4, 4], rgb)).0[..5], [1.0; 5]);
    }

    #[test]
    fn the_side_that_limits_is_filled() {
        assert_eq!(fitted([416, 416], [1242, 375]), [416, 125]);
        assert_eq!(fitted([416, 416], [375, 1242]), [125, 416]);
        assert_eq!(fitted([416, 416], [480, 270]), [416, 234]);
        assert_eq!(fitted([96, 64], [3, 2]), [96, 64]);
        assert_eq!(fitted([416, 416], [60_000, 1]), [416, 1]);
    }
}
