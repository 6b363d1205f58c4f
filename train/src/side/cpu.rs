//! Steps on the CPU: the state itself is what moves.

use render::cpu::{Isa, Renderer};
use render::{Frame, Upstream};
use scene::{Pixels, Splats};

use super::{Part, Side, Step};
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
        }
    }
}

impl Side for CpuSide<'_> {
    fn step(&mut self, now: &mut State, step: Step) -> Result<(), TrainError> {
        let Step { view, photo, camera, options, rates, exposure, exposure_rate } = step;
        let frame = self.renderer.forward(&now.splats, self.context, &camera, &options);
        pixel_weights(frame, &photo, &mut self.weights);
        let exposure = now.exposures.as_ref().map_or(exposure, |exposures| exposures.of(view));
        let shown = exposure.as_ref().map_or(&frame.colour, |exposure| {
            expose(exposure, &frame.colour, &mut self.exposed);
            &self.exposed
        });
        let value = self.loss.evaluate(shown, &photo, &self.weights, &mut self.upstream.colour);
        now.loss = value.total;
        if !value.total.is_finite() {
            now.skipped += 1;
            return Ok(());
        }
        if let Some(exposure) = &exposure {
            let by_exposure = expose_backward(exposure, &frame.colour, &mut self.upstream.colour);
            if let Some(exposures) = &mut now.exposures {
                exposures.step(view, &by_exposure, exposure_rate);
            }
        }
        let gradients = self.renderer.backward(&now.splats, &self.upstream);
        now.evidence.add(gradients, photo.area() as f32);
        now.adam.step(&mut now.splats, gradients, options.sh_degree, &rates);
        now.need.tally.add(value.l1);
        Ok(())
    }

    fn fetch(&mut self, _: &mut State, _: Part) -> Result<(), TrainError> {
        Ok(())
    }

    fn give(&mut self, _: &State, _: Part) -> Result<(), TrainError> {
        Ok(())
    }
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
