//! Mips: index and tiles. As they are but for size and checksum, which are made to fit.
#![no_main]

use libfuzzer_sys::fuzz_target;
use scene::Rect;

#[allow(dead_code, reason = "ingest uses more of it")]
#[path = "../../dataset/src/mip_tiles.rs"]
mod mip_tiles;

/// The size of the mip that the seed is. Four tiles.
const SIZE: (u32, u32) = (150, 140);

fuzz_target!(|bytes: &[u8]| {
    for masked in [false, true] {
        let layout = mip_tiles::MipLayout { width: SIZE.0, height: SIZE.1, masked };
        let mut bytes = bytes.to_vec();
        let Some(index) = bytes.get_mut(..layout.index_len()) else { return };
        let words = [SIZE.0, SIZE.1, 3 + u32::from(masked)].map(u32::to_le_bytes);
        index[..20].copy_from_slice(&[b"platmip2".as_slice(), words.as_flattened()].concat());
        let (said, check) = index.split_at_mut(layout.index_len() - 16);
        check.copy_from_slice(&blake3::hash(said).as_bytes()[..16]);
        let Ok(index) = layout.index(&bytes[..layout.index_len()]) else { continue };
        for rect in [(0, 0, 150, 140), (100, 100, 50, 40), (130, 3, 1, 9)] {
            let rect = Rect { x: rect.0, y: rect.1, width: rect.2, height: rect.3 };
            let ranges = index.ranges(rect).expect("the window is inside");
            let part =
                |range: &std::ops::Range<u64>| bytes.get(range.start as usize..range.end as usize).unwrap_or(&[]);
            if let Ok(pixels) = index.window(rect, &ranges.iter().map(part).collect::<Vec<_>>()) {
                assert_eq!((pixels.rgb.len(), pixels.mask.is_some()), (3 * rect.area() as usize, masked));
            }
        }
    }
});
