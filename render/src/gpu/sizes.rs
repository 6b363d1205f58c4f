//! How large the buffers of views are.

use shaders::{DIGITS, MOMENTS, RADIX_BLOCK, REDUCE_SPLATS, SCAN_BLOCK, Views};

/// Bytes of a record in `view.wgsl`.
const RECORD: u64 = 48;

/// Bytes of each buffer that drawing views and going back from them takes, beside the splats and their gradients.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Sizes {
    /// Of all entries.
    pub(super) records: u64,
    /// Sums over all entries, one more than there are.
    pub(super) scanned: u64,
    /// A word for each of all entries.
    pub(super) splat_words: u64,
    /// A word for each pair.
    pub(super) pair_words: u64,
    /// Moments of each pair.
    pub(super) moments: u64,
    /// What the sorter counts.
    pub(super) histogram: u64,
    /// Sums of the scan's blocks.
    pub(super) block_sums: u64,
    /// Of the tiles.
    pub(super) ranges: u64,
    /// The last pair of each pixel.
    pub(super) last: u64,
    /// Planes of the frame.
    pub(super) frame: u64,
    /// Planes of its gradient.
    pub(super) upstream: u64,
    /// Moments of each trainable splat's entries.
    pub(super) sums: u64,
    /// Four words of each.
    pub(super) statistics: u64,
}

impl Sizes {
    pub(super) fn of(views: &Views) -> Self {
        let [total, own, pairs, area] = [views.total, views.own, views.pair_capacity, views.pixels].map(u64::from);
        let digits = digits(total.max(pairs));
        Self {
            records: RECORD * total.max(1),
            scanned: 4 * (total + 1),
            splat_words: 4 * total,
            pair_words: 4 * pairs,
            moments: 4 * u64::from(MOMENTS) * pairs,
            histogram: 4 * digits,
            block_sums: block_sums(digits.max(total + 1)),
            ranges: 8 * u64::from(views.tiles),
            last: 4 * area,
            frame: 4 * area * if views.extras != 0 { 6 } else { 4 },
            upstream: 4 * area * 5,
            sums: 4 * u64::from(MOMENTS) * own.next_multiple_of(REDUCE_SPLATS.into()),
            statistics: 16 * own,
        }
    }
}

/// Entries of the sorter's histogram.
pub(super) fn digits(entries: u64) -> u64 {
    u64::from(DIGITS) * entries.div_ceil(RADIX_BLOCK.into()).max(1)
}

/// Bytes of the sums of blocks of so many entries.
pub(super) fn block_sums(entries: u64) -> u64 {
    4 * entries.div_ceil(SCAN_BLOCK.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::splats::{bytes_of_bank, most_splats, stride_of};
    use bytemuck::Zeroable;

    /// What wgpu binds at most of a buffer over Vulkan, whatever the card, and in the smallest WebGPU adapter.
    const VULKAN: u64 = i32::MAX as u64;
    const SMALLEST: u64 = 128 << 20;

    /// All buffers of a training of so many splats of SH degree 3 that all are in a view of 1920×1080.
    fn bytes(splats: u32, pairs: u32) -> Vec<u64> {
        let views = Views {
            count: 1,
            pixels: 1920 * 1080,
            tiles: 120 * 68,
            own: splats,
            total: splats,
            pair_capacity: pairs,
            extras: 1,
            ..Views::zeroed()
        };
        let stride = stride_of(splats as usize);
        let s = Sizes::of(&views);
        let words = [s.splat_words; 8].into_iter().chain([s.pair_words; 5]);
        let others =
            [s.records, s.scanned, s.moments, s.histogram, s.block_sums, s.ranges, s.last, s.frame, s.upstream];
        let banks = (0..4).map(|bank| bytes_of_bank(3, bank, stride)).flat_map(|bytes| [bytes; 4]);
        words.chain(others).chain([s.sums, s.statistics]).chain(banks).collect()
    }

    #[test]
    fn eleven_million_splats_hit_no_limit() {
        let all = bytes(11_000_000, 41_000_000);
        let (largest, sum) = (all.iter().max().copied().unwrap_or(0), all.iter().sum::<u64>());
        println!("11 million: the largest of {} buffers has {largest} bytes, all {sum}", all.len());
        // Moments of 41 million pairs of 52 bytes; a bank of fifteen columns has 660 million.
        assert_eq!(largest, 52 * 41_000_000);
        assert_eq!(bytes_of_bank(3, 1, stride_of(11_000_000)), 60 * 11_000_000);
        assert!(largest <= VULKAN);
        // Splats, gradient and two moments of Adam are 10.4 GB of it; a card of 24 GB has room for the rest.
        assert_eq!(
            4 * (0..4).map(|bank| bytes_of_bank(3, bank, stride_of(11_000_000))).sum::<u64>(),
            4 * 59 * 4 * 11_000_000
        );
        assert!(sum < 16_000_000_000, "{sum}");
        // In how many a limit is hit, and that it is told before: `Columns::new` refuses more.
        assert_eq!((most_splats(VULKAN, 3), most_splats(SMALLEST, 3)), (35_791_360, 2_236_928));
        assert!(bytes(35_791_360, 1).iter().all(|&bytes| bytes <= VULKAN));
        assert!(bytes_of_bank(3, 1, stride_of(35_791_361)) > VULKAN);
        // Numbers of threads, words and places stay within 32 bits.
        assert!(all.iter().all(|&bytes| bytes / 4 <= u64::from(u32::MAX)));
    }
}
