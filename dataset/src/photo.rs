//! A photo's bytes to pixels, with nothing believed that the bytes say of themselves.
//!
//! EXIF orientation is not applied: poses and lens models refer to the pixels as they are stored.

use std::io::{BufRead, Cursor, Seek};

use image::{DynamicImage, ImageDecoder, ImageError, ImageReader, ImageResult, Limits};
use scene::CodecError;

/// What a decoder may allocate beyond the pixels.
const DECODER_BYTES: u64 = 64 << 20;

/// Pixels that any file may claim, and how many more for each of its bytes: photos have over a quarter of a bit for each
/// pixel. More is a decompression bomb, or a header that lies: pixels are allocated before the first is decoded.
const FREE_PIXELS: u64 = 8 << 20;
const PIXELS_PER_BYTE: u64 = 32;

/// The largest file that can be a photo of this size: 16 bytes a pixel, and room for what cameras append.
pub(crate) fn file_limit(width: u32, height: u32) -> u64 {
    DECODER_BYTES + 16 * u64::from(width) * u64::from(height)
}

/// Width and height as an image's header says; no pixel is decoded.
///
/// # Errors
/// Not an image, or one whose header takes more memory than any photo's.
pub(crate) fn size(file: impl BufRead + Seek) -> ImageResult<(u32, u32)> {
    let mut reader = ImageReader::new(file).with_guessed_format()?;
    let mut limits = Limits::default();
    limits.max_alloc = Some(DECODER_BYTES);
    reader.limits(limits);
    reader.into_dimensions()
}

/// A photo as its file has it.
#[derive(Debug)]
pub(crate) struct Photograph {
    /// Red, green, blue of each pixel.
    pub(crate) rgb: Vec<u8>,
    /// 255 = use, 0 = leave out, where the file is transparent anywhere.
    pub(crate) mask: Option<Vec<u8>>,
}

/// Decodes JPEG, PNG, WebP or TIFF, told apart by content. An alpha channel with transparent pixels becomes the mask:
/// at least half opaque is usable.
///
/// # Errors
/// Not such an image, of another size than its camera's, damaged or cut short.
pub(crate) fn decode(bytes: &[u8], width: u32, height: u32) -> Result<Photograph, CodecError> {
    if u64::from(width) * u64::from(height) > FREE_PIXELS + PIXELS_PER_BYTE * bytes.len() as u64 {
        let length = bytes.len();
        return Err(CodecError::new(format!("claims {width}×{height} pixels, which {length} bytes cannot hold")));
    }
    let image = open(bytes, width, height)?;
    if !image.color().has_alpha() {
        return Ok(Photograph { rgb: image.into_rgb8().into_raw(), mask: None });
    }
    let rgba = image.into_rgba8();
    let usable: Vec<u8> = rgba.chunks_exact(4).map(|p| if p[3] < 128 { 0 } else { 255 }).collect();
    let rgb = rgba.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
    Ok(Photograph { rgb, mask: usable.contains(&0).then_some(usable) })
}

/// Decodes a mask of the photo's size: brighter than half is usable (255), the rest is left out (0).
///
/// # Errors
/// As [`decode`].
pub(crate) fn decode_mask(bytes: &[u8], width: u32, height: u32) -> Result<Vec<u8>, CodecError> {
    let luma = open(bytes, width, height)?.into_luma8();
    Ok(luma.iter().map(|&v| if v < 128 { 0 } else { 255 }).collect())
}

/// Planes from interleaved pixels: all red, all green, all blue.
pub(crate) fn planes(rgb: &[u8]) -> Vec<u8> {
    let mut planes = vec![0u8; rgb.len()];
    let (red, rest) = planes.split_at_mut(rgb.len() / 3);
    let (green, blue) = rest.split_at_mut(rgb.len() / 3);
    for (((pixel, r), g), b) in rgb.chunks_exact(3).zip(red).zip(green).zip(blue) {
        (*r, *g, *b) = (pixel[0], pixel[1], pixel[2]);
    }
    planes
}

fn open(bytes: &[u8], width: u32, height: u32) -> Result<DynamicImage, CodecError> {
    let mut limits = Limits::default();
    limits.max_alloc = Some(DECODER_BYTES + 8 * u64::from(width) * u64::from(height));
    let mut reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|e| damaged(&e))?;
    if reader.format().is_none() {
        return Err(CodecError::new("is not a JPEG, PNG, WebP or TIFF image"));
    }
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(|e| failed(&e))?;
    let (w, h) = decoder.dimensions();
    if (w, h) != (width, height) {
        return Err(CodecError::new(format!("has {w}×{h} pixels where its camera has {width}×{height}")));
    }
    if jpeg_is_cut(bytes) {
        return Err(CodecError::new("is a JPEG that is cut short"));
    }
    DynamicImage::from_decoder(decoder).map_err(|e| failed(&e))
}

fn failed(error: &ImageError) -> CodecError {
    match error {
        ImageError::Limits(_) => CodecError::new("needs far more memory than a photo of its camera"),
        ImageError::Unsupported(_) => CodecError::new(format!("is of a kind that is not read ({})", line(error))),
        other => damaged(other),
    }
}

fn damaged(error: &dyn std::error::Error) -> CodecError {
    CodecError::new(format!("is damaged or cut short ({})", line(error)))
}

fn line(error: &dyn std::error::Error) -> String {
    error.to_string().split_whitespace().collect::<Vec<_>>().join(" ")
}

/// A JPEG without an end-of-image marker after its first scan. The decoder would fill the rest with grey.
fn jpeg_is_cut(bytes: &[u8]) -> bool {
    if !bytes.starts_with(&[0xff, 0xd8]) {
        return false;
    }
    let mut at = 2;
    // Segments before the scan: marker, then a length that counts itself. Thumbnails hide in them.
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
    fn lossless_formats_give_the_pixels() {
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
    fn alpha_is_a_mask_only_where_something_is_transparent() {
        let alpha = |low: u8| RgbaImage::from_fn(4, 4, |x, _| Rgba([1, 2, 3, if x == 1 { low } else { 255 }]));
        let mask = |low| decode(&encoded(alpha(low), ImageFormat::Png), 4, 4).unwrap().mask;
        assert_eq!(mask(255), None);
        assert_eq!(mask(0).unwrap()[..4], [255, 0, 255, 255]);
        let file = encoded(alpha(0), ImageFormat::Png);
        assert_eq!(decode_mask(&file, 4, 4).unwrap(), [0; 16], "a mask file goes by brightness");
    }

    #[test]
    fn what_is_cut_or_something_else_is_refused() {
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
    fn a_bomb_is_refused_by_its_header() {
        let mut bytes = encoded(texture(10, 10), ImageFormat::Png);
        bytes[16..24].copy_from_slice(&[0, 0, 0xff, 0xff, 0, 0, 0xff, 0xff]);
        assert!(decode(&bytes, 10, 10).is_err());
        // As large as its camera, who believes the header where the capture says no size: still not allocated.
        bytes[16..24].copy_from_slice(&[0, 0, 0x3f, 0xff, 0, 0, 0x3f, 0xff]);
        let refused = decode(&bytes, 0x3fff, 0x3fff).unwrap_err().to_string();
        assert!(refused.contains("claims 16383×16383 pixels"), "{refused}");
    }
}
