//! Sums and sorts on the device: how the entry points of `scan` and `radix` follow one another.
//!
//! How many entries there are only the device knows: a word of its status says so to the threads, an entry of `args` to
//! the dispatches.

use shaders::{Pass, args, slot};

use super::device::Gpu;
use super::error::GpuError;
use super::kernel::Kernel;
use super::memory::Growing;

/// Bits of a digit.
const DIGIT_BITS: u32 = 8;

/// The kernels, the constants of each of their passes, and their scratch memory.
#[derive(Debug)]
pub(super) struct Sorter {
    scan_blocks: Kernel,
    scan_sums: Kernel,
    scan_apply: Kernel,
    count: Kernel,
    scatter: Kernel,
    histogram: Growing,
    block_sums: Growing,
}

/// Keys and values, twice: each pass goes from one side to the other.
#[derive(Debug)]
pub(super) struct Sides {
    pub(super) keys: [Growing; 2],
    pub(super) values: [Growing; 2],
}

impl Sides {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let make = |label| Growing::new(gpu, label);
        Ok(Self { keys: [make("keys")?, make("keys")?], values: [make("values")?, make("values")?] })
    }

    pub(super) fn fit(&mut self, gpu: &Gpu, bytes: u64) -> Result<(), GpuError> {
        self.keys.iter_mut().chain(&mut self.values).try_for_each(|buffer| buffer.fit(gpu, bytes))
    }
}

/// What is sorted: where its count and the dispatches that go with it are found.
#[derive(Clone, Copy)]
pub(super) enum Sorted {
    /// The visible splats.
    Splats,
    /// Their pairs with tiles.
    Pairs,
}

impl Sorter {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Ok(Self {
            scan_blocks: gpu.kernel(&shaders::SCAN, "scan_blocks")?,
            scan_sums: gpu.kernel(&shaders::SCAN, "scan_sums")?,
            scan_apply: gpu.kernel(&shaders::SCAN, "scan_apply")?,
            count: gpu.kernel(&shaders::RADIX, "radix_count")?,
            scatter: gpu.kernel(&shaders::RADIX, "radix_scatter")?,
            histogram: Growing::new(gpu, "histogram")?,
            block_sums: Growing::new(gpu, "sums of blocks")?,
        })
    }

    /// Room for a histogram and for sums of blocks, bytes.
    pub(super) fn fit(&mut self, gpu: &Gpu, histogram: u64, block_sums: u64) -> Result<(), GpuError> {
        self.histogram.fit(gpu, histogram)?;
        self.block_sums.fit(gpu, block_sums)
    }

    /// Exclusive sums of `data` in place; the status word `slot` says how many.
    pub(super) fn scan(
        &self,
        gpu: &Gpu,
        pass: &mut wgpu::ComputePass,
        data: &wgpu::Buffer,
        status: &wgpu::Buffer,
        slot: u32,
        groups: Groups,
    ) {
        let uniform = gpu.uniform(&Pass { slot, shift: 0, padding: [0; 2] });
        let bindings = [(0, data), (1, &*self.block_sums), (2, status), (3, &uniform)];
        groups.run(gpu, pass, &self.scan_blocks, &bindings);
        self.scan_sums.run(gpu, pass, &bindings[1..], 1);
        groups.run(gpu, pass, &self.scan_apply, &bindings);
    }

    /// Sorts by the lowest `bits` of the keys, stably; returns the side on which the result lies. The first pass takes
    /// keys and values of `from`, where given, instead of those of side 0.
    pub(super) fn sort(
        &self,
        gpu: &Gpu,
        pass: &mut wgpu::ComputePass,
        sides: &Sides,
        first_values: Option<&wgpu::Buffer>,
        bits: u32,
        (status, args): (&wgpu::Buffer, &wgpu::Buffer),
        what: Sorted,
    ) -> usize {
        let (count_slot, digits_slot, blocks, digits) = match what {
            Sorted::Splats => (slot::VISIBLE, slot::VISIBLE_DIGITS, args::VISIBLE_SORT, args::VISIBLE_DIGITS),
            Sorted::Pairs => (slot::PAIRS, slot::PAIR_DIGITS, args::PAIR_SORT, args::PAIR_DIGITS),
        };
        let passes = bits.div_ceil(DIGIT_BITS).max(1);
        for n in 0..passes {
            let (from, to) = (n as usize % 2, (n as usize + 1) % 2);
            let values = first_values.filter(|_| n == 0).unwrap_or(&sides.values[from]);
            let uniform = gpu.uniform(&Pass { slot: count_slot, shift: n * DIGIT_BITS, padding: [0; 2] });
            let bindings: [(u32, &wgpu::Buffer); 7] = [
                (0, &sides.keys[from]),
                (4, &self.histogram),
                (5, status),
                (6, &uniform),
                (1, values),
                (2, &sides.keys[to]),
                (3, &sides.values[to]),
            ];
            self.count.run_indirect(gpu, pass, &bindings[..4], args, blocks);
            self.scan(gpu, pass, &self.histogram, status, digits_slot, Groups::Indirect(args, digits));
            self.scatter.run_indirect(gpu, pass, &bindings, args, blocks);
        }
        passes as usize % 2
    }
}

/// How many workgroups a scan takes.
#[derive(Clone, Copy)]
pub(super) enum Groups<'a> {
    /// As the host says.
    Direct(u32),
    /// As this entry of `args` says.
    Indirect(&'a wgpu::Buffer, u64),
}

impl Groups<'_> {
    fn run(self, gpu: &Gpu, pass: &mut wgpu::ComputePass, kernel: &Kernel, bindings: &[(u32, &wgpu::Buffer)]) {
        match self {
            Self::Direct(groups) => kernel.run(gpu, pass, bindings, groups),
            Self::Indirect(args, place) => kernel.run_indirect(gpu, pass, bindings, args, place),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::sizes;
    use shaders::{RADIX_BLOCK, SCAN_BLOCK};

    /// A number for each place, the same on every machine (SplitMix64).
    fn numbers(count: usize, seed: u64) -> Vec<u32> {
        let mix = |n: u64| {
            let z = (n ^ (n >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            ((z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb) >> 32) as u32
        };
        (0..count as u64).map(|i| mix((seed + i).wrapping_mul(0x9e37_79b9_7f4a_7c15))).collect()
    }

    struct Bench {
        gpu: std::sync::Arc<Gpu>,
        sorter: Sorter,
        status: crate::gpu::Buffer,
        args: crate::gpu::Buffer,
    }

    impl Bench {
        fn open(portable: bool) -> Option<Self> {
            let gpu = crate::gpu::tests::gpu(portable)?;
            let sorter = Sorter::new(&gpu).expect("kernels");
            let status = gpu.buffer("status", size_of::<shaders::Status>() as u64).expect("a buffer");
            let args = gpu.buffer("args", 12 * args::COUNT).expect("a buffer");
            Some(Self { gpu, sorter, status, args })
        }

        /// Writes what stage `plan` would for so many visible splats.
        fn plan(&mut self, encoder: &mut wgpu::CommandEncoder, count: usize) {
            let blocks = count.div_ceil(RADIX_BLOCK as usize) as u32;
            let digits = shaders::DIGITS * blocks;
            let status = shaders::Status {
                visible: count as u32,
                visible_digits: digits,
                splat_slots: count as u32,
                ..Default::default()
            };
            self.gpu.write(encoder, &self.status, 0, &[status]);
            self.gpu.write(encoder, &self.args, 12 * args::VISIBLE_SORT, &[blocks, 1, 1]);
            self.gpu.write(encoder, &self.args, 12 * args::VISIBLE_DIGITS, &[digits.div_ceil(SCAN_BLOCK), 1, 1]);
            let entries = u64::from(digits).max(count as u64);
            self.sorter.fit(&self.gpu, 4 * sizes::digits(count as u64), sizes::block_sums(entries)).expect("room");
        }
    }

    #[test]
    fn sums_are_exclusive_and_stay_at_the_largest_number() {
        [false, true].into_iter().filter_map(Bench::open).for_each(check_sums);
    }

    fn check_sums(mut bench: Bench) {
        for (count, huge) in [(1, false), (255, false), (1024, false), (1025, false), (300_000, false), (5000, true)] {
            let mut values: Vec<u32> = numbers(count, 3).iter().map(|v| v % 1000).collect();
            if huge {
                (values[100], values[2000]) = (u32::MAX - 5, 1000);
            }
            let data = bench.gpu.buffer("data", 4 * count as u64).expect("a buffer");
            let mut encoder = bench.gpu.encoder();
            bench.plan(&mut encoder, count);
            bench.gpu.write(&mut encoder, &data, 0, &values);
            let groups = Groups::Direct((count as u32).div_ceil(SCAN_BLOCK));
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            bench.sorter.scan(&bench.gpu, &mut pass, &data, &bench.status, slot::SPLAT_SLOTS, groups);
            drop(pass);
            bench.gpu.submit(encoder).expect("submitted");
            let mut sum = 0u32;
            let expected: Vec<u32> = values.iter().map(|&v| (sum, sum = sum.saturating_add(v)).0).collect();
            assert!(bench.gpu.read::<u32>(&data, 0, count).expect("sums") == expected, "{count} entries, huge {huge}");
        }
    }

    #[test]
    fn sorts_are_stable() {
        [false, true].into_iter().filter_map(Bench::open).for_each(check_sorts);
    }

    fn check_sorts(mut bench: Bench) {
        let mut sides = Sides::new(&bench.gpu).expect("buffers");
        for count in [1, 255, 256, 257, 4095, 4096, 4097, 100_000] {
            for (bits, mask) in [(32, u32::MAX), (32, 0x3f00_0007), (10, 0x3ff), (8, 0x1)] {
                let keys: Vec<u32> = numbers(count, 9).iter().map(|key| key & mask).collect();
                let values: Vec<u32> = (0..count as u32).collect();
                sides.fit(&bench.gpu, 4 * count as u64).expect("room");
                let mut encoder = bench.gpu.encoder();
                bench.plan(&mut encoder, count);
                bench.gpu.write(&mut encoder, &sides.keys[0], 0, &keys);
                bench.gpu.write(&mut encoder, &sides.values[0], 0, &values);
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
                let known = (&*bench.status, &*bench.args);
                let side = bench.sorter.sort(&bench.gpu, &mut pass, &sides, None, bits, known, Sorted::Splats);
                drop(pass);
                bench.gpu.submit(encoder).expect("submitted");
                let mut expected = values;
                expected.sort_by_key(|&i| keys[i as usize]);
                let found: Vec<u32> = bench.gpu.read(&sides.values[side], 0, count).expect("values");
                assert!(found == expected, "{count} entries of {bits} bits, mask {mask:x}");
            }
        }
    }
}
