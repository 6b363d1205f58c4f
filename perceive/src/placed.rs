//! Places a picture in a network's input: in a corner or in the middle with grey around it, or stretched.

use crate::Picture;
use crate::card::Card;

/// Where a picture lies in the input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Placed {
    /// Pixels of the picture to one of the input, along x and y.
    pub(crate) scale: [f32; 2],
    /// The picture's upper left corner in the input.
    pub(crate) offset: [f32; 2],
    /// Width and height of the picture.
    pub(crate) size: [f32; 2],
}

/// The input (planes of the card's order and range) with the picture, resized bilinearly between pixel centres.
pub(crate) fn place(picture: &Picture, card: &Card) -> (Vec<f32>, Placed) {
    let [width, height] = card.input;
    let sides = [picture.width, picture.height];
    let (filled, corner) = card.area(sides);
    let [x, y] = corner;
    let mut input = vec![f32::from(card.pad); 3 * width * height];
    let [columns, rows] = [0, 1].map(|axis| taps(filled[axis], sides[axis]));
    for (channel, plane) in input.chunks_exact_mut(width * height).enumerate() {
        let (mean, std) = (card.mean[channel], card.std[channel]);
        let channel = card.plane(channel);
        let at = |x: usize, y: usize| f32::from(picture.rgb[3 * (y * picture.width + x) + channel]);
        for (line, &(top, bottom, down)) in plane.chunks_exact_mut(width).skip(y).zip(&rows) {
            for (value, &(left, right, along)) in line[x..].iter_mut().zip(&columns) {
                let mix = |y: usize| at(left, y) + along * (at(right, y) - at(left, y));
                let upper = mix(top);
                *value = upper + down * (mix(bottom) - upper);
            }
        }
        plane.iter_mut().for_each(|value| *value = (*value - mean) / std);
    }
    (input, Placed::new(sides, card))
}

/// For each of `to` pixels the two of `from` between whose centres its centre lies, and the share of the second.
pub(crate) fn taps(to: usize, from: usize) -> Vec<(usize, usize, f32)> {
    let tap = |i: usize| {
        let centre = ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64);
        let first = centre as usize;
        (first, (first + 1).min(from - 1), (centre - first as f64) as f32)
    };
    (0..to).map(tap).collect()
}

impl Placed {
    /// Where [`place`] puts a picture of this size.
    pub(crate) fn new(size: [usize; 2], card: &Card) -> Self {
        let (filled, corner) = card.area(size);
        let scale = [0, 1].map(|axis| size[axis] as f32 / filled[axis] as f32);
        Self { scale, offset: corner.map(|place| place as f32), size: size.map(|side| side as f32) }
    }

    /// Corners in the input as corners in the picture, cut at its edges.
    pub(crate) fn in_picture(&self, corners: [f32; 4]) -> [f32; 4] {
        let along =
            |value: f32, axis: usize| ((value - self.offset[axis]) * self.scale[axis]).clamp(0.0, self.size[axis]);
        let [left, top, right, bottom] = corners;
        [along(left, 0), along(top, 1), along(right, 0), along(bottom, 1)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::card::{Channels, Head, Resize, Written};

    fn card(input: [usize; 2], resize: Resize, channels: Channels, std: f32) -> Card {
        Card { input, resize, channels, std: [std; 3], ..Card::new(Head::Yolox, &Written::default()) }
    }

    #[test]
    fn a_wide_picture_lies_at_the_top_in_the_middle_or_everywhere() {
        // Two pixels, red and white, fill the width of 4; the rest is grey.
        let picture = Picture { rgb: &[255, 0, 0, 255, 255, 255], width: 2, height: 1 };
        let placed = |resize| place(&picture, &card([4, 4], resize, Channels::Bgr, 1.0));
        let ramp = [0.0, 63.75, 191.25, 255.0];
        let grey = [114.0; 4];
        let (input, at) = placed(Resize::Corner);
        assert_eq!(input[..16], [ramp, ramp, grey, grey].concat(), "blue comes first");
        assert_eq!(input[32..], [[255.0; 4], [255.0; 4], grey, grey].concat());
        assert_eq!(at, Placed { scale: [0.5, 0.5], offset: [0.0, 0.0], size: [2.0, 1.0] });
        assert_eq!(at.in_picture([-1.0, 1.0, 3.0, 9.0]), [0.0, 0.5, 1.5, 1.0]);
        let (input, at) = placed(Resize::Centre);
        assert_eq!(input[..16], [grey, ramp, ramp, grey].concat());
        assert_eq!(at.in_picture([0.0, 1.0, 4.0, 2.0]), [0.0, 0.0, 2.0, 0.5]);
        let (input, at) = placed(Resize::Stretch);
        assert_eq!(input[..16], [ramp; 4].concat());
        assert_eq!(at.in_picture([0.0, 1.0, 4.0, 2.0]), [0.0, 0.25, 2.0, 0.5]);
        let rgb = card([4, 4], Resize::Corner, Channels::Rgb, 255.0);
        assert_eq!(place(&picture, &rgb).0[..5], [1.0; 5]);
        let normal = Card { mean: [1.0, 2.0, 3.0], std: [2.0, 1.0, 1.0], ..rgb };
        let (input, _) = place(&picture, &normal);
        assert_eq!([input[0], input[15], input[16 + 15], input[32 + 15]], [127.0, 56.5, 112.0, 111.0]);
    }
}
