// Workgroup memory for v = alpha dL/dalpha and w = alpha T of each pair and pixel, in single precision.

// v of pair k and pixel p at 256 k + p, w 2048 later; reused for the partial moments.
var<workgroup> shared_: array<f32, 4096>;

// `pixels`: number of pixels of the view, used by the half-precision version.
fn store_pixel_terms(at: u32, v: f32, w: f32, pixels: f32) {
    shared_[at] = v;
    shared_[2048u + at] = w;
}

fn load_pixel_terms(at: u32, pixels: f32) -> vec2<f32> {
    return vec2<f32>(shared_[at], shared_[2048u + at]);
}
