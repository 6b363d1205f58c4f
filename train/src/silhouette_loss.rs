//! The silhouette loss: the cross-entropy between the opacity of the trained splats and the pixels that show their object, and its
//! gradient.
//!
//! It is the semantic mask loss of Street Detection Gaussians (equation 5), `-Σ M log(A)`, where `A = Σ αT` is over the trained splats
//! only. What stands before them takes its part of T, so a mask is compared with what can be seen of the object. The paper's term alone
//! is least where the object covers everything; here `-(1 - M) log(1 - A)` holds it back where the mask says that it is not.

use render::{Frame, Upstream};

/// Nearer to the wrong opacity than this the loss goes on straight, so that its slope is bounded. A splat is not drawn under 1/255.
const STRAIGHT: f32 = 0.01;

/// Returns `factor` times the mean loss over the pixels whose silhouette is known (`shown`, one plane: 255 = there, 0 = not, 128 =
/// unknown), weighted by `weights` where they are 0 only (one plane, or empty for all ones), and writes its gradient to the plane
/// `trainable_alpha` of `upstream`. Zero without such pixels. The frame needs [`Options::extras`](render::Options::extras).
pub(crate) fn silhouette_loss(
    frame: &Frame,
    shown: &[u8],
    weights: &[f32],
    factor: f32,
    upstream: &mut Upstream,
) -> f64 {
    let area = frame.transmittance.len();
    assert!(shown.len() == area && frame.trainable_alpha.len() == area);
    let plane = &mut upstream.trainable_alpha;
    plane.clear();
    plane.resize(area, 0.0);
    // A pixel that the photo leaves out says nothing; the share of it that the splats explain must not weight it, as that is what
    // the loss is about.
    let used = || (0..area).filter(|&i| shown[i] != 128 && weights.get(i).is_none_or(|weight| *weight > 0.0));
    let count = used().count();
    if count == 0 {
        return 0.0;
    }
    let scale = factor / count as f32;
    let mut loss = 0.0;
    for i in used() {
        let is_there = shown[i] > 128;
        let opacity = frame.trainable_alpha[i];
        let right = if is_there { opacity } else { 1.0 - opacity };
        let bounded = right.max(STRAIGHT);
        loss -= f64::from(bounded.ln() + (right - bounded) / bounded);
        let slope = scale / bounded;
        plane[i] = if is_there { -slope } else { slope };
    }
    f64::from(factor) * loss / count as f64
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3, Vec3};
    use render::cpu::Renderer;
    use render::{Options, Part};
    use scene::{Camera, Pinhole, Rigid, Splat, Splats};

    use super::*;
    use crate::random::uniform;

    const WIDTH: u32 = 24;
    const HEIGHT: u32 = 20;

    fn splats(key: u64, depth: f32) -> Splats {
        let mut splats = Splats::new(0);
        for i in 0..10 {
            let number = |k: u64| uniform(key, 16 * i + k);
            let place = Vec3::new(2.0 * number(0) - 1.0, 1.6 * number(1) - 0.8, depth + 2.0 * number(2));
            splats.push(&Splat::round(place, -0.7, Vec3::splat(0.5), 0.3 + 0.3 * number(3)));
        }
        splats
    }

    fn render<'a>(renderer: &'a mut Renderer, splats: &Splats, parts: &[Part]) -> &'a Frame {
        let pinhole = Pinhole { width: WIDTH, height: HEIGHT, fx: 20.0, fy: 20.0, cx: 12.0, cy: 10.0 };
        let options = Options { extras: true, sh_degree: 0, ..Options::default() };
        renderer.forward(splats, parts, &Camera { pinhole, camera_from_world: Rigid::IDENTITY }, &options)
    }

    #[test]
    fn gradient_agrees_with_finite_differences() {
        // Frozen splats partly before the trained ones, in axes of their own. From the opacity on the renderer's own tests go on.
        let (own, other) = (splats(3, 3.0), splats(4, 2.5));
        let turned = Rigid { rotation: DQuat::from_rotation_z(0.4), translation: DVec3::new(0.3, -0.1, 0.2) };
        let parts = [Part { splats: &other, camera_from_part: Some(turned) }];
        let area = (WIDTH * HEIGHT) as usize;
        let shown: Vec<u8> = (0..area).map(|i| [0, 255, 128][i % 7 % 3]).collect();
        let weights: Vec<f32> = (0..area).map(|i| if i % 5 == 0 { 0.0 } else { 0.3 }).collect();
        let frame = render(&mut Renderer::default(), &own, &parts).clone();
        let value = |frame: &Frame, upstream: &mut Upstream| silhouette_loss(frame, &shown, &weights, 2.0, upstream);
        let mut upstream = Upstream::default();
        assert!(value(&frame, &mut upstream) > 0.1);
        let (mut steep, mut compared) = (0, 0);
        for i in 0..area {
            let gradient = f64::from(upstream.trainable_alpha[i]);
            assert_eq!(gradient == 0.0, shown[i] == 128 || weights[i] == 0.0);
            let moved = |by: f32| {
                let mut moved = frame.clone();
                moved.trainable_alpha[i] += by;
                value(&moved, &mut Upstream::default())
            };
            let expected = (moved(1e-3) - moved(-1e-3)) / 2e-3;
            assert!((expected - gradient).abs() <= 0.05 * gradient.abs() + 1e-6, "{gradient} {expected}");
            (steep, compared) = (steep + usize::from(gradient < -0.1), compared + usize::from(gradient != 0.0));
        }
        assert!(steep > 10 && compared > 200, "{steep} of {compared}");
    }

    #[test]
    fn it_is_least_where_the_object_is_and_the_rest_is_free() {
        let (own, mut renderer) = (splats(3, 3.0), Renderer::default());
        let alpha = render(&mut renderer, &own, &[]).trainable_alpha.clone();
        let right: Vec<u8> = alpha.iter().map(|alpha| if *alpha > 0.5 { 255 } else { 0 }).collect();
        let wrong: Vec<u8> = right.iter().map(|shown| 255 - shown).collect();
        let loss = |shown: &[u8]| silhouette_loss(renderer.frame(), shown, &[], 1.0, &mut Upstream::default());
        assert!(loss(&right) < 0.5 * loss(&wrong));
        assert_eq!(loss(&vec![128; alpha.len()]), 0.0);
    }
}
