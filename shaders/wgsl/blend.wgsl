// What both directions of the rasterizer compute: whose a tile is, and a splat's opacity at a pixel.

fn view_of_tile(tile: u32) -> u32 {
    var v = 0u;
    while v + 1u < views.count && tile >= views.each[v + 1u].first_tile {
        v++;
    }
    return v;
}

struct Touch {
    delta: vec2<f32>,
    // Before it is clamped at ALPHA_MAX; below ALPHA_MIN the splat is skipped.
    alpha: f32,
}

fn touch(place: vec4<f32>, c: f32, log2_opacity: f32, pixel: vec2<f32>) -> Touch {
    let delta = pixel - place.xy;
    let u = fma(place.z, delta.x, place.w * delta.y);
    let v = c * delta.y;
    return Touch(delta, exp2(fma(-u, u, fma(-v, v, log2_opacity))));
}
