// Workgroup memory for v = alpha dL/dalpha and w = alpha T of each pair and pixel, as two halves in one word. Sums are
// in single precision, so the rounding errors of single terms, one part in 2048, mostly average out.

// Pair k and pixel p at 256 k + p.
var<workgroup> halves: array<u32, 2048>;

// The largest finite half.
const LARGEST_HALF: f32 = 65504.0;

// v is scaled by the view's number of pixels: gradients of a mean over pixels would underflow.
fn store_pixel_terms(at: u32, v: f32, w: f32, pixels: f32) {
    halves[at] = pack2x16float(vec2<f32>(clamp(v * pixels, -LARGEST_HALF, LARGEST_HALF), w));
}

fn load_pixel_terms(at: u32, pixels: f32) -> vec2<f32> {
    return unpack2x16float(halves[at]) * vec2<f32>(1.0 / pixels, 1.0);
}
