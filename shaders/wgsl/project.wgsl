// Stage `project`: EWA projection of splats to ellipses in the views; one thread per entry.

@group(0) @binding(6) var<storage, read_write> records: array<Record>;
@group(0) @binding(7) var<storage, read_write> is_visible: array<u32>;
// A copy of `is_visible`, scanned in place.
@group(0) @binding(8) var<storage, read_write> sums: array<u32>;
@group(0) @binding(9) var<storage, read_write> tiles: array<u32>;

@compute @workgroup_size(256)
fn project(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let entry = thread_number(group, groups, local);
    if entry >= splats.count * views.count {
        return;
    }
    view = views.view[entry % views.count];
    let n = splats.first * views.count + entry;
    var record: Record;
    let drawn = project_splat(entry / views.count, &record);
    is_visible[n] = u32(drawn);
    sums[n] = u32(drawn);
    if drawn {
        records[n] = record;
        tiles[n] = count_tiles(record);
    }
}

// Conservative visibility: the splat is treated as an opaque sphere of its largest scale.
fn near_image(i: u32, p: vec3<f32>) -> bool {
    // 3.34: sqrt(2 ln 255) with a margin for rounding; 1.9: the same times sqrt(LOW_PASS).
    let scales = column3(3u, i);
    let reach = exp2(max(scales.x, max(scales.y, scales.z)) * LOG2_E) * 3.34;
    let inv_z = 1.0 / max(p.z, NEAR_METRES);
    let ratio = p.xy * inv_z;
    let u = min(max(ratio, view.cone_min), view.cone_max);
    // A row of J W has norm f/z sqrt(1 + u^2).
    let half = fma(view.focal * inv_z * reach, 1.0 + abs(u), vec2<f32>(1.9));
    let centre = fma(view.focal, ratio, view.principal);
    return all(centre - half <= vec2<f32>(view.pixels)) && all(vec2<f32>(0.0) <= centre + half);
}

fn project_splat(i: u32, record: ptr<function, Record>) -> bool {
    let mean = column3(0u, i);
    let p = camera_point(mean);
    if !(is_finite(p.x) && is_finite(p.y) && is_finite(p.z)) || !(p.z > NEAR_METRES) || !near_image(i, p) {
        return false;
    }
    let logit = column(10u, i);
    if !(is_finite(column(3u, i)) && is_finite(column(4u, i)) && is_finite(column(5u, i)) && is_finite(logit)) {
        return false;
    }
    let e = ewa(i, p);
    let inv_det = 1.0 / e.det1;
    var o = opacity(i);
    if views.antialiased != 0u {
        o *= sqrt(e.det0 * inv_det);
    }
    // The squared radius in sigmas at which alpha falls to 1/255.
    let reach = 2.0 * log(o * 255.0);
    let variance = e.cov.xz + LOW_PASS;
    let half = sqrt(max(reach * variance, vec2<f32>(0.0)));
    let centre = view.focal * p.xy * e.inv_z + view.principal;
    // The bounding box must contain a pixel centre.
    let size = vec2<f32>(view.pixels);
    let sane = is_finite(half.x + half.y) && is_finite(centre.x + centre.y) && is_finite(reach) && is_finite(e.det1)
        && is_finite(inv_det);
    let inside = reach > 0.0 && e.det1 > 0.0 && all(centre - half <= size - 0.5) && all(vec2<f32>(0.5) <= centre + half)
        && half.x + half.y < 1e7;
    if !sane || !inside {
        return false;
    }

    let raw = colour(i, direction(mean).xyz);
    // Non-finite or huge colours would corrupt whole pixels: such splats are culled.
    if !(is_finite(raw.x) && is_finite(raw.y) && is_finite(raw.z)) || !all(abs(raw) < vec3<f32>(1e6)) {
        return false;
    }
    let inv_std_y = sqrt(0.5 * LOG2_E / variance.y);
    let inv_std_x = sqrt(0.5 * LOG2_E * variance.y * inv_det); // of x given y
    (*record).mean_ab = vec4<f32>(centre, inv_std_x, -(inv_std_x * e.cov.y / variance.y));
    (*record).c_opacity_extent = vec4<f32>(inv_std_y, log2(o), half);
    (*record).colour_depth = vec4<f32>(max(raw, vec3<f32>(0.0)), p.z);
    return true;
}

fn count_tiles(r: Record) -> u32 {
    let box = tile_box(r, view.tiles);
    let e = ellipse(r);
    var count = 0u;
    for (var y = box.first.y; y < box.end.y; y++) {
        for (var x = box.first.x; x < box.end.x; x++) {
            count += u32(overlaps(e, vec2<u32>(x, y)));
        }
    }
    return count;
}
