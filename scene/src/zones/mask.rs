//! The pixels of an object, as run lengths.

use std::iter::from_fn;
use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::error::CodecError;

/// Which pixels of a photo show an object: lengths of runs of pixels, row by row from the top left, outside the object
/// and inside it in turns, the first outside. What follows the last run is outside. (COCO's runs go by columns.)
///
/// A length takes seven bits a byte, the low ones first; the high bit says that more follow (LEB128). So an object of
/// a hundred rows takes two to four hundred bytes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ZoneMask(Vec<u8>);

impl ZoneMask {
    /// The object's pixels in a photo of this width: row and columns, in order.
    pub fn spans(&self, width: u32) -> impl Iterator<Item = (u32, Range<u32>)> + '_ {
        let width = u64::from(width.max(1));
        let (mut runs, mut run) = (self.runs(), 0..0);
        from_fn(move || {
            while run.is_empty() {
                run = runs.next()?;
            }
            let (row, start) = (run.start / width, run.start % width);
            let end = run.end.min((row + 1) * width);
            run.start = end;
            Some((row as u32, start as u32..(end - row * width) as u32))
        })
    }

    /// The number of the object's pixels.
    pub fn area(&self) -> u64 {
        self.runs().map(|run| run.end - run.start).sum()
    }

    /// The bytes that it takes.
    pub fn bytes(&self) -> usize {
        self.0.len()
    }

    /// Checks it against the number of a photo's pixels.
    ///
    /// # Errors
    /// Damaged lengths, no pixel, or pixels beyond the photo.
    pub(super) fn check(&self, pixels: u64) -> Result<(), CodecError> {
        let (mut bytes, mut at, mut is_inside) = (self.0.iter(), 0, false);
        while bytes.len() > 0 {
            let length = length(&mut bytes).ok_or_else(|| CodecError::new("has a mask with a damaged run"))?;
            at += length;
            if at > pixels || (is_inside && length == 0) {
                return Err(CodecError::new("has a mask that is empty or larger than the photo"));
            }
            is_inside = !is_inside;
        }
        // It ends with a run inside.
        if is_inside || at == 0 { Err(CodecError::new("has a mask without its last run")) } else { Ok(()) }
    }

    /// Runs of the object's pixels, by their numbers. A damaged mask ends early.
    fn runs(&self) -> impl Iterator<Item = Range<u64>> + '_ {
        let (mut bytes, mut at) = (self.0.iter(), 0u64);
        from_fn(move || {
            let start = at.checked_add(length(&mut bytes)?)?;
            at = start.checked_add(length(&mut bytes)?)?;
            Some(start..at)
        })
    }
}

/// A length of at most 35 bits; `None` if it is longer or cut short.
fn length(bytes: &mut std::slice::Iter<'_, u8>) -> Option<u64> {
    let mut length = 0;
    for shift in (0..35).step_by(7) {
        let byte = *bytes.next()?;
        length |= u64::from(byte & 0x7f) << shift;
        if byte < 0x80 {
            return Some(length);
        }
    }
    None
}

/// Makes a [`ZoneMask`] from spans of pixels.
#[derive(Debug)]
pub struct MaskBuilder {
    width: u32,
    bytes: Vec<u8>,
    /// End of the last run that was written.
    written: u64,
    /// The run that is growing.
    run: Range<u64>,
    /// Left, top, right and bottom.
    bounds: [u32; 4],
}

impl MaskBuilder {
    /// For a photo of this width.
    pub fn new(width: u32) -> Self {
        Self { width, bytes: Vec::new(), written: 0, run: 0..0, bounds: [u32::MAX, u32::MAX, 0, 0] }
    }

    /// Adds pixels of a row. Spans come in the order of rows, within a row in that of their starts; they may overlap.
    pub fn push(&mut self, row: u32, columns: Range<u32>) {
        let columns = columns.start..columns.end.min(self.width);
        let first = u64::from(row) * u64::from(self.width);
        let start = (first + u64::from(columns.start)).max(self.run.end);
        let end = first + u64::from(columns.end);
        if columns.is_empty() || start >= end {
            return;
        }
        if start > self.run.end {
            self.write();
            self.run.start = start;
        }
        self.run.end = end;
        let [left, top, right, bottom] = self.bounds;
        self.bounds = [left.min(columns.start), top.min(row), right.max(columns.end), bottom.max(row + 1)];
    }

    /// The mask and its bounds: left, top, right and bottom; `None` without a pixel.
    pub fn finish(mut self) -> Option<(ZoneMask, [f32; 4])> {
        self.write();
        (!self.bytes.is_empty()).then(|| (ZoneMask(self.bytes), self.bounds.map(|side| side as f32)))
    }

    fn write(&mut self) {
        if self.run.is_empty() {
            return;
        }
        for mut length in [self.run.start - self.written, self.run.end - self.run.start] {
            while length >= 0x80 {
                self.bytes.push(length as u8 | 0x80);
                length >>= 7;
            }
            self.bytes.push(length as u8);
        }
        self.written = self.run.end;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Span = (u32, Range<u32>);

    fn built(width: u32, spans: &[Span]) -> Option<(ZoneMask, [f32; 4])> {
        let mut builder = MaskBuilder::new(width);
        spans.iter().for_each(|(row, columns)| builder.push(*row, columns.clone()));
        builder.finish()
    }

    #[test]
    fn spans_are_kept_and_overlaps_merged() {
        let spans = [(1, 3..5), (1, 4..7), (1, 5..6), (2, 300..400), (3, 0..400), (4, 0..1)];
        let (mask, bounds) = built(400, &spans).unwrap();
        assert_eq!(bounds, [0.0, 1.0, 400.0, 5.0]);
        let kept: Vec<Span> = mask.spans(400).collect();
        assert_eq!(kept, [(1, 3..7), (2, 300..400), (3, 0..400), (4, 0..1)]);
        assert_eq!((mask.area(), mask.bytes()), (4 + 100 + 400 + 1, 7));
        assert!(mask.check(2000).is_ok() && mask.check(1601).is_ok() && mask.check(1600).is_err());
        assert_eq!(built(10, &[(0, 9..20)]).unwrap().0.spans(10).collect::<Vec<_>>(), [(0, 9..10)]);
        assert_eq!([built(10, &[]), built(10, &[(3, 10..20), (4, 5..5)])], [None, None]);
    }

    #[test]
    fn damaged_masks_are_refused_and_end_early() {
        for bytes in [vec![], vec![3], vec![3, 0], vec![0, 5, 2], vec![0x80], vec![1, 0xff, 0xff, 0xff, 0xff, 0xff, 1]]
        {
            let mask = ZoneMask(bytes);
            assert!(mask.check(1 << 40).is_err(), "{mask:?}");
            assert!(mask.spans(0).count() <= 5);
        }
        assert!(ZoneMask(vec![0, 5]).check(4).is_err());
    }
}
