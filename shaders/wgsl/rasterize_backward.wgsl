// Stage `rasterize_backward`: gradient moments of each pair of a trainable splat and a tile, as sums over the tile's
// pixels.
//
// A workgroup walks its tile's pairs front to back, as `rasterize` does, in batches of eight, in two steps. First, with
// a thread per pixel, it recomputes the eight alphas, derives the colour behind each as "final minus blended so far",
// and stores v = alpha dL/dalpha and w = alpha T in workgroup memory. Then, with 32 threads per pair, each thread sums
// eight pixels of one column, so that most moments need only the sums of v, v dy and v dy^2; `reduce_parts` adds the 32
// parts in a fixed order. There are no float atomics: results are bit-identical from run to run.

@group(0) @binding(0) var<uniform> views: Views;
@group(0) @binding(1) var<storage, read> tile_ranges: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> sorted: array<u32>;
@group(0) @binding(3) var<storage, read> pair_splat: array<u32>;
@group(0) @binding(4) var<storage, read> records: array<Record>;
@group(0) @binding(5) var<storage, read> frame: array<f32>;
@group(0) @binding(6) var<storage, read> last_pair: array<u32>;
// Planes per view: dL/d red, green, blue and, as `planes` says, transmittance and depth; all five have space.
@group(0) @binding(7) var<storage, read> upstream: array<f32>;
@group(0) @binding(8) var<uniform> planes: UpstreamPlanes;
const PAIRS: u32 = 8u; // of a batch
const PARTS: u32 = 32u; // threads per pair
const PIXELS: u32 = 8u; // per thread

var<workgroup> means_ab: array<vec4<f32>, PAIRS>;
var<workgroup> c_opacities: array<vec2<f32>, PAIRS>;
var<workgroup> colours_depths: array<vec4<f32>, PAIRS>;
// Index of the output moments of each pair.
var<workgroup> output_slots: array<u32, PAIRS>;
var<workgroup> is_trainable: array<u32, PAIRS>;
// dL/d colour and depth of each pixel.
var<workgroup> gradients: array<vec4<f32>, 256>;
// Bit k: some pixel blended pair k.
var<workgroup> blended: atomic<u32>;
var<workgroup> end_of_tile: atomic<u32>;
var<workgroup> end_now: u32;

@compute @workgroup_size(256)
fn rasterize_backward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    thread: Thread,
) {
    let local = local_index(thread);
    let tile = group.y * groups.x + group.x;
    let exists = tile < views.tiles;
    var range = vec2<u32>(0u);
    if exists {
        range = tile_ranges[tile];
    }
    let view = views.view[view_of_tile(tile)];
    let tile_of_view = tile - view.first_tile;
    let corner = vec2<u32>(tile_of_view % view.tiles.x, tile_of_view / view.tiles.x) * TILE;
    let at = corner + vec2<u32>(local % TILE, local / TILE);
    let area = view.pixels.x * view.pixels.y;
    let pixel_of_view = at.y * view.pixels.x + at.x;
    let frame_at = frame_planes(views.extras) * view.first_pixel + pixel_of_view;
    let upstream_at = 5u * view.first_pixel + pixel_of_view;

    // This thread's pixel: the upstream gradient, the end of its blended pairs, and the dot product of the gradient
    // with the colour behind the splats blended so far, initially with the final colour.
    var gradient = vec4<f32>(0.0);
    var end = 0u;
    var behind = 0.0;
    if exists && all(at < view.pixels) {
        gradient = vec4<f32>(upstream[upstream_at], upstream[area + upstream_at], upstream[2u * area + upstream_at], 0.0);
        let colour = vec3<f32>(frame[frame_at], frame[area + frame_at], frame[2u * area + frame_at]);
        behind = fma(colour.x, gradient.x, fma(colour.y, gradient.y, colour.z * gradient.z));
        if planes.transmittance != 0u {
            behind = fma(frame[3u * area + frame_at], upstream[3u * area + upstream_at], behind);
        }
        if planes.depth != 0u {
            gradient.w = upstream[4u * area + upstream_at];
            behind = fma(frame[4u * area + frame_at], gradient.w, behind);
        }
        end = last_pair[view.first_pixel + pixel_of_view];
    }
    gradients[local] = gradient;
    if local == 0u {
        atomicStore(&end_of_tile, range.x);
    }
    workgroupBarrier();
    atomicMax(&end_of_tile, end);
    workgroupBarrier();
    if local == 0u {
        end_now = atomicLoad(&end_of_tile);
    }
    let stop = workgroupUniformLoad(&end_now);

    let pixel = vec2<f32>(at) + 0.5;
    var transmittance = 1.0;
    for (var first = range.x; first < stop; first += PAIRS) {
        let count = min(PAIRS, range.y - first);
        if local < count {
            let pair = sorted[first + local];
            let i = pair_splat[pair];
            let record = records[i];
            means_ab[local] = record.mean_ab;
            c_opacities[local] = record.c_opacity_extent.xy;
            colours_depths[local] = record.colour_depth;
            if views.extras == INVERSE_DEPTH {
                colours_depths[local].w = 1.0 / record.colour_depth.w;
            }
            output_slots[local] = output_slot(pair, i);
            is_trainable[local] = u32(i < views.trainable_entries);
        }
        if local == 0u {
            atomicStore(&blended, 0u);
        }
        workgroupBarrier();

        var blended_here = 0u;
        for (var k = 0u; k < count; k++) {
            var v = 0.0;
            var w = 0.0;
            if first + k < end {
                let sample = pixel_alpha(means_ab[k], c_opacities[k].x, c_opacities[k].y, pixel);
                if sample.alpha >= ALPHA_MIN {
                    let alpha = min(sample.alpha, ALPHA_MAX);
                    w = alpha * transmittance;
                    let colour_depth = colours_depths[k];
                    let d_weight = fma(gradient.x, colour_depth.x, fma(gradient.y, colour_depth.y, fma(gradient.z, colour_depth.z, gradient.w * colour_depth.w)));
                    behind = fma(-w, d_weight, behind);
                    // v = alpha dL/dalpha = alpha (T dL/dw - behind / (1 - alpha)); zero where clamped.
                    if sample.alpha < ALPHA_MAX {
                        v = alpha * (transmittance * d_weight - behind / (1.0 - alpha));
                    }
                    transmittance -= w;
                    blended_here |= 1u << k;
                }
            }
            store_pixel_terms(256u * k + local, v, w, f32(area));
        }
        if blended_here != 0u {
            atomicOr(&blended, blended_here);
        }
        workgroupBarrier();

        let k = local / PARTS;
        let part = local % PARTS;
        var sums = PartSums(0.0, 0.0, 0.0, vec4<f32>(0.0), 0.0, vec2<f32>(0.0));
        let any = ((atomicLoad(&blended) >> k) & 1u) != 0u;
        let dx = f32(corner.x + part % TILE) + 0.5 - means_ab[k].x;
        if k < count && any && is_trainable[k] != 0u {
            sums = sum_part(k, part, f32(area), dx, f32(corner.y + part / TILE) + 0.5 - means_ab[k].y);
        }
        reduce_parts(moments_from(sums, dx), count, thread);
    }

    // Clear the pairs behind the last blended one.
    var rest = max(stop, range.x);
    if stop > range.x {
        // The loop above processed whole batches of eight.
        rest = min(range.x + (stop - range.x + PAIRS - 1u) / PAIRS * PAIRS, range.y);
    }
    clear_moments(rest, range.y, local);
}

// The MOMENTS floats of a pair, in order: v, v dx, v dy, v dx^2 | v dx dy, v dy^2, w red, w green | w blue, w depth, w,
// |x| | |y|. Red, green, blue and depth are upstream gradients; |x| and |y| are the mean's gradient with absolute
// values summed.
struct Moments {
    a: vec4<f32>,
    b: vec4<f32>,
    c: vec4<f32>,
    d: f32,
}

fn moments_from(sums: PartSums, dx: f32) -> Moments {
    return Moments(
        vec4<f32>(sums.v, sums.v * dx, sums.vy, sums.v * dx * dx),
        vec4<f32>(sums.vy * dx, sums.vyy, sums.colour_depth.xy),
        vec4<f32>(sums.colour_depth.zw, sums.w, sums.d_weight.x),
        sums.d_weight.y,
    );
}

struct PartSums {
    v: f32,
    vy: f32,
    vyy: f32,
    colour_depth: vec4<f32>,
    w: f32,
    d_weight: vec2<f32>,
}

// Sums over the eight pixels of a part: column part % 16, every second row from part / 16; dx and dy are those of the
// first pixel.
fn sum_part(k: u32, part: u32, pixels: f32, dx: f32, dy: f32) -> PartSums {
    let a = means_ab[k].z;
    let b = means_ab[k].w;
    let c = c_opacities[k].x;
    // (dalpha/d(mean)) / alpha: the derivative of the exponent, converted from base 2.
    let aa = 2.0 * LN_2 * a * a;
    let ab = 2.0 * LN_2 * a * b;
    let bc = 2.0 * LN_2 * fma(b, b, c * c);
    var sums = PartSums(0.0, 0.0, 0.0, vec4<f32>(0.0), 0.0, vec2<f32>(0.0));
    for (var n = 0u; n < PIXELS; n++) {
        let p = part + PARTS * n;
        let vw = load_pixel_terms(256u * k + p, pixels);
        let v = vw.x;
        let w = vw.y;
        let y = dy + f32(2u * n);
        let vy = v * y;
        sums.v += v;
        sums.vy += vy;
        sums.vyy = fma(vy, y, sums.vyy);
        sums.colour_depth = fma(vec4<f32>(w), gradients[p], sums.colour_depth);
        sums.w += w;
        sums.d_weight += abs(v) * abs(vec2<f32>(fma(aa, dx, ab * y), fma(bc, y, ab * dx)));
    }
    return sums;
}
