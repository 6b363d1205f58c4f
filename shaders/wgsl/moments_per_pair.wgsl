// Where a pair's sums go: to a place of their own, which stage `reduce` adds up in the order of the splat's tiles.

// MOMENTS floats a pair.
@group(0) @binding(9) var<storage, read_write> moments: array<f32>;

// Whose sums those of this pair are.
fn output_slot(pair: u32, splat: u32) -> u32 {
    return pair;
}

fn write_moment(at: u32, total: f32) {
    moments[at] = total;
}

// Pairs that no pixel blended.
fn clear_moments(first: u32, end: u32, local: u32) {
    let words = (end - first) * MOMENTS;
    for (var word = local; word < words; word += 256u) {
        moments[sorted[first + word / MOMENTS] * MOMENTS + word % MOMENTS] = 0.0;
    }
}
