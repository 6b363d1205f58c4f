// Stage `loss`: (1 - lambda) L1 + lambda (1 - SSIM) of each view of a step against its photo, and the gradient of that. A workgroup is a
// tile of one colour plane; windows are smoothed along rows, then along columns, in workgroup memory.
//
//   loss_forward → SSIM's derivatives, sums of tiles → judge → loss, scales → loss_backward → upstream

@group(0) @binding(0) var<uniform> windows: Windows;
// Of each view planes: red, green, blue, transmittance and, where pixels count by share, depth and own.
@group(0) @binding(1) var<storage, read> frame: array<f32>;
// Bytes of each: red, green and blue planes, then the mask where there is one.
@group(0) @binding(2) var<storage, read> photo: array<u32>;
// Of each view dSSIM/dmu, dSSIM/dE[x^2], dSSIM/dE[xy], each times the pixel's weight; three colour planes each.
@group(0) @binding(3) var<storage, read_write> partials: array<f32>;
// Of each tile of each colour of each view: sums of w |x - y|, of w SSIM and, of the first colour, of w.
@group(0) @binding(4) var<storage, read_write> sums: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> books: Books;
@group(0) @binding(6) var<storage, read_write> upstream: array<f32>;
@group(0) @binding(7) var<storage, read> status: Status;

// The one that this workgroup is at.
var<private> window: Window;

const C1: f32 = 0.0001;
const C2: f32 = 0.0009;

var<workgroup> near_x: array<f32, 676>;
var<workgroup> near_y: array<f32, 676>;
var<workgroup> near_z: array<f32, 676>;
// Smoothed along rows: 26 rows of 16, five quantities or three.
var<workgroup> rows: array<array<f32, 416>, 5>;
var<workgroup> totals: array<vec4<f32>, 256>;

fn photo_byte(i: u32) -> u32 {
    let at = window.first_byte + i;
    return byte_of(photo[at / 4u], at);
}

// Pixel i of the frame's planes.
fn drawn(i: u32) -> f32 {
    return frame[planes_of(windows.by_share) * window.first_pixel + i];
}

// Of a colour plane, 0 to 1.
fn level(i: u32) -> f32 {
    return f32(photo_byte(i)) * (1.0 / 255.0);
}

fn is_hidden(pixel: u32) -> bool {
    return window.masked != 0u && photo_byte(3u * window.width * window.height + pixel) < 128u;
}

// What a pixel counts: nothing under a mask; else the share of what is drawn there that the block's own splats explain,
// squared. What nothing explains yet is half the block's.
fn weight(pixel: u32) -> f32 {
    if is_hidden(pixel) {
        return 0.0;
    }
    if windows.by_share == 0u {
        return 1.0;
    }
    let area = window.width * window.height;
    let transmittance = drawn(3u * area + pixel);
    let open = 0.5 * transmittance + 1e-4;
    let share = (drawn(5u * area + pixel) + open) / (1.0 - transmittance + open);
    return share * share;
}

struct Place {
    view: u32,
    colour: u32,
    // Of the tile's first pixel.
    x: u32,
    y: u32,
}

fn place(group: vec3<u32>, groups: vec3<u32>) -> Place {
    let n = group.y * groups.x + group.x;
    var v = 0u;
    while v + 1u < windows.count && n >= 3u * windows.each[v + 1u].first_tile {
        v++;
    }
    window = windows.each[v];
    let tile = n - 3u * window.first_tile;
    let tiles = window.tiles_x * window.tiles_y;
    let of_plane = tile % tiles;
    return Place(v, tile / tiles, of_plane % window.tiles_x * TILE, of_plane / window.tiles_x * TILE);
}

// The pixel at entry k of a tile's surroundings, or one past all where that is outside the image.
fn surrounding(at: Place, k: u32) -> u32 {
    // Below zero wraps around to far outside.
    let x = at.x + k % SIDE - REACH;
    let y = at.y + k / SIDE - REACH;
    let inside = x < window.width && y < window.height;
    return select(window.width * window.height, y * window.width + x, inside);
}

@compute @workgroup_size(256)
fn loss_forward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let at = place(group, groups);
    if at.colour > 2u {
        return;
    }
    let area = window.width * window.height;
    for (var k = local; k < SIDE * SIDE; k += GROUP) {
        let i = surrounding(at, k);
        var x = 0.0;
        var y = 0.0;
        // Hidden pixels are to SSIM what lies outside the image: zero in both.
        if i < area && !is_hidden(i) {
            x = drawn(at.colour * area + i);
            y = level(at.colour * area + i);
        }
        near_x[k] = x;
        near_y[k] = y;
    }
    workgroupBarrier();
    for (var k = local; k < SIDE * TILE; k += GROUP) {
        let centre = k / TILE * SIDE + k % TILE + REACH;
        var x = near_x[centre];
        var y = near_y[centre];
        var tap = TAPS[0];
        var blurred = array<f32, 5>(tap * x, tap * y, tap * (x * x), tap * (y * y), tap * (x * y));
        for (var d = 1u; d <= REACH; d++) {
            tap = TAPS[d];
            let x0 = near_x[centre - d];
            let x1 = near_x[centre + d];
            let y0 = near_y[centre - d];
            let y1 = near_y[centre + d];
            blurred[0] = fma(x0 + x1, tap, blurred[0]);
            blurred[1] = fma(y0 + y1, tap, blurred[1]);
            blurred[2] = fma(x0 * x0 + x1 * x1, tap, blurred[2]);
            blurred[3] = fma(y0 * y0 + y1 * y1, tap, blurred[3]);
            blurred[4] = fma(x0 * y0 + x1 * y1, tap, blurred[4]);
        }
        for (var q = 0u; q < 5u; q++) {
            rows[q][k] = blurred[q];
        }
    }
    workgroupBarrier();
    let px = at.x + local % TILE;
    let py = at.y + local / TILE;
    var total = vec4<f32>(0.0);
    if px < window.width && py < window.height {
        let centre = local + REACH * TILE;
        var means = array<f32, 5>();
        for (var q = 0u; q < 5u; q++) {
            var sum = TAPS[0] * rows[q][centre];
            for (var d = 1u; d <= REACH; d++) {
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
        let i = py * window.width + px;
        let w = weight(i);
        let out = at.colour * area + i;
        let to = 9u * window.first_pixel + out;
        partials[to] = w * (2.0 * my * (a2 - a1) * i12 - 2.0 * mx * ssim * (i1 - i2));
        partials[3u * area + to] = -w * (ssim * i2);
        partials[6u * area + to] = w * (2.0 * a1 * i12);
        let difference = drawn(out) - level(out);
        total = vec4<f32>(w * abs(difference), w * ssim, select(0.0, w, at.colour == 0u), 0.0);
    }
    total = in_order(total, local);
    if local == 0u {
        sums[group.y * groups.x + group.x] = total;
    }
}

// The sum over a workgroup, halving it: always in the same order.
fn in_order(value: vec4<f32>, local: u32) -> vec4<f32> {
    totals[local] = value;
    workgroupBarrier();
    for (var half = GROUP / 2u; half > 0u; half /= 2u) {
        if local < half {
            totals[local] += totals[local + half];
        }
        workgroupBarrier();
    }
    return totals[0];
}

// One workgroup: the loss, and whether the step counts. Without room for the views' pairs the step is not over.
@compute @workgroup_size(256)
fn judge(@builtin(local_invocation_index) local: u32) {
    var loss = 0.0;
    var l1 = 0.0;
    for (var v = 0u; v < windows.count; v++) {
        let here = windows.each[v];
        var total = vec4<f32>(0.0);
        for (var k = local; k < 3u * here.tiles_x * here.tiles_y; k += GROUP) {
            total += sums[3u * here.first_tile + k];
        }
        total = in_order(total, local);
        // Nothing counts: there is no loss either. Not so of NaN.
        if !(is_finite(total.z) && total.z <= 0.0) {
            let norm = 1.0 / (3.0 * total.z);
            l1 += total.x * norm;
            loss += (1.0 - windows.lambda) * (total.x * norm) + windows.lambda * (1.0 - total.y * norm);
            if local == 0u {
                books.scales[v] = vec2<f32>((1.0 - windows.lambda) * norm, -windows.lambda * norm);
            }
        } else if local == 0u {
            books.scales[v] = vec2<f32>(0.0);
        }
        workgroupBarrier(); // the sum is taken before the next one begins
    }
    if local != 0u {
        return;
    }
    books.good = 0u;
    if status.overflow != 0u {
        return;
    }
    books.done++;
    books.loss = loss / f32(windows.count);
    if is_finite(loss) {
        books.good = 1u;
        books.adam_steps++;
        books.count += windows.count;
        books.sum += l1;
    } else {
        books.skipped++;
    }
}

@compute @workgroup_size(256)
fn loss_backward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let at = place(group, groups);
    if at.colour > 2u {
        return;
    }
    let area = window.width * window.height;
    let plane = at.colour * area;
    for (var k = local; k < SIDE * SIDE; k += GROUP) {
        let i = surrounding(at, k);
        let inside = i < area;
        let source = 9u * window.first_pixel + plane + select(0u, i, inside);
        near_x[k] = select(0.0, partials[source], inside);
        near_y[k] = select(0.0, partials[3u * area + source], inside);
        near_z[k] = select(0.0, partials[6u * area + source], inside);
    }
    workgroupBarrier();
    for (var k = local; k < SIDE * TILE; k += GROUP) {
        let centre = k / TILE * SIDE + k % TILE + REACH;
        var blurred = TAPS[0] * vec3<f32>(near_x[centre], near_y[centre], near_z[centre]);
        for (var d = 1u; d <= REACH; d++) {
            let before = vec3<f32>(near_x[centre - d], near_y[centre - d], near_z[centre - d]);
            let after = vec3<f32>(near_x[centre + d], near_y[centre + d], near_z[centre + d]);
            blurred = fma(before + after, vec3<f32>(TAPS[d]), blurred);
        }
        rows[0][k] = blurred.x;
        rows[1][k] = blurred.y;
        rows[2][k] = blurred.z;
    }
    workgroupBarrier();
    let px = at.x + local % TILE;
    let py = at.y + local / TILE;
    if px >= window.width || py >= window.height {
        return;
    }
    let i = py * window.width + px;
    if is_hidden(i) {
        upstream[5u * window.first_pixel + plane + i] = 0.0;
        return;
    }
    let centre = local + REACH * TILE;
    var means = array<f32, 3>();
    for (var q = 0u; q < 3u; q++) {
        var sum = TAPS[0] * rows[q][centre];
        for (var d = 1u; d <= REACH; d++) {
            sum = fma(rows[q][centre - d * TILE] + rows[q][centre + d * TILE], TAPS[d], sum);
        }
        means[q] = sum;
    }
    let x = drawn(plane + i);
    let y = level(plane + i);
    let w = weight(i);
    let scales = books.scales[at.view];
    let by_l1 = select(select(0.0, -w, x < y), w, y < x);
    let by_ssim = means[0] + 2.0 * x * means[1] + y * means[2];
    upstream[5u * window.first_pixel + plane + i] = fma(by_l1, scales.x, by_ssim * scales.y);
}
