//! Deterministic captures for the tests of this crate.

use glam::{DMat3, DQuat, DVec2, DVec3};
use scene::{Camera, Capture, Pinhole, Rigid, SparsePoints, View};

use crate::ground::Ground;

/// A root of 64 m with its corner at the origin, without background.
pub(crate) fn ground() -> Ground {
    Ground {
        ground_from_world: DQuat::IDENTITY,
        min: DVec2::ZERO,
        edge_metres: 64.0,
        height_metres: 0.0,
        near_metres: 1e300,
    }
}

/// A counter-based random number in [0, 1).
pub(crate) fn noise(counter: u64) -> f64 {
    let mut z = counter.wrapping_add(0x9e37_79b9_7f4a_7c15).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

/// A camera at `eye` that faces `target`, with image-up along `up`.
pub(crate) fn look_at(eye: DVec3, target: DVec3, up: DVec3) -> Camera {
    let z = (target - eye).normalize();
    let x = z.cross(up).normalize();
    let rotation = DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z)).inverse();
    Camera {
        pinhole: Pinhole { width: 640, height: 480, fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0 },
        camera_from_world: Rigid { rotation, translation: -(rotation * eye) },
    }
}

/// A capture of these cameras and points. With `tracks`, each point has a track of all views it projects into.
pub(crate) fn capture(cameras: &[Camera], positions: Vec<DVec3>, tracks: bool) -> Capture {
    let views: Vec<View> = (cameras.iter().enumerate())
        .map(|(i, &camera)| View {
            name: format!("{i:05}.jpg"),
            camera,
            mips: Vec::new(),
            masked: false,
            depth: None,
            seconds: None,
        })
        .collect();
    let mut points = SparsePoints { colours: vec![[120, 90, 60]; positions.len()], positions, ..Default::default() };
    if tracks {
        points.track_start.push(0);
        for p in &points.positions {
            for (i, camera) in cameras.iter().enumerate() {
                let (pixel, depth) = camera.project(*p);
                if depth > 0.0 && pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < 640.0 && pixel.y < 480.0 {
                    points.seen_by.push(i as u32);
                }
            }
            points.track_start.push(points.seen_by.len() as u32);
        }
    }
    Capture { views, points, ..Capture::default() }
}

/// An aerial survey: `n × n` nadir cameras 60 m above a square of `side` metres with `points` points. All cameras head
/// north, so their mean image-up vector is horizontal.
pub(crate) fn aerial(n: usize, side: f64, points: usize) -> Capture {
    let place = |i: usize| (i as f64 + 0.5) / n as f64 * side - 0.5 * side;
    let cameras: Vec<Camera> = (0..n * n)
        .map(|i| {
            let eye = DVec3::new(place(i % n), place(i / n), 60.0);
            look_at(eye, eye - DVec3::Z, DVec3::Y)
        })
        .collect();
    let at = |i: usize, k: u64| noise(3 * i as u64 + k) - 0.5;
    let positions = (0..points).map(|i| DVec3::new(at(i, 0) * side, at(i, 1) * side, at(i, 2) * 8.0)).collect();
    capture(&cameras, positions, true)
}

/// A drive along x between two walls with forward-facing cameras.
pub(crate) fn street(views: usize, points: usize) -> Capture {
    let cameras: Vec<Camera> = (0..views)
        .map(|i| look_at(DVec3::new(i as f64 * 2.0, 0.0, 1.6), DVec3::new(i as f64 * 2.0 + 10.0, 0.0, 1.6), DVec3::Z))
        .collect();
    let length = views as f64 * 2.0 + 30.0;
    let positions = (0..points)
        .map(|i| {
            let side = if i % 2 == 0 { -7.0 } else { 7.0 };
            DVec3::new(noise(2 * i as u64) * length, side, noise(2 * i as u64 + 1) * 9.0)
        })
        .collect();
    capture(&cameras, positions, true)
}

/// The capture in a rotated world frame.
pub(crate) fn rotated(mut capture: Capture, rotation: DQuat) -> Capture {
    for p in &mut capture.points.positions {
        *p = rotation * *p;
    }
    for view in &mut capture.views {
        view.camera.camera_from_world.rotation *= rotation.inverse();
    }
    capture
}
