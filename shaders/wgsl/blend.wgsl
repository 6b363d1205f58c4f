// A splat's opacity at a pixel, as both directions of the rasterizer compute it.

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
