// Stage `rasterize`: front-to-back blending; a workgroup per tile, a thread per pixel, until every pixel is finished.

@group(0) @binding(0) var<uniform> views: Views;
@group(0) @binding(1) var<storage, read> tile_ranges: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> sorted: array<u32>;
@group(0) @binding(3) var<storage, read> pair_splat: array<u32>;
@group(0) @binding(4) var<storage, read> records: array<Record>;
// Planes per view: red, green, blue, transmittance and, with extras, depth and trainable alpha.
@group(0) @binding(5) var<storage, read_write> frame: array<f32>;
// For each pixel one past the last blended pair, 0 if there is none.
@group(0) @binding(6) var<storage, read_write> last_pair: array<u32>;

const BATCH: u32 = 256u;

var<workgroup> means_ab: array<vec4<f32>, BATCH>;
var<workgroup> c_opacities: array<vec2<f32>, BATCH>;
var<workgroup> colours_depths: array<vec4<f32>, BATCH>;
var<workgroup> is_trainable: array<f32, BATCH>;
var<workgroup> any_unfinished: atomic<u32>;
var<workgroup> any_unfinished_now: u32;

@compute @workgroup_size(256)
fn rasterize(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    // The dispatch may have more workgroups than tiles; surplus ones have no pairs and no pixels.
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
    let inside = exists && all(at < view.pixels);
    let pixel = vec2<f32>(at) + 0.5;

    var transmittance = 1.0;
    var finished = !inside;
    var colour = vec3<f32>(0.0);
    var depth = 0.0;
    var trainable_alpha = 0.0;
    var end = 0u;
    for (var first = range.x; first < range.y; first += BATCH) {
        if local == 0u {
            atomicStore(&any_unfinished, 0u);
        }
        workgroupBarrier();
        if !finished {
            atomicOr(&any_unfinished, 1u);
        }
        workgroupBarrier();
        if local == 0u {
            any_unfinished_now = atomicLoad(&any_unfinished);
        }
        if workgroupUniformLoad(&any_unfinished_now) == 0u {
            break;
        }
        let count = min(BATCH, range.y - first);
        if local < count {
            let i = pair_splat[sorted[first + local]];
            let record = records[i];
            means_ab[local] = record.mean_ab;
            c_opacities[local] = record.c_opacity_extent.xy;
            colours_depths[local] = record.colour_depth;
            if views.extras == INVERSE_DEPTH {
                colours_depths[local].w = 1.0 / record.colour_depth.w;
            }
            is_trainable[local] = f32(i < views.trainable_entries);
        }
        workgroupBarrier();
        for (var k = 0u; k < count && !finished; k++) {
            let sample = pixel_alpha(means_ab[k], c_opacities[k].x, c_opacities[k].y, pixel);
            if sample.alpha < ALPHA_MIN {
                continue;
            }
            let weight = min(sample.alpha, ALPHA_MAX) * transmittance;
            let rest = transmittance - weight;
            if rest <= TRANSMITTANCE_MIN {
                finished = true;
                break;
            }
            let colour_depth = colours_depths[k];
            colour = fma(vec3<f32>(weight), colour_depth.xyz, colour);
            depth = fma(weight, colour_depth.w, depth);
            trainable_alpha = fma(weight, is_trainable[k], trainable_alpha);
            transmittance = rest;
            end = first + k + 1u;
        }
    }

    if inside {
        let area = view.pixels.x * view.pixels.y;
        let here = at.y * view.pixels.x + at.x;
        let to = frame_planes(views.extras) * view.first_pixel + here;
        colour = fma(vec3<f32>(transmittance), views.background.xyz, colour);
        frame[to] = colour.x;
        frame[area + to] = colour.y;
        frame[2u * area + to] = colour.z;
        frame[3u * area + to] = transmittance;
        if views.extras != 0u {
            frame[4u * area + to] = depth;
            frame[5u * area + to] = trainable_alpha;
        }
        last_pair[view.first_pixel + here] = end;
    }
}
