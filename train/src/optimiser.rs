//! Adam over splat columns, on the splats that the view has seen.
//!
//! A splat outside the view keeps its parameters and its moments (the sparse Adam of Taming-3DGS): its gradient is not zero,
//! it is unknown. The regularisers act in the same pass and so on seen splats only; global ones melt large scenes.

use rayon::prelude::*;
use render::Gradients;
use render::cpu::Isa;
use render::cpu::simd::{LANES, Lanes};
use render::{each, kernel};
use scene::{Splats, column};

const CHUNK: usize = 1024;
const BETA1: f32 = 0.9;
const EPSILON: f32 = 1e-15;

/// Step sizes of one step, and the pull of the regularisers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Step of the mean in units of the splat's own size (geometric mean of its three scales), so that near and far,
    /// fine and coarse move alike.
    pub mean: f32,
    /// Step of ln(scale).
    pub log_scale: f32,
    /// Step of the quaternion.
    pub quat: f32,
    /// Step of the opacity's logit.
    pub opacity: f32,
    /// Step of the constant colour coefficient.
    pub sh_dc: f32,
    /// Step of the other coefficients.
    pub sh_rest: f32,
    /// Decay of the second moment.
    pub beta2: f32,
    /// Weight of the mean opacity of seen splats in the loss.
    pub opacity_pull: f32,
    /// Weight of the mean excess `ln(longest / middle) - ln 10` of needles among seen splats.
    pub needle_pull: f32,
    /// Bounds of ln(scale).
    pub log_scale_bounds: [f32; 2],
}

/// First and second moments of every column, and the number of steps taken.
#[derive(Debug, Clone)]
pub struct Adam {
    isa: Isa,
    step: i32,
    first: Vec<Vec<f32>>,
    second: Vec<Vec<f32>>,
}

/// A chunk of splats: parameters, moments, gradients; one slice a column.
struct Chunk<'a> {
    values: Vec<&'a mut [f32]>,
    first: Vec<&'a mut [f32]>,
    second: Vec<&'a mut [f32]>,
    gradients: Vec<&'a [f32]>,
    seen: &'a [u16],
}

impl Adam {
    /// No moments yet for `splats`.
    pub fn new(isa: Isa, splats: &Splats) -> Self {
        let zeros: Vec<Vec<f32>> = splats.columns().iter().map(|c| vec![0.0; c.len()]).collect();
        Self { isa, step: 0, first: zeros.clone(), second: zeros }
    }

    /// Steps taken, first and second moments.
    pub(crate) fn parts(&self) -> (i32, &[Vec<f32>], &[Vec<f32>]) {
        (self.step, &self.first, &self.second)
    }

    /// From such parts.
    pub(crate) fn from_parts(isa: Isa, step: i32, first: Vec<Vec<f32>>, second: Vec<Vec<f32>>) -> Self {
        Self { isa, step, first, second }
    }

    /// One step along the gradient of the columns that the SH degree uses.
    pub fn step(&mut self, splats: &mut Splats, gradients: &Gradients, sh_degree: u8, rates: &Rates) {
        self.step += 1;
        let used = column::SH + 3 * scene::splats::sh_coefficients(sh_degree.min(splats.sh_degree()));
        let seen: u32 = gradients.seen.iter().map(|word| word.count_ones()).sum();
        let mut rates = *rates;
        rates.opacity_pull /= seen.max(1) as f32;
        rates.needle_pull /= seen.max(1) as f32;
        let correction = [1.0 - BETA1.powi(self.step), 1.0 - rates.beta2.powi(self.step)];
        let chunks = splats.len().div_ceil(CHUNK);
        let mut work: Vec<Chunk> = (0..chunks)
            .map(|n| Chunk {
                values: Vec::with_capacity(used),
                first: Vec::with_capacity(used),
                second: Vec::with_capacity(used),
                gradients: Vec::with_capacity(used),
                seen: &gradients.seen[n * (CHUNK / LANES)..],
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

    /// Rows `rows` of the moments, in that order; `None` starts with zero moments. Follows a change of the splats.
    pub fn rearrange(&mut self, rows: &[Option<u32>]) {
        let pick = |column: &Vec<f32>| rows.iter().map(|row| row.map_or(0.0, |i| column[i as usize])).collect();
        self.first = self.first.iter().map(pick).collect();
        self.second = self.second.iter().map(pick).collect();
    }
}

kernel!(fn update(chunk: &mut Chunk, rates: &Rates, correction: [f32; 2]) = update_lanes);

/// Column after column: with its moments and its gradient each is four walks through memory already, and a core foresees only a
/// few. Means and scales go by threes, as they need what all scales were before.
#[inline(always)]
fn update_lanes<L: Lanes>(chunk: &mut Chunk, rates: &Rates, correction: [f32; 2]) {
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
            let pull = L::select(needle & longest.le(scales[c]), L::splat(rates.needle_pull), L::zero());
            let bounds = rates.log_scale_bounds;
            step.column(chunk, at, column::LOG_SCALE + c, L::splat(rates.log_scale), pull, bounds);
        }
    }
    for group in 0..groups {
        let at = Group::of(chunk, group);
        let logit = L::load_from(chunk.values[column::OPACITY], at.first, 0.0);
        let opacity = L::splat(1.0) / (L::splat(1.0) + (logit * L::splat(-std::f32::consts::LOG2_E)).exp2());
        let pull = opacity * (L::splat(1.0) - opacity) * L::splat(rates.opacity_pull);
        step.column(chunk, at, column::OPACITY, L::splat(rates.opacity), pull, [-15.0, 15.0]);
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
    /// Bit `n`: the view has seen splat `first + n`.
    seen: u16,
}

impl Group {
    #[inline(always)]
    fn of(chunk: &Chunk, group: usize) -> Self {
        Self { first: group * LANES, seen: chunk.seen[group] }
    }

    #[inline(always)]
    fn scales<L: Lanes>(self, chunk: &Chunk) -> [L; 3] {
        each!(c in [0, 1, 2] => L::load_from(chunk.values[column::LOG_SCALE + c], self.first, 0.0))
    }
}

/// What a step has in common over all splats.
struct Step<L> {
    beta2: L,
    /// 1 / (1 - βᵗ) of both moments.
    correction: [f32; 2],
}

impl<L: Lanes> Step<L> {
    #[inline(always)]
    fn column(&self, chunk: &mut Chunk, at: Group, c: usize, rate: L, pull: L, bounds: [f32; 2]) {
        if at.seen == 0 {
            return;
        }
        let i = at.first;
        let value = L::load_from(chunk.values[c], i, 0.0);
        let gradient = L::load_from(chunk.gradients[c], i, 0.0) + pull;
        let (m0, v0) = (L::load_from(chunk.first[c], i, 0.0), L::load_from(chunk.second[c], i, 0.0));
        let m = L::splat(BETA1).fma(m0, L::splat(1.0 - BETA1) * gradient);
        let v = self.beta2.fma(v0, (L::splat(1.0) - self.beta2) * gradient * gradient);
        let root = (v * L::splat(self.correction[1])).sqrt() + L::splat(EPSILON);
        let next = value - rate * L::splat(self.correction[0]) * m / root;
        let next = next.max(L::splat(bounds[0])).min(L::splat(bounds[1]));
        // A gradient that is not finite moves nothing: NaN and infinity fail these comparisons.
        let good = at.seen & gradient.abs().lt(L::splat(f32::MAX)) & next.abs().lt(L::splat(f32::MAX));
        L::select(good, next, value).store_to(chunk.values[c], i);
        L::select(good, m, m0).store_to(chunk.first[c], i);
        L::select(good, v, v0).store_to(chunk.second[c], i);
    }
}
