// Stage `displace`: moves the cameras of the views by rigid motions in their own axes (translation in metres, rotation
// vector in radians) and multiplies their focal lengths; one thread per view. Zeros keep a camera's bits.

@group(0) @binding(0) var<storage, read_write> views: Views;
// Eight numbers per displacement: the motion, ln of the factor of the focal length, padding.
@group(0) @binding(1) var<storage, read> displacements: array<f32>;

@compute @workgroup_size(256)
fn displace(@builtin(local_invocation_index) local: u32) {
    if local >= views.count || views.view[local].displacement == 0u {
        return;
    }
    let at = 8u * (views.view[local].displacement - 1u);
    let shift = vec3<f32>(displacements[at], displacements[at + 1u], displacements[at + 2u]);
    let turn = vec3<f32>(displacements[at + 3u], displacements[at + 4u], displacements[at + 5u]);
    let rows = views.view[local].rows;

    // Sine and cosine of half the angle as series, as WGSL's are inexact: 2 ulp up to half a turn.
    let h2 = 0.25 * dot(turn, turn);
    let s = 0.5 * (1.0 - h2 / 6.0 * (1.0 - h2 / 20.0 * (1.0 - h2 / 42.0 * (1.0 - h2 / 72.0 * (1.0 - h2 / 110.0)))));
    let c = 1.0 - h2 / 2.0 * (1.0 - h2 / 12.0 * (1.0 - h2 / 30.0 * (1.0 - h2 / 56.0 * (1.0 - h2 / 90.0))));
    // The inverse rotation, of the columns of the camera's matrix.
    for (var k = 0u; k < 4u; k++) {
        var column = vec3<f32>(rows[0][k], rows[1][k], rows[2][k]);
        if k == 3u {
            column -= shift;
        }
        let across = cross(turn, column);
        let moved = column + 2.0 * s * (s * cross(turn, across) - c * across);
        for (var r = 0u; r < 3u; r++) {
            views.view[local].rows[r][k] = moved[r];
        }
    }
    let in_world = rows[0].xyz * shift.x + rows[1].xyz * shift.y + rows[2].xyz * shift.z;
    views.view[local].centre += vec4<f32>(in_world, 0.0);
    // The exponential as a series, as WGSL's is inexact: 2 ulp up to a tenth.
    let f = displacements[at + 6u];
    let factor = 1.0 + f * (1.0 + f / 2.0 * (1.0 + f / 3.0 * (1.0 + f / 4.0 * (1.0 + f / 5.0))));
    if factor != 1.0 {
        views.view[local].focal *= factor;
        views.view[local].cone_min /= factor;
        views.view[local].cone_max /= factor;
    }
}
