//! Pictures for people.

use image::RgbImage;
use render::Frame;

use crate::images::colour_image;

/// Depth is known where a pixel's alpha is above this.
const MIN_ALPHA: f32 = 0.5;
/// A drawn picture.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Picture {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Red, green and blue planes, consecutive; sRGB.
    pub colour: Vec<f32>,
    /// Metres along the optical axis, 0 where nothing is; empty unless the options ask for inverse depths.
    pub depth: Vec<f32>,
}

impl Picture {
    /// Of a rendered frame.
    pub fn of(frame: &Frame) -> Self {
        Self { width: frame.width, height: frame.height, colour: frame.colour.clone(), depth: depth_metres(frame) }
    }

    /// In 8 bits.
    pub fn image(&self) -> RgbImage {
        colour_image(&self.colour, self.width, self.height)
    }

    /// Number of pixels.
    pub(crate) fn area(&self) -> usize {
        self.width * self.height
    }

    /// Colour of a plane at a place in pixels, between the four nearest pixels.
    pub(crate) fn at(&self, plane: usize, x: f32, y: f32) -> f32 {
        let clamped = |value: f32, length: usize| value.clamp(0.5, length as f32 - 0.5) - 0.5;
        let (x, y) = (clamped(x, self.width), clamped(y, self.height));
        let (left, top) = (x as usize, y as usize);
        let (right, bottom) = ((left + 1).min(self.width - 1), (top + 1).min(self.height - 1));
        let (across, down) = (x - left as f32, y - top as f32);
        let value = |x: usize, y: usize| self.colour[plane * self.area() + y * self.width + x];
        let row = |y: usize| value(left, y) + across * (value(right, y) - value(left, y));
        row(top) + down * (row(bottom) - row(top))
    }
}

/// Depth of each pixel, metres: the harmonic mean over its splats, as `plat eval --depth` measures it. The mean would put a wall
/// behind which a little of a sky at 1 km shines through metres too far. 0 where alpha is too low; empty without depths.
fn depth_metres(frame: &Frame) -> Vec<f32> {
    let depth = frame.depth.iter().zip(&frame.transmittance);
    let metres = |(inverse, rest): (&f32, &f32)| (1.0 - rest) / inverse.max(f32::MIN_POSITIVE);
    depth.map(|of| if 1.0 - of.1 > MIN_ALPHA { metres(of) } else { 0.0 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_is_the_harmonic_mean_over_alpha() {
        let frame = Frame {
            width: 3,
            height: 1,
            transmittance: vec![0.2, 0.6, 1.0],
            depth: vec![0.08, 0.4, 0.0],
            ..Frame::default()
        };
        assert_eq!(depth_metres(&frame), [10.0, 0.0, 0.0]);
    }
}
