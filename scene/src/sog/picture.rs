//! Pictures of four bytes a pixel, as lossless WebP.

use std::io::Cursor;

use image_webp::{ColorType, WebPDecoder, WebPEncoder};

use crate::error::CodecError;

/// Most bytes that the decoder's tables may take.
const TABLE_BYTES: usize = 16 << 20;

/// A picture, RGBA, row by row.
pub(super) struct Picture {
    width: usize,
    height: usize,
    rgba: Vec<u8>,
}

impl Picture {
    /// A picture of zeros.
    pub(super) fn new(width: usize, height: usize) -> Self {
        Self { width, height, rgba: vec![0; 4 * width * height] }
    }

    /// A picture of `count` pixels and some of zeros behind them, about as wide as high; the width is a multiple of 4.
    pub(super) fn of(count: usize, pixel: impl Fn(usize) -> [u8; 4]) -> Self {
        let width = ((count as f64).sqrt() / 4.0).ceil().max(1.0) as usize * 4;
        let mut picture = Self::new(width, count.div_ceil(width).max(1));
        (0..count).for_each(|i| picture.set(i, pixel(i)));
        picture
    }

    pub(super) fn width(&self) -> usize {
        self.width
    }

    /// Number of pixels.
    pub(super) fn len(&self) -> usize {
        self.width * self.height
    }

    pub(super) fn get(&self, i: usize) -> [u8; 4] {
        [self.rgba[4 * i], self.rgba[4 * i + 1], self.rgba[4 * i + 2], self.rgba[4 * i + 3]]
    }

    pub(super) fn set(&mut self, i: usize, pixel: [u8; 4]) {
        self.rgba[4 * i..4 * i + 4].copy_from_slice(&pixel);
    }

    pub(super) fn encode(&self) -> Result<Vec<u8>, CodecError> {
        let mut bytes = Vec::new();
        let encoder = WebPEncoder::new(&mut bytes);
        let encoded = encoder.encode(&self.rgba, self.width as u32, self.height as u32, ColorType::Rgba8);
        encoded.map_err(|error| CodecError::new(format!("WebP: {error}")))?;
        Ok(bytes)
    }

    /// Decodes a picture of at most this many pixels; its size is known before memory is taken for it.
    ///
    /// # Errors
    /// Not WebP, lossy, damaged, or larger.
    pub(super) fn decode(bytes: &[u8], most: usize) -> Result<Self, CodecError> {
        let bad = |error| CodecError::new(format!("not a WebP picture that can be read ({error})"));
        let mut decoder = WebPDecoder::new(Cursor::new(bytes)).map_err(bad)?;
        decoder.set_memory_limit(TABLE_BYTES);
        if decoder.is_lossy() || decoder.is_animated() {
            return Err(CodecError::new("a WebP picture that is lossy or moves, where numbers were expected"));
        }
        let (width, height) = decoder.dimensions();
        let (width, height) = (width as usize, height as usize);
        let size = decoder.output_buffer_size().filter(|_| width * height <= most);
        let size =
            size.ok_or_else(|| CodecError::new(format!("a WebP picture of {width}×{height} pixels is too large")))?;
        let mut pixels = vec![0; size];
        decoder.read_image(&mut pixels).map_err(bad)?;
        let rgba = match decoder.has_alpha() {
            true => pixels,
            false => {
                let mut rgba = Vec::with_capacity(4 * width * height);
                pixels.as_chunks::<3>().0.iter().for_each(|&[r, g, b]| rgba.extend([r, g, b, 255]));
                rgba
            }
        };
        Ok(Self { width, height, rgba })
    }
}
