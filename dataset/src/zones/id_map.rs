//! Pictures whose pixels are ids.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use png::{BitDepth, ColorType, Decoder, Limits, Transformations};
use scene::{BadInput, MaskBuilder, Pinhole, ZoneMask, Zones};

use crate::undistortion::Undistorter;

/// Memory of the decoder beyond the pixels, bytes.
const DECODER_BYTES: usize = 64 << 20;

/// The ids of a picture's pixels, by rows.
pub(super) struct IdMap {
    path: PathBuf,
    width: u32,
    ids: Vec<u32>,
}

impl IdMap {
    /// Reads a PNG of this size: 8 or 16 bits of grey, the numbers of a palette's colours, or 24 bits, the low ones red,
    /// as in COCO's panoptic labels.
    ///
    /// # Errors
    /// Not such a file, damaged, or of another size.
    pub(super) fn read(path: &Path, [width, height]: [u32; 2]) -> Result<Self, BadInput> {
        let bad = |problem: String| {
            BadInput::new(path.display().to_string(), problem, "give a PNG of 8 or 16-bit ids, as large as its photo")
        };
        let damaged = |error: png::DecodingError| {
            let line: Vec<String> = error.to_string().split_whitespace().map(str::to_owned).collect();
            bad(format!("is no PNG that can be read ({})", line.join(" ")))
        };
        let file = File::open(path).map_err(|error| bad(format!("cannot be read ({error})")))?;
        let mut decoder = Decoder::new_with_limits(BufReader::new(file), Limits { bytes: DECODER_BYTES });
        decoder.set_transformations(Transformations::IDENTITY);
        let mut reader = decoder.read_info().map_err(damaged)?;
        let (colour, depth) = (reader.info().color_type, reader.info().bit_depth);
        let size = reader.info().size();
        if size != (width, height) {
            return Err(bad(format!("has {}×{} pixels, its photo {width}×{height}", size.0, size.1)));
        }
        let read: fn(&[u8]) -> u32 = match (colour, depth) {
            (ColorType::Grayscale | ColorType::Indexed, BitDepth::Eight) => |bytes| u32::from(bytes[0]),
            (ColorType::Grayscale, BitDepth::Sixteen) => |bytes| u32::from(u16::from_be_bytes([bytes[0], bytes[1]])),
            (ColorType::Rgb, BitDepth::Eight) => |bytes| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], 0]),
            _ => return Err(bad(format!("has pixels of {depth:?} bits and kind {colour:?}"))),
        };
        let length = colour.samples() * if depth == BitDepth::Sixteen { 2 } else { 1 };
        // The size is that of a photo, which ingest holds several times as large.
        let mut bytes = vec![0; length * width as usize * height as usize];
        reader.next_frame(&mut bytes).map_err(damaged)?;
        Ok(Self { path: path.to_path_buf(), width, ids: bytes.chunks_exact(length).map(read).collect() })
    }

    /// As the ideal pinhole sees it.
    pub(super) fn undistorted(self, undistorter: &Undistorter) -> Self {
        if undistorter.is_identity() {
            return self;
        }
        Self { width: undistorter.pinhole().width, ids: undistorter.nearest(&self.ids), ..self }
    }

    /// For each id of an object its pixels in an ingested photo, which has one N-th of this picture's size, and their
    /// bounds.
    ///
    /// # Errors
    /// More than [`Zones::MAX`] objects.
    pub(super) fn masks(
        &self,
        ingested: &Pinhole,
        is_object: impl Fn(u32) -> bool,
    ) -> Result<BTreeMap<u32, (ZoneMask, [f32; 4])>, BadInput> {
        let (width, height) = (ingested.width, ingested.height);
        let n = (self.width / width.max(1)).max(1);
        let mut builders: BTreeMap<u32, MaskBuilder> = BTreeMap::new();
        for y in 0..height {
            // The pixel in the middle of the N × N.
            let row = (y * n + n / 2) as usize * self.width as usize;
            let id_at = |x: u32| self.ids.get(row + (x * n + n / 2) as usize).copied().unwrap_or_default();
            let mut start = 0;
            while start < width {
                let id = id_at(start);
                let end = (start + 1..width).find(|&x| id_at(x) != id).unwrap_or(width);
                if is_object(id) {
                    builders.entry(id).or_insert_with(|| MaskBuilder::new(width)).push(y, start..end);
                    if builders.len() > Zones::MAX {
                        let problem = format!("has more than {} objects", Zones::MAX);
                        let advice = "name fewer classes as objects, or merge them";
                        return Err(BadInput::new(self.path.display().to_string(), problem, advice));
                    }
                }
                start = end;
            }
        }
        Ok(builders.into_iter().filter_map(|(id, builder)| Some((id, builder.finish()?))).collect())
    }
}

#[cfg(test)]
mod tests {
    use image::{ColorType as Kind, ImageBuffer, Luma, RgbImage};

    use super::*;

    fn pinhole(width: u32, height: u32) -> Pinhole {
        Pinhole { width, height, fx: 9.0, fy: 9.0, cx: 4.0, cy: 2.0 }
    }

    #[test]
    fn ids_are_read_from_grey_palettes_and_24_bits() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let ids = |x: u32, y: u32| 7 * y + x;
        let expected: Vec<u32> = (0..3).flat_map(|y| (0..4).map(move |x| ids(x, y))).collect();
        let read = || IdMap::read(&path, [4, 3]).unwrap().ids;
        ImageBuffer::from_fn(4, 3, |x, y| Luma([ids(x, y) as u8])).save(&path).unwrap();
        assert_eq!(read(), expected);
        ImageBuffer::from_fn(4, 3, |x, y| Luma([1000 * ids(x, y) as u16])).save(&path).unwrap();
        assert_eq!(read(), expected.iter().map(|id| 1000 * id).collect::<Vec<_>>());
        RgbImage::from_fn(4, 3, |x, y| image::Rgb([ids(x, y) as u8, 1, 2])).save(&path).unwrap();
        assert_eq!(read(), expected.iter().map(|id| id + 256 + (2 << 16)).collect::<Vec<_>>());
        let mut encoder = png::Encoder::new(File::create(&path).unwrap(), 4, 3);
        encoder.set_color(ColorType::Indexed);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_palette(vec![9u8; 3 * 32]);
        let bytes: Vec<u8> = expected.iter().map(|id| *id as u8).collect();
        encoder.write_header().unwrap().write_image_data(&bytes).unwrap();
        assert_eq!(read(), expected);

        let refused = |size, says: &str| {
            let line = IdMap::read(&path, size).err().unwrap().to_string();
            assert!(line.contains(says) && line.contains("a.png"), "{line}");
        };
        refused([3, 4], "has 4×3 pixels, its photo 3×4");
        image::save_buffer(&path, &[0; 48], 4, 3, Kind::Rgba8).unwrap();
        refused([4, 3], "Rgba");
        std::fs::write(&path, &std::fs::read(&path).unwrap()[..40]).unwrap();
        refused([4, 3], "no PNG");
        std::fs::remove_file(&path).unwrap();
        refused([4, 3], "cannot be read");
    }

    #[test]
    fn every_object_gets_its_pixels() {
        let row = |text: &str| text.bytes().map(|letter| u32::from(letter - b'0')).collect::<Vec<_>>();
        let ids = ["00110220", "01110220", "00000000", "00030303"].iter().flat_map(|text| row(text)).collect();
        let map = IdMap { path: PathBuf::from("a.png"), width: 8, ids };
        let masks = map.masks(&pinhole(8, 4), |id| id > 0).unwrap();
        let shown = |of: &(ZoneMask, [f32; 4])| (of.0.area(), of.1);
        let found: Vec<_> = masks.values().map(shown).collect();
        assert_eq!(found[..2], [(5, [1.0, 0.0, 4.0, 2.0]), (4, [5.0, 0.0, 7.0, 2.0])]);
        assert_eq!(found[2..], [(3, [3.0, 3.0, 8.0, 4.0])]);
        // At half the size, the pixels at odd columns of odd rows.
        let half = map.masks(&pinhole(4, 2), |id| id > 0).unwrap();
        assert_eq!(half.iter().map(|(id, of)| (*id, of.0.area())).collect::<Vec<_>>(), [(1, 2), (2, 1), (3, 3)]);
        assert!(map.masks(&pinhole(8, 4), |id| id == 9).unwrap().is_empty());

        let many = IdMap { path: PathBuf::from("a.png"), width: 2000, ids: (0..2000).collect() };
        let line = many.masks(&pinhole(2000, 1), |_| true).unwrap_err().to_string();
        assert!(line.contains("more than 1000 objects"), "{line}");
    }
}
