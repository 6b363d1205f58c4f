//! Decompresses a stream of Snappy without its frame, as Parquet has it.
//!
//! A page may hold hundreds of photos, so it is never held as a whole, which is how other decoders take it: this one keeps the
//! last 64 KB, the block of all compressors. Source: `format_description.txt` in github.com/google/snappy.

use std::io::{self, ErrorKind, Read};

/// The farthest that a copy may reach back.
const REACH: usize = 1 << 16;
/// Bytes decoded before the older ones are dropped.
const KEPT: usize = 4 * REACH;

/// The decompressed bytes of a stream.
pub(super) struct Snappy<R> {
    source: R,
    /// Decompressed bytes, of which those before `given` were handed out.
    history: Vec<u8>,
    given: usize,
    /// Decompressed bytes still to come; `None` before the head was read.
    left: Option<u64>,
    /// Bytes of the current literal still to come.
    literal: u64,
}

impl<R: Read> Snappy<R> {
    pub(super) fn new(source: R) -> Self {
        Self { source, history: Vec::new(), given: 0, left: None, literal: 0 }
    }

    fn byte(&mut self) -> io::Result<u8> {
        let mut byte = [0];
        self.source.read_exact(&mut byte)?;
        Ok(byte[0])
    }

    /// A number of this many bytes, little endian.
    fn number(&mut self, bytes: usize) -> io::Result<u64> {
        let mut number = [0; 8];
        self.source.read_exact(&mut number[..bytes])?;
        Ok(u64::from_le_bytes(number))
    }

    /// The decompressed length.
    fn head(&mut self) -> io::Result<u64> {
        let mut length = 0;
        for shift in (0..35).step_by(7) {
            let byte = self.byte()?;
            length |= u64::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                return Ok(length);
            }
        }
        Err(damaged())
    }

    /// Decodes a part of a literal, or a copy. `left` is above zero.
    fn decode(&mut self, left: u64) -> io::Result<()> {
        if self.history.len() > KEPT {
            let old = self.given.min(self.history.len() - REACH);
            self.history.drain(..old);
            self.given -= old;
        }
        let before = self.history.len();
        if self.literal == 0 {
            let tag = self.byte()?;
            let (length, offset) = match tag & 3 {
                0 => {
                    self.literal = match u64::from(tag >> 2) {
                        short @ 0..60 => short + 1,
                        long => self.number(long as usize - 59)? + 1,
                    };
                    (0, 1)
                }
                1 => (4 + (tag >> 2 & 7), usize::from(tag >> 5) << 8 | usize::from(self.byte()?)),
                2 => ((tag >> 2) + 1, self.number(2)? as usize),
                _ => ((tag >> 2) + 1, self.number(4)? as usize),
            };
            let from =
                before.checked_sub(offset).filter(|_| offset > 0 && offset <= REACH).or((length == 0).then_some(0));
            let from = from.ok_or_else(damaged)?;
            // A copy may reach into what it writes.
            for i in from..from + usize::from(length) {
                self.history.push(self.history[i]);
            }
        }
        if self.literal > 0 {
            let step = self.literal.min(REACH as u64);
            if (&mut self.source).take(step).read_to_end(&mut self.history)? as u64 != step {
                return Err(ErrorKind::UnexpectedEof.into());
            }
            self.literal -= step;
        }
        self.left = Some(left.checked_sub((self.history.len() - before) as u64).ok_or_else(damaged)?);
        Ok(())
    }
}

impl<R: Read> Read for Snappy<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let mut left = match self.left {
            Some(left) => left,
            None => self.head()?,
        };
        self.left = Some(left);
        while self.given == self.history.len() && left > 0 {
            self.decode(left)?;
            left = self.left.unwrap_or(0);
        }
        let length = out.len().min(self.history.len() - self.given);
        out[..length].copy_from_slice(&self.history[self.given..self.given + length]);
        self.given += length;
        Ok(length)
    }
}

fn damaged() -> io::Error {
    io::Error::new(ErrorKind::InvalidData, "damaged Snappy data")
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn decoded(bytes: &[u8]) -> io::Result<Vec<u8>> {
        let mut out = Vec::new();
        Snappy::new(bytes).read_to_end(&mut out).map(|_| out)
    }

    proptest! {
        #[test]
        fn what_was_compressed_comes_back(seed: Vec<u8>, repeats in 1usize..3000, noise in 1u32..8) {
            let mixed = (0..repeats as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> (24 + noise)) as u8);
            let bytes: Vec<u8> = mixed.flat_map(|byte| seed.iter().map(move |other| byte ^ other)).collect();
            let packed = snap::raw::Encoder::new().compress_vec(&bytes).unwrap();
            prop_assert_eq!(decoded(&packed).unwrap(), bytes);
        }

        #[test]
        fn damage_is_an_error_or_other_bytes_of_the_told_length(bytes: Vec<u8>) {
            let told = bytes.iter().take(5).zip((0..).step_by(7)).fold((0u64, true), |(sum, goes_on), (byte, shift)| {
                (if goes_on { sum | u64::from(byte & 0x7f) << shift } else { sum }, goes_on && byte & 0x80 != 0)
            });
            if let Ok(out) = decoded(&bytes) {
                prop_assert_eq!(out.len() as u64, told.0);
            }
        }
    }

    #[test]
    fn copies_reach_into_what_they_write_and_not_before_the_start() {
        assert_eq!(decoded(&[7, 0, b'a', 0b0000_1001, 1]).unwrap(), b"aaaaaaa");
        assert_eq!(decoded(&[6, 0, b'a', 0b0000_1001, 1]).unwrap_err().kind(), ErrorKind::InvalidData, "one too many");
        assert!(decoded(&[8, 0, b'a', 0b0000_1001, 1]).is_err(), "one is missing");
        assert_eq!(decoded(&[5, 0, b'a', 1, 1]).unwrap(), b"aaaaa");
        assert!(decoded(&[5, 0, b'a', 1, 2]).is_err() && decoded(&[5, 0, b'a', 1, 0]).is_err());
        assert!(decoded(&[5, 16, b'a']).is_err() && decoded(&[0xff; 9]).is_err() && decoded(&[0]).unwrap().is_empty());
    }
}
