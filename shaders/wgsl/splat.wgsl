// Splat columns in four banks, and the parts of the projection that `project` and `project_backward` share. EWA
// splatting (Zwicker et al. 2001): covariance' = A A^T + 0.3 I with A = J W R S.

@group(0) @binding(0) var<storage, read> bank_a: array<f32>;
@group(0) @binding(1) var<storage, read> bank_b: array<f32>;
@group(0) @binding(2) var<storage, read> bank_c: array<f32>;
@group(0) @binding(3) var<storage, read> bank_d: array<f32>;
@group(0) @binding(4) var<uniform> views: Views;
@group(0) @binding(5) var<uniform> splats: SplatSet;

// The view of this thread.
var<private> view: View;

// Column k of bank 0.
fn column(k: u32, i: u32) -> f32 {
    return bank_a[k * splats.stride + i];
}

fn column3(k: u32, i: u32) -> vec3<f32> {
    return vec3<f32>(column(k, i), column(k + 1u, i), column(k + 2u, i));
}

// SH coefficient b of the three channels; b must be within the degree in use.
fn coefficient(b: u32, i: u32) -> vec3<f32> {
    let n = splats.stride;
    if b == 0u {
        return column3(11u, i);
    } else if b < 6u {
        let k = (3u * b - 3u) * n + i;
        return vec3<f32>(bank_b[k], bank_b[k + n], bank_b[k + 2u * n]);
    } else if b < 11u {
        let k = (3u * b - 18u) * n + i;
        return vec3<f32>(bank_c[k], bank_c[k + n], bank_c[k + 2u * n]);
    }
    let k = (3u * b - 33u) * n + i;
    return vec3<f32>(bank_d[k], bank_d[k + n], bank_d[k + 2u * n]);
}

fn dot3(a: vec3<f32>, b: vec3<f32>) -> f32 {
    return fma(a.x, b.x, fma(a.y, b.y, a.z * b.z));
}

// The centre in the camera frame.
fn camera_point(mean: vec3<f32>) -> vec3<f32> {
    var p: vec3<f32>;
    for (var r = 0u; r < 3u; r++) {
        let row = view.rows[r];
        p[r] = fma(mean.x, row.x, fma(mean.y, row.y, fma(mean.z, row.z, row.w)));
    }
    return p;
}

struct Ewa {
    inv_z: f32,
    // x/z and y/z, clamped to the view and 15 % beyond, and whether they are unclamped.
    u: vec2<f32>,
    free: vec2<bool>,
    quat: vec4<f32>, // normalised, wxyz
    inv_norm: f32,
    scale: vec3<f32>,
    axes: mat3x3<f32>, // columns of R S
    t0: vec3<f32>, // rows of J W
    t1: vec3<f32>,
    a0: vec3<f32>, // rows of A
    a1: vec3<f32>,
    cov: vec3<f32>, // xx, xy, yy before the low-pass filter
    det0: f32, // determinant before the low-pass filter
    det1: f32, // and after
}

fn ewa(i: u32, p: vec3<f32>) -> Ewa {
    var e: Ewa;
    e.inv_z = 1.0 / max(p.z, NEAR_METRES);
    let ratio = p.xy * e.inv_z;
    e.u = min(max(ratio, view.cone_min), view.cone_max);
    e.free = ratio == e.u;

    let q = vec4<f32>(column(6u, i), column(7u, i), column(8u, i), column(9u, i));
    let norm2 = fma(q.x, q.x, fma(q.y, q.y, fma(q.z, q.z, q.w * q.w)));
    e.inv_norm = 1.0 / sqrt(max(norm2, 1e-24));
    e.quat = q * e.inv_norm;
    let w = e.quat.x;
    let x = e.quat.y;
    let y = e.quat.z;
    let z = e.quat.w;
    e.scale = exp2(column3(3u, i) * LOG2_E);
    e.axes = mat3x3<f32>(
        vec3<f32>(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)) * e.scale.x,
        vec3<f32>(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)) * e.scale.y,
        vec3<f32>(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)) * e.scale.z,
    );

    let j = view.focal * e.inv_z;
    let third = view.rows[2].xyz;
    e.t0 = fma(vec3<f32>(j.x), view.rows[0].xyz, -(j.x * e.u.x) * third);
    e.t1 = fma(vec3<f32>(j.y), view.rows[1].xyz, -(j.y * e.u.y) * third);
    e.a0 = vec3<f32>(dot3(e.t0, e.axes[0]), dot3(e.t0, e.axes[1]), dot3(e.t0, e.axes[2]));
    e.a1 = vec3<f32>(dot3(e.t1, e.axes[0]), dot3(e.t1, e.axes[1]), dot3(e.t1, e.axes[2]));
    e.cov = vec3<f32>(dot3(e.a0, e.a0), dot3(e.a0, e.a1), dot3(e.a1, e.a1));
    // A sum of squares (Cauchy-Binet), as xx yy - xy^2 cancels for needles.
    let minors = vec3<f32>(
        e.a0.x * e.a1.y - e.a1.x * e.a0.y,
        e.a0.y * e.a1.z - e.a1.y * e.a0.z,
        e.a0.z * e.a1.x - e.a1.z * e.a0.x,
    );
    e.det0 = dot3(minors, minors);
    e.det1 = fma(LOW_PASS, e.cov.x + e.cov.z + LOW_PASS, e.det0);
    return e;
}

fn opacity(i: u32) -> f32 {
    return 1.0 / (1.0 + exp2(column(10u, i) * -LOG2_E));
}

// Unit direction from the camera's centre, and 1 / distance.
fn direction(mean: vec3<f32>) -> vec4<f32> {
    let v = mean - view.centre.xyz;
    let inv = 1.0 / sqrt(max(dot3(v, v), 1e-24));
    return vec4<f32>(v * inv, inv);
}

// Real spherical harmonics with the constants of the original 3DGS rasterizer (Kerbl et al. 2023).
const C1: f32 = 0.48860252;
const C2A: f32 = 1.0925484;
const C2B: f32 = 0.31539157;
const C2C: f32 = 0.54627424;
const C3A: f32 = -0.5900436;
const C3B: f32 = 2.8906114;
const C3C: f32 = -0.4570458;
const C3D: f32 = 0.37317634;
const C3E: f32 = 1.4453057;

fn basis1(d: vec3<f32>) -> array<f32, 3> {
    return array<f32, 3>(-C1 * d.y, C1 * d.z, -C1 * d.x);
}

fn basis2(d: vec3<f32>) -> array<f32, 5> {
    let s = d * d;
    return array<f32, 5>(
        C2A * d.x * d.y,
        -C2A * d.y * d.z,
        C2B * (s.z + s.z - s.x - s.y),
        -C2A * d.x * d.z,
        C2C * (s.x - s.y),
    );
}

fn basis3(d: vec3<f32>) -> array<f32, 7> {
    let s = d * d;
    let four_zz = 4.0 * s.z - s.x - s.y;
    return array<f32, 7>(
        C3A * d.y * (3.0 * s.x - s.y),
        C3B * d.x * d.y * d.z,
        C3C * d.y * four_zz,
        C3D * d.z * (s.z + s.z - 3.0 * (s.x + s.y)),
        C3C * d.x * four_zz,
        C3E * d.z * (s.x - s.y),
        C3A * d.x * (s.x - 3.0 * s.y),
    );
}

// The colour before the clamp at 0, sRGB.
fn colour(i: u32, d: vec3<f32>) -> vec3<f32> {
    var c = fma(coefficient(0u, i), vec3<f32>(SH_C0), vec3<f32>(0.5));
    if splats.sh_degree >= 1u {
        let b = basis1(d);
        c = fma(vec3<f32>(b[0]), coefficient(1u, i), c);
        c = fma(vec3<f32>(b[1]), coefficient(2u, i), c);
        c = fma(vec3<f32>(b[2]), coefficient(3u, i), c);
    }
    if splats.sh_degree >= 2u {
        let b = basis2(d);
        c = fma(vec3<f32>(b[0]), coefficient(4u, i), c);
        c = fma(vec3<f32>(b[1]), coefficient(5u, i), c);
        c = fma(vec3<f32>(b[2]), coefficient(6u, i), c);
        c = fma(vec3<f32>(b[3]), coefficient(7u, i), c);
        c = fma(vec3<f32>(b[4]), coefficient(8u, i), c);
    }
    if splats.sh_degree >= 3u {
        let b = basis3(d);
        c = fma(vec3<f32>(b[0]), coefficient(9u, i), c);
        c = fma(vec3<f32>(b[1]), coefficient(10u, i), c);
        c = fma(vec3<f32>(b[2]), coefficient(11u, i), c);
        c = fma(vec3<f32>(b[3]), coefficient(12u, i), c);
        c = fma(vec3<f32>(b[4]), coefficient(13u, i), c);
        c = fma(vec3<f32>(b[5]), coefficient(14u, i), c);
        c = fma(vec3<f32>(b[6]), coefficient(15u, i), c);
    }
    return c;
}
