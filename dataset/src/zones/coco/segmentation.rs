//! The `segmentation` of an annotation: polygons, or run lengths by columns (RLE), as numbers or as the string that COCO's
//! tools write.

use std::fmt;
use std::ops::Range;

use scene::{CodecError, MaskBuilder, ZoneMask};
use serde::de::{self, Deserialize, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};

/// Rows that the edges of an object's polygons may cross, at least; of larger photos as many as they have pixels.
const MAX_CROSSINGS: usize = 1 << 20;

/// The pixels of an object.
#[derive(Debug, PartialEq)]
pub(super) enum Segmentation {
    /// Corners of polygons, x and y in turns, pixels from the image's top left corner.
    Polygons(Vec<Vec<f32>>),
    /// Height and width of the image, and lengths of runs outside and inside the object in turns, column by column.
    Runs([u32; 2], Counts),
}

/// Lengths of runs.
#[derive(Debug, PartialEq)]
pub(super) enum Counts {
    Plain(Vec<u32>),
    Compressed(String),
}

impl Segmentation {
    /// Whether it has no pixels because it says nothing, as files of boxes write `[]`.
    pub(super) fn is_empty(&self) -> bool {
        matches!(self, Self::Polygons(polygons) if polygons.is_empty())
    }

    /// The object's pixels and their bounds in a photo of this size (width, height), of which the image is a copy of
    /// `size`; `None` without a pixel. A pixel is inside if its centre is.
    ///
    /// # Errors
    /// Points outside the image, polygons that wind too often, or runs that do not fill the image.
    pub(super) fn mask(&self, size: [u32; 2], photo: [u32; 2]) -> Result<Option<(ZoneMask, [f32; 4])>, CodecError> {
        let mut builder = MaskBuilder::new(photo[0]);
        match self {
            Self::Polygons(polygons) => {
                for (row, columns) in filled(polygons, size, photo)? {
                    builder.push(row, columns);
                }
            }
            Self::Runs([height, width], _) if [*width, *height] != size => {
                let [w, h] = size;
                return Err(CodecError::new(format!("has run lengths of {width}×{height} pixels, its image {w}×{h}")));
            }
            Self::Runs(_, Counts::Plain(counts)) => by_columns(counts, size, photo, &mut builder)?,
            Self::Runs(_, Counts::Compressed(text)) => by_columns(&decompressed(text)?, size, photo, &mut builder)?,
        }
        Ok(builder.finish())
    }
}

/// The first pixel of the photo whose centre is not before a position in the image.
fn first(at: f64, scale: f64, side: u32) -> u32 {
    (at * scale - 0.5).ceil().clamp(0.0, f64::from(side)) as u32
}

/// The rows and columns inside any of the polygons, in order.
fn filled(polygons: &[Vec<f32>], size: [u32; 2], photo: [u32; 2]) -> Result<Vec<(u32, Range<u32>)>, CodecError> {
    let scale = [0, 1].map(|axis| f64::from(photo[axis]) / f64::from(size[axis]));
    let mut spans = Vec::new();
    let (mut left, all) = (MAX_CROSSINGS.max(photo[0] as usize * photo[1] as usize), size.map(|side| side as f32));
    for polygon in polygons {
        // A pixel of tolerance: tools round.
        let is_inside = |x: f32, y: f32| (-1.0..=all[0] + 1.0).contains(&x) && (-1.0..=all[1] + 1.0).contains(&y);
        if polygon.len() % 2 == 1 {
            return Err(CodecError::new("has a polygon with an x without its y"));
        }
        let points: Vec<[f64; 2]> = polygon.chunks_exact(2).map(|at| [f64::from(at[0]), f64::from(at[1])]).collect();
        if let Some(at) = polygon.chunks_exact(2).find(|at| !is_inside(at[0], at[1])) {
            return Err(CodecError::new(format!("has a polygon with the point {}, {} outside of it", at[0], at[1])));
        }
        let mut crossings: Vec<(u32, u32)> = Vec::new();
        for (i, a) in points.iter().enumerate() {
            let b = points[(i + 1) % points.len()];
            let (low, high) = if a[1] < b[1] { (*a, b) } else { (b, *a) };
            let rows = first(low[1], scale[1], photo[1])..first(high[1], scale[1], photo[1]);
            left = left.checked_sub(rows.len()).ok_or_else(|| CodecError::new("has polygons that wind too often"))?;
            crossings.extend(rows.map(|row| {
                let y = (f64::from(row) + 0.5) / scale[1];
                let x = low[0] + (high[0] - low[0]) * (y - low[1]) / (high[1] - low[1]);
                (row, first(x, scale[0], photo[0]))
            }));
        }
        crossings.sort_unstable();
        spans.extend(crossings.chunks_exact(2).map(|pair| (pair[0].0, pair[0].1..pair[1].1)));
    }
    spans.sort_unstable_by_key(|(row, columns): &(u32, Range<u32>)| (*row, columns.start));
    Ok(spans)
}

/// Adds the pixels of runs that go by columns.
fn by_columns(
    counts: &[u32],
    [width, height]: [u32; 2],
    photo: [u32; 2],
    builder: &mut MaskBuilder,
) -> Result<(), CodecError> {
    let (sum, all) = (counts.iter().map(|&count| u64::from(count)).sum::<u64>(), u64::from(width) * u64::from(height));
    if sum != all {
        return Err(CodecError::new(format!("has run lengths of {sum} pixels in all, its image {all}")));
    }
    let scale = [f64::from(photo[0]) / f64::from(width), f64::from(photo[1]) / f64::from(height)];
    // Rectangles of the photo: columns and rows. There are at most as many as runs and columns.
    let (mut parts, mut at) = (Vec::new(), 0);
    for pair in counts.chunks(2) {
        let &[outside, inside] = pair else { break };
        let start = at + u64::from(outside);
        at = start + u64::from(inside);
        let (h, mut from) = (u64::from(height), start);
        while from < at {
            let column = from / h;
            let to = at.min((column + 1) * h);
            let x = |column: u64| first(column as f64, scale[0], photo[0]);
            let y = |pixel: u64| first((pixel - column * h) as f64, scale[1], photo[1]);
            let (columns, rows) = (x(column)..x(column + 1), y(from)..y(to));
            if !columns.is_empty() && !rows.is_empty() {
                parts.push((columns, rows));
            }
            from = to;
        }
    }
    let Some(bounds) = bounds(&parts) else { return Ok(()) };
    let [left, top, right, bottom] = bounds;
    let stride = (right - left) as usize;
    let mut pixels = vec![false; stride * (bottom - top) as usize];
    for (columns, rows) in parts {
        for row in rows {
            let start = (row - top) as usize * stride;
            pixels[start + (columns.start - left) as usize..start + (columns.end - left) as usize].fill(true);
        }
    }
    for (row, pixels) in (top..).zip(pixels.chunks_exact(stride)) {
        for (column, _) in (left..).zip(pixels).filter(|(_, is_inside)| **is_inside) {
            builder.push(row, column..column + 1);
        }
    }
    Ok(())
}

fn bounds(parts: &[(Range<u32>, Range<u32>)]) -> Option<[u32; 4]> {
    let (first_columns, first_rows) = parts.first()?.clone();
    let first = [first_columns.start, first_rows.start, first_columns.end, first_rows.end];
    Some(parts.iter().fold(first, |[left, top, right, bottom], (x, y)| {
        [left.min(x.start), top.min(y.start), right.max(x.end), bottom.max(y.end)]
    }))
}

/// The lengths in the string of COCO's tools: five bits a letter from `0` on, the low ones first, with a bit that says that
/// more follow; the third and later ones are differences to the last but one, and may be negative.
fn decompressed(text: &str) -> Result<Vec<u32>, CodecError> {
    let damaged = || CodecError::new("has a damaged string of run lengths");
    let mut counts: Vec<u32> = Vec::new();
    let mut letters = text.bytes();
    while letters.len() > 0 {
        let (mut value, mut shift) = (0i64, 0);
        loop {
            let bits = letters.next().and_then(|letter| letter.checked_sub(b'0')).filter(|bits| *bits < 64);
            let bits = bits.filter(|_| shift < 35).ok_or_else(damaged)?;
            value |= i64::from(bits & 0x1f) << shift;
            shift += 5;
            if bits & 0x20 == 0 {
                if bits & 0x10 != 0 {
                    value -= 1 << shift;
                }
                break;
            }
        }
        if counts.len() > 2 {
            value += i64::from(counts[counts.len() - 2]);
        }
        counts.push(u32::try_from(value).map_err(|_| damaged())?);
    }
    Ok(counts)
}

impl<'de> Deserialize<'de> for Segmentation {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = Segmentation;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("polygons, or an object with size and counts")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Self::Value, A::Error> {
                let mut polygons = Vec::new();
                while let Some(polygon) = list.next_element::<Vec<f32>>()? {
                    // Fewer than three points have no area.
                    if polygon.len() > 5 {
                        polygons.push(polygon);
                    }
                }
                Ok(Segmentation::Polygons(polygons))
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
                let (mut size, mut counts) = (None, None);
                while let Some(key) = map.next_key::<String>()? {
                    match key.as_str() {
                        "size" => size = Some(map.next_value()?),
                        "counts" => counts = Some(map.next_value()?),
                        _ => map.next_value::<IgnoredAny>().map(|_| ())?,
                    }
                }
                let missing = |name| <A::Error as de::Error>::missing_field(name);
                let size = size.ok_or_else(|| missing("size"))?;
                Ok(Segmentation::Runs(size, counts.ok_or_else(|| missing("counts"))?))
            }
        }
        deserializer.deserialize_any(Either)
    }
}

impl<'de> Deserialize<'de> for Counts {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = Counts;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("run lengths as numbers or as a string")
            }

            fn visit_str<E>(self, text: &str) -> Result<Self::Value, E> {
                Ok(Counts::Compressed(text.to_owned()))
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Self::Value, A::Error> {
                let mut counts = Vec::new();
                while let Some(count) = list.next_element()? {
                    counts.push(count);
                }
                Ok(Counts::Plain(counts))
            }
        }
        deserializer.deserialize_any(Either)
    }
}

#[cfg(test)]
mod tests;
