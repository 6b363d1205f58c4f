//! Decodes photos and masks from untrusted bytes, with bounded memory.
//!
//! EXIF orientation is not applied: poses and lens models refer to the pixels as they are stored.

use std::io::{BufRead, Cursor, Seek};

use image::{DynamicImage, ImageDecoder, ImageError, ImageReader, ImageResult, Limits};
use scene::CodecError;

/// Memory that a decoder may allocate beyond the pixels, bytes.
const DECODER_BYTES: u64 = 64 << 20;

/// A header may claim `BASE_PIXELS` plus `PIXELS_PER_BYTE` for each byte of the file; photos have over a quarter of a bit per
/// pixel. A larger claim is a decompression bomb: the decoder allocates all pixels first.
const BASE_PIXELS: u64 = 8 << 20;
const PIXELS_PER_BYTE: u64 = 32;

/// The largest file accepted for a photo of this size: 16 bytes per pixel, and room for metadata.
pub(crate) fn max_file_bytes(width: u32, height: u32) -> u64 {
    DECODER_BYTES + 16 * u64::from(width) * u64::from(height)
}

/// What images are decoded from. All decoders are compiled for each type of it, so there is one.
trait Bytes: BufRead + Seek {}
impl<T: BufRead + Seek> Bytes for T {}

/// Width and height from an image's header. No pixel is decoded.
///
/// # Errors
/// Not an image, or one whose header needs too much memory.
pub(crate) fn size(mut file: impl BufRead + Seek) -> ImageResult<(u32, u32)> {
    let mut reader = ImageReader::new(&mut file as &mut dyn Bytes).with_guessed_format()?;
    let mut limits = Limits::default();
    limits.max_alloc = Some(DECODER_BYTES);
    reader.limits(limits);
    reader.into_dimensions()
}

/// A decoded photo, still distorted.
#[derive(Debug)]
pub(crate) struct DecodedPhoto {
    /// Interleaved red, green and blue.
    pub(crate) rgb: Vec<u8>,
    /// From the alpha channel: 255 is usable, 0 is excluded. `None` without transparent pixels.
    pub(crate) mask: Option<Vec<u8>>,
}

/// Decodes JPEG, PNG, WebP or TIFF; the content decides which. An alpha channel with transparent pixels becomes the mask:
/// pixels of alpha 128 or more are usable.
///
/// # Errors
/// Another format, another size than its camera's, damaged or truncated.
pub(crate) fn decode(bytes: &[u8], width: u32, height: u32) -> Result<DecodedPhoto, CodecError> {
    if u64::from(width) * u64::from(height) > BASE_PIXELS + PIXELS_PER_BYTE * bytes.len() as u64 {
        let length = bytes.len();
        return Err(CodecError::new(format!("claims {width}×{height} pixels, which {length} bytes cannot hold")));
    }
    let image = open(bytes, width, height)?;
    if !image.color().has_alpha() {
        return Ok(DecodedPhoto { rgb: image.into_rgb8().into_raw(), mask: None });
    }
    let rgba = image.into_rgba8();
    let usable: Vec<u8> = rgba.chunks_exact(4).map(|p| if p[3] < 128 { 0 } else { 255 }).collect();
    let rgb = rgba.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
    Ok(DecodedPhoto { rgb, mask: usable.contains(&0).then_some(usable) })
}

/// Decodes a mask of the photo's size: luma of 128 or more is usable (255), the rest is excluded (0).
///
/// # Errors
/// As [`decode`].
pub(crate) fn decode_mask(bytes: &[u8], width: u32, height: u32) -> Result<Vec<u8>, CodecError> {
    let luma = open(bytes, width, height)?.into_luma8();
    Ok(luma.iter().map(|&v| if v < 128 { 0 } else { 255 }).collect())
}

/// Converts interleaved pixels to planes: all red, all green, all blue.
pub(crate) fn planes(rgb: &[u8]) -> Vec<u8> {
    let mut planes = vec![0u8; rgb.len()];
    let (red, rest) = planes.split_at_mut(rgb.len() / 3);
    let (green, blue) = rest.split_at_mut(rgb.len() / 3);
    for (((pixel, r), g), b) in rgb.chunks_exact(3).zip(red).zip(green).zip(blue) {
        (*r, *g, *b) = (pixel[0], pixel[1], pixel[2]);
    }
    planes
}

/// Decodes an image of this size.
///
/// # Errors
/// As [`decode`].
pub(crate) fn open(bytes: &[u8], width: u32, height: u32) -> Result<DynamicImage, CodecError> {
    let mut limits = Limits::default();
    limits.max_alloc = Some(DECODER_BYTES + 8 * u64::from(width) * u64::from(height));
    let mut cursor = Cursor::new(bytes);
    let reader = ImageReader::new(&mut cursor as &mut dyn Bytes).with_guessed_format();
    let mut reader = reader.map_err(|e| damaged(&e))?;
    if reader.format().is_none() {
        return Err(CodecError::new("is not a JPEG, PNG, WebP or TIFF image"));
    }
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(|e| failed(&e))?;
    let (w, h) = decoder.dimensions();
    if (w, h) != (width, height) {
        return Err(CodecError::new(format!("has {w}×{h} pixels where its camera has {width}×{height}")));
    }
    if is_truncated_jpeg(bytes) {
        return Err(CodecError::new("is a JPEG that is cut short"));
    }
    DynamicImage::from_decoder(decoder).map_err(|e| failed(&e))
}

fn failed(error: &ImageError) -> CodecError {
    match error {
        ImageError::Limits(_) => CodecError::new("needs far more memory than a photo of its camera"),
        ImageError::Unsupported(_) => CodecError::new(format!("has an unsupported format ({})", line(error))),
        other => damaged(other),
    }
}

fn damaged(error: &dyn std::error::Error) -> CodecError {
    CodecError::new(format!("is damaged or cut short ({})", line(error)))
}

fn line(error: &dyn std::error::Error) -> String {
    error.to_string().split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Whether a JPEG lacks an end-of-image marker after its first scan. The decoder would fill the rest with grey.
fn is_truncated_jpeg(bytes: &[u8]) -> bool {
    if !bytes.starts_with(&[0xff, 0xd8]) {
        return false;
    }
    let mut at = 2;
    // Skips the segments before the scan (marker, then a length that includes itself): a thumbnail in one of them has an
    // end-of-image marker of its own.
    while let Some(&[marker, kind, high, low]) = bytes.get(at..at + 4) {
        match (marker, kind) {
            (0xff, 0xff) => at += 1,
            (0xff, 0xda) => return !bytes[at..].windows(2).any(|pair| pair == [0xff, 0xd9]),
            (0xff, _) => at += 2 + usize::from(u16::from_be_bytes([high, low])),
            _ => return false,
        }
    }
    true
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use image::{ImageFormat, Rgb, RgbImage, Rgba, RgbaImage};

    pub(crate) fn texture(width: u32, height: u32) -> RgbImage {
        RgbImage::from_fn(width, height, |x, y| Rgb([(x * 5 % 256) as u8, (y * 3 % 256) as u8, ((x ^ y) % 256) as u8]))
    }

    pub(crate) fn encoded(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        image.into().write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    }

    #[test]
    fn lossless_formats_decode_to_the_same_pixels() {
        let image = texture(40, 30);
        for format in [ImageFormat::Png, ImageFormat::Tiff, ImageFormat::WebP] {
            let pixels = decode(&encoded(image.clone(), format), 40, 30).unwrap();
            assert_eq!((&pixels.rgb, pixels.mask), (image.as_raw(), None));
            let planes = planes(&pixels.rgb);
            for (i, pixel) in image.pixels().enumerate() {
                assert_eq!([planes[i], planes[1200 + i], planes[2400 + i]], pixel.0);
            }
        }
        let grey = decode(&encoded(DynamicImage::from(image).to_luma8(), ImageFormat::Png), 40, 30).unwrap();
        assert!(grey.rgb.chunks(3).all(|p| p[0] == p[1] && p[1] == p[2]));
    }

    #[test]
    fn alpha_becomes_a_mask_only_with_transparent_pixels() {
        let alpha = |low: u8| RgbaImage::from_fn(4, 4, |x, _| Rgba([1, 2, 3, if x == 1 { low } else { 255 }]));
        let mask = |low| decode(&encoded(alpha(low), ImageFormat::Png), 4, 4).unwrap().mask;
        assert_eq!(mask(255), None);
        assert_eq!(mask(0).unwrap()[..4], [255, 0, 255, 255]);
        let file = encoded(alpha(0), ImageFormat::Png);
        assert_eq!(decode_mask(&file, 4, 4).unwrap(), [0; 16], "a mask file is thresholded by luma");
    }

    #[test]
    fn truncated_and_other_files_are_refused() {
        for format in [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::Tiff, ImageFormat::WebP] {
            let bytes = encoded(texture(200, 100), format);
            decode(&bytes, 200, 100).unwrap();
            for cut in [0, 1, 3, 20, bytes.len() / 2, bytes.len() * 9 / 10] {
                assert!(decode(&bytes[..cut], 200, 100).is_err(), "{format:?} cut at {cut}");
            }
            let wrong = decode(&bytes, 100, 200).unwrap_err().to_string();
            assert!(wrong.contains("has 200×100 pixels where its camera has 100×200"), "{wrong}");
        }
        let text = decode(b"just some text, which is no image", 10, 10).unwrap_err().to_string();
        assert!(text.contains("is not a JPEG"), "{text}");
    }

    #[test]
    fn a_decompression_bomb_is_refused_by_its_header() {
        let mut bytes = encoded(texture(10, 10), ImageFormat::Png);
        bytes[16..24].copy_from_slice(&[0, 0, 0xff, 0xff, 0, 0, 0xff, 0xff]);
        assert!(decode(&bytes, 10, 10).is_err());
        // Also where the camera has the size that the header claims, as in captures that give no size.
        bytes[16..24].copy_from_slice(&[0, 0, 0x3f, 0xff, 0, 0, 0x3f, 0xff]);
        let refused = decode(&bytes, 0x3fff, 0x3fff).unwrap_err().to_string();
        assert!(refused.contains("claims 16383×16383 pixels"), "{refused}");
    }
}
