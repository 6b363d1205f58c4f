//! Stage `project`: EWA projection of splats to ellipses in the view, sixteen at a time.
//!
//! EWA splatting (Zwicker et al. 2001) with gsplat's conventions: `Σ' = A Aᵀ + 0.3·I` with `A = J W R S`. The Jacobian
//! J is taken at the centre, clamped to the view plus 15 %. SH colour is evaluated here, once per splat and view.

use scene::{Camera, Splats, column};

use super::sh;
use super::simd::{LANES, Lanes, prefetch};
use crate::{ALPHA_MIN, LOW_PASS, NEAR_METRES, Options, kernel, unroll};

/// Indices of the values in a [`Projected`] record.
pub(crate) mod at {
    /// Mean in pixels.
    pub(crate) const X: usize = 0;
    pub(crate) const Y: usize = 1;
    /// Cholesky factor of the conic, scaled for base 2: α = 2^(LOG2_OPACITY - (A dx + B dy)² - (C dy)²). Evaluating the
    /// conic itself cancels along needles: its error grows with the square of their length.
    pub(crate) const A: usize = 2;
    pub(crate) const B: usize = 3;
    pub(crate) const C: usize = 4;
    pub(crate) const LOG2_OPACITY: usize = 5;
    /// Colour, clamped below at 0.
    pub(crate) const RED: usize = 6;
    pub(crate) const GREEN: usize = 7;
    pub(crate) const BLUE: usize = 8;
    /// Depth in metres.
    pub(crate) const Z: usize = 9;
    /// 1 for trainable splats, 0 for context.
    pub(crate) const TRAINABLE: usize = 10;
    /// Half extents of the ellipse at α = 1/255, pixels.
    pub(crate) const HALF_WIDTH: usize = 11;
    pub(crate) const HALF_HEIGHT: usize = 12;
}

/// A projected splat: one cache line.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(64))]
pub(crate) struct Projected(pub(crate) [f32; 16]);

/// A camera in single precision.
#[derive(Debug, Clone, Copy)]
pub(crate) struct View {
    pub(crate) rotation: [[f32; 3]; 3],
    pub(crate) translation: [f32; 3],
    pub(crate) centre: [f32; 3],
    pub(crate) focal: [f32; 2],
    pub(crate) principal: [f32; 2],
    pub(crate) size: [f32; 2],
    /// Bounds of x/z and y/z in the Jacobian.
    pub(crate) cone_min: [f32; 2],
    pub(crate) cone_max: [f32; 2],
}

impl View {
    pub(crate) fn new(camera: &Camera) -> Self {
        let k = &camera.pinhole;
        let rows = camera.rotation().transpose().to_cols_array_2d();
        let guard = |length: f64, focal: f64| 0.15 * length / focal;
        let (gx, gy) = (guard(k.width.into(), k.fx), guard(k.height.into(), k.fy));
        Self {
            rotation: rows.map(|row| row.map(|v| v as f32)),
            translation: camera.camera_from_world.translation.as_vec3().to_array(),
            centre: camera.centre().as_vec3().to_array(),
            focal: [k.fx as f32, k.fy as f32],
            principal: [k.cx as f32, k.cy as f32],
            size: [k.width as f32, k.height as f32],
            cone_min: [(-k.cx / k.fx - gx) as f32, (-k.cy / k.fy - gy) as f32],
            cone_max: [
                ((f64::from(k.width) - k.cx) / k.fx + gx) as f32,
                ((f64::from(k.height) - k.cy) / k.fy + gy) as f32,
            ],
        }
    }
}

/// Values between a splat's columns and its conic that the backward pass recomputes.
pub(crate) struct Ewa<L> {
    pub(crate) inv_z: L,
    /// x/z and y/z in the Jacobian, clamped.
    pub(crate) u: [L; 2],
    /// Mask of the lanes whose x/z (y/z) is not clamped.
    pub(crate) unclamped: [u16; 2],
    /// Normalised quaternion and 1 / its length.
    pub(crate) quat: [L; 4],
    pub(crate) inv_norm: L,
    /// `R S`: `axes[k]` is the k-th principal axis, that is rotation column times scale.
    pub(crate) axes: [[L; 3]; 3],
    pub(crate) scale: [L; 3],
    /// The two rows of `T = J W`.
    pub(crate) t: [[L; 3]; 2],
    /// `A = T · axes`: `a[k]` is the k-th column.
    pub(crate) a: [[L; 2]; 3],
    /// xx, xy, yy of the covariance before the low-pass filter.
    pub(crate) cov: [L; 3],
    /// Determinant before the low-pass filter.
    pub(crate) det0: L,
    /// Determinant after the low-pass filter.
    pub(crate) det1: L,
}

/// Centres of sixteen splats in the camera frame.
#[inline(always)]
pub(crate) fn camera_point<L: Lanes>(splats: &Splats, i: usize, view: &View) -> [L; 3] {
    let m = unroll!(k in [0, 1, 2] => L::load_from(splats.col(column::MEAN + k), i, 0.0));
    unroll!(r in [0, 1, 2] => {
        let row = &view.rotation[r];
        let moved = m[2].fma(L::splat(row[2]), L::splat(view.translation[r]));
        m[0].fma(L::splat(row[0]), m[1].fma(L::splat(row[1]), moved))
    })
}

/// The EWA projection of sixteen splats.
#[inline(always)]
pub(crate) fn ewa<L: Lanes>(splats: &Splats, i: usize, view: &View, p: [L; 3]) -> Ewa<L> {
    let (one, two) = (L::splat(1.0), L::splat(2.0));
    let inv_z = one / p[2].max(L::splat(NEAR_METRES));
    let mut u = [L::zero(); 2];
    let mut unclamped = [0; 2];
    for d in 0..2 {
        let ratio = p[d] * inv_z;
        u[d] = ratio.max(L::splat(view.cone_min[d])).min(L::splat(view.cone_max[d]));
        unclamped[d] = ratio.le(u[d]) & u[d].le(ratio);
    }

    let q = unroll!(c in [0, 1, 2, 3] => L::load_from(splats.col(column::QUAT + c), i, 1.0));
    let norm2 = q[0].fma(q[0], q[1].fma(q[1], q[2].fma(q[2], q[3] * q[3])));
    let inv_norm = one / norm2.max(L::splat(1e-24)).sqrt();
    let quat = unroll!(c in [0, 1, 2, 3] => q[c] * inv_norm);
    let [w, x, y, z] = quat;
    let rotation = [
        [one - two * (y * y + z * z), two * (x * y + w * z), two * (x * z - w * y)],
        [two * (x * y - w * z), one - two * (x * x + z * z), two * (y * z + w * x)],
        [two * (x * z + w * y), two * (y * z - w * x), one - two * (x * x + y * y)],
    ]; // by columns
    let scale = unroll!(c in [0, 1, 2] => {
        (L::load_from(splats.col(column::LOG_SCALE + c), i, 0.0) * L::splat(std::f32::consts::LOG2_E)).exp2()
    });
    let axes = unroll!(c in [0, 1, 2] => unroll!(j in [0, 1, 2] => rotation[c][j] * scale[c]));

    let w = &view.rotation;
    let t = unroll!(r in [0, 1] => {
        let j0 = L::splat(view.focal[r]) * inv_z;
        let j2 = -(j0 * u[r]);
        unroll!(c in [0, 1, 2] => j0.fma(L::splat(w[r][c]), j2 * L::splat(w[2][c])))
    });
    let a = unroll!(c in [0, 1, 2] => unroll!(r in [0, 1] => dot(t[r], axes[c])));
    let cov = [
        a[0][0].fma(a[0][0], a[1][0].fma(a[1][0], a[2][0] * a[2][0])),
        a[0][0].fma(a[0][1], a[1][0].fma(a[1][1], a[2][0] * a[2][1])),
        a[0][1].fma(a[0][1], a[1][1].fma(a[1][1], a[2][1] * a[2][1])),
    ];
    // A sum of squares (Cauchy-Binet), as xx·yy - xy² cancels for needles.
    let minors = unroll!(c in [0, 1, 2] => a[c][0] * a[(c + 1) % 3][1] - a[c][1] * a[(c + 1) % 3][0]);
    let det0 = dot(minors, minors);
    let det1 = L::splat(LOW_PASS).fma(cov[0] + cov[2] + L::splat(LOW_PASS), det0);
    Ewa { inv_z, u, unclamped, quat, inv_norm, axes, scale, t, a, cov, det0, det1 }
}

#[inline(always)]
pub(crate) fn dot<L: Lanes>(a: [L; 3], b: [L; 3]) -> L {
    a[0].fma(b[0], a[1].fma(b[1], a[2] * b[2]))
}

/// Unit directions from the camera's centre to sixteen splats, and 1 / distance.
#[inline(always)]
pub(crate) fn directions<L: Lanes>(splats: &Splats, i: usize, view: &View) -> ([L; 3], L) {
    let v = unroll!(c in [0, 1, 2] => L::load_from(splats.col(column::MEAN + c), i, 0.0) - L::splat(view.centre[c]));
    let inv = L::splat(1.0) / dot(v, v).max(L::splat(1e-24)).sqrt();
    (unroll!(c in [0, 1, 2] => v[c] * inv), inv)
}

/// Opacity of sixteen splats.
#[inline(always)]
pub(crate) fn opacity<L: Lanes>(splats: &Splats, i: usize) -> L {
    let logit = L::load_from(splats.col(column::OPACITY), i, -100.0);
    let e = (logit * L::splat(-std::f32::consts::LOG2_E)).exp2();
    L::splat(1.0) / (L::splat(1.0) + e)
}

kernel!(
    /// Projects splats `first .. first + out.len()` into `out`; the length is a multiple of 16 except in the last
    /// chunk. Sets bit `i % 16` of `seen[i / 16]` for visible splats.
    pub(crate) fn project(
        splats: &Splats, first: usize, view: &View, options: &Options, trainable: f32, out: &mut [Projected], seen: &mut [u16],
    ) = project_lanes
);

#[inline(always)]
fn project_lanes<L: Lanes>(
    splats: &Splats,
    first: usize,
    view: &View,
    options: &Options,
    trainable: f32,
    out: &mut [Projected],
    seen: &mut [u16],
) {
    for (group, (out, seen)) in out.chunks_mut(LANES).zip(seen.iter_mut()).enumerate() {
        *seen = project_group::<L>(splats, first + group * LANES, view, options, trainable, out);
    }
}

/// Conservative visibility of sixteen splats: each is treated as an opaque sphere of its largest scale. Splats are in
/// Morton order, so this cheap test rejects most groups outside the view as a whole.
#[inline(always)]
fn near_image<L: Lanes>(splats: &Splats, i: usize, view: &View, p: [L; 3]) -> u16 {
    /// √(2 ln(1 / ALPHA_MIN)), with a margin for rounding.
    const SIGMAS: f32 = 3.34;
    /// The same times √LOW_PASS.
    const LOW_PASS_PIXELS: f32 = 1.9;
    let log_scale = unroll!(c in [0, 1, 2] => L::load_from(splats.col(column::LOG_SCALE + c), i, 0.0));
    let largest = log_scale[0].max(log_scale[1]).max(log_scale[2]);
    let reach = (largest * L::splat(std::f32::consts::LOG2_E)).exp2() * L::splat(SIGMAS);
    let inv_z = L::splat(1.0) / p[2].max(L::splat(NEAR_METRES));
    let mut near = u16::MAX;
    for d in 0..2 {
        let ratio = p[d] * inv_z;
        let u = ratio.max(L::splat(view.cone_min[d])).min(L::splat(view.cone_max[d]));
        let focal = L::splat(view.focal[d]);
        // A row of `J W` has norm f/z √(1 + u²).
        let half = (focal * inv_z * reach).fma(L::splat(1.0) + u.abs(), L::splat(LOW_PASS_PIXELS));
        let centre = focal.fma(ratio, L::splat(view.principal[d]));
        near &= (centre - half).le(L::splat(view.size[d])) & L::zero().le(centre + half);
    }
    near
}

#[inline(always)]
fn project_group<L: Lanes>(
    splats: &Splats,
    i: usize,
    view: &View,
    options: &Options,
    trainable: f32,
    out: &mut [Projected],
) -> u16 {
    let lanes_in_use = if out.len() >= LANES { u16::MAX } else { (1 << out.len()) - 1 };
    let p = camera_point::<L>(splats, i, view);
    let in_front = L::splat(NEAR_METRES).lt(p[2]) & p[2].lt(L::splat(f32::MAX)) & lanes_in_use;
    if in_front == 0 || in_front & near_image(splats, i, view, p) == 0 {
        return 0;
    }
    // The hardware prefetcher does not track this many columns.
    let used = column::SH + 3 * scene::splats::sh_coefficients(options.sh_degree);
    splats.columns()[..used].iter().filter_map(|column| column.get(i + LANES - 1)).for_each(prefetch);
    let e = ewa(splats, i, view, p);
    let inv_det = L::splat(1.0) / e.det1;
    let mut opacity = opacity::<L>(splats, i);
    if options.antialiased {
        opacity = opacity * (e.det0 * inv_det).sqrt();
    }
    let reach = (opacity * L::splat(1.0 / ALPHA_MIN)).map(f32::ln) * L::splat(2.0); // -2 ln(α_min / o): squared radius in sigmas
    let (var_x, var_y) = (e.cov[0] + L::splat(LOW_PASS), e.cov[2] + L::splat(LOW_PASS));
    let half_width = (reach * var_x).max(L::zero()).sqrt();
    let half_height = (reach * var_y).max(L::zero()).sqrt();
    let x = L::splat(view.focal[0]) * p[0] * e.inv_z + L::splat(view.principal[0]);
    let y = L::splat(view.focal[1]) * p[1] * e.inv_z + L::splat(view.principal[1]);
    // `exp2` turns NaN into a number, so scales and opacity are tested themselves.
    let scales = unroll!(c in [0, 1, 2] => L::load_from(splats.col(column::LOG_SCALE + c), i, 0.0).abs());
    let logit = L::load_from(splats.col(column::OPACITY), i, 0.0).abs();
    // The bounding box must contain a pixel centre. NaN fails every comparison and is culled.
    let seen = in_front
        & (scales[0] + scales[1] + scales[2] + logit).lt(L::splat(f32::MAX))
        & L::zero().lt(reach)
        & L::zero().lt(e.det1)
        & (x - half_width).le(L::splat(view.size[0] - 0.5))
        & L::splat(0.5).le(x + half_width)
        & (y - half_height).le(L::splat(view.size[1] - 0.5))
        & L::splat(0.5).le(y + half_height)
        & (half_width + half_height).lt(L::splat(1e7));
    if seen == 0 {
        return 0;
    }

    let (c0, half) = (L::splat(scene::splats::SH_C0), L::splat(0.5));
    let mut colour = unroll!(c in [0, 1, 2] => L::load_from(splats.col(column::SH + c), i, 0.0).fma(c0, half));
    if options.sh_degree > 0 {
        let ([dx, dy, dz], _) = directions::<L>(splats, i, view);
        let basis = sh::basis(options.sh_degree, dx, dy, dz);
        for (b, basis) in basis.iter().enumerate().take(scene::splats::sh_coefficients(options.sh_degree) - 1) {
            for c in 0..3 {
                colour[c] = basis.fma(L::load_from(splats.col(column::SH + 3 * (b + 1) + c), i, 0.0), colour[c]);
            }
        }
    }
    // Non-finite or huge colours would corrupt whole pixels: such splats are culled.
    let max_colour = L::splat(1e6);
    let seen = seen & colour[0].abs().lt(max_colour) & colour[1].abs().lt(max_colour) & colour[2].abs().lt(max_colour);
    let colour = unroll!(c in [0, 1, 2] => colour[c].max(L::zero()));

    let half_log2e = L::splat(0.5 * std::f32::consts::LOG2_E);
    let inv_std_y = (half_log2e / var_y).sqrt();
    let inv_std_x = (half_log2e * var_y * inv_det).sqrt(); // of x given y
    let lanes = [
        x,
        y,
        inv_std_x,
        -(inv_std_x * e.cov[1] / var_y),
        inv_std_y,
        opacity.map(f32::log2),
        colour[0],
        colour[1],
        colour[2],
        p[2],
        L::splat(trainable),
        half_width,
        half_height,
    ];
    let mut values = [[0.0; LANES]; 13];
    for (value, lanes) in values.iter_mut().zip(lanes) {
        lanes.store(value);
    }
    for (lane, record) in out.iter_mut().enumerate() {
        for (k, value) in values.iter().enumerate() {
            record.0[k] = value[lane];
        }
    }
    seen
}
