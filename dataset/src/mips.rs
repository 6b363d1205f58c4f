//! Mips of a view: half the size each, and stored so that a window of one is read without the rest.
//!
//! A pixel of mip `m` is the mean of the `2^m × 2^m` pixels of mip 0 below it, rounded once (not once a level), as
//! [`scene::Camera::mip`] places it; a remainder at the right and bottom is dropped. With a mask, a coarse pixel is
//! usable only if all pixels below it are.
//!
//! One mip of one view is one artefact, little endian:
//!
//! ```text
//! "plat" "mip2"  width u32  height u32  planes u32 (3, or 4 with a mask)
//! end of each tile's bytes, counted from the first tile's start, u32 each, in row order
//! first 16 bytes of the BLAKE3 hash of all of the above
//! the tiles: 64 × 64 pixels, less at the right and bottom
//! ```
//!
//! Whoever knows the size of the image knows the length of this index, so a window takes two reads: the index, and its tiles
//! (a store reads what lies side by side at once). A tile is a zstd frame (level 1, with its checksum) of planes G, R-G, B-G (mask), each byte
//! less the one above it. Measured on the photos of three captures, per core, with tiles of 128: 0.20 to 0.45 of the raw size
//! and 0.8 to 1.1 GB/s back to pixels; PNG's fast mode takes 0.42 to 0.56 at 0.36 GB/s, QOI 0.41 to 0.60 at 0.7, LZ4 over the
//! same planes 0.34 to 0.75 at 1.4. Tiles of 64 halve that speed, but a block looks at windows of a photo: those of a city's
//! blocks read 1.35 to 1.54 times what they use (`bench/results/scale.jsonl`; 1.7 with tiles of 128, by a probe that was not kept).

use std::ops::Range;

use scene::{CodecError, Pixels, Rect};

/// Edge of a tile in pixels.
pub const TILE: u32 = 64;
/// The last mip is the last one whose shorter side has at least this many pixels (mip 0 is always there).
pub const SHORTEST_SIDE: u32 = 16;
/// The largest image: 268 million pixels, so that the ends of tiles fit 32 bits.
pub const PIXEL_LIMIT: u64 = 1 << 28;

const MAGIC: &[u8; 8] = b"platmip2";
const PREFIX: usize = 20;
const CHECK: usize = 16;
const LEVEL: i32 = 1;

/// How many mips an image of this size has.
pub fn count(width: u32, height: u32) -> u8 {
    let shorter = width.min(height);
    let count = (0..32).take_while(|&m| shorter >> m >= SHORTEST_SIDE).count();
    count.max(1) as u8
}

/// Calls `each` with the mips of an image, the image itself first. Besides the image there is one more in memory.
///
/// # Errors
/// What `each` answers; the rest is left out.
pub fn for_each<E>(finest: Pixels, mut each: impl FnMut(&Pixels) -> Result<(), E>) -> Result<(), E> {
    each(&finest)?;
    let levels = count(finest.width, finest.height);
    let mut sums = halve(finest.width, finest.height, &finest.rgb, finest.mask.as_deref());
    drop(finest);
    for m in 1..levels {
        each(&sums.mean(m))?;
        sums = halve(sums.width, sums.height, &sums.rgb, sums.mask.as_deref());
    }
    Ok(())
}

/// A mip before rounding: the sums of the pixels of mip 0 below each pixel (under 2^32, as 2^24 pixels of 255 are).
struct Sums {
    width: u32,
    height: u32,
    rgb: Vec<u32>,
    mask: Option<Vec<u8>>,
}

impl Sums {
    fn mean(&self, m: u8) -> Pixels {
        let half = (1u64 << (2 * m)) / 2;
        let rgb = self.rgb.iter().map(|&sum| ((u64::from(sum) + half) >> (2 * m)) as u8).collect();
        Pixels { width: self.width, height: self.height, rgb, mask: self.mask.clone() }
    }
}

/// The sums of 2×2; a mask of 255 and 0 stays one.
fn halve<T: Copy + Into<u32>>(width: u32, height: u32, rgb: &[T], mask: Option<&[u8]>) -> Sums {
    let (from, w, h) = (width as usize, width / 2, height / 2);
    let mut sums = Vec::with_capacity(3 * w as usize * h as usize);
    for plane in rgb.chunks_exact(from * height as usize) {
        quads(plane, from, |[a, b, c, d]| sums.push(a.into() + b.into() + c.into() + d.into()));
    }
    let mask = mask.map(|mask| {
        let mut all = Vec::with_capacity(w as usize * h as usize);
        quads(mask, from, |[a, b, c, d]| all.push(a & b & c & d));
        all
    });
    Sums { width: w, height: h, rgb: sums, mask }
}

fn quads<T: Copy>(plane: &[T], width: usize, mut each: impl FnMut([T; 4])) {
    for rows in plane.chunks_exact(2 * width) {
        let (upper, lower) = rows.split_at(width);
        for (a, b) in upper.chunks_exact(2).zip(lower.chunks_exact(2)) {
            each([a[0], a[1], b[0], b[1]]);
        }
    }
}

/// The mean over blocks of `factor × factor` pixels; sides are divided and rounded down. A block is usable only if all
/// of its pixels are.
///
/// # Panics
/// With a factor of 0.
pub fn downscale(pixels: &Pixels, factor: u32) -> Pixels {
    let (width, height) = (pixels.width / factor, pixels.height / factor);
    let (n, stride) = (u64::from(factor).pow(2), pixels.width as usize);
    let mut sums = vec![0u64; width as usize];
    let mut shrink = |plane: &[u8], out: &mut Vec<u8>, value: fn(u64, u64) -> u8| {
        for rows in plane.chunks_exact(stride * factor as usize) {
            sums.fill(0);
            for row in rows.chunks_exact(stride) {
                for (sum, block) in sums.iter_mut().zip(row.chunks_exact(factor as usize)) {
                    *sum += block.iter().map(|&v| u64::from(v)).sum::<u64>();
                }
            }
            out.extend(sums.iter().map(|&sum| value(sum, n)));
        }
    };
    let mut rgb = Vec::with_capacity(3 * width as usize * height as usize);
    for plane in pixels.rgb.chunks_exact(pixels.area()) {
        shrink(plane, &mut rgb, |sum, n| ((sum + n / 2) / n) as u8);
    }
    let mask = pixels.mask.as_ref().map(|mask| {
        let mut all = Vec::with_capacity(width as usize * height as usize);
        shrink(mask, &mut all, |sum, n| if sum == 255 * n { 255 } else { 0 });
        all
    });
    Pixels { width, height, rgb, mask }
}

/// One mip as the bytes of an artefact.
///
/// # Errors
/// More than [`PIXEL_LIMIT`] pixels, or none.
pub fn encode(pixels: &Pixels) -> Result<Vec<u8>, CodecError> {
    let layout = Layout { width: pixels.width, height: pixels.height, masked: pixels.mask.is_some() };
    layout.check()?;
    let mut bytes = Vec::with_capacity(layout.index_len() + pixels.rgb.len() / 2);
    bytes.extend_from_slice(MAGIC);
    for word in [layout.width, layout.height, layout.planes() as u32] {
        bytes.extend_from_slice(&word.to_le_bytes());
    }
    bytes.resize(layout.index_len(), 0);
    let failed = |error: std::io::Error| CodecError::new(format!("a tile does not compress: {error}"));
    let mut zstd = zstd::bulk::Compressor::new(LEVEL).map_err(failed)?;
    zstd.include_checksum(true).map_err(failed)?;
    let mut tile = Vec::new();
    for i in 0..layout.tiles() {
        layout.filter(pixels, layout.tile(i), &mut tile);
        bytes.extend_from_slice(&zstd.compress(&tile).map_err(failed)?);
        let end = u32::try_from(bytes.len() - layout.index_len()).expect("tiles of PIXEL_LIMIT pixels fit 32 bits");
        bytes[PREFIX + 4 * i..][..4].copy_from_slice(&end.to_le_bytes());
    }
    let check = layout.index_len() - CHECK;
    let hash = *blake3::hash(&bytes[..check]).as_bytes();
    bytes[check..layout.index_len()].copy_from_slice(&hash[..CHECK]);
    Ok(bytes)
}

/// What is known of a mip before it is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// True with a mask.
    pub masked: bool,
}

impl Layout {
    /// The bytes of the artefact that are its index.
    pub fn index_len(&self) -> usize {
        PREFIX + 4 * self.tiles() + CHECK
    }

    /// Reads the index.
    ///
    /// # Errors
    /// Not the index of a mip of this layout, or damaged.
    pub fn index(self, bytes: &[u8]) -> Result<Index, CodecError> {
        self.check()?;
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
        if bytes.len() != self.index_len() || &bytes[..8] != MAGIC {
            return Err(CodecError::new("not a mip, or one of another size or version"));
        }
        if [word(8), word(12), word(16)] != [self.width, self.height, self.planes() as u32] {
            return Err(CodecError::new("a mip of another size, or with a mask where none is expected"));
        }
        let (index, check) = bytes.split_at(bytes.len() - CHECK);
        if check != &blake3::hash(index).as_bytes()[..CHECK] {
            return Err(CodecError::new("the index of the mip fails its checksum"));
        }
        let ends: Vec<u32> = (0..self.tiles()).map(|i| word(PREFIX + 4 * i)).collect();
        let start = |i: usize| if i == 0 { 0 } else { ends[i - 1] };
        let bound = |i: usize| zstd::zstd_safe::compress_bound(self.tile_bytes(self.tile(i))) as u64 + 64;
        let sane = |i: usize| ends[i] > start(i) && u64::from(ends[i] - start(i)) <= bound(i);
        if !(0..ends.len()).all(sane) {
            return Err(CodecError::new("the tiles of the mip overlap or are too long"));
        }
        Ok(Index { layout: self, ends })
    }

    fn check(&self) -> Result<(), CodecError> {
        let area = u64::from(self.width) * u64::from(self.height);
        if area == 0 || area > PIXEL_LIMIT {
            let (w, h) = (self.width, self.height);
            return Err(CodecError::new(format!("an image of {w}×{h} pixels is empty or over {PIXEL_LIMIT} pixels")));
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

    /// The tiles that a rectangle inside the image touches, by rows: `(first, last)` of each row.
    fn tile_rows(&self, rect: Rect) -> impl Iterator<Item = (usize, usize)> + use<> {
        let (columns, last) = (self.columns(), ((rect.x + rect.width - 1) / TILE) as usize);
        let rows = (rect.y / TILE) as usize..=((rect.y + rect.height - 1) / TILE) as usize;
        rows.map(move |row| (row * columns + (rect.x / TILE) as usize, row * columns + last))
    }

    /// The planes of a tile as they are compressed: red and blue less green, then each byte less the one above.
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

    /// Undoes [`Layout::filter`]; the planes are then green, red, blue, mask.
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

/// Where the tiles of a mip lie.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Index {
    layout: Layout,
    ends: Vec<u32>,
}

impl Index {
    /// Bytes that it takes in memory, roughly.
    pub(crate) fn size(&self) -> usize {
        4 * self.ends.len() + 64
    }

    /// The ranges of the artefact's bytes that hold a window's tiles, in the order in which [`Index::window`] wants them; those of
    /// neighbours touch. `None` for a window that is empty or not inside the image.
    pub fn ranges(&self, rect: Rect) -> Option<Vec<Range<u64>>> {
        let fits = |from: u32, len: u32, side: u32| len > 0 && from.checked_add(len).is_some_and(|end| end <= side);
        if !fits(rect.x, rect.width, self.layout.width) || !fits(rect.y, rect.height, self.layout.height) {
            return None;
        }
        Some(self.tiles(rect).map(|i| self.tile_range(i)).collect())
    }

    /// The bytes that a window inside the image takes of its tiles', had each pixel of a tile the same.
    pub fn bytes_of(&self, rect: Rect) -> u64 {
        let part = |i: usize| {
            let (tile, range) = (self.layout.tile(i), self.tile_range(i));
            let common = |a: u32, n: u32, b: u32, m: u32| u64::from((a + n).min(b + m).saturating_sub(a.max(b)));
            let area =
                common(tile.x, tile.width, rect.x, rect.width) * common(tile.y, tile.height, rect.y, rect.height);
            (range.end - range.start) * area / tile.area()
        };
        self.tiles(rect).map(part).sum()
    }

    /// The pixels of a window from the bytes of its [`Index::ranges`].
    ///
    /// # Errors
    /// Damaged or missing bytes.
    pub fn window(&self, rect: Rect, parts: &[impl AsRef<[u8]>]) -> Result<Pixels, CodecError> {
        let cut = || CodecError::new("a tile of the mip is missing or damaged");
        let area = rect.area() as usize;
        let ranges = self.ranges(rect).ok_or_else(|| CodecError::new("a window outside of its image"))?;
        if parts.len() != ranges.len() {
            return Err(cut());
        }
        let mut planes = vec![0u8; area * self.layout.planes()];
        let mut zstd = zstd::bulk::Decompressor::new().map_err(|_| cut())?;
        let mut tile_bytes = Vec::new();
        for (i, part) in self.tiles(rect).zip(parts) {
            let tile = self.layout.tile(i);
            tile_bytes.resize(self.layout.tile_bytes(tile), 0);
            let written = zstd.decompress_to_buffer(part.as_ref(), &mut tile_bytes[..]).map_err(|_| cut())?;
            if written != tile_bytes.len() {
                return Err(cut());
            }
            self.layout.unfilter(tile, &mut tile_bytes);
            place(&tile_bytes, tile, &mut planes, rect);
        }
        let mask = self.layout.masked.then(|| planes.split_off(3 * area));
        Ok(Pixels { width: rect.width, height: rect.height, rgb: planes, mask })
    }

    /// The tiles that a window inside the image touches.
    fn tiles(&self, rect: Rect) -> impl Iterator<Item = usize> + use<> {
        self.layout.tile_rows(rect).flat_map(|(first, last)| first..=last)
    }

    fn tile_range(&self, i: usize) -> Range<u64> {
        let base = self.layout.index_len() as u64;
        let start = if i == 0 { 0 } else { self.ends[i - 1] };
        base + u64::from(start)..base + u64::from(self.ends[i])
    }
}

/// Copies what a tile (green, red, blue, mask) shows of a window into the window's planes (red, green, blue, mask).
fn place(tile_bytes: &[u8], tile: Rect, planes: &mut [u8], rect: Rect) {
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

    /// A textured image of odd sizes, with noise that no two tiles share.
    fn image(width: u32, height: u32, masked: bool) -> Pixels {
        let n = (width * height) as usize;
        let byte = |i: usize| ((i / 7) as u32 ^ (i as u32).wrapping_mul(2_654_435_761) >> 27) as u8;
        let mask = masked.then(|| (0..n).map(|i| if i % 97 < 5 { 0 } else { 255 }).collect());
        Pixels { width, height, rgb: (0..3 * n).map(byte).collect(), mask }
    }

    fn crop(p: &Pixels, r: Rect) -> Pixels {
        let cut = |plane: &[u8]| -> Vec<u8> {
            let rows = plane.chunks(p.width as usize).skip(r.y as usize).take(r.height as usize);
            rows.flat_map(|row| &row[r.x as usize..(r.x + r.width) as usize]).copied().collect()
        };
        let rgb = p.rgb.chunks(p.area()).flat_map(cut).collect();
        Pixels { width: r.width, height: r.height, rgb, mask: p.mask.as_ref().map(|m| cut(m)) }
    }

    /// The mean of 2^m × 2^m pixels, one pixel at a time.
    fn naive(p: &Pixels, edge: u32) -> Pixels {
        let (width, height) = (p.width / edge, p.height / edge);
        let pool = |plane: &[u8], value: &dyn Fn(&[u8]) -> u8| -> Vec<u8> {
            let mut out = Vec::new();
            for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
                let at = |i: u32| plane[((y * edge + i / edge) * p.width + x * edge + i % edge) as usize];
                out.push(value(&(0..edge * edge).map(at).collect::<Vec<u8>>()));
            }
            out
        };
        let mean = |v: &[u8]| (v.iter().map(|&v| f64::from(v)).sum::<f64>() / v.len() as f64 + 0.5).floor() as u8;
        let all = |v: &[u8]| if v.iter().all(|&v| v == 255) { 255 } else { 0 };
        let rgb = p.rgb.chunks(p.area()).flat_map(|plane| pool(plane, &mean)).collect();
        Pixels { width, height, rgb, mask: p.mask.as_ref().map(|m| pool(m, &all)) }
    }

    fn index(bytes: &[u8], p: &Pixels) -> Result<Index, CodecError> {
        let layout = Layout { width: p.width, height: p.height, masked: p.mask.is_some() };
        layout.index(bytes.get(..layout.index_len()).unwrap_or(bytes))
    }

    fn window(bytes: &[u8], p: &Pixels, rect: Rect) -> Result<Pixels, CodecError> {
        let index = index(bytes, p)?;
        let ranges = index.ranges(rect).ok_or_else(|| CodecError::new("outside"))?;
        let part = |r: &Range<u64>| bytes.get(r.start as usize..r.end as usize).unwrap_or(&[]);
        index.window(rect, &ranges.iter().map(part).collect::<Vec<_>>())
    }

    #[test]
    fn mips_are_the_means_of_mip_0() {
        for masked in [false, true] {
            let finest = image(333, 150, masked);
            let mut m = 0;
            for_each(finest.clone(), |mip| {
                assert!(*mip == naive(&finest, 1 << m), "mip {m}");
                m += 1;
                Ok::<_, ()>(())
            })
            .unwrap();
            assert_eq!((m, count(333, 150)), (4, 4));
            for factor in [1, 2, 3, 5] {
                assert!(downscale(&finest, factor) == naive(&finest, factor), "factor {factor}");
            }
        }
        assert_eq!([count(1, 1), count(16, 16), count(31, 4000), count(32, 32)], [1, 1, 1, 2]);
    }

    #[test]
    fn windows_are_crops() {
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
    fn damage_is_seen() {
        let finest = image(150, 40, true);
        let whole = Rect { x: 0, y: 0, width: 150, height: 40 };
        let bytes = encode(&finest).unwrap();
        for at in (0..bytes.len()).step_by(3) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 0x10;
            let seen = window(&damaged, &finest, whole);
            assert!(seen.is_err() || seen.is_ok_and(|pixels| pixels == finest), "flip at {at} changed pixels");
            assert!(window(&bytes[..at], &finest, whole).is_err(), "cut at {at} went unseen");
        }
        assert!(index(&bytes, &image(40, 150, true)).is_err() && index(&bytes, &image(150, 40, false)).is_err());
        assert!(encode(&Pixels { width: 0, height: 4, rgb: vec![], mask: None }).is_err());
    }
}
