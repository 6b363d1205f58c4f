//! Mutation tests of every reader: a damaged file gives a value or a one-line error, never a panic, within a memory limit that
//! depends on the file's size.
//!
//! `PLAT_FUZZ_CASES` sets the number of cases (2,000), `PLAT_FUZZ_SEED` the random seed (0). A failure prints file, seed and case; with
//! `PLAT_FUZZ_SEED=seed PLAT_FUZZ_FROM=case PLAT_FUZZ_CASES=1` that case runs alone.

mod corpus;
mod memory;
mod mutate;
mod readers;
mod zones;

use std::io::{Read, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use corpus::{Seal, Seed};
use mutate::Random;

/// Files under this may not take more than [`MAX_BYTES`].
const SMALL_FILE: usize = 10 << 20;
const MAX_BYTES: usize = 256 << 20;
/// A file of this length gets all of its cases, one of twice the length half of them.
const QUICK_FILE: usize = 64 << 10;
/// Maximum length of a fuzzer's seed.
const LARGEST_SEED: usize = 16 << 10;
/// Bytes of a frame before its header.
const FRAME_PREFIX: usize = 40;

/// Serialises tests: memory is counted for the whole process.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

#[test]
fn decompression_bombs_are_refused_within_the_memory_limit() {
    let _alone = ONE_AT_A_TIME.lock();
    for file in corpus::swelling() {
        let (outcome, peak) = memory::peak_of(|| file.reader.read(&file.bytes));
        let line = outcome.expect_err(&file.name);
        assert!(line.len() < 16 << 10 && !line.contains(char::is_control), "{}: {line:?}", file.name);
        let budget = file.budget.base + file.budget.factor * file.bytes.len();
        println!("{}: {} bytes, {peak} in memory of {budget}: {line:.80}", file.name, file.bytes.len());
        assert!(peak <= budget.min(MAX_BYTES), "{}: {peak} bytes for a file of {}", file.name, file.bytes.len());
    }
}

#[test]
fn damaged_files_are_refused_or_read() {
    let _alone = ONE_AT_A_TIME.lock();
    let number = |name: &str| std::env::var(name).ok().map(|text| text.parse::<u64>().expect("a whole number"));
    let (seed, from) = (number("PLAT_FUZZ_SEED").unwrap_or(0), number("PLAT_FUZZ_FROM").unwrap_or(0));
    let cases = number("PLAT_FUZZ_CASES").unwrap_or(2000);

    let seeds = corpus::seeds();
    if let Some(folder) = std::env::var_os("PLAT_FUZZ_SEEDS") {
        write_seeds(Path::new(&folder), &seeds);
    }
    for file in &seeds {
        file.reader.read(&file.bytes).unwrap_or_else(|error| panic!("{} undamaged: {error}", file.name));
    }
    let (mut slowest, mut largest) = ((Duration::ZERO, String::new()), (0, String::new()));
    let mut refused = 0;
    for case in from..from + cases {
        let mut random = Random(seed ^ case.wrapping_mul(0xd134_2543_de82_ef95));
        random.next();
        let file = choose(&seeds, &mut random);
        let other = &seeds[random.below(seeds.len())];
        let (bytes, damage) = damaged(file, &other.bytes, &mut random);
        let what = || format!("{}: {damage} (seed {seed}, case {case})", file.name);

        let start = Instant::now();
        let (outcome, peak) = memory::peak_of(|| catch_unwind(AssertUnwindSafe(|| file.reader.read(&bytes))));
        let took = start.elapsed();
        match outcome {
            Ok(Ok(())) => {}
            Ok(Err(line)) => {
                refused += 1;
                assert!(!line.is_empty() && !line.contains(char::is_control), "{}: not a line: {line:?}", what());
                assert!(line.len() < 16 << 10, "{}: a line of {} bytes", what(), line.len());
            }
            Err(_) => panic!("{}: panicked", what()),
        }
        let budget = file.budget.base + file.budget.factor * bytes.len();
        assert!(peak <= budget, "{}: {peak} bytes for a file of {}", what(), bytes.len());
        assert!(peak <= MAX_BYTES || bytes.len() >= SMALL_FILE, "{}: {peak} bytes", what());
        if took > slowest.0 {
            slowest = (took, what());
        }
        if peak > largest.0 {
            largest = (peak, what());
        }
    }
    println!("{cases} cases of {} files, {refused} refused", seeds.len());
    println!("slowest {:.3} s: {}", slowest.0.as_secs_f64(), slowest.1);
    println!("largest {:.1} MB: {}", largest.0 as f64 / 1e6, largest.1);
}

/// Writes the files as seeds of the fuzz targets, without checksums, which the targets restore.
fn write_seeds(folder: &Path, seeds: &[Seed]) {
    for (i, file) in seeds.iter().enumerate() {
        let mut bytes = opened(file);
        bytes.truncate(LARGEST_SEED);
        let folder = folder.join(file.reader.target);
        std::fs::create_dir_all(&folder).expect("a folder for seeds");
        std::fs::write(folder.join(format!("{i:03}")), bytes).expect("a seed is written");
    }
}

/// The content of a file inside its checksum or compression.
fn opened(file: &Seed) -> Vec<u8> {
    match file.seal {
        Seal::None | Seal::Png => file.bytes.clone(),
        Seal::Frame => file.bytes[FRAME_PREFIX..].to_vec(),
        Seal::Gzip => {
            let mut bytes = Vec::new();
            flate2::read::GzDecoder::new(&file.bytes[..]).read_to_end(&mut bytes).expect("the file itself is whole");
            bytes
        }
    }
}

/// A random file; long ones are less likely.
fn choose<'a>(seeds: &'a [Seed], random: &mut Random) -> &'a Seed {
    loop {
        let file = &seeds[random.below(seeds.len())];
        if random.below(file.bytes.len().div_ceil(QUICK_FILE).max(1)) == 0 {
            return file;
        }
    }
}

/// A damaged file and a description of the damage. Checksums are restored in most cases.
fn damaged(file: &Seed, other: &[u8], random: &mut Random) -> (Vec<u8>, String) {
    let sealed = file.seal != Seal::None && random.below(4) > 0;
    let mut bytes = if sealed && file.seal == Seal::Gzip { opened(file) } else { file.bytes.clone() };
    let damage = mutate::mutate(&mut bytes, other, random);
    if sealed {
        seal(file.seal, &mut bytes);
    }
    (bytes, if sealed { format!("{damage}, sealed") } else { damage })
}

fn seal(seal: Seal, bytes: &mut Vec<u8>) {
    match seal {
        Seal::None => {}
        Seal::Frame if bytes.len() < FRAME_PREFIX => {}
        Seal::Frame => {
            // The lengths of header and bulk are kept if they fit, else the header takes all bytes.
            let length = |bytes: &[u8]| bytes.iter().rev().fold(0u64, |n, b| n << 8 | u64::from(*b));
            let (header, bulk) = (length(&bytes[12..16]), length(&bytes[16..24]));
            if header.checked_add(bulk) != Some((bytes.len() - FRAME_PREFIX) as u64) && header < 1 << 20 {
                let rest = (bytes.len() - FRAME_PREFIX).saturating_sub(bulk.min(1 << 40) as usize) as u32;
                bytes[12..16].copy_from_slice(&rest.to_le_bytes());
            }
            let hash = blake3::hash(&bytes[FRAME_PREFIX..]);
            bytes[24..40].copy_from_slice(&hash.as_bytes()[..16]);
        }
        Seal::Gzip => {
            let mut to = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
            to.write_all(bytes).expect("memory takes it");
            *bytes = to.finish().expect("memory takes it");
        }
        Seal::Png => {
            let mut at = 8;
            while let Some(length) = bytes.get(at..at + 4) {
                let length = u32::from_be_bytes(length.try_into().expect("four bytes")) as usize;
                let end = at + 8 + length;
                if end + 4 > bytes.len() {
                    break;
                }
                let mut sum = flate2::Crc::new();
                sum.update(&bytes[at + 4..end]);
                bytes[end..end + 4].copy_from_slice(&sum.sum().to_be_bytes());
                at = end + 4;
            }
        }
    }
}
