// Output of moments: atomic addition to the splat's sums, in the order in which tiles finish. WGSL has no atomic
// addition of floats, so it is a compare-exchange loop. Results differ from run to run: only a baseline for
// `moments_per_pair.wgsl`.

// MOMENTS floats per entry, as bits.
@group(0) @binding(9) var<storage, read_write> moments: array<atomic<u32>>;

// Index of the moments that this pair writes.
fn output_slot(pair: u32, splat: u32) -> u32 {
    return splat;
}

fn write_moment(at: u32, total: f32) {
    if total == 0.0 {
        return;
    }
    var before = atomicLoad(&moments[at]);
    loop {
        let tried = atomicCompareExchangeWeak(&moments[at], before, bitcast<u32>(bitcast<f32>(before) + total));
        if tried.exchanged {
            break;
        }
        before = tried.old_value;
    }
}

// Pairs without a blended pixel add nothing.
fn clear_moments(first: u32, end: u32, local: u32) {
}
