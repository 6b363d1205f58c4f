//! Integers of a fixed width in runs: definition levels, repetition levels, and indices of a dictionary.
//!
//! A run has a head, a variable-length number. An even one is twice the number of times that the value after it is repeated; an
//! odd one tells how many groups of eight values follow, packed from the lowest bit. Source: "Run Length Encoding / Bit-Packing
//! Hybrid", `Encodings.md` in github.com/apache/parquet-format.

use super::thrift::push_varint;
use crate::error::CodecError;

/// Reads values one after the other.
pub(super) struct Hybrid {
    bytes: Vec<u8>,
    /// Where the next run begins.
    at: usize,
    width: u32,
    run: Run,
}

enum Run {
    Repeated {
        value: u32,
        left: u64,
    },
    /// Values from number `next` to `end` of those that begin at a byte.
    Packed {
        start: usize,
        next: u64,
        end: u64,
    },
}

impl Hybrid {
    /// Values of this many bits, at most 32.
    pub(super) fn new(bytes: Vec<u8>, width: u32) -> Self {
        Self { bytes, at: 0, width, run: Run::Repeated { value: 0, left: 0 } }
    }

    /// The next value.
    ///
    /// # Errors
    /// There is none.
    pub(super) fn next(&mut self) -> Result<u32, CodecError> {
        loop {
            match &mut self.run {
                Run::Repeated { value, left } if *left > 0 => {
                    *left -= 1;
                    return Ok(*value);
                }
                Run::Packed { start, next, end } if *next < *end => {
                    let value = packed(&self.bytes[*start..], *next * u64::from(self.width), self.width);
                    *next += 1;
                    return Ok(value);
                }
                _ => self.open()?,
            }
        }
    }

    /// Passes over values.
    ///
    /// # Errors
    /// There are fewer.
    pub(super) fn skip(&mut self, mut count: u64) -> Result<(), CodecError> {
        while count > 0 {
            let (passed, is_over) = match &mut self.run {
                Run::Repeated { left, .. } => {
                    let step = count.min(*left);
                    *left -= step;
                    (step, *left == 0)
                }
                Run::Packed { next, end, .. } => {
                    let step = count.min(*end - *next);
                    *next += step;
                    (step, next == end)
                }
            };
            count -= passed;
            if is_over && count > 0 {
                self.open()?;
            }
        }
        Ok(())
    }

    /// Reads the head of the next run.
    fn open(&mut self) -> Result<(), CodecError> {
        let ended = || CodecError::new("has a page that claims more values than it has");
        let mut head = 0u64;
        for shift in (0..).step_by(7) {
            let byte = *self.bytes.get(self.at).ok_or_else(ended)?;
            self.at += 1;
            head |= u64::from(byte & 0x7f).checked_shl(shift).unwrap_or(0);
            if byte & 0x80 == 0 {
                break;
            }
            if shift > 56 {
                return Err(CodecError::new("has a page with a run that is too long"));
            }
        }
        let (count, left) = (head >> 1, &self.bytes[self.at..]);
        if head & 1 == 0 {
            let value = left.get(..self.width.div_ceil(8) as usize).ok_or_else(ended)?;
            self.at += value.len();
            let value = value.iter().rev().fold(0, |value, &byte| value << 8 | u32::from(byte));
            self.run = Run::Repeated { value, left: count };
            return Ok(());
        }
        // The last run may be cut after the last group that has values.
        let length = count.saturating_mul(u64::from(self.width)).min(left.len() as u64);
        let whole = count.saturating_mul(8);
        let end = if self.width == 0 { whole } else { (8 * length / u64::from(self.width)).min(whole) };
        self.run = Run::Packed { start: self.at, next: 0, end };
        self.at += length as usize;
        Ok(())
    }
}

/// The value of this many bits from a bit on; both are inside.
fn packed(bytes: &[u8], bit: u64, width: u32) -> u32 {
    let (from, shift) = ((bit / 8) as usize, bit % 8);
    let word = bytes[from..].iter().take(5).rev().fold(0u64, |word, &byte| word << 8 | u64::from(byte));
    (word >> shift & ((1 << width) - 1)) as u32
}

/// The levels of a page, of which none is over `most`.
///
/// # Errors
/// Fewer values, or larger ones.
pub(super) fn levels(bytes: Vec<u8>, most: u8, count: u64) -> Result<Vec<u8>, CodecError> {
    let mut hybrid = Hybrid::new(bytes, u8::BITS - most.leading_zeros());
    let mut levels = Vec::new();
    for _ in 0..count {
        let level = hybrid.next()?;
        if level > u32::from(most) {
            return Err(CodecError::new("has a page with levels that its column does not have"));
        }
        levels.push(level as u8);
    }
    Ok(levels)
}

/// Appends a run of a value of one bit.
pub(super) fn push_run(bytes: &mut Vec<u8>, value: bool, count: usize) {
    if count > 0 {
        push_varint(bytes, (count as u64) << 1);
        bytes.push(value.into());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_of_both_kinds_are_read_and_skipped() {
        // Five sevens, then 0 to 7 in three bits (the example of the specification), then one six.
        let bytes = [10, 7, 3, 0b1000_1000, 0b1100_0110, 0b1111_1010, 2, 6];
        let expected: Vec<u32> = [7; 5].into_iter().chain(0..8).chain([6]).collect();
        for skipped in 0..=expected.len() {
            let mut hybrid = Hybrid::new(bytes.to_vec(), 3);
            hybrid.skip(skipped as u64).unwrap();
            let rest: Vec<u32> = (skipped..expected.len()).map(|_| hybrid.next().unwrap()).collect();
            assert_eq!(rest, expected[skipped..]);
            assert!(hybrid.next().is_err());
        }
        assert!(Hybrid::new(bytes.to_vec(), 3).skip(15).is_err());
        assert!(
            levels(bytes.to_vec(), 6, 5).is_err()
                && levels(bytes.to_vec(), 7, 14).is_ok()
                && levels(vec![], 1, 1).is_err()
        );
        assert!(levels(vec![], 0, 0).unwrap().is_empty());
    }

    #[test]
    fn damaged_runs_end() {
        for bytes in [&[0xff; 12][..], &[3], &[2], &[1, 1, 1], &[0, 0, 0], &[0xff, 0xff, 0xff, 0xff, 0x0f, 1]] {
            let mut hybrid = Hybrid::new(bytes.to_vec(), 32);
            assert!((0..1000).any(|_| hybrid.next().is_err()), "{bytes:?}");
        }
        let mut endless = Hybrid::new(vec![0xff, 0xff, 0xff, 0xff, 0x0f], 0);
        assert_eq!((endless.next(), endless.skip(1 << 30)), (Ok(0), Ok(())));
    }
}
