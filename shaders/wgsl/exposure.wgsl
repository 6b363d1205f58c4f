// Stage `exposure`: the gradient of the exposed render, as `loss_backward` leaves it, becomes that of the render and of
// each view's exposure; then an Adam step of the exposures. All sums run in a fixed order.
//
//   upstream → expose_backward → upstream, sums per tile → exposure_step → exposures

@group(0) @binding(0) var<uniform> photos: Photos;
@group(0) @binding(1) var<storage, read> frame: array<f32>;
@group(0) @binding(2) var<storage, read_write> upstream: array<f32>;
// Three rows per exposure.
@group(0) @binding(3) var<storage, read_write> exposures: array<vec4<f32>>;
// Per tile: the gradient of the exposure's three rows.
@group(0) @binding(4) var<storage, read_write> sums: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> state: OptimiserState;
@group(0) @binding(6) var<uniform> constants: ExposureConstants;
// Per exposure: the first moments of its three rows, then the second moments.
@group(0) @binding(7) var<storage, read_write> moments: array<vec4<f32>>;
// Adam steps of each exposure.
@group(0) @binding(8) var<storage, read_write> steps: array<u32>;

const BETA2: f32 = 0.999;

var<workgroup> gradient: array<vec4<f32>, 3>;

// A workgroup handles one tile.
@compute @workgroup_size(256)
fn expose_backward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let n = group.y * groups.x + group.x;
    var v = 0u;
    while v + 1u < photos.count && n >= photos.photo[v + 1u].first_tile {
        v++;
    }
    let photo = photos.photo[v];
    if n >= photos.tiles || photo.exposure == 0u {
        return;
    }
    let tile = n - photo.first_tile;
    let x = tile % photo.tiles_x * TILE + local % TILE;
    let y = tile / photo.tiles_x * TILE + local / TILE;
    var by = vec3<f32>(0.0);
    var drawn = vec4<f32>(0.0);
    if x < photo.width && y < photo.height {
        let area = photo.width * photo.height;
        let pixel = y * photo.width + x;
        let source = frame_planes(photos.extras) * photo.first_pixel + pixel;
        drawn = vec4<f32>(frame[source], frame[source + area], frame[source + 2u * area], 1.0);
        let to = 5u * photo.first_pixel + pixel;
        by = vec3<f32>(upstream[to], upstream[to + area], upstream[to + 2u * area]);
        let row = 3u * (photo.exposure - 1u);
        let back = exposures[row].xyz * by.x + exposures[row + 1u].xyz * by.y + exposures[row + 2u].xyz * by.z;
        upstream[to] = back.x;
        upstream[to + area] = back.y;
        upstream[to + 2u * area] = back.z;
    }
    for (var r = 0u; r < 3u; r++) {
        let total = workgroup_sum(by[r] * drawn, local);
        if local == 0u {
            sums[3u * n + r] = total;
        }
        workgroupBarrier(); // protects `totals` until the sum is read
    }
}

// One workgroup: a step of the exposure of each view in turn, after each of which all exposures are shifted so that
// their mean is the identity.
@compute @workgroup_size(256)
fn exposure_step(@builtin(local_invocation_index) local: u32) {
    for (var v = 0u; v < photos.count; v++) {
        let photo = photos.photo[v];
        for (var r = 0u; r < 3u; r++) {
            var total = vec4<f32>(0.0);
            for (var k = local; k < photo.tiles_x * photo.tiles_y; k += WORKGROUP_SIZE) {
                total += sums[3u * (photo.first_tile + k) + r];
            }
            total = workgroup_sum(total, local);
            if local == 0u {
                gradient[r] = total;
            }
            workgroupBarrier(); // as above
        }
        let changes = state.is_step_valid != 0u && photo.exposure != 0u && is_gradient_finite();
        let at = photo.exposure - 1u;
        if changes && local < 3u {
            let age = min(steps[at] + 1u, 1u << 20u);
            update_row(at, local, 1.0 / (1.0 - power(BETA1, age)), 1.0 / (1.0 - power(BETA2, age)));
        }
        storageBarrier();
        if changes && local == 0u {
            steps[at] = min(steps[at], 0xfffffffeu) + 1u;
        }
        for (var r = 0u; r < 3u; r++) {
            var excess = vec4<f32>(0.0);
            for (var k = local; k < constants.rows; k += WORKGROUP_SIZE) {
                excess += exposures[3u * k + r] - identity_row(r);
            }
            excess = workgroup_sum(excess, local) / f32(constants.rows);
            for (var k = local; changes && k < constants.rows; k += WORKGROUP_SIZE) {
                exposures[3u * k + r] -= excess;
            }
            workgroupBarrier(); // as above
        }
        storageBarrier();
    }
}

fn is_gradient_finite() -> bool {
    var finite = true;
    for (var r = 0u; r < 3u; r++) {
        let row = gradient[r];
        finite = finite && is_finite(row.x) && is_finite(row.y) && is_finite(row.z) && is_finite(row.w);
    }
    return finite;
}

fn identity_row(r: u32) -> vec4<f32> {
    return vec4<f32>(f32(r == 0u), f32(r == 1u), f32(r == 2u), 0.0);
}

// Adam on row r of an exposure; the corrections are 1 / (1 - beta^age).
fn update_row(at: u32, r: u32, correction1: f32, correction2: f32) {
    let first = 6u * at + r;
    let second = first + 3u;
    let m = BETA1 * moments[first] + (1.0 - BETA1) * gradient[r];
    let v = BETA2 * moments[second] + (1.0 - BETA2) * gradient[r] * gradient[r];
    exposures[3u * at + r] -= constants.rate * (m * correction1) / (sqrt(v * correction2) + EPSILON);
    moments[first] = m;
    moments[second] = v;
}
