// Where v = alpha dL/dalpha and w = alpha T of a pair and a pixel wait for those who add them up: workgroup memory, in single precision.

// v of pair k and pixel p at 256 k + p, w 2048 later; then the parts of the moments.
var<workgroup> shared_: array<f32, 4096>;

// `pixels` are those of the view.
fn store_pixel_terms(at: u32, v: f32, w: f32, pixels: f32) {
    shared_[at] = v;
    shared_[2048u + at] = w;
}

fn load_pixel_terms(at: u32, pixels: f32) -> vec2<f32> {
    return vec2<f32>(shared_[at], shared_[2048u + at]);
}
