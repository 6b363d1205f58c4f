// Stage `loss`: (1 - lambda) L1 + lambda (1 - SSIM) of each view of a step against its photo, and its gradient. A
// workgroup handles one tile of one colour plane; the SSIM window is separable, applied along rows, then along columns,
// in workgroup memory.
//
//   loss_forward → SSIM derivatives, sums per tile → finish_loss → loss, gradient scales → loss_backward → upstream
//
// The loss is that of the exposed render where the view has an exposure, and so is the gradient.

@group(0) @binding(0) var<uniform> photos: Photos;
// Planes per view: red, green, blue, transmittance and, with extras, depth and trainable alpha.
@group(0) @binding(1) var<storage, read> frame: array<f32>;
// Bytes per photo: red, green and blue planes, then the mask if there is one; then words: the pixel weights, the
// target depths and the slopes of the picture loss (three planes), each if there are any.
@group(0) @binding(2) var<storage, read> photo_words: array<u32>;
// Per view: dSSIM/dmu, dSSIM/dE[x^2], dSSIM/dE[xy], each times the pixel's weight; three colour planes each.
@group(0) @binding(3) var<storage, read_write> partials: array<f32>;
// Per tile, colour and view: sums of w |x - y|, of w SSIM and, for the first colour, of w. The fourth value is for the
// depth loss: the sum of w over its pixels (first colour), and of its weighted values (second colour).
@group(0) @binding(4) var<storage, read_write> sums: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> state: OptimiserState;
@group(0) @binding(6) var<storage, read_write> upstream: array<f32>;
@group(0) @binding(7) var<storage, read> status: Status;
// Three rows per exposure.
@group(0) @binding(8) var<storage, read> exposures: array<vec4<f32>>;

// The photo of this workgroup.
var<private> photo: Photo;

const C1: f32 = 0.0001;
const C2: f32 = 0.0009;

var<workgroup> halo_x: array<f32, 676>;
var<workgroup> halo_y: array<f32, 676>;
var<workgroup> halo_z: array<f32, 676>;
// After the row pass: 26 rows of 16, of five quantities (forward) or three (backward).
var<workgroup> rows: array<array<f32, 416>, 5>;

fn photo_byte(i: u32) -> u32 {
    let at = photo.first_byte + i;
    return byte_of(photo_words[at / 4u], at);
}

// Value i of the planes of this view.
fn frame_value(i: u32) -> f32 {
    return frame[frame_planes(photos.extras) * photo.first_pixel + i];
}

// Pixel of a colour plane as the photo's exposure shows it.
fn shown(colour: u32, pixel: u32) -> f32 {
    let area = photo.width * photo.height;
    if photo.exposure == 0u {
        return frame_value(colour * area + pixel);
    }
    let row = exposures[3u * (photo.exposure - 1u) + colour];
    let drawn = vec3<f32>(frame_value(pixel), frame_value(area + pixel), frame_value(2u * area + pixel));
    return row.x * drawn.x + row.y * drawn.y + row.z * drawn.z + row.w;
}

// Value i of the colour planes of the photo, 0 to 1.
fn photo_value(i: u32) -> f32 {
    return f32(photo_byte(i)) * (1.0 / 255.0);
}

// Pixels of weight 0 are left out like masked ones.
fn is_masked(pixel: u32) -> bool {
    if photo.first_weight != 0u && !(photo_weight(pixel) > 0.0) {
        return true;
    }
    return photo.masked != 0u && photo_byte(3u * photo.width * photo.height + pixel) < 128u;
}

fn photo_weight(pixel: u32) -> f32 {
    return bitcast<f32>(photo_words[photo.first_weight + pixel]);
}

// Weight of a pixel: 0 under a mask; else the photo's weight times its weight by share.
fn weight(pixel: u32) -> f32 {
    if is_masked(pixel) {
        return 0.0;
    }
    let by_share = share_weight(pixel);
    if photo.first_weight == 0u {
        return by_share;
    }
    return by_share * photo_weight(pixel);
}

// With share weighting, the square of the share of a pixel's alpha that trainable splats contribute. Uncovered alpha
// counts half as trainable.
fn share_weight(pixel: u32) -> f32 {
    if photos.share_weighted == 0u {
        return 1.0;
    }
    let area = photo.width * photo.height;
    let transmittance = frame_value(3u * area + pixel);
    let open = 0.5 * transmittance + 1e-4;
    let share = (frame_value(5u * area + pixel) + open) / (1.0 - transmittance + open);
    return share * share;
}

// Relative error at which the depth loss changes from quadratic to linear.
const DEPTH_BETA: f32 = 0.1;
// Least alpha at which a pixel has a depth.
const DEPTH_MIN_ALPHA: f32 = 0.5;

struct DepthError {
    // False: the pixel has no target depth or too little alpha, and no part in the depth loss.
    used: bool,
    alpha: f32,
    // Mean inverse depth, 1/metres, and target depth, metres.
    inverse: f32,
    goal: f32,
}

fn depth_error(pixel: u32) -> DepthError {
    if photo.first_depth == 0u || photos.extras == 0u {
        return DepthError(false, 0.0, 0.0, 0.0);
    }
    let area = photo.width * photo.height;
    let goal = bitcast<f32>(photo_words[photo.first_depth + pixel]);
    let alpha = 1.0 - frame_value(3u * area + pixel);
    if !(goal > 0.0 && alpha > DEPTH_MIN_ALPHA) {
        return DepthError(false, 0.0, 0.0, 0.0);
    }
    return DepthError(true, alpha, frame_value(4u * area + pixel) / alpha, goal);
}

// Smooth L1 of the relative error of a pixel's inverse depth.
fn depth_value(at: DepthError) -> f32 {
    let size = abs(at.inverse * at.goal - 1.0);
    return select(size - 0.5 * DEPTH_BETA, 0.5 * size * size / DEPTH_BETA, size < DEPTH_BETA);
}

struct PlaneTile {
    view: u32,
    colour: u32,
    // Coordinates of the tile's first pixel.
    x: u32,
    y: u32,
}

fn plane_tile(group: vec3<u32>, groups: vec3<u32>) -> PlaneTile {
    let n = group.y * groups.x + group.x;
    var v = 0u;
    while v + 1u < photos.count && n >= 3u * photos.photo[v + 1u].first_tile {
        v++;
    }
    photo = photos.photo[v];
    let tile = n - 3u * photo.first_tile;
    let tiles = photo.tiles_x * photo.tiles_y;
    let of_plane = tile % tiles;
    return PlaneTile(v, tile / tiles, of_plane % photo.tiles_x * TILE, of_plane / photo.tiles_x * TILE);
}

// Pixel at entry k of the tile with halo; the number of pixels if it is outside the image.
fn halo_pixel(at: PlaneTile, k: u32) -> u32 {
    // Negative coordinates wrap around to outside the image.
    let x = at.x + k % HALO_SIDE - RADIUS;
    let y = at.y + k / HALO_SIDE - RADIUS;
    let inside = x < photo.width && y < photo.height;
    return select(photo.width * photo.height, y * photo.width + x, inside);
}

@compute @workgroup_size(256)
fn loss_forward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let at = plane_tile(group, groups);
    if at.colour > 2u {
        return;
    }
    let area = photo.width * photo.height;
    for (var k = local; k < HALO_SIDE * HALO_SIDE; k += WORKGROUP_SIZE) {
        let i = halo_pixel(at, k);
        var x = 0.0;
        var y = 0.0;
        // Masked pixels are zero in both images, like pixels outside them.
        if i < area && !is_masked(i) {
            x = shown(at.colour, i);
            y = photo_value(at.colour * area + i);
        }
        halo_x[k] = x;
        halo_y[k] = y;
    }
    workgroupBarrier();
    for (var k = local; k < HALO_SIDE * TILE; k += WORKGROUP_SIZE) {
        let centre = k / TILE * HALO_SIDE + k % TILE + RADIUS;
        var x = halo_x[centre];
        var y = halo_y[centre];
        var tap = TAPS[0];
        var smoothed = array<f32, 5>(tap * x, tap * y, tap * (x * x), tap * (y * y), tap * (x * y));
        for (var d = 1u; d <= RADIUS; d++) {
            tap = TAPS[d];
            let x0 = halo_x[centre - d];
            let x1 = halo_x[centre + d];
            let y0 = halo_y[centre - d];
            let y1 = halo_y[centre + d];
            smoothed[0] = fma(x0 + x1, tap, smoothed[0]);
            smoothed[1] = fma(y0 + y1, tap, smoothed[1]);
            smoothed[2] = fma(x0 * x0 + x1 * x1, tap, smoothed[2]);
            smoothed[3] = fma(y0 * y0 + y1 * y1, tap, smoothed[3]);
            smoothed[4] = fma(x0 * y0 + x1 * y1, tap, smoothed[4]);
        }
        for (var q = 0u; q < 5u; q++) {
            rows[q][k] = smoothed[q];
        }
    }
    workgroupBarrier();
    let px = at.x + local % TILE;
    let py = at.y + local / TILE;
    var total = vec4<f32>(0.0);
    if px < photo.width && py < photo.height {
        let centre = local + RADIUS * TILE;
        var means = array<f32, 5>();
        for (var q = 0u; q < 5u; q++) {
            var sum = TAPS[0] * rows[q][centre];
            for (var d = 1u; d <= RADIUS; d++) {
                sum = fma(rows[q][centre - d * TILE] + rows[q][centre + d * TILE], TAPS[d], sum);
            }
            means[q] = sum;
        }
        let mx = means[0];
        let my = means[1];
        let a1 = fma(2.0, mx * my, C1);
        let a2 = fma(2.0, means[4] - mx * my, C2);
        let i1 = 1.0 / (mx * mx + my * my + C1);
        let i2 = 1.0 / ((means[2] - mx * mx) + (means[3] - my * my) + C2);
        let i12 = i1 * i2;
        let ssim = a1 * a2 * i12;
        let i = py * photo.width + px;
        let w = weight(i);
        let out = at.colour * area + i;
        let to = 9u * photo.first_pixel + out;
        partials[to] = w * (2.0 * my * (a2 - a1) * i12 - 2.0 * mx * ssim * (i1 - i2));
        partials[3u * area + to] = -w * (ssim * i2);
        partials[6u * area + to] = w * (2.0 * a1 * i12);
        let difference = shown(at.colour, i) - photo_value(out);
        total = vec4<f32>(w * abs(difference), w * ssim, select(0.0, w, at.colour == 0u), 0.0);
        if photos.depth_weight > 0.0 && at.colour < 2u {
            let depth = depth_error(i);
            if depth.used {
                total.w = select(w * depth_value(depth), w, at.colour == 0u);
            }
        }
    }
    total = workgroup_sum(total, local);
    if local == 0u {
        sums[group.y * groups.x + group.x] = total;
    }
}

// One workgroup: the loss, and whether the step is valid. After an overflow of pairs the step is not done, and the host
// repeats it.
@compute @workgroup_size(256)
fn finish_loss(@builtin(local_invocation_index) local: u32) {
    var loss = 0.0;
    var l1 = 0.0;
    for (var v = 0u; v < photos.count; v++) {
        let here = photos.photo[v];
        var total = vec4<f32>(0.0);
        for (var k = local; k < 3u * here.tiles_x * here.tiles_y; k += WORKGROUP_SIZE) {
            total += sums[3u * here.first_tile + k];
        }
        total = workgroup_sum(total, local);
        // Without weighted pixels the loss is zero. NaN takes this branch and makes the step invalid.
        if !(is_finite(total.z) && total.z <= 0.0) {
            let norm = 1.0 / (3.0 * total.z);
            l1 += total.x * norm;
            loss += (1.0 - photos.lambda) * (total.x * norm) + photos.lambda * (1.0 - total.y * norm);
            if local == 0u {
                state.gradient_scales[v] = vec2<f32>((1.0 - photos.lambda) * norm, -photos.lambda * norm);
            }
        } else if local == 0u {
            state.gradient_scales[v] = vec2<f32>(0.0);
        }
        workgroupBarrier(); // protects `totals` until all threads have read the sum
        if photos.depth_weight > 0.0 {
            let tiles = here.tiles_x * here.tiles_y;
            var depth = vec4<f32>(0.0);
            for (var k = local; k < tiles; k += WORKGROUP_SIZE) {
                depth.x += sums[3u * here.first_tile + k].w;
                depth.y += sums[3u * here.first_tile + tiles + k].w;
            }
            depth = workgroup_sum(depth, local);
            var scale = 0.0;
            if !(is_finite(depth.x) && depth.x <= 0.0) {
                scale = photos.depth_weight / depth.x;
                loss += scale * depth.y;
            }
            if local == 0u {
                state.depth_scales[v] = scale;
            }
            workgroupBarrier(); // as above
        }
    }
    if local != 0u {
        return;
    }
    state.is_step_valid = 0u;
    if status.overflow != 0u {
        return;
    }
    loss += photos.picture_loss;
    state.steps_done++;
    state.loss = loss / f32(photos.count);
    if is_finite(loss) {
        state.is_step_valid = 1u;
        state.adam_steps++;
        state.epoch_views += photos.count;
        state.epoch_l1 += l1;
    } else {
        state.steps_skipped++;
    }
}

@compute @workgroup_size(256)
fn loss_backward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let at = plane_tile(group, groups);
    if at.colour > 2u {
        return;
    }
    let area = photo.width * photo.height;
    let plane = at.colour * area;
    for (var k = local; k < HALO_SIDE * HALO_SIDE; k += WORKGROUP_SIZE) {
        let i = halo_pixel(at, k);
        let inside = i < area;
        let source = 9u * photo.first_pixel + plane + select(0u, i, inside);
        halo_x[k] = select(0.0, partials[source], inside);
        halo_y[k] = select(0.0, partials[3u * area + source], inside);
        halo_z[k] = select(0.0, partials[6u * area + source], inside);
    }
    workgroupBarrier();
    for (var k = local; k < HALO_SIDE * TILE; k += WORKGROUP_SIZE) {
        let centre = k / TILE * HALO_SIDE + k % TILE + RADIUS;
        var smoothed = TAPS[0] * vec3<f32>(halo_x[centre], halo_y[centre], halo_z[centre]);
        for (var d = 1u; d <= RADIUS; d++) {
            let before = vec3<f32>(halo_x[centre - d], halo_y[centre - d], halo_z[centre - d]);
            let after = vec3<f32>(halo_x[centre + d], halo_y[centre + d], halo_z[centre + d]);
            smoothed = fma(before + after, vec3<f32>(TAPS[d]), smoothed);
        }
        rows[0][k] = smoothed.x;
        rows[1][k] = smoothed.y;
        rows[2][k] = smoothed.z;
    }
    workgroupBarrier();
    let px = at.x + local % TILE;
    let py = at.y + local / TILE;
    if px >= photo.width || py >= photo.height {
        return;
    }
    let i = py * photo.width + px;
    if photos.depth_weight > 0.0 && at.colour == 0u {
        var d_depth = 0.0;
        var d_transmittance = 0.0;
        let depth = depth_error(i);
        if depth.used {
            let error = depth.inverse * depth.goal - 1.0;
            let slope = clamp(error / DEPTH_BETA, -1.0, 1.0) * depth.goal;
            d_depth = state.depth_scales[at.view] * weight(i) * slope / depth.alpha;
            d_transmittance = d_depth * depth.inverse;
        }
        upstream[5u * photo.first_pixel + 3u * area + i] = d_transmittance;
        upstream[5u * photo.first_pixel + 4u * area + i] = d_depth;
    }
    if is_masked(i) {
        upstream[5u * photo.first_pixel + plane + i] = 0.0;
        return;
    }
    let centre = local + RADIUS * TILE;
    var means = array<f32, 3>();
    for (var q = 0u; q < 3u; q++) {
        var sum = TAPS[0] * rows[q][centre];
        for (var d = 1u; d <= RADIUS; d++) {
            sum = fma(rows[q][centre - d * TILE] + rows[q][centre + d * TILE], TAPS[d], sum);
        }
        means[q] = sum;
    }
    let x = shown(at.colour, i);
    let y = photo_value(plane + i);
    let w = weight(i);
    let scales = state.gradient_scales[at.view];
    let d_l1 = select(select(0.0, -w, x < y), w, y < x);
    let d_ssim = means[0] + 2.0 * x * means[1] + y * means[2];
    var slope = fma(d_l1, scales.x, d_ssim * scales.y);
    if photo.first_slope != 0u {
        slope += bitcast<f32>(photo_words[photo.first_slope + plane + i]);
    }
    upstream[5u * photo.first_pixel + plane + i] = slope;
}
