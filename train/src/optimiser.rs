//! Sparse Adam over splat columns: updates only the splats that are visible in the step's views.
//!
//! An invisible splat keeps its parameters and Adam moments, because its gradient is unknown rather than zero
//! (Taming-3DGS). The regularisers are part of the same pass and therefore act on visible splats only. Global ones
//! would shrink the splats of a large scene, each of which few views see.

use rayon::prelude::*;
use render::Gradients;
use render::cpu::Isa;
use render::cpu::simd::{LANES, Lanes};
use render::{kernel, unroll};
use scene::{Splats, column};

const CHUNK: usize = 1024;
const BETA1: f32 = 0.9;
const EPSILON: f32 = 1e-15;

/// Learning rates and regulariser weights of one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LearningRates {
    /// Learning rate of the mean, in units of the splat's size (geometric mean of its three scales), so that it does
    /// not depend on the scene's scale.
    pub mean: f32,
    /// Learning rate of ln(scale).
    pub log_scale: f32,
    /// Learning rate of the quaternion.
    pub quat: f32,
    /// Learning rate of the opacity logit.
    pub opacity: f32,
    /// Learning rate of the SH coefficients of degree 0.
    pub sh_dc: f32,
    /// Learning rate of the other SH coefficients.
    pub sh_rest: f32,
    /// Decay β₂ of the second moment.
    pub beta2: f32,
    /// Weight of the opacity regulariser: the mean opacity of visible splats.
    pub opacity_reg: f32,
    /// Weight of the needle regulariser: the mean over visible splats of `max(0, ln(longest / middle) - ln 10)`.
    pub needle_reg: f32,
    /// Smallest and largest ln(scale).
    pub log_scale_bounds: [f32; 2],
}

/// Adam's first and second moments of every column, and the number of steps.
#[derive(Debug, Clone)]
pub struct Adam {
    isa: Isa,
    step: i32,
    first: Vec<Vec<f32>>,
    second: Vec<Vec<f32>>,
}

/// A chunk of splats: parameters, moments and gradients, one slice per column.
struct Chunk<'a> {
    values: Vec<&'a mut [f32]>,
    first: Vec<&'a mut [f32]>,
    second: Vec<&'a mut [f32]>,
    gradients: Vec<&'a [f32]>,
    visible: &'a [u16],
}

impl Adam {
    /// Zero moments for `splats`.
    pub fn new(isa: Isa, splats: &Splats) -> Self {
        let zeros: Vec<Vec<f32>> = splats.columns().iter().map(|c| vec![0.0; c.len()]).collect();
        Self { isa, step: 0, first: zeros.clone(), second: zeros }
    }

    /// Number of steps, first moments, second moments.
    pub(crate) fn parts(&self) -> (i32, &[Vec<f32>], &[Vec<f32>]) {
        (self.step, &self.first, &self.second)
    }

    /// The inverse of [`parts`](Self::parts).
    pub(crate) fn from_parts(isa: Isa, step: i32, first: Vec<Vec<f32>>, second: Vec<Vec<f32>>) -> Self {
        Self { isa, step, first, second }
    }

    /// One Adam step on the visible splats and the columns that the SH degree uses.
    pub fn step(&mut self, splats: &mut Splats, gradients: &Gradients, sh_degree: u8, rates: &LearningRates) {
        self.step += 1;
        let used = column::SH + 3 * scene::splats::sh_coefficients(sh_degree.min(splats.sh_degree()));
        let visible: u32 = gradients.seen.iter().map(|word| word.count_ones()).sum();
        let mut rates = *rates;
        rates.opacity_reg /= visible.max(1) as f32;
        rates.needle_reg /= visible.max(1) as f32;
        let correction = [1.0 - BETA1.powi(self.step), 1.0 - rates.beta2.powi(self.step)];
        let chunks = splats.len().div_ceil(CHUNK);
        let mut work: Vec<Chunk> = (0..chunks)
            .map(|n| Chunk {
                values: Vec::with_capacity(used),
                first: Vec::with_capacity(used),
                second: Vec::with_capacity(used),
                gradients: Vec::with_capacity(used),
                visible: &gradients.seen[n * (CHUNK / LANES)..],
            })
            .collect();
        let moments = self.first.iter_mut().zip(&mut self.second);
        let columns = splats.columns_mut().iter_mut().zip(moments).zip(&gradients.columns);
        for ((column, (first, second)), gradient) in columns.take(used) {
            let parts = (column.chunks_mut(CHUNK).zip(first.chunks_mut(CHUNK)))
                .zip(second.chunks_mut(CHUNK).zip(gradient.chunks(CHUNK)));
            for (chunk, ((value, first), (second, gradient))) in work.iter_mut().zip(parts) {
                chunk.values.push(value);
                chunk.first.push(first);
                chunk.second.push(second);
                chunk.gradients.push(gradient);
            }
        }
        let isa = self.isa;
        work.par_iter_mut().with_max_len(1).for_each(|chunk| update(isa, chunk, &rates, correction));
    }

    /// Reorders the moments after densification: new row `i` takes the moments of old row `rows[i]`, or zeros for
    /// `None`.
    pub fn rearrange(&mut self, rows: &[Option<u32>]) {
        for columns in [&mut self.first, &mut self.second] {
            columns.par_iter_mut().for_each(|column| {
                *column = rows.iter().map(|row| row.map_or(0.0, |i| column[i as usize])).collect();
            });
        }
    }
}

kernel!(fn update(chunk: &mut Chunk, rates: &LearningRates, correction: [f32; 2]) = update_lanes);

/// Updates one column at a time. A column with its moments and gradient is four memory streams already, and hardware
/// prefetchers follow only a few. Means precede scales because their learning rate depends on the scales before the
/// update.
#[inline(always)]
fn update_lanes<L: Lanes>(chunk: &mut Chunk, rates: &LearningRates, correction: [f32; 2]) {
    let step = Step::<L> { beta2: L::splat(rates.beta2), correction: correction.map(|c| 1.0 / c) };
    let groups = chunk.values[0].len().div_ceil(LANES);
    let free = [f32::MIN, f32::MAX];
    for group in 0..groups {
        let at = Group::of(chunk, group);
        let scales = at.scales::<L>(chunk);
        let size = ((scales[0] + scales[1] + scales[2]) * L::splat(std::f32::consts::LOG2_E / 3.0)).exp2();
        for c in 0..3 {
            step.column(chunk, at, column::MEAN + c, size * L::splat(rates.mean), L::zero(), free);
        }
    }
    for group in 0..groups {
        let at = Group::of(chunk, group);
        let scales = at.scales::<L>(chunk);
        let longest = scales[0].max(scales[1]).max(scales[2]);
        let shortest = scales[0].min(scales[1]).min(scales[2]);
        let middle = scales[0] + scales[1] + scales[2] - longest - shortest;
        let needle = L::splat(std::f32::consts::LN_10).lt(longest - middle);
        for c in 0..3 {
            let regulariser = L::select(needle & longest.le(scales[c]), L::splat(rates.needle_reg), L::zero());
            let bounds = rates.log_scale_bounds;
            step.column(chunk, at, column::LOG_SCALE + c, L::splat(rates.log_scale), regulariser, bounds);
        }
    }
    for group in 0..groups {
        let at = Group::of(chunk, group);
        let logit = L::load_from(chunk.values[column::OPACITY], at.first, 0.0);
        let opacity = L::splat(1.0) / (L::splat(1.0) + (logit * L::splat(-std::f32::consts::LOG2_E)).exp2());
        let regulariser = opacity * (L::splat(1.0) - opacity) * L::splat(rates.opacity_reg);
        step.column(chunk, at, column::OPACITY, L::splat(rates.opacity), regulariser, [-15.0, 15.0]);
    }
    let quats = (column::QUAT..column::QUAT + 4).map(|c| (c, rates.quat));
    let colours =
        (column::SH..chunk.values.len()).map(|c| (c, if c < column::SH + 3 { rates.sh_dc } else { rates.sh_rest }));
    for (c, rate) in quats.chain(colours) {
        for group in 0..groups {
            step.column(chunk, Group::of(chunk, group), c, L::splat(rate), L::zero(), free);
        }
    }
}

/// Sixteen splats of a chunk.
#[derive(Clone, Copy)]
struct Group {
    first: usize,
    /// Bit `n`: splat `first + n` is visible.
    visible: u16,
}

impl Group {
    #[inline(always)]
    fn of(chunk: &Chunk, group: usize) -> Self {
        Self { first: group * LANES, visible: chunk.visible[group] }
    }

    #[inline(always)]
    fn scales<L: Lanes>(self, chunk: &Chunk) -> [L; 3] {
        unroll!(c in [0, 1, 2] => L::load_from(chunk.values[column::LOG_SCALE + c], self.first, 0.0))
    }
}

/// Constants of a step.
struct Step<L> {
    beta2: L,
    /// Bias corrections 1 / (1 - βᵗ) of both moments.
    correction: [f32; 2],
}

impl<L: Lanes> Step<L> {
    #[inline(always)]
    fn column(&self, chunk: &mut Chunk, at: Group, c: usize, rate: L, regulariser: L, bounds: [f32; 2]) {
        if at.visible == 0 {
            return;
        }
        let i = at.first;
        let value = L::load_from(chunk.values[c], i, 0.0);
        let gradient = L::load_from(chunk.gradients[c], i, 0.0) + regulariser;
        let (m0, v0) = (L::load_from(chunk.first[c], i, 0.0), L::load_from(chunk.second[c], i, 0.0));
        let m = L::splat(BETA1).fma(m0, L::splat(1.0 - BETA1) * gradient);
        let v = self.beta2.fma(v0, (L::splat(1.0) - self.beta2) * gradient * gradient);
        let root = (v * L::splat(self.correction[1])).sqrt() + L::splat(EPSILON);
        let next = value - rate * L::splat(self.correction[0]) * m / root;
        let next = next.max(L::splat(bounds[0])).min(L::splat(bounds[1]));
        // Gradients that are not finite are skipped: NaN and infinity fail these comparisons.
        let is_valid = at.visible & gradient.abs().lt(L::splat(f32::MAX)) & next.abs().lt(L::splat(f32::MAX));
        L::select(is_valid, next, value).store_to(chunk.values[c], i);
        L::select(is_valid, m, m0).store_to(chunk.first[c], i);
        L::select(is_valid, v, v0).store_to(chunk.second[c], i);
    }
}
