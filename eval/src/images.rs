//! 8-bit pictures of frames and photos, and PNG files of them.

use std::io::Cursor;
use std::path::Path;

use image::{ImageFormat, Rgb, RgbImage};
use rayon::prelude::*;
use render::Frame;
use scene::Pixels;
use store::file::{SaveError, save};

/// A frame's colours, rounded to 8 bits.
pub fn frame_image(frame: &Frame) -> RgbImage {
    colour_image(&frame.colour, frame.width, frame.height)
}

/// Three planes of sRGB values, clamped to 0..1 and rounded to 8 bits.
pub(crate) fn colour_image(colour: &[f32], width: usize, height: usize) -> RgbImage {
    let area = width * height;
    // Rounding by a half and a cut, which take an instruction each; round() is a call on most machines.
    let byte = |value: f32| (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    let mut bytes = vec![0; 3 * area];
    bytes.par_chunks_mut(3 * width.max(1)).enumerate().for_each(|(y, row)| {
        let planes = [0, 1, 2].map(|channel| &colour[channel * area + y * width..][..width]);
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            (0..3).for_each(|channel| pixel[channel] = byte(planes[channel][x]));
        }
    });
    RgbImage::from_raw(width as u32, height as u32, bytes).expect("three bytes for each pixel")
}

/// A photo as a picture.
pub fn photo_image(photo: &Pixels) -> RgbImage {
    let area = photo.area();
    RgbImage::from_fn(photo.width, photo.height, |x, y| {
        let at = y as usize * photo.width as usize + x as usize;
        Rgb([photo.rgb[at], photo.rgb[area + at], photo.rgb[2 * area + at]])
    })
}

/// Writes an 8-bit PNG.
///
/// # Errors
/// A file that cannot be written.
pub fn write_png(path: &Path, image: &RgbImage) -> Result<(), SaveError> {
    let mut png = Cursor::new(Vec::new());
    image.write_to(&mut png, ImageFormat::Png).map_err(|error| SaveError::new(path, &error))?;
    save(path, png.get_ref())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_png_can_be_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("picture.png");
        let picture = RgbImage::from_fn(7, 5, |x, y| Rgb([x as u8 * 30, y as u8 * 40, 200]));
        write_png(&path, &picture).unwrap();
        assert_eq!(image::open(&path).unwrap().to_rgb8(), picture);
        assert!(write_png(&folder.path().join("no/such.png"), &picture).is_err());
    }
}
