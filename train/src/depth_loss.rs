//! The depth loss: smooth L1 of the relative error of the rendered inverse depth against sparse target depths, and its
//! gradient.
//!
//! The inverse depth of a pixel is the mean `I = (Σ αT/z) / (1 - T)`. The error `I d - 1` is relative to the target `d`,
//! as the uncertainty of triangulated points grows with their distance. The mean of `z` itself would not do: two percent
//! of a sky at 500 m double it, and splats move towards the camera to make up for that (docs/decisions/0057).

use render::{Frame, Upstream};

/// Relative error at which the loss changes from quadratic to linear.
const BETA: f32 = 0.1;
/// Least alpha at which a pixel has a depth. Below it the expected depth is that of a haze before an unseen surface.
const MIN_ALPHA: f32 = 0.5;

/// Returns `factor` times the mean loss over the pixels with a target (`target`, one plane of metres, 0 = none) and
/// enough alpha, weighted by `weights` (one plane, or empty for all ones), and writes its gradient to the planes
/// `depth` and `transmittance` of `upstream`. Zero without such pixels. The frame needs
/// [`Options::extras`](render::Options::extras) and [`Options::inverse_depth`](render::Options::inverse_depth).
pub(crate) fn depth_loss(frame: &Frame, target: &[f32], weights: &[f32], factor: f32, upstream: &mut Upstream) -> f64 {
    let area = frame.transmittance.len();
    assert!(target.len() == area && frame.depth.len() == area && (weights.is_empty() || weights.len() == area));
    for plane in [&mut upstream.depth, &mut upstream.transmittance] {
        plane.clear();
        plane.resize(area, 0.0);
    }
    let weight = |i: usize| weights.get(i).copied().unwrap_or(1.0);
    let used = || (0..area).filter(|&i| target[i] > 0.0 && 1.0 - frame.transmittance[i] > MIN_ALPHA);
    let total_weight: f64 = used().map(|i| f64::from(weight(i))).sum();
    if total_weight <= 0.0 {
        return 0.0;
    }
    let scale = (f64::from(factor) / total_weight) as f32;
    let mut loss = 0.0;
    for i in used() {
        let alpha = 1.0 - frame.transmittance[i];
        let inverse = frame.depth[i] / alpha;
        let error = inverse * target[i] - 1.0;
        let size = error.abs();
        let value = if size < BETA { 0.5 * size * size / BETA } else { size - 0.5 * BETA };
        loss += f64::from(weight(i)) * f64::from(value);
        let d_inverse = scale * weight(i) * (error / BETA).clamp(-1.0, 1.0) * target[i];
        upstream.depth[i] = d_inverse / alpha;
        upstream.transmittance[i] = d_inverse * inverse / alpha;
    }
    f64::from(factor) * loss / total_weight
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3, Vec3};
    use render::Options;
    use render::cpu::Renderer;
    use scene::{Camera, Pinhole, Rigid, Splat, Splats};

    use super::*;
    use crate::random::uniform;

    const WIDTH: u32 = 24;
    const HEIGHT: u32 = 20;

    fn splats() -> Splats {
        let mut splats = Splats::new(0);
        for i in 0..12 {
            let number = |k: u64| uniform(6, 16 * i + k);
            let place = Vec3::new(2.0 * number(0) - 1.0, 1.6 * number(1) - 0.8, 3.0 + 2.0 * number(2));
            splats.push(&Splat::round(place, -0.5, Vec3::splat(0.5), 0.5 + 0.4 * number(3)));
        }
        splats
    }

    /// Targets on every third pixel, some near the rendered depth and some far from it; weights from 0 to 2.
    fn targets() -> (Vec<f32>, Vec<f32>) {
        let area = (WIDTH * HEIGHT) as usize;
        let target = |i: usize| if i.is_multiple_of(3) { 3.0 + 2.0 * uniform(7, i as u64) } else { 0.0 };
        let weight = |i: usize| if i.is_multiple_of(9) { 0.0 } else { 2.0 * uniform(8, i as u64) };
        ((0..area).map(target).collect(), (0..area).map(weight).collect())
    }

    fn render<'a>(renderer: &'a mut Renderer, splats: &Splats) -> &'a Frame {
        let pinhole = Pinhole { width: WIDTH, height: HEIGHT, fx: 20.0, fy: 20.0, cx: 12.0, cy: 10.0 };
        let camera_from_world = Rigid { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };
        let options = Options { extras: true, inverse_depth: true, sh_degree: 0, ..Options::default() };
        renderer.forward(splats, &[], &Camera { pinhole, camera_from_world }, &options)
    }

    #[test]
    fn gradient_through_the_renderer_agrees_with_finite_differences() {
        let (splats, (target, weights), mut renderer) = (splats(), targets(), Renderer::default());
        let mut upstream = Upstream::default();
        let frame = render(&mut renderer, &splats);
        let value = depth_loss(frame, &target, &weights, 3.0, &mut upstream);
        assert!(value > 0.01 && upstream.depth.iter().filter(|v| **v != 0.0).count() > 20);
        upstream.colour.resize(3 * target.len(), 0.0);
        let columns = renderer.backward(&splats, &upstream).columns.clone();
        let value = |splats: &Splats| {
            depth_loss(render(&mut Renderer::default(), splats), &target, &weights, 3.0, &mut Upstream::default())
        };
        // Means along z, x; ln(scale); opacity.
        let (mut largest, mut off) = (0.0f64, 0.0f64);
        for column in [scene::column::MEAN + 2, scene::column::MEAN, scene::column::LOG_SCALE, scene::column::OPACITY] {
            for row in 0..splats.len() {
                let step = 2e-3;
                let moved = |by: f32| {
                    let mut moved = splats.clone();
                    moved.columns_mut()[column][row] += by;
                    value(&moved)
                };
                let slope = (moved(step) - moved(-step)) / (2.0 * f64::from(step));
                let found = f64::from(columns[column][row]);
                largest = largest.max(slope.abs());
                off = off.max((found - slope).abs());
            }
        }
        println!("slopes up to {largest:.3e}, off by {off:.1e}");
        assert!(largest > 0.05 && off < 0.005 * largest, "{largest} {off}");
    }

    #[test]
    fn pixels_without_target_alpha_or_weight_have_no_part() {
        let mut renderer = Renderer::default();
        let frame = render(&mut renderer, &splats());
        let area = target_area(frame);
        let mut upstream = Upstream::default();
        assert_eq!(depth_loss(frame, &vec![0.0; area], &[], 1.0, &mut upstream), 0.0);
        assert_eq!(depth_loss(frame, &vec![2.0; area], &vec![0.0; area], 1.0, &mut upstream), 0.0);
        assert_eq!((upstream.depth.len(), upstream.depth.iter().all(|v| *v == 0.0)), (area, true));
        let empty = Frame { transmittance: vec![0.6; area], ..frame.clone() };
        assert_eq!(depth_loss(&empty, &vec![2.0; area], &[], 1.0, &mut upstream), 0.0);
    }

    fn target_area(frame: &Frame) -> usize {
        frame.width * frame.height
    }
}
