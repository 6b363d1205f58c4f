//! Stage `project_backward`: from the moments of a splat to the gradients of its parameters and of the pose.
//!
//! The chain rule through [`project`](super::project) in reverse, sixteen splats at a time. Intermediate values are
//! recomputed from the parameters; only the moments are stored between the passes.

use scene::{Splats, column};

use super::project::{Ewa, View, camera_point, directions, dot, ewa, opacity};
use super::sh;
use super::simd::{LANES, Lanes, prefetch};
use super::tile::{Moments, moment};
use crate::{LOW_PASS, Options, kernel, unroll};

/// Output of a chunk of splats.
pub(crate) struct GradientChunk<'a> {
    /// One slice per column, each as long as the chunk.
    pub(crate) columns: Vec<&'a mut [f32]>,
    pub(crate) screen_gradient: &'a mut [f32],
    pub(crate) screen_gradient_abs: &'a mut [f32],
    pub(crate) weight: &'a mut [f32],
}

kernel!(
    /// Gradients of splats `first ..` from their moments `sums`, which are in depth order (`rank`). Returns the chunk's
    /// part of the gradients of the pose, (ρ, ω), and of the focal length.
    pub(crate) fn project_backward(
        splats: &Splats, first: usize, view: &View, options: &Options, seen: &[u16], rank: &[u32], sums: &[Moments],
        out: &mut GradientChunk,
    ) -> [f32; 7] = project_backward_lanes
);

#[inline(always)]
fn project_backward_lanes<L: Lanes>(
    splats: &Splats,
    first: usize,
    view: &View,
    options: &Options,
    seen: &[u16],
    rank: &[u32],
    sums: &[Moments],
    out: &mut GradientChunk,
) -> [f32; 7] {
    let mut camera = [L::zero(); 16];
    for (group, (ranks, &seen)) in rank.chunks(LANES).zip(seen).enumerate() {
        let at = group * LANES;
        // The rank of an invisible splat is undefined, hence `get`.
        let ahead = rank.get(at + LANES..).unwrap_or(&[]);
        ahead.iter().take(LANES).filter_map(|&rank| sums.get(rank as usize)).for_each(prefetch);
        let columns = splats.columns()[..out.columns.len()].iter().filter_map(|column| column.get(first + at + LANES));
        columns.chain(out.columns.iter().filter_map(|column| column.get(at + LANES))).for_each(prefetch);
        if seen == 0 {
            let range = at..at + ranks.len();
            for column in
                out.columns.iter_mut().chain([&mut out.screen_gradient, &mut out.screen_gradient_abs, &mut out.weight])
            {
                column[range.clone()].fill(0.0);
            }
            continue;
        }
        backward_group::<L>(splats, first + at, at, view, options, seen, ranks, sums, out, &mut camera);
    }
    L::sums(&camera).to_array()[..7].try_into().expect("the first seven lanes")
}

#[inline(always)]
fn backward_group<L: Lanes>(
    splats: &Splats,
    i: usize,
    at: usize,
    view: &View,
    options: &Options,
    seen: u16,
    ranks: &[u32],
    sums: &[Moments],
    out: &mut GradientChunk,
    camera: &mut [L; 16],
) {
    let (half, one, two) = (L::splat(0.5), L::splat(1.0), L::splat(2.0));
    let mut lanes = [[0.0; 16]; 16];
    for (lane, &rank) in ranks.iter().enumerate() {
        if seen >> lane & 1 == 1 {
            for (m, value) in sums[rank as usize].0.iter().enumerate() {
                lanes[m][lane] = *value;
            }
        }
    }
    let mut s = [L::zero(); 16];
    for (sum, lanes) in s.iter_mut().zip(&lanes) {
        *sum = L::load(lanes);
    }

    let p = camera_point::<L>(splats, i, view);
    let e = ewa::<L>(splats, i, view, p);
    let Ewa { inv_z, u, unclamped, quat, inv_norm, axes, scale, t, a, cov, det0, det1 } = e;

    // The conic and the gradient of the mean.
    let inv_det = one / det1;
    let conic = [(cov[2] + L::splat(LOW_PASS)) * inv_det, -(cov[1] * inv_det), (cov[0] + L::splat(LOW_PASS)) * inv_det];
    let d_mean =
        [conic[0].fma(s[moment::VX], conic[1] * s[moment::VY]), conic[1].fma(s[moment::VX], conic[2] * s[moment::VY])];
    (d_mean[0] * d_mean[0] + d_mean[1] * d_mean[1]).sqrt().keep(seen).store_to(out.screen_gradient, at);
    let (ax, ay) = (s[moment::ABS_X], s[moment::ABS_Y]);
    (ax * ax + ay * ay).sqrt().keep(seen).store_to(out.screen_gradient_abs, at);
    s[moment::WEIGHT].keep(seen).store_to(out.weight, at);

    // dΣ' = -K G K with G the symmetric gradient of the conic K.
    let g = [-(half * s[moment::VXX]), -(half * s[moment::VXY]), -(half * s[moment::VYY])];
    let kg = [
        [conic[0] * g[0] + conic[1] * g[1], conic[0] * g[1] + conic[1] * g[2]],
        [conic[1] * g[0] + conic[2] * g[1], conic[1] * g[1] + conic[2] * g[2]],
    ];
    let mut d_cov = [
        -(kg[0][0] * conic[0] + kg[0][1] * conic[1]),
        -(kg[0][0] * conic[1] + kg[0][1] * conic[2]),
        -(kg[1][0] * conic[1] + kg[1][1] * conic[2]),
    ];

    // Opacity: Σ v = o_eff · dL/do_eff, and o_eff = o · √(det0 / det1) in anti-aliased mode.
    let o = opacity::<L>(splats, i);
    (s[moment::V] * (one - o)).keep(seen).store_to(out.columns[column::OPACITY], at);
    if options.antialiased {
        let ratio = det0 * inv_det;
        // dL/d ratio = ½ Σv / ratio; d ratio / dΣ' = adj(Σ)/det1 - ratio·K.
        let d_ratio = half * s[moment::V] / ratio.max(L::splat(1e-12));
        d_cov[0] = d_cov[0] + d_ratio * (cov[2] * inv_det - ratio * conic[0]);
        d_cov[1] = d_cov[1] - d_ratio * (cov[1] * inv_det + ratio * conic[1]);
        d_cov[2] = d_cov[2] + d_ratio * (cov[0] * inv_det - ratio * conic[2]);
    }

    // Chain rule through A = T·axes.
    let mut d_t = [[L::zero(); 3]; 2];
    let mut d_rotation = [[L::zero(); 3]; 3]; // by columns
    for c in 0..3 {
        let d_a = [two * (d_cov[0] * a[c][0] + d_cov[1] * a[c][1]), two * (d_cov[1] * a[c][0] + d_cov[2] * a[c][1])];
        let d_axis = unroll!(j in [0, 1, 2] => t[0][j].fma(d_a[0], t[1][j] * d_a[1]));
        for r in 0..2 {
            for j in 0..3 {
                d_t[r][j] = d_a[r].fma(axes[c][j], d_t[r][j]);
            }
        }
        dot(d_axis, axes[c]).keep(seen).store_to(out.columns[column::LOG_SCALE + c], at);
        d_rotation[c] = unroll!(j in [0, 1, 2] => d_axis[j] * scale[c]);
    }
    let [[d00, d10, d20], [d01, d11, d21], [d02, d12, d22]] = d_rotation;
    let [w, x, y, z] = quat;
    let d_unit = [
        two * (x * (d21 - d12) + y * (d02 - d20) + z * (d10 - d01)),
        two * (y * (d01 + d10) + z * (d02 + d20) + w * (d21 - d12)) - L::splat(4.0) * x * (d11 + d22),
        two * (x * (d01 + d10) + z * (d12 + d21) + w * (d02 - d20)) - L::splat(4.0) * y * (d00 + d22),
        two * (x * (d02 + d20) + y * (d12 + d21) + w * (d10 - d01)) - L::splat(4.0) * z * (d00 + d11),
    ];
    let radial = w * d_unit[0] + x * d_unit[1] + y * d_unit[2] + z * d_unit[3];
    for c in 0..4 {
        ((d_unit[c] - quat[c] * radial) * inv_norm).keep(seen).store_to(out.columns[column::QUAT + c], at);
    }

    // Chain rule through T = J W and the projection of the centre.
    let rows = unroll!(r in [0, 1, 2] => unroll!(c in [0, 1, 2] => L::splat(view.rotation[r][c])));
    let d_depth = if options.inverse_depth { -(s[moment::Z] * inv_z * inv_z) } else { s[moment::Z] };
    let mut d_p = [L::zero(), L::zero(), d_depth];
    // Of ln(focal length): the projected centre and J are proportional to it, but for a clamped ratio, which is inversely so.
    let mut d_focal = L::zero();
    for r in 0..2 {
        let f_z = L::splat(view.focal[r]) * inv_z;
        let d_j0 = dot(d_t[r], rows[r]);
        let d_j2 = dot(d_t[r], rows[2]);
        let d_ratio = L::select(unclamped[r], -(f_z * d_j2), L::zero());
        d_p[2] = d_p[2] + f_z * inv_z * (u[r] * d_j2 - d_j0);
        d_focal = d_focal + f_z * (d_j0 - L::select(unclamped[r], u[r] * d_j2, L::zero()));
        d_focal = d_focal + f_z * d_mean[r] * p[r];
        // Gradient of the ratio p_r / z: of the centre and, unless clamped, of the Jacobian.
        let d_ratio = d_ratio + L::splat(view.focal[r]) * d_mean[r];
        d_p[r] = d_ratio * inv_z;
        d_p[2] = d_p[2] - d_ratio * p[r] * inv_z * inv_z;
    }
    let mut d_world = unroll!(j in [0, 1, 2] => rows[0][j].fma(d_p[0], rows[1][j].fma(d_p[1], rows[2][j] * d_p[2])));

    // Colour.
    let d_colour = [s[moment::RED], s[moment::GREEN], s[moment::BLUE]];
    let mut d_direction = [L::zero(); 3];
    let degree = options.sh_degree;
    let (direction, inv_distance) = directions::<L>(splats, i, view);
    let basis = sh::basis(degree, direction[0], direction[1], direction[2]);
    let coefficients = scene::splats::sh_coefficients(degree);
    let c0 = L::splat(scene::splats::SH_C0);
    let mut colour = unroll!(c in [0, 1, 2] => coefficient::<L>(splats, i, 0, c).fma(c0, half));
    for b in 1..coefficients {
        for c in 0..3 {
            colour[c] = basis[b - 1].fma(coefficient::<L>(splats, i, b, c), colour[c]);
        }
    }
    // No gradient where the colour is clamped at zero.
    let d_colour = unroll!(c in [0, 1, 2] => L::select(L::zero().lt(colour[c]), d_colour[c], L::zero()));
    for c in 0..3 {
        (d_colour[c] * c0).keep(seen).store_to(out.columns[column::SH + c], at);
    }
    if degree > 0 {
        let mut along = [L::zero(); 15];
        for b in 1..coefficients {
            for c in 0..3 {
                (d_colour[c] * basis[b - 1]).keep(seen).store_to(out.columns[column::SH + 3 * b + c], at);
                along[b - 1] = d_colour[c].fma(coefficient::<L>(splats, i, b, c), along[b - 1]);
            }
        }
        let d_unit = sh::basis_gradient(degree, direction[0], direction[1], direction[2], &along);
        let radial = dot(d_unit, direction);
        for c in 0..3 {
            d_direction[c] = (d_unit[c] - direction[c] * radial) * inv_distance;
            d_world[c] = d_world[c] + d_direction[c];
        }
    }
    for c in 0..3 {
        d_world[c].keep(seen).store_to(out.columns[column::MEAN + c], at);
    }

    // Pose: a translation moves the splat's centre and the camera's centre, a rotation the splat's centre and the axes
    // W.
    let turn = cross(p, d_p);
    for r in 0..3 {
        camera[r] = camera[r] + L::select(seen, d_p[r] + dot(rows[r], d_direction), L::zero());
        camera[3 + r] = camera[3 + r] + L::select(seen, turn[r], L::zero());
    }
    for c in 0..3 {
        let column = [rows[0][c], rows[1][c], rows[2][c]];
        // Column c of dL/dW = Jᵀ dL/dT.
        let j = unroll!(r in [0, 1] => L::splat(view.focal[r]) * inv_z * d_t[r][c]);
        let d_column = [j[0], j[1], -(u[0] * j[0] + u[1] * j[1])];
        let turn = cross(column, d_column);
        for r in 0..3 {
            camera[3 + r] = camera[3 + r] + L::select(seen, turn[r], L::zero());
        }
    }
    camera[6] = camera[6] + L::select(seen, d_focal, L::zero());
}

trait Keep: Lanes {
    /// Zero in the lanes of invisible splats, which may hold NaN.
    #[inline(always)]
    fn keep(self, seen: u16) -> Self {
        Self::select(seen, self, Self::zero())
    }
}

impl<L: Lanes> Keep for L {}

/// SH coefficient `b` of channel `c` of sixteen splats.
#[inline(always)]
fn coefficient<L: Lanes>(splats: &Splats, i: usize, b: usize, c: usize) -> L {
    L::load_from(splats.col(column::SH + 3 * b + c), i, 0.0)
}

#[inline(always)]
fn cross<L: Lanes>(a: [L; 3], b: [L; 3]) -> [L; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
