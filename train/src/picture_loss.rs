//! A loss of whole pictures beside the photometric one: what a detector sees in them, for example.
//!
//! It comes from outside, as this crate knows no detectors. It is shown what the photo is compared with: the render with
//! the view's exposure. Of pixels that do not count (under a mask) it is shown the photo's, and of those that other
//! blocks explain in part a mixture, so that nothing there differs from the photo and this block is not to blame for it.

use scene::{Pixels, Rect};

use crate::device::step::ViewSample;
use crate::error::TrainError;

/// A loss of a picture against the photo of the same window.
pub trait PictureLoss: Sync {
    /// The loss of a picture, and its derivative with respect to the picture. Both are three planes of the photo's size,
    /// red first, 0..1. `rect` is in pixels of mip `mip` of the view. `None` where there is nothing to compare, or where
    /// the numbers are not finite. Equal arguments give equal bits.
    ///
    /// # Errors
    /// One line that says why the loss cannot be computed.
    fn evaluate(
        &self,
        view: u32,
        mip: u8,
        rect: Rect,
        photo: &Pixels,
        picture: &[f32],
    ) -> Result<Option<(f64, Vec<f32>)>, String>;
}

/// Returns `factor` times the loss of `shown` (three planes), and adds its gradient to `gradient` (three planes).
/// `weights` (one plane, or empty for all ones) are the pixel weights of the photometric loss; that the photo's own weights
/// raise some of them does not matter here.
pub(crate) fn add_picture_loss(
    loss: &dyn PictureLoss,
    factor: f32,
    sample: &ViewSample,
    shown: &[f32],
    weights: &[f32],
    gradient: &mut [f32],
) -> Result<f64, TrainError> {
    let ViewSample { view, mip, rect, photo, .. } = sample;
    let area = photo.area();
    let share = |i: usize| {
        let raised = photo.weights.as_ref().map_or(1.0, |of_photo| of_photo[i]);
        let weight = weights.get(i).copied().unwrap_or(1.0);
        if raised > 0.0 { weight / raised } else { 0.0 }
    };
    let shares: Vec<f32> = (0..area).map(share).collect();
    let mixed = shown.iter().zip(&photo.rgb).enumerate().map(|(i, (&shown, &photo))| {
        let photo = f32::from(photo) * (1.0 / 255.0);
        photo + shares[i % area] * (shown - photo)
    });
    let mixed: Vec<f32> = mixed.collect();
    let found = loss.evaluate(*view, *mip, *rect, photo, &mixed).map_err(TrainError::PictureLoss)?;
    let Some((value, slopes)) = found else { return Ok(0.0) };
    for (i, (sum, slope)) in gradient.iter_mut().zip(&slopes).enumerate() {
        *sum += factor * shares[i % area] * slope;
    }
    Ok(f64::from(factor) * value)
}

#[cfg(test)]
pub(crate) mod tests {
    use std::sync::Arc;

    use glam::{DQuat, DVec3, Vec3};
    use render::Options;
    use render::cpu::Isa;
    use scene::{Camera, Exposure, Pinhole, Rigid, Splat, Splats, column};

    use super::*;
    use crate::checkpoint::State;
    use crate::coarse_to_fine::CoarseToFine;
    use crate::device::Backend;
    use crate::device::step::Step;
    use crate::growth::DensificationStats;
    use crate::optimiser::{Adam, LearningRates};
    use crate::pose::GivenPoses;
    use crate::random::uniform;

    const WIDTH: u32 = 24;
    const HEIGHT: u32 = 20;

    /// Σ (picture − photo)³, which tells signs apart and is smooth.
    pub(crate) struct Cubes;

    impl PictureLoss for Cubes {
        fn evaluate(
            &self,
            _: u32,
            _: u8,
            _: Rect,
            photo: &Pixels,
            picture: &[f32],
        ) -> Result<Option<(f64, Vec<f32>)>, String> {
            let errors = || picture.iter().zip(&photo.rgb).map(|(value, byte)| value - f32::from(*byte) / 255.0);
            let loss = errors().map(|error| f64::from(error).powi(3)).sum();
            Ok(Some((loss, errors().map(|error| 3.0 * error * error).collect())))
        }
    }

    fn splats(key: u64, depth: f32) -> Splats {
        let mut splats = Splats::new(0);
        for i in 0..12 {
            let number = |k: u64| uniform(key, 16 * i + k);
            let place = Vec3::new(2.0 * number(0) - 1.0, 1.6 * number(1) - 0.8, depth + number(2));
            splats.push(&Splat::round(place, -0.7, Vec3::new(number(3), number(4), number(5)), 0.7));
        }
        splats
    }

    /// A window with a mask, weights and an exposure.
    fn sample() -> ViewSample {
        let area = (WIDTH * HEIGHT) as usize;
        let photo = Pixels {
            width: WIDTH,
            height: HEIGHT,
            rgb: (0..3 * area).map(|i| (255.0 * uniform(7, i as u64)) as u8).collect(),
            mask: Some((0..area).map(|i| if i % 24 < 5 { 0 } else { 255 }).collect()),
            weights: Some((0..area).map(|i| if i.is_multiple_of(3) { 5.0 } else { 1.0 }).collect()),
            ..Pixels::default()
        };
        let pinhole = Pinhole { width: WIDTH, height: HEIGHT, fx: 20.0, fy: 20.0, cx: 12.0, cy: 10.0 };
        let camera_from_world = Rigid { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };
        let camera = Camera { pinhole, camera_from_world };
        let exposure = Exposure([[1.1, 0.1, 0.0, 0.05], [0.0, 0.9, 0.1, 0.0], [0.2, 0.0, 0.8, -0.05]]);
        let photo = Arc::new(photo);
        ViewSample {
            view: 0,
            mip: 0,
            rect: camera.full(),
            photo,
            camera,
            camera_from_context: None,
            exposure: Some(exposure),
        }
    }

    /// The loss of a step and its gradient along the splats' first colour column.
    fn step(splats: &Splats, context: &Splats, picture_weight: f32) -> (f64, Vec<f32>) {
        let given = Arc::new(GivenPoses::of(&[], &Splats::new(0), true, None, None));
        let mut state = State {
            step: 0,
            skipped: 0,
            start_count: splats.len(),
            coarse_to_fine: CoarseToFine::default(),
            adam: Adam::new(Isa::detect(), splats),
            densification: DensificationStats::default(),
            exposures: None,
            poses: None,
            swing: None,
            splats: splats.clone(),
            loss: f64::NAN,
        };
        let mut device = Backend::Cpu.open(&state, 0.2, Some(&Cubes), Some(context), &given).unwrap();
        let rates = LearningRates {
            mean: 0.01,
            log_scale: 0.01,
            quat: 0.01,
            opacity: 0.01,
            sh_dc: 0.01,
            sh_rest: 0.01,
            beta2: 0.99,
            opacity_reg: 0.0,
            needle_reg: 0.0,
            log_scale_bounds: [-5.0, 1.0],
        };
        let step = Step {
            samples: vec![sample()],
            options: Options { extras: true, sh_degree: 0, ..Options::default() },
            rates: Some(rates),
            depth_weight: 0.0,
            silhouette_weight: 0.0,
            picture_weight,
            swing: None,
            exposure_rate: 0.0,
            pose_rates: None,
        };
        device.step(&mut state, step).unwrap();
        drop(device);
        // After one step the first moment is a tenth of the gradient.
        let (_, first, _) = state.adam.parts();
        (state.loss, first[column::SH].iter().map(|moment| 10.0 * moment).collect())
    }

    #[test]
    fn a_steps_gradient_agrees_with_finite_differences() {
        let (own, context) = (splats(1, 3.0), splats(2, 4.0));
        // Of the picture loss alone: the photometric one has edges.
        let alone = |splats: &Splats| {
            let [(with, by_all), (without, by_photo)] = [0.02, 0.0].map(|weight| step(splats, &context, weight));
            let gradient: Vec<f32> = by_all.iter().zip(by_photo).map(|(all, photo)| all - photo).collect();
            (with - without, gradient)
        };
        let (_, gradient) = alone(&own);
        let (mut largest, mut off) = (0.0f64, 0.0f64);
        for row in 0..own.len() {
            let moved = |by: f32| {
                let mut moved = own.clone();
                moved.columns_mut()[column::SH][row] += by;
                alone(&moved).0
            };
            let slope = (moved(0.02) - moved(-0.02)) / 0.04;
            largest = largest.max(slope.abs());
            off = off.max((f64::from(gradient[row]) - slope).abs());
        }
        println!("slopes up to {largest:.3e}, off by {off:.1e}");
        assert!(largest > 0.01 && off < 0.01 * largest, "{largest} {off}");
    }
}
