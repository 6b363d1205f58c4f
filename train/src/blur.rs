//! What a pixel hides: the renderer's blur, carried from one resolution to another.
//!
//! A pixel blurs every splat by 0.3 px² (EWA's low-pass filter, as 3DGS has it), so splats that were fitted at a coarse
//! resolution come out too thin where they are drawn at a finer one: dilation is larger there in metres. Two steps of
//! resolution cost 0.6 dB before the first step of training, and a coarse block beside a fine one shows holes. So a block
//! hands on splats as they have to be for full images, thickened by what its own mips hid ([`to_full_images`]), and whoever trains
//! on coarser mips starts by taking out what those hide ([`from_full_images`]). At mip 0 both change nothing.
//! (Mip-Splatting, Yu et al. 2024, bounds scales by the finest sampling rate likewise, during training.)

use scene::{Splats, column};

use crate::TrainView;
use crate::sight::finest;

/// Variance that the renderer adds, px².
const PIXEL_VARIANCE: f64 = 0.3;
/// A scale is thinned to this share of itself at least.
const THINNEST: f64 = 0.3;

/// Thickens splats that were trained on these windows to look alike in the same views at full size.
pub fn to_full_images(splats: &mut Splats, views: &[TrainView]) {
    shift(splats, views, 1.0);
}

/// Thins splats of full images to look alike in these windows: the inverse, but for splats too thin to be told.
pub fn from_full_images(splats: &mut Splats, views: &[TrainView]) {
    shift(splats, views, -1.0);
}

fn shift(splats: &mut Splats, views: &[TrainView], sign: f64) {
    if views.iter().all(|view| view.mip == 0) {
        return;
    }
    // Square metres by which the mip of the window with the finest pixels here blurs more than its image at full size does.
    let hidden: Vec<f64> = (finest(splats, views, 0.0).into_iter())
        .map(|finest| if finest.is_seen() { PIXEL_VARIANCE * f64::from(finest.area * finest.coarser) } else { 0.0 })
        .collect();
    for column in &mut splats.columns_mut()[column::LOG_SCALE..column::LOG_SCALE + 3] {
        for (log_scale, hidden) in column.iter_mut().zip(&hidden) {
            let variance = (2.0 * f64::from(*log_scale)).exp();
            let shifted = (variance + sign * hidden).max(variance * THINNEST * THINNEST);
            *log_scale = (0.5 * shifted.ln()) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use render::Options;
    use render::cpu::Renderer;
    use scene::{Camera, Pinhole, Rigid, Splat};

    use super::*;

    /// A camera at the origin that looks along z, and its window of half the image at a mip.
    fn view(mip: u8) -> TrainView {
        let pinhole = Pinhole { width: 256, height: 256, fx: 200.0, fy: 200.0, cx: 128.0, cy: 128.0 };
        let camera = Camera { pinhole, camera_from_world: Rigid::IDENTITY };
        TrainView { view: 0, mip, rect: camera.mip(mip).full(), camera }
    }

    fn splats() -> Splats {
        let mut splats = Splats::new(0);
        for i in 0..40 {
            let (x, y) = ((i % 8) as f32 - 3.5, (i / 8) as f32 - 2.0);
            splats.push(&Splat::round(Vec3::new(x, y, 10.0), -3.0 + 0.02 * i as f32, Vec3::splat(0.9), 0.6));
        }
        splats
    }

    #[test]
    fn what_looks_right_at_a_coarse_mip_looks_right_in_full() {
        let (coarse, fine, trained) = (view(2), view(0), splats());
        let draw = |splats: &Splats, view: &TrainView| {
            Renderer::default().forward(splats, None, &view.camera.mip(view.mip), &Options::default()).colour.clone()
        };
        // The photo, as it were: what the coarse mip showed; each of its pixels against the mean of its sixteen in full.
        let truth = draw(&trained, &coarse);
        let error = |splats: &Splats| {
            let full = draw(splats, &fine);
            let mean = |i: usize| {
                let (x, y) = (i % 64 * 4, i / 64 * 4);
                (0..16).map(|k| full[(y + k / 4) * 256 + x + k % 4]).sum::<f32>() / 16.0
            };
            (0..64 * 64).map(|i| (mean(i) - truth[i]).abs()).sum::<f32>()
        };
        let mut thick = trained.clone();
        to_full_images(&mut thick, &[coarse]);
        let (thin, thick_error) = (error(&trained), error(&thick));
        assert!(thick_error < 0.25 * thin, "{thick_error} against {thin}");

        from_full_images(&mut thick, &[coarse]);
        let same = |a: &f32, b: &f32| (a - b).abs() < 1e-4;
        assert!(thick.columns().iter().flatten().zip(trained.columns().iter().flatten()).all(|(a, b)| same(a, b)));
    }

    #[test]
    fn full_images_and_what_is_not_seen_stay() {
        let (before, mut after) = (splats(), splats());
        to_full_images(&mut after, &[view(0)]);
        assert_eq!(before, after);
        let mut behind = Splats::new(0);
        behind.push(&Splat::round(Vec3::new(0.0, 0.0, -5.0), -2.0, Vec3::ONE, 0.5));
        let same = behind.clone();
        to_full_images(&mut behind, &[view(3)]);
        assert_eq!(behind, same);
    }
}
