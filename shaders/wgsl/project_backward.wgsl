// Stage `project_backward`: from the moments of a splat in the views that see it to the gradients of its parameters;
// one thread per visible trainable splat. The chain rule through `project` in reverse; intermediate values are
// recomputed from the parameters.

@group(0) @binding(6) var<storage, read> status: Status;
@group(0) @binding(7) var<storage, read> visible: array<u32>;
@group(0) @binding(8) var<storage, read> sums: array<f32>;
// Gradient columns, in the banks of the splats.
@group(0) @binding(9) var<storage, read_write> out_a: array<f32>;
@group(0) @binding(10) var<storage, read_write> out_b: array<f32>;
@group(0) @binding(11) var<storage, read_write> out_c: array<f32>;
@group(0) @binding(12) var<storage, read_write> out_d: array<f32>;
// For each visible trainable entry: norm of the mean's gradient in pixels, the same with absolute values summed, sum of
// alpha T, pixels of the view. After one of these per trainable entry, two vectors for each visible trainable entry of a
// view with a displacement: the six terms of the gradient of its pose, and that of its focal length.
@group(0) @binding(13) var<storage, read_write> statistics: array<vec4<f32>>;

// Whether an earlier view has written the gradient, so that this view adds to it.
var<private> accumulate: bool;

fn write_gradient(k: u32, i: u32, value: f32) {
    let at = k * splats.stride + i;
    var sum = value;
    if accumulate {
        sum += out_a[at];
    }
    out_a[at] = sum;
}

fn write_gradient3(k: u32, i: u32, value: vec3<f32>) {
    write_gradient(k, i, value.x);
    write_gradient(k + 1u, i, value.y);
    write_gradient(k + 2u, i, value.z);
}

// Writes the gradient of SH coefficient b; returns the derivative of the loss along its basis function.
fn write_coefficient(b: u32, i: u32, basis: f32, d_colour: vec3<f32>) -> f32 {
    let n = splats.stride;
    var d = d_colour * basis;
    if b < 6u {
        let k = (3u * b - 3u) * n + i;
        if accumulate {
            d += vec3<f32>(out_b[k], out_b[k + n], out_b[k + 2u * n]);
        }
        out_b[k] = d.x;
        out_b[k + n] = d.y;
        out_b[k + 2u * n] = d.z;
    } else if b < 11u {
        let k = (3u * b - 18u) * n + i;
        if accumulate {
            d += vec3<f32>(out_c[k], out_c[k + n], out_c[k + 2u * n]);
        }
        out_c[k] = d.x;
        out_c[k + n] = d.y;
        out_c[k + 2u * n] = d.z;
    } else {
        let k = (3u * b - 33u) * n + i;
        if accumulate {
            d += vec3<f32>(out_d[k], out_d[k + n], out_d[k + 2u * n]);
        }
        out_d[k] = d.x;
        out_d[k + n] = d.y;
        out_d[k + 2u * n] = d.z;
    }
    return dot3(d_colour, coefficient(b, i));
}

@compute @workgroup_size(256)
fn project_backward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let first = thread_number(group, groups, local);
    if first >= status.visible_trainable {
        return;
    }
    let i = visible[first] / views.count;
    if first > 0u && visible[first - 1u] / views.count == i {
        return; // the thread of the splat's first visible entry handles it
    }
    for (var visible_at = first; visible_at < status.visible_trainable; visible_at++) {
        let entry = visible[visible_at];
        if entry / views.count != i {
            break;
        }
        view = views.view[entry % views.count];
        accumulate = visible_at > first;
        splat_gradient(i, visible_at);
    }
}

// Gradient of splat i in one view.
fn splat_gradient(i: u32, visible_at: u32) {
    let s = visible_at * MOMENTS;
    let mean = column3(0u, i);
    let p = camera_point(mean);
    let e = ewa(i, p);

    // The conic and the gradient of the mean.
    let inv_det = 1.0 / e.det1;
    let conic = vec3<f32>(e.cov.z + LOW_PASS, -e.cov.y, e.cov.x + LOW_PASS) * inv_det;
    let d_mean = vec2<f32>(
        fma(conic.x, sums[s + 1u], conic.y * sums[s + 2u]),
        fma(conic.y, sums[s + 1u], conic.z * sums[s + 2u]),
    );
    let along = vec2<f32>(sums[s + 11u], sums[s + 12u]);
    statistics[visible_at] = vec4<f32>(
        sqrt(d_mean.x * d_mean.x + d_mean.y * d_mean.y),
        sqrt(along.x * along.x + along.y * along.y),
        sums[s + 10u],
        f32(view.pixels.x * view.pixels.y),
    );

    // dcovariance' = -K G K with G the symmetric gradient of the conic K.
    let g = -0.5 * vec3<f32>(sums[s + 3u], sums[s + 4u], sums[s + 5u]);
    let kg0 = vec2<f32>(conic.x * g.x + conic.y * g.y, conic.x * g.y + conic.y * g.z);
    let kg1 = vec2<f32>(conic.y * g.x + conic.z * g.y, conic.y * g.y + conic.z * g.z);
    var d_cov = -vec3<f32>(
        kg0.x * conic.x + kg0.y * conic.y,
        kg0.x * conic.y + kg0.y * conic.z,
        kg1.x * conic.y + kg1.y * conic.z,
    );

    // Opacity: the sum of v is o_eff dL/do_eff, and o_eff = o sqrt(det0 / det1) in anti-aliased mode.
    write_gradient(10u, i, sums[s] * (1.0 - opacity(i)));
    if views.antialiased != 0u {
        let ratio = e.det0 * inv_det;
        let d_ratio = 0.5 * sums[s] / max(ratio, 1e-12);
        d_cov.x += d_ratio * (e.cov.z * inv_det - ratio * conic.x);
        d_cov.y -= d_ratio * (e.cov.y * inv_det + ratio * conic.y);
        d_cov.z += d_ratio * (e.cov.x * inv_det - ratio * conic.z);
    }

    // Chain rule through A = T axes.
    let d_a0 = 2.0 * (d_cov.x * e.a0 + d_cov.y * e.a1);
    let d_a1 = 2.0 * (d_cov.y * e.a0 + d_cov.z * e.a1);
    let d_t0 = e.axes * d_a0;
    let d_t1 = e.axes * d_a1;
    let d_axis0 = fma(e.t0, vec3<f32>(d_a0.x), e.t1 * d_a1.x);
    let d_axis1 = fma(e.t0, vec3<f32>(d_a0.y), e.t1 * d_a1.y);
    let d_axis2 = fma(e.t0, vec3<f32>(d_a0.z), e.t1 * d_a1.z);
    write_gradient3(3u, i, vec3<f32>(dot3(d_axis0, e.axes[0]), dot3(d_axis1, e.axes[1]), dot3(d_axis2, e.axes[2])));
    let r0 = d_axis0 * e.scale.x; // gradient of the rotation, by columns
    let r1 = d_axis1 * e.scale.y;
    let r2 = d_axis2 * e.scale.z;
    let w = e.quat.x;
    let x = e.quat.y;
    let y = e.quat.z;
    let z = e.quat.w;
    let d_unit = vec4<f32>(
        2.0 * (x * (r1.z - r2.y) + y * (r2.x - r0.z) + z * (r0.y - r1.x)),
        2.0 * (y * (r1.x + r0.y) + z * (r2.x + r0.z) + w * (r1.z - r2.y)) - 4.0 * x * (r1.y + r2.z),
        2.0 * (x * (r1.x + r0.y) + z * (r2.y + r1.z) + w * (r2.x - r0.z)) - 4.0 * y * (r0.x + r2.z),
        2.0 * (x * (r2.x + r0.z) + y * (r2.y + r1.z) + w * (r0.y - r1.x)) - 4.0 * z * (r0.x + r1.y),
    );
    let d_quat = (d_unit - e.quat * dot(e.quat, d_unit)) * e.inv_norm;
    write_gradient3(6u, i, d_quat.xyz);
    write_gradient(9u, i, d_quat.w);

    // Chain rule through T = J W and the projection of the centre.
    var d_p = vec3<f32>(0.0, 0.0, sums[s + 9u]);
    if views.extras == INVERSE_DEPTH {
        d_p.z *= -e.inv_z * e.inv_z;
    }
    // Of ln(focal length): the projected centre and J are proportional to it, but for a clamped ratio, which is inversely so.
    var d_focal = 0.0;
    let third = view.rows[2].xyz;
    let d_t = array<vec3<f32>, 2>(d_t0, d_t1);
    for (var r = 0u; r < 2u; r++) {
        let f_z = view.focal[r] * e.inv_z;
        let d_j0 = dot3(d_t[r], view.rows[r].xyz);
        let d_j2 = dot3(d_t[r], third);
        d_p.z += f_z * e.inv_z * (e.u[r] * d_j2 - d_j0);
        d_focal += f_z * (d_j0 - select(0.0, e.u[r] * d_j2, e.free[r]));
        d_focal += f_z * d_mean[r] * p[r];
        // Gradient of the ratio p_r / z: of the centre and, unless clamped, of the Jacobian.
        let d_ratio = select(0.0, -(f_z * d_j2), e.free[r]) + view.focal[r] * d_mean[r];
        d_p[r] = d_ratio * e.inv_z;
        d_p.z -= d_ratio * p[r] * e.inv_z * e.inv_z;
    }
    var d_world = fma(view.rows[0].xyz, vec3<f32>(d_p.x), fma(view.rows[1].xyz, vec3<f32>(d_p.y), third * d_p.z));

    // Colour; no gradient where it is clamped at zero.
    let to_splat = direction(mean);
    let d = to_splat.xyz;
    let is_unclamped = colour(i, d) > vec3<f32>(0.0);
    let d_colour = select(vec3<f32>(0.0), vec3<f32>(sums[s + 6u], sums[s + 7u], sums[s + 8u]), is_unclamped);
    write_gradient3(11u, i, d_colour * SH_C0);
    var d_direction = vec3<f32>(0.0);
    if splats.sh_degree >= 1u {
        let b = basis1(d);
        let s1 = write_coefficient(1u, i, b[0], d_colour);
        let s2 = write_coefficient(2u, i, b[1], d_colour);
        let s3 = write_coefficient(3u, i, b[2], d_colour);
        d_direction = C1 * vec3<f32>(-s3, -s1, s2);
    }
    if splats.sh_degree >= 2u {
        let b = basis2(d);
        let s4 = C2A * write_coefficient(4u, i, b[0], d_colour);
        let s5 = -C2A * write_coefficient(5u, i, b[1], d_colour);
        let s6 = 2.0 * C2B * write_coefficient(6u, i, b[2], d_colour);
        let s7 = -C2A * write_coefficient(7u, i, b[3], d_colour);
        let s8 = 2.0 * C2C * write_coefficient(8u, i, b[4], d_colour);
        d_direction += vec3<f32>(
            s4 * d.y - s6 * d.x + s7 * d.z + s8 * d.x,
            s4 * d.x + s5 * d.z - s6 * d.y - s8 * d.y,
            s5 * d.y + 2.0 * s6 * d.z + s7 * d.x,
        );
    }
    if splats.sh_degree >= 3u {
        let b = basis3(d);
        let s9 = C3A * write_coefficient(9u, i, b[0], d_colour);
        let s10 = C3B * write_coefficient(10u, i, b[1], d_colour);
        let s11 = C3C * write_coefficient(11u, i, b[2], d_colour);
        let s12 = C3D * write_coefficient(12u, i, b[3], d_colour);
        let s13 = C3C * write_coefficient(13u, i, b[4], d_colour);
        let s14 = C3E * write_coefficient(14u, i, b[5], d_colour);
        let s15 = C3A * write_coefficient(15u, i, b[6], d_colour);
        let q = d * d;
        let xy = d.x * d.y;
        let xz = d.x * d.z;
        let yz = d.y * d.z;
        d_direction += vec3<f32>(
            6.0 * s9 * xy + s10 * yz - 2.0 * s11 * xy - 6.0 * s12 * xz + s13 * (4.0 * q.z - 3.0 * q.x - q.y)
                + 2.0 * s14 * xz + 3.0 * s15 * (q.x - q.y),
            3.0 * s9 * (q.x - q.y) + s10 * xz + s11 * (4.0 * q.z - q.x - 3.0 * q.y) - 6.0 * s12 * yz - 2.0 * s13 * xy
                - 2.0 * s14 * yz - 6.0 * s15 * xy,
            s10 * xy + 8.0 * s11 * yz + s12 * (6.0 * q.z - 3.0 * (q.x + q.y)) + 8.0 * s13 * xz + s14 * (q.x - q.y),
        );
    }
    d_direction = (d_direction - d * dot3(d_direction, d)) * to_splat.w;
    write_gradient3(0u, i, d_world + d_direction);

    if view.displacement != 0u {
        // A translation moves the splat's centre and the camera's centre, a rotation the splat's centre and the axes W.
        var shift = d_p;
        var turn = cross(p, d_p);
        for (var r = 0u; r < 3u; r++) {
            shift[r] += dot3(view.rows[r].xyz, d_direction);
            let j = view.focal * e.inv_z * vec2<f32>(d_t0[r], d_t1[r]);
            // Column r of W, and of dL/dW = J^T dL/dT.
            let column = vec3<f32>(view.rows[0][r], view.rows[1][r], third[r]);
            turn += cross(column, vec3<f32>(j, -(e.u.x * j.x + e.u.y * j.y)));
        }
        let to = views.trainable_entries + 2u * visible_at;
        statistics[to] = vec4<f32>(shift, turn.x);
        statistics[to + 1u] = vec4<f32>(turn.yz, d_focal, 0.0);
    }
}
