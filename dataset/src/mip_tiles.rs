//! The artefact of one mip: an index and compressed tiles, so that a window is read without the rest.
//!
//! MipLayout, little endian:
//!
//! ```text
//! "plat" "mip2"  width u32  height u32  planes u32 (3, or 4 with a mask)
//! end of each tile's bytes, counted from the first tile's start, u32 each, in row order
//! first 16 bytes of the BLAKE3 hash of all of the above
//! the tiles: 64 × 64 pixels, smaller at the right and bottom
//! ```
//!
//! The size of the image gives the length of the index, so a window takes two reads: the index, and the ranges of its tiles,
//! which the store coalesces. A tile is a zstd frame (level 1, with its checksum) of the planes G, R-G, B-G and the mask, each
//! byte minus the one above it: 0.20 to 0.45 of the raw size, decoded at about 0.5 GB/s per core. Tiles of 64 decode at half
//! the speed of tiles of 128, but the windows of a city's blocks then read 1.35 to 1.54 times the bytes that they use instead of 1.7.

use std::ops::Range;

use scene::{CodecError, Pixels, Rect};

/// Edge of a tile in pixels.
pub const TILE: u32 = 64;
/// The largest image: 268 million pixels, so that the ends of tiles fit 32 bits.
pub const MAX_PIXELS: u64 = 1 << 28;

const MAGIC: &[u8; 8] = b"platmip2";
const HEADER_BYTES: usize = 20;
const CHECKSUM_BYTES: usize = 16;
const ZSTD_LEVEL: i32 = 1;

/// Encodes one mip as an artefact.
///
/// # Errors
/// More than [`MAX_PIXELS`] pixels, or none.
pub fn encode(pixels: &Pixels) -> Result<Vec<u8>, CodecError> {
    let layout = MipLayout { width: pixels.width, height: pixels.height, masked: pixels.mask.is_some() };
    layout.check()?;
    let mut bytes = Vec::with_capacity(layout.index_len() + pixels.rgb.len() / 2);
    bytes.extend_from_slice(MAGIC);
    for word in [layout.width, layout.height, layout.planes() as u32] {
        bytes.extend_from_slice(&word.to_le_bytes());
    }
    bytes.resize(layout.index_len(), 0);
    let failed = |error: std::io::Error| CodecError::new(format!("a tile does not compress: {error}"));
    let mut zstd = zstd::bulk::Compressor::new(ZSTD_LEVEL).map_err(failed)?;
    zstd.include_checksum(true).map_err(failed)?;
    let mut tile = Vec::new();
    for i in 0..layout.tiles() {
        layout.filter(pixels, layout.tile(i), &mut tile);
        bytes.extend_from_slice(&zstd.compress(&tile).map_err(failed)?);
        let end = u32::try_from(bytes.len() - layout.index_len()).expect("tiles of MAX_PIXELS pixels fit 32 bits");
        bytes[HEADER_BYTES + 4 * i..][..4].copy_from_slice(&end.to_le_bytes());
    }
    let check = layout.index_len() - CHECKSUM_BYTES;
    let hash = *blake3::hash(&bytes[..check]).as_bytes();
    bytes[check..layout.index_len()].copy_from_slice(&hash[..CHECKSUM_BYTES]);
    Ok(bytes)
}

/// Size and planes of a mip, known before its artefact is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MipLayout {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Whether it has a mask plane.
    pub masked: bool,
}

impl MipLayout {
    /// Length of the index at the start of the artefact, bytes.
    pub fn index_len(&self) -> usize {
        HEADER_BYTES + 4 * self.tiles() + CHECKSUM_BYTES
    }

    /// Decodes the index from the first [`index_len`](Self::index_len) bytes of the artefact.
    ///
    /// # Errors
    /// Damaged, or the index of a mip of another layout.
    pub fn index(self, bytes: &[u8]) -> Result<TileIndex, CodecError> {
        self.check()?;
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
        if bytes.len() != self.index_len() || &bytes[..8] != MAGIC {
            return Err(CodecError::new("not a mip, or one of another size or version"));
        }
        if [word(8), word(12), word(16)] != [self.width, self.height, self.planes() as u32] {
            return Err(CodecError::new("a mip of another size, or with a mask where none is expected"));
        }
        let (index, check) = bytes.split_at(bytes.len() - CHECKSUM_BYTES);
        if check != &blake3::hash(index).as_bytes()[..CHECKSUM_BYTES] {
            return Err(CodecError::new("the index of the mip fails its checksum"));
        }
        let ends: Vec<u32> = (0..self.tiles()).map(|i| word(HEADER_BYTES + 4 * i)).collect();
        let start = |i: usize| if i == 0 { 0 } else { ends[i - 1] };
        let max_len = |i: usize| zstd::zstd_safe::compress_bound(self.tile_bytes(self.tile(i))) as u64 + 64;
        let is_valid = |i: usize| ends[i] > start(i) && u64::from(ends[i] - start(i)) <= max_len(i);
        if !(0..ends.len()).all(is_valid) {
            return Err(CodecError::new("the tiles of the mip overlap or are too long"));
        }
        Ok(TileIndex { layout: self, ends })
    }

    fn check(&self) -> Result<(), CodecError> {
        let area = u64::from(self.width) * u64::from(self.height);
        if area == 0 || area > MAX_PIXELS {
            let (w, h) = (self.width, self.height);
            return Err(CodecError::new(format!(
                "an image of {w}×{h} pixels is empty or has over {MAX_PIXELS} pixels"
            )));
        }
        Ok(())
    }

    fn planes(&self) -> usize {
        3 + usize::from(self.masked)
    }

    fn columns(&self) -> usize {
        self.width.div_ceil(TILE) as usize
    }

    fn tiles(&self) -> usize {
        self.columns() * self.height.div_ceil(TILE) as usize
    }

    fn tile_bytes(&self, tile: Rect) -> usize {
        tile.area() as usize * self.planes()
    }

    fn tile(&self, i: usize) -> Rect {
        let (x, y) = ((i % self.columns()) as u32 * TILE, (i / self.columns()) as u32 * TILE);
        Rect { x, y, width: TILE.min(self.width - x), height: TILE.min(self.height - y) }
    }

    /// The tiles that a rectangle inside the image intersects: `(first, last)` of each row of tiles.
    fn tile_rows(&self, rect: Rect) -> impl Iterator<Item = (usize, usize)> + use<> {
        let (columns, last) = (self.columns(), ((rect.x + rect.width - 1) / TILE) as usize);
        let rows = (rect.y / TILE) as usize..=((rect.y + rect.height - 1) / TILE) as usize;
        rows.map(move |row| (row * columns + (rect.x / TILE) as usize, row * columns + last))
    }

    /// Filters the planes of a tile for compression: red and blue minus green, then each byte minus the one above.
    fn filter(&self, pixels: &Pixels, tile: Rect, out: &mut Vec<u8>) {
        out.clear();
        let mut planes = pixels.rgb.chunks_exact(pixels.area());
        let [red, green, blue] = [(); 3].map(|()| planes.next().expect("an image has three planes"));
        for plane in [green, red, blue].into_iter().chain(pixels.mask.as_deref()) {
            for y in tile.y..tile.y + tile.height {
                let start = y as usize * self.width as usize + tile.x as usize;
                out.extend_from_slice(&plane[start..start + tile.width as usize]);
            }
        }
        let (green, others) = out.split_at_mut(tile.area() as usize);
        for plane in others.chunks_exact_mut(green.len()).take(2) {
            plane.iter_mut().zip(&*green).for_each(|(v, &g)| *v = v.wrapping_sub(g));
        }
        let width = tile.width as usize;
        for plane in out.chunks_exact_mut(tile.area() as usize) {
            for y in (1..tile.height as usize).rev() {
                let (above, row) = plane[(y - 1) * width..][..2 * width].split_at_mut(width);
                row.iter_mut().zip(above).for_each(|(v, a)| *v = v.wrapping_sub(*a));
            }
        }
    }

    /// Inverse of [`MipLayout::filter`]. The planes are green, red, blue, mask.
    fn unfilter(&self, tile: Rect, planes: &mut [u8]) {
        let width = tile.width as usize;
        for plane in planes.chunks_exact_mut(tile.area() as usize) {
            for y in 1..tile.height as usize {
                let (above, row) = plane[(y - 1) * width..][..2 * width].split_at_mut(width);
                row.iter_mut().zip(above).for_each(|(v, a)| *v = v.wrapping_add(*a));
            }
        }
        let (green, others) = planes.split_at_mut(tile.area() as usize);
        for plane in others.chunks_exact_mut(green.len()).take(2) {
            plane.iter_mut().zip(&*green).for_each(|(v, &g)| *v = v.wrapping_add(g));
        }
    }
}

/// The byte ranges of the tiles of a mip's artefact.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TileIndex {
    layout: MipLayout,
    ends: Vec<u32>,
}

impl TileIndex {
    /// Approximate size in memory, bytes.
    pub fn memory_bytes(&self) -> usize {
        4 * self.ends.len() + 64
    }

    /// The byte ranges of the artefact that hold a window's tiles, in the order that [`TileIndex::window`] takes them. Ranges of
    /// neighbouring tiles are adjacent. `None` for a window that is empty or not inside the image.
    pub fn ranges(&self, rect: Rect) -> Option<Vec<Range<u64>>> {
        let fits = |from: u32, len: u32, side: u32| len > 0 && from.checked_add(len).is_some_and(|end| end <= side);
        if !fits(rect.x, rect.width, self.layout.width) || !fits(rect.y, rect.height, self.layout.height) {
            return None;
        }
        Some(self.tiles(rect).map(|i| self.tile_range(i)).collect())
    }

    /// The share of its tiles' compressed bytes that a window inside the image uses, by area.
    pub fn used_bytes(&self, rect: Rect) -> u64 {
        let share = |i: usize| {
            let (tile, range) = (self.layout.tile(i), self.tile_range(i));
            let overlap = |a: u32, n: u32, b: u32, m: u32| u64::from((a + n).min(b + m).saturating_sub(a.max(b)));
            let area =
                overlap(tile.x, tile.width, rect.x, rect.width) * overlap(tile.y, tile.height, rect.y, rect.height);
            (range.end - range.start) * area / tile.area()
        };
        self.tiles(rect).map(share).sum()
    }

    /// Decodes a window from the bytes of its [`TileIndex::ranges`].
    ///
    /// # Errors
    /// Damaged or missing bytes.
    pub fn window(&self, rect: Rect, parts: &[impl AsRef<[u8]>]) -> Result<Pixels, CodecError> {
        let damaged = || CodecError::new("a tile of the mip is missing or damaged");
        let area = rect.area() as usize;
        let ranges = self.ranges(rect).ok_or_else(|| CodecError::new("the window is not inside the image"))?;
        if parts.len() != ranges.len() {
            return Err(damaged());
        }
        let mut planes = vec![0u8; area * self.layout.planes()];
        let mut zstd = zstd::bulk::Decompressor::new().map_err(|_| damaged())?;
        let mut tile_bytes = Vec::new();
        for (i, part) in self.tiles(rect).zip(parts) {
            let tile = self.layout.tile(i);
            tile_bytes.resize(self.layout.tile_bytes(tile), 0);
            let written = zstd.decompress_to_buffer(part.as_ref(), &mut tile_bytes[..]).map_err(|_| damaged())?;
            if written != tile_bytes.len() {
                return Err(damaged());
            }
            self.layout.unfilter(tile, &mut tile_bytes);
            copy_overlap(&tile_bytes, tile, &mut planes, rect);
        }
        let mask = self.layout.masked.then(|| planes.split_off(3 * area));
        Ok(Pixels { width: rect.width, height: rect.height, rgb: planes, mask, ..Pixels::default() })
    }

    /// The tiles that a window inside the image intersects.
    fn tiles(&self, rect: Rect) -> impl Iterator<Item = usize> + use<> {
        self.layout.tile_rows(rect).flat_map(|(first, last)| first..=last)
    }

    fn tile_range(&self, i: usize) -> Range<u64> {
        let base = self.layout.index_len() as u64;
        let start = if i == 0 { 0 } else { self.ends[i - 1] };
        base + u64::from(start)..base + u64::from(self.ends[i])
    }
}

/// Copies the overlap of a tile (planes green, red, blue, mask) and a window into the window's planes (red, green, blue, mask).
fn copy_overlap(tile_bytes: &[u8], tile: Rect, planes: &mut [u8], rect: Rect) {
    let (left, right) = (tile.x.max(rect.x), (tile.x + tile.width).min(rect.x + rect.width));
    let (top, bottom) = (tile.y.max(rect.y), (tile.y + tile.height).min(rect.y + rect.height));
    let n = (right - left) as usize;
    let at = |of: Rect, y: u32| (y - of.y) as usize * of.width as usize + (left - of.x) as usize;
    for (from, to) in [1, 0, 2, 3].into_iter().zip(planes.chunks_exact_mut(rect.area() as usize)) {
        let from = &tile_bytes[from * tile.area() as usize..];
        for y in top..bottom {
            to[at(rect, y)..][..n].copy_from_slice(&from[at(tile, y)..][..n]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mips::tests::image;

    fn crop(p: &Pixels, r: Rect) -> Pixels {
        let cut = |plane: &[u8]| -> Vec<u8> {
            let rows = plane.chunks(p.width as usize).skip(r.y as usize).take(r.height as usize);
            rows.flat_map(|row| &row[r.x as usize..(r.x + r.width) as usize]).copied().collect()
        };
        let rgb = p.rgb.chunks(p.area()).flat_map(cut).collect();
        Pixels { width: r.width, height: r.height, rgb, mask: p.mask.as_ref().map(|m| cut(m)), ..Pixels::default() }
    }

    fn index(bytes: &[u8], p: &Pixels) -> Result<TileIndex, CodecError> {
        let layout = MipLayout { width: p.width, height: p.height, masked: p.mask.is_some() };
        layout.index(bytes.get(..layout.index_len()).unwrap_or(bytes))
    }

    fn window(bytes: &[u8], p: &Pixels, rect: Rect) -> Result<Pixels, CodecError> {
        let index = index(bytes, p)?;
        let ranges = index.ranges(rect).ok_or_else(|| CodecError::new("outside"))?;
        let part = |r: &Range<u64>| bytes.get(r.start as usize..r.end as usize).unwrap_or(&[]);
        index.window(rect, &ranges.iter().map(part).collect::<Vec<_>>())
    }

    #[test]
    fn windows_are_crops_of_the_image() {
        for masked in [false, true] {
            let finest = image(401, 300, masked);
            let bytes = encode(&finest).unwrap();
            let mut random = 1u64;
            let mut below = |n: u32| {
                random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                ((random >> 33) % u64::from(n)) as u32
            };
            for _ in 0..200 {
                let (x, y) = (below(401), below(300));
                let rect = Rect { x, y, width: 1 + below(401 - x), height: 1 + below(300 - y) };
                assert!(window(&bytes, &finest, rect).unwrap() == crop(&finest, rect), "{rect:?}");
            }
            let whole = Rect { x: 0, y: 0, width: 401, height: 300 };
            assert!(window(&bytes, &finest, whole).unwrap() == finest);
            let ranges = index(&bytes, &finest).unwrap().ranges(whole).unwrap();
            assert_eq!((ranges.len(), ranges[34].end), (7 * 5, bytes.len() as u64));
            assert!(ranges.windows(2).all(|pair| pair[0].end == pair[1].start));
            for (x, y, width, height) in [(0, 0, 402, 1), (0, 300, 1, 1), (0, 0, 0, 1), (u32::MAX, 0, 2, 1)] {
                assert_eq!(index(&bytes, &finest).unwrap().ranges(Rect { x, y, width, height }), None);
            }
        }
    }

    #[test]
    fn damage_is_an_error_or_changes_no_pixel() {
        let finest = image(150, 40, true);
        let whole = Rect { x: 0, y: 0, width: 150, height: 40 };
        let bytes = encode(&finest).unwrap();
        for at in (0..bytes.len()).step_by(3) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 0x10;
            let seen = window(&damaged, &finest, whole);
            assert!(seen.is_err() || seen.is_ok_and(|pixels| pixels == finest), "the bit flip at {at} changed pixels");
            assert!(window(&bytes[..at], &finest, whole).is_err(), "the truncation at {at} was not detected");
        }
        assert!(index(&bytes, &image(40, 150, true)).is_err() && index(&bytes, &image(150, 40, false)).is_err());
        assert!(encode(&Pixels { width: 0, height: 4, rgb: vec![], ..Pixels::default() }).is_err());
    }
}
