//! Carries splats between resolutions by compensating for the renderer's low-pass filter.
//!
//! The renderer adds 0.3 px² to the variance of every projected splat (EWA's low-pass filter, as in 3DGS). In metres
//! the filter is wider at a coarse mip, so splats trained there come out too thin when rendered at full resolution: two
//! mips cost 0.6 dB, and a coarse block shows holes next to a fine one. A block therefore publishes its splats for full
//! resolution, widened by the filter of its own mips ([`to_full_resolution`]), and training on coarser mips starts by
//! removing that width again ([`from_full_resolution`]). At mip 0 both change nothing. (Mip-Splatting, Yu et al. 2024,
//! bounds scales by the finest sampling rate during training.)

use scene::{Splats, column};

use crate::view::TrainView;
use crate::visibility::finest_pixels;

/// Variance that the renderer's low-pass filter adds, px².
const FILTER_VARIANCE: f64 = 0.3;
/// Smallest factor by which a scale is reduced.
const MIN_SCALE_FACTOR: f64 = 0.3;

/// Widens splats trained on these windows so that they render alike in the same views at mip 0.
pub fn to_full_resolution(splats: &mut Splats, views: &[TrainView]) {
    shift(splats, views, 1.0);
}

/// Narrows splats of mip 0 so that they render alike in these windows. The inverse of [`to_full_resolution`], except
/// for splats much narrower than a pixel, whose width is lost.
pub fn from_full_resolution(splats: &mut Splats, views: &[TrainView]) {
    shift(splats, views, -1.0);
}

fn shift(splats: &mut Splats, views: &[TrainView], sign: f64) {
    if views.iter().all(|view| view.mip == 0) {
        return;
    }
    // Filter variance in m², beyond that of mip 0, in the window with the finest pixels at each splat.
    let excess: Vec<f64> = (finest_pixels(splats, views, 0.0).into_iter())
        .map(
            |pixel| if pixel.is_visible() { FILTER_VARIANCE * f64::from(pixel.area * pixel.coarse_share) } else { 0.0 },
        )
        .collect();
    for column in &mut splats.columns_mut()[column::LOG_SCALE..column::LOG_SCALE + 3] {
        for (log_scale, excess) in column.iter_mut().zip(&excess) {
            let variance = (2.0 * f64::from(*log_scale)).exp();
            let shifted = (variance + sign * excess).max(variance * MIN_SCALE_FACTOR * MIN_SCALE_FACTOR);
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

    /// A camera at the origin looking along z, and the window of its whole image at a mip.
    fn view(mip: u8) -> TrainView {
        let pinhole = Pinhole { width: 256, height: 256, fx: 200.0, fy: 200.0, cx: 128.0, cy: 128.0 };
        let camera = Camera { pinhole, camera_from_world: Rigid::IDENTITY };
        TrainView { view: 0, mip, rect: camera.mip(mip).full(), camera, camera_from_context: None }
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
    fn splats_of_a_coarse_mip_render_alike_at_full_resolution() {
        let (coarse, fine, trained) = (view(2), view(0), splats());
        let draw = |splats: &Splats, view: &TrainView| {
            Renderer::default().forward(splats, &[], &view.camera.mip(view.mip), &Options::default()).colour.clone()
        };
        // Each pixel of the coarse render against the mean of its sixteen pixels at full resolution.
        let expected = draw(&trained, &coarse);
        let error = |splats: &Splats| {
            let full = draw(splats, &fine);
            let mean = |i: usize| {
                let (x, y) = (i % 64 * 4, i / 64 * 4);
                (0..16).map(|k| full[(y + k / 4) * 256 + x + k % 4]).sum::<f32>() / 16.0
            };
            (0..64 * 64).map(|i| (mean(i) - expected[i]).abs()).sum::<f32>()
        };
        let mut thick = trained.clone();
        to_full_resolution(&mut thick, &[coarse]);
        let (thin, thick_error) = (error(&trained), error(&thick));
        assert!(thick_error < 0.25 * thin, "{thick_error} against {thin}");

        from_full_resolution(&mut thick, &[coarse]);
        let same = |a: &f32, b: &f32| (a - b).abs() < 1e-4;
        assert!(thick.columns().iter().flatten().zip(trained.columns().iter().flatten()).all(|(a, b)| same(a, b)));
    }

    #[test]
    fn mip_0_and_invisible_splats_are_unchanged() {
        let (before, mut after) = (splats(), splats());
        to_full_resolution(&mut after, &[view(0)]);
        assert_eq!(before, after);
        let mut behind = Splats::new(0);
        behind.push(&Splat::round(Vec3::new(0.0, 0.0, -5.0), -2.0, Vec3::ONE, 0.5));
        let same = behind.clone();
        to_full_resolution(&mut behind, &[view(3)]);
        assert_eq!(behind, same);
    }
}
