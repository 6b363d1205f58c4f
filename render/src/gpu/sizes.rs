//! Sizes of the renderer's buffers for given views.

use shaders::{MOMENTS, RADIX_BINS, RADIX_BLOCK, REDUCE_SPLATS, SCAN_BLOCK, Views};

/// Bytes of a `Record` in `view.wgsl`.
const RECORD_BYTES: u64 = 48;

/// Bytes of each buffer of a forward and a backward pass, without the splats and their gradients.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Sizes {
    /// Projected splats of all entries.
    pub(super) records: u64,
    /// Prefix sums over all entries, and the total.
    pub(super) entry_sums: u64,
    /// A word per entry.
    pub(super) entry_words: u64,
    /// A word per pair.
    pub(super) pair_words: u64,
    /// Moments per pair.
    pub(super) moments: u64,
    /// Radix histogram.
    pub(super) histogram: u64,
    /// Sums of the scan's blocks.
    pub(super) block_sums: u64,
    /// First and last pair of each tile.
    pub(super) tile_ranges: u64,
    /// Last blended pair of each pixel.
    pub(super) last_pair: u64,
    /// Planes of the frame.
    pub(super) frame: u64,
    /// Planes of the upstream gradient.
    pub(super) upstream: u64,
    /// Moments per entry of a trainable splat.
    pub(super) splat_moments: u64,
    /// Four words per entry of a trainable splat, or twelve with displacements.
    pub(super) statistics: u64,
}

impl Sizes {
    pub(super) fn of(views: &Views) -> Self {
        let [entries, trainable, pairs, area] =
            [views.entries, views.trainable_entries, views.pair_capacity, views.pixels].map(u64::from);
        let histogram = histogram_len(entries.max(pairs));
        Self {
            records: RECORD_BYTES * entries.max(1),
            entry_sums: 4 * (entries + 1),
            entry_words: 4 * entries,
            pair_words: 4 * pairs,
            moments: 4 * u64::from(MOMENTS) * pairs,
            histogram: 4 * histogram,
            block_sums: block_sums(histogram.max(entries + 1)),
            tile_ranges: 8 * u64::from(views.tiles),
            last_pair: 4 * area,
            frame: 4 * area * if views.extras != 0 { 6 } else { 4 },
            upstream: 4 * area * 5,
            splat_moments: 4 * u64::from(MOMENTS) * trainable.next_multiple_of(REDUCE_SPLATS.into()),
            // With displacements, also two vectors of the pose gradient.
            statistics: if is_displaced(views) { 3 * 16 * trainable } else { 16 * trainable },
        }
    }
}

/// Whether any view has a displacement.
pub(super) fn is_displaced(views: &Views) -> bool {
    views.view[..views.count as usize].iter().any(|view| view.displacement != 0)
}

/// Length of the radix histogram for so many entries.
pub(super) fn histogram_len(entries: u64) -> u64 {
    u64::from(RADIX_BINS) * entries.div_ceil(RADIX_BLOCK.into()).max(1)
}

/// Bytes of the block sums of a scan over so many entries.
pub(super) fn block_sums(entries: u64) -> u64 {
    4 * entries.div_ceil(SCAN_BLOCK.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::splats::{bank_bytes, max_splats, stride_of};
    use bytemuck::Zeroable;

    /// wgpu's largest binding over Vulkan on any card.
    const VULKAN_LIMIT: u64 = i32::MAX as u64;
    /// The largest binding that WebGPU guarantees.
    const WEBGPU_LIMIT: u64 = 128 << 20;

    /// Sizes of all buffers of training with so many splats of SH degree 3, all visible in one view of 1920×1080.
    fn bytes(splats: u32, pairs: u32) -> Vec<u64> {
        let views = Views {
            count: 1,
            pixels: 1920 * 1080,
            tiles: 120 * 68,
            trainable_entries: splats,
            entries: splats,
            pair_capacity: pairs,
            extras: 1,
            ..Views::zeroed()
        };
        let stride = stride_of(splats as usize);
        let s = Sizes::of(&views);
        let words = [s.entry_words; 8].into_iter().chain([s.pair_words; 5]);
        let others = [
            s.records,
            s.entry_sums,
            s.moments,
            s.histogram,
            s.block_sums,
            s.tile_ranges,
            s.last_pair,
            s.frame,
            s.upstream,
        ];
        let banks = (0..4).map(|bank| bank_bytes(3, bank, stride)).flat_map(|bytes| [bytes; 4]);
        words.chain(others).chain([s.splat_moments, s.statistics]).chain(banks).collect()
    }

    #[test]
    fn eleven_million_splats_fit_the_limits() {
        let all = bytes(11_000_000, 41_000_000);
        let (largest, sum) = (all.iter().max().copied().unwrap_or(0), all.iter().sum::<u64>());
        println!("11 million: the largest of {} buffers has {largest} bytes, all have {sum}", all.len());
        // Moments of 41 million pairs of 52 bytes; a bank of fifteen columns has 660 million.
        assert_eq!(largest, 52 * 41_000_000);
        assert_eq!(bank_bytes(3, 1, stride_of(11_000_000)), 60 * 11_000_000);
        assert!(largest <= VULKAN_LIMIT);
        // Splats, gradients and Adam's two moments are 10.4 GB of the total, which fits a card of 24 GB.
        assert_eq!(
            4 * (0..4).map(|bank| bank_bytes(3, bank, stride_of(11_000_000))).sum::<u64>(),
            4 * 59 * 4 * 11_000_000
        );
        assert!(sum < 16_000_000_000, "{sum}");
        // The largest counts that fit; `Columns::new` rejects more.
        assert_eq!((max_splats(VULKAN_LIMIT, 3), max_splats(WEBGPU_LIMIT, 3)), (35_791_360, 2_236_928));
        assert!(bytes(35_791_360, 1).iter().all(|&bytes| bytes <= VULKAN_LIMIT));
        assert!(bank_bytes(3, 1, stride_of(35_791_361)) > VULKAN_LIMIT);
        // Thread and word indices stay within 32 bits.
        assert!(all.iter().all(|&bytes| bytes / 4 <= u64::from(u32::MAX)));
    }
}
