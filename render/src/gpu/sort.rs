//! Prefix sum and LSD radix sort: the sequences of dispatches of `scan` and `radix`.
//!
//! Only the device knows the number of entries: threads read it from a word of the status, dispatches take it from
//! `args`.

use shaders::{PassConstants, args, status_word};

use super::buffer::GrowableBuffer;
use super::device::Gpu;
use super::error::GpuError;
use super::kernel::Kernel;

/// Bits of a digit.
const DIGIT_BITS: u32 = 8;

/// The kernels of both, and their scratch buffers.
#[derive(Debug)]
pub(super) struct Sorter {
    scan_blocks: Kernel,
    scan_sums: Kernel,
    scan_apply: Kernel,
    count: Kernel,
    scatter: Kernel,
    histogram: GrowableBuffer,
    block_sums: GrowableBuffer,
}

/// Ping-pong buffers of keys and values: each pass reads one pair and writes the other.
#[derive(Debug)]
pub(super) struct SortBuffers {
    pub(super) keys: [GrowableBuffer; 2],
    pub(super) values: [GrowableBuffer; 2],
}

impl SortBuffers {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let make = |label| GrowableBuffer::new(gpu, label);
        Ok(Self { keys: [make("keys")?, make("keys")?], values: [make("values")?, make("values")?] })
    }

    pub(super) fn reserve(&mut self, gpu: &Gpu, bytes: u64) -> Result<(), GpuError> {
        self.keys.iter_mut().chain(&mut self.values).try_for_each(|buffer| buffer.reserve(gpu, bytes))
    }
}

/// The array to sort; it determines the status words and indirect dispatches.
#[derive(Clone, Copy)]
pub(super) enum SortInput {
    /// The visible entries.
    Entries,
    /// The pairs of entries and tiles.
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
            histogram: GrowableBuffer::new(gpu, "histogram")?,
            block_sums: GrowableBuffer::new(gpu, "sums of blocks")?,
        })
    }

    /// Allocates the histogram and the block sums, bytes.
    pub(super) fn reserve(&mut self, gpu: &Gpu, histogram: u64, block_sums: u64) -> Result<(), GpuError> {
        self.histogram.reserve(gpu, histogram)?;
        self.block_sums.reserve(gpu, block_sums)
    }

    /// Exclusive prefix sum of `data` in place; status word `len_word` holds its length.
    pub(super) fn scan(
        &self,
        gpu: &Gpu,
        pass: &mut wgpu::ComputePass,
        data: &wgpu::Buffer,
        status: &wgpu::Buffer,
        len_word: u32,
        groups: Groups,
    ) {
        let uniform = gpu.uniform(&PassConstants { len_word, shift: 0, padding: [0; 2] });
        let bindings = [(0, data), (1, &*self.block_sums), (2, status), (3, &uniform)];
        groups.run(gpu, pass, &self.scan_blocks, &bindings);
        self.scan_sums.run(gpu, pass, &bindings[1..], 1);
        groups.run(gpu, pass, &self.scan_apply, &bindings);
    }

    /// Sorts stably by the lowest `bits` of the keys; returns the index of the ping-pong buffer that holds the result.
    /// Input keys are in buffer 0; input values are `first_values`, or else in buffer 0.
    pub(super) fn sort(
        &self,
        gpu: &Gpu,
        pass: &mut wgpu::ComputePass,
        buffers: &SortBuffers,
        first_values: Option<&wgpu::Buffer>,
        bits: u32,
        (status, args): (&wgpu::Buffer, &wgpu::Buffer),
        input: SortInput,
    ) -> usize {
        let (count_word, histogram_word, blocks, histogram) = match input {
            SortInput::Entries => {
                (status_word::VISIBLE, status_word::VISIBLE_HISTOGRAM, args::VISIBLE_SORT, args::VISIBLE_HISTOGRAM)
            }
            SortInput::Pairs => {
                (status_word::PAIRS, status_word::PAIR_HISTOGRAM, args::PAIR_SORT, args::PAIR_HISTOGRAM)
            }
        };
        let passes = bits.div_ceil(DIGIT_BITS).max(1);
        for n in 0..passes {
            let (from, to) = (n as usize % 2, (n as usize + 1) % 2);
            let values = first_values.filter(|_| n == 0).unwrap_or(&buffers.values[from]);
            let uniform = gpu.uniform(&PassConstants { len_word: count_word, shift: n * DIGIT_BITS, padding: [0; 2] });
            let bindings: [(u32, &wgpu::Buffer); 7] = [
                (0, &buffers.keys[from]),
                (4, &self.histogram),
                (5, status),
                (6, &uniform),
                (1, values),
                (2, &buffers.keys[to]),
                (3, &buffers.values[to]),
            ];
            self.count.run_indirect(gpu, pass, &bindings[..4], args, blocks);
            self.scan(gpu, pass, &self.histogram, status, histogram_word, Groups::Indirect(args, histogram));
            self.scatter.run_indirect(gpu, pass, &bindings, args, blocks);
        }
        passes as usize % 2
    }
}

/// The number of workgroups of a scan.
#[derive(Clone, Copy)]
pub(super) enum Groups<'a> {
    /// This many.
    Direct(u32),
    /// From this entry of the indirect arguments.
    Indirect(&'a wgpu::Buffer, u64),
}

impl Groups<'_> {
    fn run(self, gpu: &Gpu, pass: &mut wgpu::ComputePass, kernel: &Kernel, bindings: &[(u32, &wgpu::Buffer)]) {
        match self {
            Self::Direct(groups) => kernel.run(gpu, pass, bindings, groups),
            Self::Indirect(args, dispatch) => kernel.run_indirect(gpu, pass, bindings, args, dispatch),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::sizes;
    use shaders::{RADIX_BLOCK, SCAN_BLOCK};

    /// Random numbers, the same on every machine (SplitMix64).
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
            let gpu = crate::gpu::testing::gpu(portable)?;
            let sorter = Sorter::new(&gpu).expect("kernels");
            let status = gpu.buffer("status", size_of::<shaders::Status>() as u64).expect("a buffer");
            let args = gpu.buffer("args", 12 * args::COUNT).expect("a buffer");
            Some(Self { gpu, sorter, status, args })
        }

        /// Writes the status and arguments that stage `plan` writes for so many visible entries.
        fn plan(&mut self, encoder: &mut wgpu::CommandEncoder, count: usize) {
            let blocks = count.div_ceil(RADIX_BLOCK as usize) as u32;
            let histogram = shaders::RADIX_BINS * blocks;
            let status = shaders::Status {
                visible: count as u32,
                visible_histogram_len: histogram,
                entry_scan_len: count as u32,
                ..Default::default()
            };
            self.gpu.write(encoder, &self.status, 0, &[status]);
            self.gpu.write(encoder, &self.args, 12 * args::VISIBLE_SORT, &[blocks, 1, 1]);
            self.gpu.write(encoder, &self.args, 12 * args::VISIBLE_HISTOGRAM, &[histogram.div_ceil(SCAN_BLOCK), 1, 1]);
            let entries = u64::from(histogram).max(count as u64);
            self.sorter
                .reserve(&self.gpu, 4 * sizes::histogram_len(count as u64), sizes::block_sums(entries))
                .expect("buffers");
        }
    }

    #[test]
    fn prefix_sums_are_exclusive_and_saturate() {
        [false, true].into_iter().filter_map(Bench::open).for_each(check_prefix_sums);
    }

    fn check_prefix_sums(mut bench: Bench) {
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
            bench.sorter.scan(&bench.gpu, &mut pass, &data, &bench.status, status_word::ENTRY_SCAN, groups);
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
        let mut buffers = SortBuffers::new(&bench.gpu).expect("buffers");
        for count in [1, 255, 256, 257, 4095, 4096, 4097, 100_000] {
            for (bits, mask) in [(32, u32::MAX), (32, 0x3f00_0007), (10, 0x3ff), (8, 0x1)] {
                let keys: Vec<u32> = numbers(count, 9).iter().map(|key| key & mask).collect();
                let values: Vec<u32> = (0..count as u32).collect();
                buffers.reserve(&bench.gpu, 4 * count as u64).expect("buffers");
                let mut encoder = bench.gpu.encoder();
                bench.plan(&mut encoder, count);
                bench.gpu.write(&mut encoder, &buffers.keys[0], 0, &keys);
                bench.gpu.write(&mut encoder, &buffers.values[0], 0, &values);
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
                let (status, args) = (&*bench.status, &*bench.args);
                let input = SortInput::Entries;
                let sorted = bench.sorter.sort(&bench.gpu, &mut pass, &buffers, None, bits, (status, args), input);
                drop(pass);
                bench.gpu.submit(encoder).expect("submitted");
                let mut expected = values;
                expected.sort_by_key(|&i| keys[i as usize]);
                let found: Vec<u32> = bench.gpu.read(&buffers.values[sorted], 0, count).expect("values");
                assert!(found == expected, "{count} entries of {bits} bits, mask {mask:x}");
            }
        }
    }
}
