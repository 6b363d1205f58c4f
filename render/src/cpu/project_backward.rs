//! Stage `project_backward`: from a splat's gradient in the view to the gradient of its parameters and of the pose.
//!
//! The chain of [`project`](super::project) in reverse, recomputed from the parameters instead of stored: sixteen splats at a
//! time, nothing kept between the passes but the 2D sums.

use scene::{Splats, column};

use super::project::{Ewa, View, camera_point, directions, dot, ewa, opacity};
use super::rasterize::{Moments, moment};
use super::sh;
use super::simd::{LANES, Lanes, prefetch};
use crate::{BLUR, Options, each, kernel};

/// Where the gradients of a chunk of splats go.
pub(crate) struct Sink<'a> {
    /// One slice a column, each as long as the chunk.
    pub(crate) columns: Vec<&'a mut [f32]>,
    pub(crate) screen: &'a mut [f32],
    pub(crate) screen_abs: &'a mut [f32],
    pub(crate) weight: &'a mut [f32],
}

kernel!(
    /// Gradients of splats `first ..` from the 2D sums of each, which lie by depth; returns the chunk's part of the pose gradient.
    pub(crate) fn project_backward(
        splats: &Splats, first: usize, view: &View, options: &Options, seen: &[u16], rank: &[u32], sums: &[Moments],
        sink: &mut Sink,
    ) -> [f32; 6] = project_backward_lanes
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
    sink: &mut Sink,
) -> [f32; 6] {
    let mut pose = [L::zero(); 16];
    for (group, (ranks, &seen)) in rank.chunks(LANES).zip(seen).enumerate() {
        let at = group * LANES;
        // Of splats that were not seen the rank is any.
        let ahead = rank.get(at + LANES..).unwrap_or(&[]);
        ahead.iter().take(LANES).filter_map(|&rank| sums.get(rank as usize)).for_each(prefetch);
        let columns = splats.columns()[..sink.columns.len()].iter().filter_map(|column| column.get(first + at + LANES));
        columns.chain(sink.columns.iter().filter_map(|column| column.get(at + LANES))).for_each(prefetch);
        if seen == 0 {
            let range = at..at + ranks.len();
            for column in sink.columns.iter_mut().chain([&mut sink.screen, &mut sink.screen_abs, &mut sink.weight]) {
                column[range.clone()].fill(0.0);
            }
            continue;
        }
        backward_group::<L>(splats, first + at, at, view, options, seen, ranks, sums, sink, &mut pose);
    }
    L::sums(&pose).to_array()[..6].try_into().expect("six of sixteen")
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
    sink: &mut Sink,
    pose: &mut [L; 16],
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
    let Ewa { inv_z, u, free, quat, inv_norm, axes, scale, t, a, cov, det0, det1 } = e;

    // The conic and what follows from the moments.
    let inv_det = one / det1;
    let conic = [(cov[2] + L::splat(BLUR)) * inv_det, -(cov[1] * inv_det), (cov[0] + L::splat(BLUR)) * inv_det];
    let d_mean =
        [conic[0].fma(s[moment::VX], conic[1] * s[moment::VY]), conic[1].fma(s[moment::VX], conic[2] * s[moment::VY])];
    (d_mean[0] * d_mean[0] + d_mean[1] * d_mean[1]).sqrt().keep(seen).store_to(sink.screen, at);
    let (ax, ay) = (s[moment::ABS_X], s[moment::ABS_Y]);
    (ax * ax + ay * ay).sqrt().keep(seen).store_to(sink.screen_abs, at);
    s[moment::WEIGHT].keep(seen).store_to(sink.weight, at);

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
    (s[moment::V] * (one - o)).keep(seen).store_to(sink.columns[column::OPACITY], at);
    if options.antialiased {
        let ratio = det0 * inv_det;
        // dL/d ratio = ½ Σv / ratio; d ratio / dΣ' = adj(Σ)/det1 - ratio·K.
        let d_ratio = half * s[moment::V] / ratio.max(L::splat(1e-12));
        d_cov[0] = d_cov[0] + d_ratio * (cov[2] * inv_det - ratio * conic[0]);
        d_cov[1] = d_cov[1] - d_ratio * (cov[1] * inv_det + ratio * conic[1]);
        d_cov[2] = d_cov[2] + d_ratio * (cov[0] * inv_det - ratio * conic[2]);
    }

    // Through A = T·axes.
    let mut d_t = [[L::zero(); 3]; 2];
    let mut d_rotation = [[L::zero(); 3]; 3]; // by columns
    for c in 0..3 {
        let d_a = [two * (d_cov[0] * a[c][0] + d_cov[1] * a[c][1]), two * (d_cov[1] * a[c][0] + d_cov[2] * a[c][1])];
        let d_axis = each!(j in [0, 1, 2] => t[0][j].fma(d_a[0], t[1][j] * d_a[1]));
        for r in 0..2 {
            for j in 0..3 {
                d_t[r][j] = d_a[r].fma(axes[c][j], d_t[r][j]);
            }
        }
        dot(d_axis, axes[c]).keep(seen).store_to(sink.columns[column::LOG_SCALE + c], at);
        d_rotation[c] = each!(j in [0, 1, 2] => d_axis[j] * scale[c]);
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
        ((d_unit[c] - quat[c] * radial) * inv_norm).keep(seen).store_to(sink.columns[column::QUAT + c], at);
    }

    // Through T = J W and the projection of the centre.
    let rows = each!(r in [0, 1, 2] => each!(c in [0, 1, 2] => L::splat(view.rotation[r][c])));
    let mut d_p = [L::zero(), L::zero(), s[moment::Z]];
    for r in 0..2 {
        let f_z = L::splat(view.focal[r]) * inv_z;
        let d_j0 = dot(d_t[r], rows[r]);
        let d_j2 = dot(d_t[r], rows[2]);
        let d_ratio = L::select(free[r], -(f_z * d_j2), L::zero());
        d_p[2] = d_p[2] + f_z * inv_z * (u[r] * d_j2 - d_j0);
        // The ratio p_r / z, of the centre and (unless clamped) of the Jacobian.
        let d_ratio = d_ratio + L::splat(view.focal[r]) * d_mean[r];
        d_p[r] = d_ratio * inv_z;
        d_p[2] = d_p[2] - d_ratio * p[r] * inv_z * inv_z;
    }
    let mut d_world = each!(j in [0, 1, 2] => rows[0][j].fma(d_p[0], rows[1][j].fma(d_p[1], rows[2][j] * d_p[2])));

    // Colour.
    let d_colour = [s[moment::RED], s[moment::GREEN], s[moment::BLUE]];
    let mut d_direction = [L::zero(); 3];
    let degree = options.sh_degree;
    let (direction, inv_distance) = directions::<L>(splats, i, view);
    let basis = sh::basis(degree, direction[0], direction[1], direction[2]);
    let coefficients = scene::splats::sh_coefficients(degree);
    let c0 = L::splat(scene::splats::SH_C0);
    let mut colour = each!(c in [0, 1, 2] => coefficient::<L>(splats, i, 0, c).fma(c0, half));
    for b in 1..coefficients {
        for c in 0..3 {
            colour[c] = basis[b - 1].fma(coefficient::<L>(splats, i, b, c), colour[c]);
        }
    }
    // Clamped at zero: no gradient.
    let d_colour = each!(c in [0, 1, 2] => L::select(L::zero().lt(colour[c]), d_colour[c], L::zero()));
    for c in 0..3 {
        (d_colour[c] * c0).keep(seen).store_to(sink.columns[column::SH + c], at);
    }
    if degree > 0 {
        let mut along = [L::zero(); 15];
        for b in 1..coefficients {
            for c in 0..3 {
                (d_colour[c] * basis[b - 1]).keep(seen).store_to(sink.columns[column::SH + 3 * b + c], at);
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
        d_world[c].keep(seen).store_to(sink.columns[column::MEAN + c], at);
    }

    // Pose: translation moves the centre of the splat and of the camera, rotation the centre and the axes W.
    let turn = cross(p, d_p);
    for r in 0..3 {
        pose[r] = pose[r] + L::select(seen, d_p[r] + dot(rows[r], d_direction), L::zero());
        pose[3 + r] = pose[3 + r] + L::select(seen, turn[r], L::zero());
    }
    for c in 0..3 {
        let column = [rows[0][c], rows[1][c], rows[2][c]];
        // dL/dW, column c: Jᵀ dT.
        let j = each!(r in [0, 1] => L::splat(view.focal[r]) * inv_z * d_t[r][c]);
        let d_column = [j[0], j[1], -(u[0] * j[0] + u[1] * j[1])];
        let turn = cross(column, d_column);
        for r in 0..3 {
            pose[3 + r] = pose[3 + r] + L::select(seen, turn[r], L::zero());
        }
    }
}

/// Zero in the lanes of splats that were not seen, whatever their parameters made of it.
trait Keep: Lanes {
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
