// Where v = alpha dL/dalpha and w = alpha T of a pair and a pixel wait for those who add them up: workgroup memory, both in one word of
// two halves. Sums are in single precision, so that what a rounding is off by, one part in 2048, is mostly lost among the others of
// a splat.

// Of pair k and pixel p at 256 k + p.
var<workgroup> halves: array<u32, 2048>;

// The largest half; beyond it is no number.
const LARGEST_HALF: f32 = 65504.0;

// `pixels` are those of the view: a loss is a mean over them, and a half has no digits for what is so small.
fn store_pixel_terms(at: u32, v: f32, w: f32, pixels: f32) {
    halves[at] = pack2x16float(vec2<f32>(clamp(v * pixels, -LARGEST_HALF, LARGEST_HALF), w));
}

fn load_pixel_terms(at: u32, pixels: f32) -> vec2<f32> {
    return unpack2x16float(halves[at]) * vec2<f32>(1.0 / pixels, 1.0);
}
