//! Mutations of files: bit flips, truncation, insertions, and extreme numbers in counts and sizes.

/// SplitMix64.
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A number below `n`, which is not zero.
    pub(crate) fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }

    pub(crate) fn pick<T: Copy>(&mut self, of: &[T]) -> T {
        of[self.below(of.len())]
    }
}

/// Extreme values for counts and lengths.
const COUNTS: [u64; 14] = [
    0,
    1,
    0xff,
    0xffff,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    1 << 32,
    1 << 40,
    1 << 61,
    u64::MAX / 24,
    i64::MAX as u64,
    u64::MAX - 39,
    u64::MAX,
];
const FLOATS: [f64; 9] =
    [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX, f64::MIN, f64::MIN_POSITIVE, 5e-324, 0.0, -0.0];
const WORDS: [&str; 20] = [
    "nan",
    "NaN",
    "inf",
    "-inf",
    "1e999",
    "-1e308",
    "1e-320",
    "0",
    "-1",
    "4294967296",
    "18446744073709551615",
    "99999999999999999999999",
    "\"\"",
    "null",
    "[]",
    "../../../etc/passwd",
    "\u{0}",
    "\n",
    "é",
    "1 1",
];

/// Mutates the bytes one to three times and returns a description.
pub(crate) fn mutate(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) -> String {
    let times = random.pick(&[1, 1, 1, 2, 3]);
    (0..times).map(|_| once(bytes, other, random)).collect::<Vec<_>>().join(", ")
}

fn once(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) -> String {
    if bytes.is_empty() {
        bytes.extend(&other[..other.len().min(64)]);
        return "start of another file".into();
    }
    let at = place(bytes.len(), random);
    match random.below(9) {
        0 => {
            bytes.truncate(at);
            format!("cut at {at}")
        }
        1 => {
            let bit = random.below(8);
            bytes[at] ^= 1 << bit;
            format!("bit {bit} of byte {at} flipped")
        }
        2 => {
            let end = bytes.len().min(at + 1 + random.below(16));
            bytes[at..end].fill_with(|| random.next() as u8);
            format!("bytes {at} to {end} random")
        }
        3 => {
            let count = random.pick(&COUNTS);
            put(bytes, at, &count.to_le_bytes()[..random.pick(&[4, 8])], random);
            format!("count {count} at {at}")
        }
        4 => {
            let value = random.pick(&FLOATS);
            let single = (value as f32).to_le_bytes();
            let word: &[u8] = if random.below(2) == 0 { &single } else { &value.to_le_bytes() };
            put(bytes, at, word, random);
            format!("float {value} at {at}")
        }
        5 => {
            // A piece of a file of any format, overwritten or inserted.
            let from = place(other.len().max(1), random).min(other.len());
            let piece = &other[from..other.len().min(from + 1 + random.below(200))];
            let end = if random.below(2) == 0 { at } else { bytes.len().min(at + piece.len()) };
            bytes.splice(at..end, piece.iter().copied());
            format!("{} bytes of another file over {at}..{end}", piece.len())
        }
        6 => {
            let end = bytes.len().min(at + 1 + random.below(64));
            bytes.drain(at..end);
            format!("{at}..{end} removed")
        }
        7 => {
            let end = bytes.len().min(at + 1 + random.below(256));
            let twice = bytes[at..end].to_vec();
            bytes.splice(at..at, twice);
            format!("{at}..{end} twice")
        }
        _ => {
            // A number in a text is replaced by another word.
            let is_number = |b: u8| b.is_ascii_digit() || matches!(b, b'-' | b'+' | b'.' | b'e');
            let Some(start) = (at..bytes.len()).take(4096).find(|&i| bytes[i].is_ascii_digit()) else {
                return "nothing".into();
            };
            let end = (start..bytes.len()).find(|&i| !is_number(bytes[i])).unwrap_or(bytes.len()).min(start + 40);
            let word = random.pick(&WORDS);
            bytes.splice(start..end, word.bytes());
            format!("word {word:?} over {start}..{end}")
        }
    }
}

/// A position; half the time among the first bytes, which hold counts and sizes.
fn place(length: usize, random: &mut Random) -> usize {
    let near = if random.below(2) == 0 { 256 } else { usize::MAX };
    random.below(length.min(near))
}

/// Overwrites bytes, half the time at a multiple of four.
fn put(bytes: &mut [u8], at: usize, word: &[u8], random: &mut Random) {
    let at = if random.below(2) == 0 { at & !3 } else { at };
    let end = bytes.len().min(at + word.len());
    bytes[at..end].copy_from_slice(&word[..end - at]);
}
