//! Finds the world point that a pixel shows, from rendered depth.

use blocks::Ground;
use glam::DVec3;
use render::Frame;
use scene::{BlockId, Camera, Splats};

/// Pixels whose alpha is below this show no surface.
const MIN_ALPHA: f32 = 0.2;

/// A test for points of the foreground: inside the root square, and no farther above or below its median height than it is wide.
/// The backdrop, which stands for the sky and distant things, is outside; its depths would distort those of the foreground.
pub(crate) fn foreground_test(splats: &Splats, ground: &Ground) -> impl Fn(DVec3) -> bool + use<> {
    let (ground, root) = (*ground, ground.core(BlockId::ROOT));
    let points = (0..splats.len()).map(|i| ground.from_world(splats.mean(i).as_dvec3()));
    let mut heights: Vec<f64> = points.filter(|at| root.contains(at.truncate())).map(|at| at.z).collect();
    heights.sort_by(f64::total_cmp);
    let median = heights.get(heights.len() / 2).copied().unwrap_or_default();
    move |point| {
        let at = ground.from_world(point);
        root.contains(at.truncate()) && (at.z - median).abs() <= ground.edge_metres
    }
}

/// The splats of the foreground.
pub(crate) fn without_backdrop(splats: &Splats, ground: &Ground) -> Splats {
    let is_foreground = foreground_test(splats, ground);
    splats.filter(|i| is_foreground(splats.mean(i).as_dvec3()))
}

/// The world point that a pixel of a frame with extras shows, and its depth, metres. `None` where it shows no surface.
pub(crate) fn surface_point(frame: &Frame, camera: &Camera, pixel: usize) -> Option<(DVec3, f64)> {
    let alpha = 1.0 - frame.transmittance[pixel];
    let depth = f64::from(frame.depth[pixel] / alpha);
    if alpha < MIN_ALPHA || !depth.is_finite() || depth <= 0.0 {
        return None;
    }
    let k = &camera.pinhole;
    let (x, y) = ((pixel % frame.width) as f64 + 0.5, (pixel / frame.width) as f64 + 0.5);
    let ray = DVec3::new((x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0);
    Some((camera.camera_from_world.inverse().apply(ray * depth), depth))
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use scene::{Pinhole, Rigid};

    use super::*;

    #[test]
    fn a_pixel_shows_the_point_in_front_of_it() {
        let pinhole = Pinhole { width: 4, height: 2, fx: 2.0, fy: 2.0, cx: 2.0, cy: 1.0 };
        let camera_from_world = Rigid { rotation: DQuat::IDENTITY, translation: DVec3::new(0.0, 0.0, 5.0) };
        let camera = Camera { pinhole, camera_from_world };
        let mut frame =
            Frame { width: 4, height: 2, transmittance: vec![0.5; 8], depth: vec![4.0; 8], ..Frame::default() };
        frame.transmittance[3] = 0.9;
        let (point, depth) = surface_point(&frame, &camera, 5).unwrap();
        assert_eq!((point, depth), (DVec3::new(-2.0, 2.0, 3.0), 8.0));
        assert_eq!(camera.project(point).0, glam::DVec2::new(1.5, 1.5));
        assert!(surface_point(&frame, &camera, 3).is_none());
    }
}
