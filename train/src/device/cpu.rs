//! Computes training steps on the CPU, in place on the state.

use std::sync::Arc;

use rayon::prelude::*;
use render::cpu::{Isa, Renderer};
use render::{Frame, Gradients, Part, Upstream};
use scene::{Pixels, Splats};

use super::step::{StatePart, Step, TrainDevice, ViewSample};
use crate::checkpoint::State;
use crate::depth_loss::depth_loss;
use crate::error::TrainError;
use crate::exposure::{expose, expose_backward};
use crate::loss::PhotometricLoss;
use crate::picture_loss::{PictureLoss, add_picture_loss};
use crate::pose::GivenPoses;
use crate::silhouette_loss::silhouette_loss;
use crate::swing::SwingTraining;

/// The renderer, the loss and their buffers.
pub(crate) struct CpuDevice<'a> {
    context: Option<&'a Splats>,
    given: Arc<GivenPoses>,
    renderer: Renderer,
    loss: PhotometricLoss,
    picture_loss: Option<&'a dyn PictureLoss>,
    upstream: Upstream,
    exposed: Vec<f32>,
    /// The splats where they are in the view that is drawn.
    swung: Splats,
    weights: Vec<f32>,
    /// Summed gradients of a step with several samples.
    sum: Gradients,
}

impl<'a> CpuDevice<'a> {
    /// `lambda` is the weight of D-SSIM in the loss.
    pub(crate) fn new(
        lambda: f32,
        picture_loss: Option<&'a dyn PictureLoss>,
        context: Option<&'a Splats>,
        given: &Arc<GivenPoses>,
    ) -> Self {
        let isa = Isa::detect();
        Self {
            context,
            given: Arc::clone(given),
            renderer: Renderer::new(isa),
            loss: PhotometricLoss::new(isa, lambda),
            picture_loss,
            upstream: Upstream::default(),
            exposed: Vec::new(),
            swung: Splats::new(0),
            weights: Vec::new(),
            sum: Gradients::default(),
        }
    }
}

impl TrainDevice for CpuDevice<'_> {
    fn step(&mut self, state: &mut State, step: Step) -> Result<(), TrainError> {
        let Step {
            samples,
            options,
            rates,
            depth_weight,
            silhouette_weight,
            picture_weight,
            swing,
            exposure_rate,
            pose_rates,
        } = step;
        let walk = self.given.times.as_ref().and_then(|times| times.walk.as_ref());
        let several = samples.len() > 1;
        let before = several.then(|| state.densification.clone());
        let (mut loss, mut errors, mut visible_sum) = (0.0, Vec::new(), 0);
        let (mut by_exposure, mut by_pose) = (Vec::new(), Vec::new());
        for sample in &samples {
            let &ViewSample { view, ref photo, ref camera, camera_from_context, exposure, .. } = sample;
            let camera = state.poses.as_ref().map_or(*camera, |poses| poses.apply(&self.given, view, camera));
            let context = self.context.map(|splats| Part { splats, camera_from_part: camera_from_context });
            let splats = match (&state.swing, walk) {
                (Some(swing), Some(walk)) => {
                    self.swung.clone_from(&state.splats);
                    swing.apply(walk, &mut self.swung, view);
                    &self.swung
                }
                _ => &state.splats,
            };
            let frame = self.renderer.forward(splats, context.as_slice(), &camera, &options);
            pixel_weights(frame, photo, self.context.is_some(), &mut self.weights);
            let exposure = state.exposures.as_ref().map_or(exposure, |exposures| exposures.of(view));
            let shown = exposure.as_ref().map_or(&frame.colour, |exposure| {
                expose(exposure, &frame.colour, &mut self.exposed);
                &self.exposed
            });
            let mut value = self.loss.evaluate(shown, photo, &self.weights, &mut self.upstream.colour);
            match &photo.depth {
                Some(target) if depth_weight > 0.0 => {
                    value.total += depth_loss(frame, target, &self.weights, depth_weight, &mut self.upstream);
                }
                _ => {
                    self.upstream.depth.clear();
                    self.upstream.transmittance.clear();
                }
            }
            match &photo.silhouette {
                Some(shown) if silhouette_weight > 0.0 => {
                    value.total += silhouette_loss(frame, shown, &self.weights, silhouette_weight, &mut self.upstream);
                }
                _ => self.upstream.trainable_alpha.clear(),
            }
            if let Some(of_picture) = self.picture_loss.filter(|_| picture_weight > 0.0) {
                let (weights, gradient) = (&self.weights, &mut self.upstream.colour);
                value.total += add_picture_loss(of_picture, picture_weight, sample, shown, weights, gradient)?;
            }
            loss += value.total / samples.len() as f64;
            if !value.total.is_finite() {
                (state.loss, state.skipped) = (loss, state.skipped + 1);
                state.swing.iter_mut().for_each(SwingTraining::forget);
                state.densification = before.unwrap_or_else(|| std::mem::take(&mut state.densification));
                return Ok(());
            }
            errors.push(value.l1);
            if let Some(exposure) = &exposure {
                by_exposure.push((view, expose_backward(exposure, &frame.colour, &mut self.upstream.colour)));
            }
            let gradients = self.renderer.backward(splats, &self.upstream);
            if let (Some(of_splats), Some(walk), Some(step)) = (&mut state.swing, walk, swing) {
                of_splats.add(walk, gradients, view, step);
            }
            let [x, y, z, a, b, c] = gradients.pose;
            by_pose.push((view, [x, y, z, a, b, c, gradients.focal]));
            if rates.is_some() {
                state.densification.add(gradients, photo.area() as f32);
            }
            if several {
                visible_sum += visible_count(gradients);
                accumulate(&mut self.sum, gradients, errors.len() == 1);
            }
        }
        state.loss = loss;
        if let Some(exposures) = &mut state.exposures {
            by_exposure.iter().for_each(|(view, gradient)| exposures.step(*view, gradient, exposure_rate));
        }
        if let (Some(poses), Some(rates)) = (&mut state.poses, pose_rates) {
            by_pose.iter().for_each(|(view, gradient)| poses.step(&self.given, *view, gradient, &rates));
        }
        let Some(mut rates) = rates else { return Ok(()) };
        let gradients = match several {
            // Each sample's regulariser is a mean over the splats visible in it, Adam's over those visible in any.
            true => {
                let share = (samples.len() * visible_count(&self.sum)) as f32 / visible_sum.max(1) as f32;
                rates.opacity_reg *= share;
                rates.needle_reg *= share;
                &self.sum
            }
            false => self.renderer.gradients(),
        };
        if let (Some(of_splats), Some(walk), Some(step)) = (&mut state.swing, walk, swing) {
            of_splats.step(walk, &state.splats, gradients, step);
        }
        state.adam.step(&mut state.splats, gradients, options.sh_degree, &rates);
        errors.into_iter().for_each(|error| state.coarse_to_fine.tally.add(error));
        Ok(())
    }

    fn download(&mut self, _: &mut State, _: StatePart) -> Result<(), TrainError> {
        Ok(())
    }

    fn upload(&mut self, _: &State, _: StatePart) -> Result<(), TrainError> {
        Ok(())
    }

    fn rearrange(&mut self, state: &mut State, rows: &[Option<u32>]) -> Result<(), TrainError> {
        state.adam.rearrange(rows);
        Ok(())
    }
}

/// Number of visible splats.
fn visible_count(gradients: &Gradients) -> usize {
    gradients.seen.iter().map(|word| word.count_ones() as usize).sum()
}

/// Adds the columns and visibility of a sample's gradients, which are all that Adam uses.
fn accumulate(sum: &mut Gradients, more: &Gradients, first: bool) {
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

/// Loss weight of each pixel: zero under a mask, else the photo's weight times, beside a context (`share_weighted`), the
/// squared share of the pixel that the block's own splats explain. Empty where all weights are 1.
pub(super) fn pixel_weights(frame: &Frame, photo: &Pixels, share_weighted: bool, weights: &mut Vec<f32>) {
    weights.clear();
    if share_weighted {
        // Transmittance that nothing explains yet counts half as the block's own, so that a block may fill it. The
        // share is squared: Adam normalises gradients, so small steady ones would still move splats.
        const UNEXPLAINED: f32 = 0.5;
        const MIN_SHARE: f32 = 1e-4;
        weights.extend(frame.trainable_alpha.iter().zip(&frame.transmittance).map(|(own, transmittance)| {
            let open = UNEXPLAINED * transmittance + MIN_SHARE;
            let share = (own + open) / (1.0 - transmittance + open);
            share * share
        }));
    }
    if let Some(of_photo) = &photo.weights {
        if weights.is_empty() {
            weights.resize(of_photo.len(), 1.0);
        }
        weights.iter_mut().zip(of_photo).for_each(|(weight, of_photo)| *weight *= of_photo);
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
