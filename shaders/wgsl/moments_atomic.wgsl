// Where a pair's sums go: straight to its splat's, in whatever order tiles come. WGSL has no atomic addition of floats, so that a
// thread tries until nobody came between. To be measured against `in_order.wgsl`, not to be trained with: other bits every time.

// MOMENTS floats a splat, as bits.
@group(0) @binding(9) var<storage, read_write> moments: array<atomic<u32>>;

// Whose sums those of this pair are.
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

// Pairs that no pixel blended add nothing.
fn clear_moments(first: u32, end: u32, local: u32) {
}
