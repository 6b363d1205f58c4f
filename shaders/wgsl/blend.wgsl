// Shared by both rasterizer stages: the view of a tile, and alpha of a splat at a pixel.

fn view_of_tile(tile: u32) -> u32 {
    var v = 0u;
    while v + 1u < views.count && tile >= views.view[v + 1u].first_tile {
        v++;
    }
    return v;
}

struct PixelAlpha {
    // Pixel minus mean.
    delta: vec2<f32>,
    // Not yet clamped to ALPHA_MAX; below ALPHA_MIN the splat is skipped.
    alpha: f32,
}

fn pixel_alpha(mean_ab: vec4<f32>, c: f32, log2_opacity: f32, pixel: vec2<f32>) -> PixelAlpha {
    let delta = pixel - mean_ab.xy;
    let u = fma(mean_ab.z, delta.x, mean_ab.w * delta.y);
    let v = c * delta.y;
    return PixelAlpha(delta, exp2(fma(-u, u, fma(-v, v, log2_opacity))));
}
