// Output of moments: a slot per pair; stage `reduce` sums the slots in the order of the tiles.

// MOMENTS floats per pair.
@group(0) @binding(9) var<storage, read_write> moments: array<f32>;

// Index of the moments that this pair writes.
fn output_slot(pair: u32, splat: u32) -> u32 {
    return pair;
}

fn write_moment(at: u32, total: f32) {
    moments[at] = total;
}

// Clears the moments of pairs without a blended pixel.
fn clear_moments(first: u32, end: u32, local: u32) {
    let words = (end - first) * MOMENTS;
    for (var word = local; word < words; word += 256u) {
        moments[sorted[first + word / MOMENTS] * MOMENTS + word % MOMENTS] = 0.0;
    }
}
