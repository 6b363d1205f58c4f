//! Steps on the CPU: the state itself is what moves.

use rayon::prelude::*;
use render::cpu::{Isa, Renderer};
use render::{Frame, Gradients, Upstream};
use scene::{Pixels, Splats};

use super::{Look, Part, Side, Step};
use crate::exposure::{expose, expose_backward};
use crate::loss::Photometric;
use crate::{State, TrainError};

/// The renderer, the loss and their buffers.
pub(crate) struct CpuSide<'a> {
    context: Option<&'a Splats>,
    renderer: Renderer,
    loss: Photometric,
    upstream: Upstream,
    exposed: Vec<f32>,
    weights: Vec<f32>,
    /// Of all looks of a step, where there are several.
    sum: Gradients,
}

impl<'a> CpuSide<'a> {
    /// With the weight λ of 1 - SSIM in the loss.
    pub(crate) fn new(lambda: f32, context: Option<&'a Splats>) -> Self {
        let isa = Isa::detect();
        Self {
            context,
            renderer: Renderer::new(isa),
            loss: Photometric::new(isa, lambda),
            upstream: Upstream::default(),
            exposed: Vec::new(),
            weights: Vec::new(),
            sum: Gradients::default(),
        }
    }
}

impl Side for CpuSide<'_> {
    fn step(&mut self, now: &mut State, step: Step) -> Result<(), TrainError> {
        let Step { looks, options, mut rates, exposure_rate } = step;
        let several = looks.len() > 1;
        let before = several.then(|| now.evidence.clone());
        let (mut loss, mut errors, mut by_exposure, mut entries) = (0.0, Vec::new(), Vec::new(), 0);
        for Look { view, photo, camera, exposure } in &looks {
            let frame = self.renderer.forward(&now.splats, self.context, camera, &options);
            pixel_weights(frame, photo, &mut self.weights);
            let exposure = now.exposures.as_ref().map_or(*exposure, |exposures| exposures.of(*view));
            let shown = exposure.as_ref().map_or(&frame.colour, |exposure| {
                expose(exposure, &frame.colour, &mut self.exposed);
                &self.exposed
            });
            let value = self.loss.evaluate(shown, photo, &self.weights, &mut self.upstream.colour);
            loss += value.total / looks.len() as f64;
            if !value.total.is_finite() {
                (now.loss, now.skipped) = (loss, now.skipped + 1);
                now.evidence = before.unwrap_or_else(|| std::mem::take(&mut now.evidence));
                return Ok(());
            }
            errors.push(value.l1);
            if let Some(exposure) = &exposure {
                by_exposure.push((*view, expose_backward(exposure, &frame.colour, &mut self.upstream.colour)));
            }
            let gradients = self.renderer.backward(&now.splats, &self.upstream);
            now.evidence.add(gradients, photo.area() as f32);
            if several {
                entries += count(gradients);
                add(&mut self.sum, gradients, errors.len() == 1);
            }
        }
        now.loss = loss;
        if let Some(exposures) = &mut now.exposures {
            by_exposure.iter().for_each(|(view, gradient)| exposures.step(*view, gradient, exposure_rate));
        }
        let gradients = match several {
            // Each look's loss holds the means over the splats that it sees.
            true => {
                let share = (looks.len() * count(&self.sum)) as f32 / entries.max(1) as f32;
                rates.opacity_pull *= share;
                rates.needle_pull *= share;
                &self.sum
            }
            false => self.renderer.gradients(),
        };
        now.adam.step(&mut now.splats, gradients, options.sh_degree, &rates);
        errors.into_iter().for_each(|error| now.need.tally.add(error));
        Ok(())
    }

    fn fetch(&mut self, _: &mut State, _: Part) -> Result<(), TrainError> {
        Ok(())
    }

    fn give(&mut self, _: &State, _: Part) -> Result<(), TrainError> {
        Ok(())
    }
}

/// Splats that were seen.
fn count(gradients: &Gradients) -> usize {
    gradients.seen.iter().map(|word| word.count_ones() as usize).sum()
}

/// Adds a look's gradients to those before it, in so far as Adam goes by them.
fn add(sum: &mut Gradients, more: &Gradients, first: bool) {
    if first {
        sum.columns.clone_from(&more.columns);
        sum.seen.clone_from(&more.seen);
        return;
    }
    sum.columns.par_iter_mut().zip(&more.columns).for_each(|(sum, more)| {
        sum.iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
    });
    sum.seen.iter_mut().zip(&more.seen).for_each(|(sum, more)| *sum |= more);
}

/// What each pixel counts: nothing under a mask; else the share of what is drawn there that the block's own splats explain.
/// Empty where every pixel counts alike.
pub(super) fn pixel_weights(frame: &Frame, photo: &Pixels, weights: &mut Vec<f32>) {
    weights.clear();
    if !frame.own.is_empty() {
        // What nothing explains yet is half the block's: whoever sees it may repair it. Squared, as Adam makes steps of a
        // given size of however small a gradient, if only it is steady.
        const UNEXPLAINED: f32 = 0.5;
        const NOTHING: f32 = 1e-4;
        weights.extend(frame.own.iter().zip(&frame.transmittance).map(|(own, transmittance)| {
            let open = UNEXPLAINED * transmittance + NOTHING;
            let share = (own + open) / (1.0 - transmittance + open);
            share * share
        }));
    }
    if let Some(mask) = &photo.mask {
        if weights.is_empty() {
            weights.resize(mask.len(), 1.0);
        }
        for (weight, &mask) in weights.iter_mut().zip(mask) {
            if mask < 128 {
                *weight = 0.0;
            }
        }
    }
}
