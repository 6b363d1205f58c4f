//! Places cameras above a scene so that nearly all of it is in view.

use glam::{DMat3, DQuat, DVec3};
use scene::{Camera, Capture, Pinhole, Rigid};

/// Horizontal field of view. Narrow, so that houses lean little.
const FIELD_OF_VIEW_DEGREES: f64 = 30.0;
/// Share of points that may lie outside each side of the framed box: structure from motion has outliers.
const OUTLIER_SHARE: f64 = 0.01;

/// A camera that looks straight down on the extent of the capture's sparse points, or of its cameras if it has no points. World y
/// points up in the picture. `up` points away from the ground. The picture is `width` pixels wide; its height follows from
/// the extent, between half and double the width.
pub fn birdseye_camera(capture: &Capture, up: DVec3, width: u32) -> Camera {
    camera_above(capture, up, 90.0, width)
}

/// As [`birdseye_camera`], but looking along +y, 55° below the horizon.
pub fn oblique_camera(capture: &Capture, up: DVec3, width: u32) -> Camera {
    camera_above(capture, up, 55.0, width)
}

fn camera_above(capture: &Capture, up: DVec3, below_horizon_degrees: f64, width: u32) -> Camera {
    let up = up.try_normalize().unwrap_or(DVec3::Z);
    // Axes on the ground; x and y themselves if z is up.
    let east = (DVec3::X - up * up.x).try_normalize().unwrap_or(DVec3::Y);
    let north = up.cross(east);
    let corners = corners(capture, [east, north, up]);
    let centre = 0.5 * (corners[0] + corners[7]);

    let (sin, cos) = below_horizon_degrees.to_radians().sin_cos();
    let forward = cos * north - sin * up;
    let (right, down) = (east, forward.cross(east));
    let half_extent = |axis: DVec3| corners.iter().map(|&c| (c - centre).dot(axis).abs()).fold(0.1, f64::max);
    let height = f64::from(width) * (half_extent(down) / half_extent(right)).clamp(0.5, 2.0);
    let height = (height.round() as u32).max(1);
    let focal = 0.5 * f64::from(width) / (0.5 * FIELD_OF_VIEW_DEGREES).to_radians().tan();
    // Every corner is inside the picture: focal · |offset| / depth ≤ half a side.
    let distance = corners.iter().fold(0.1, |distance: f64, &corner| {
        let offset = corner - centre;
        let across = (offset.dot(right).abs() / f64::from(width)).max(offset.dot(down).abs() / f64::from(height));
        distance.max(1.03 * 2.0 * focal * across - offset.dot(forward))
    });
    let rotation = DQuat::from_mat3(&DMat3::from_cols(right, down, forward).transpose()).normalize();
    let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
    let eye = centre - distance * forward;
    Camera {
        pinhole: Pinhole { width, height, fx: focal, fy: focal, cx, cy },
        camera_from_world: Rigid { rotation, translation: -(rotation * eye) },
    }
}

/// The corners of the scene's box along these axes, without outliers. The first and the last are opposite.
fn corners(capture: &Capture, axes: [DVec3; 3]) -> [DVec3; 8] {
    let mut points = capture.points.positions.clone();
    if points.is_empty() {
        points = capture.views.iter().map(|view| view.camera.centre()).collect();
    }
    points.retain(|p| p.is_finite());
    let range = axes.map(|axis| {
        let mut along: Vec<f64> = points.iter().map(|p| p.dot(axis)).collect();
        along.sort_by(f64::total_cmp);
        match along.len().checked_sub(1) {
            None => [-1.0, 1.0],
            Some(last) => {
                [OUTLIER_SHARE, 1.0 - OUTLIER_SHARE].map(|share| along[(share * last as f64).round() as usize])
            }
        }
    });
    std::array::from_fn(|i| (0..3).map(|k| axes[k] * range[k][i >> k & 1]).sum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use scene::SparsePoints;

    fn capture(up_is_z: bool) -> Capture {
        let points = (0..2000).map(|i| {
            let (x, y, z) = (f64::from(i % 50) * 4.0, f64::from(i / 50) * 2.5, f64::from(i % 7));
            if up_is_z { DVec3::new(x, y, z) } else { DVec3::new(x, -z, y) }
        });
        let positions: Vec<DVec3> = points.chain([DVec3::splat(1e6)]).collect();
        Capture { points: SparsePoints { positions, ..Default::default() }, ..Default::default() }
    }

    #[test]
    fn nearly_all_points_are_in_the_picture_and_fill_it() {
        for (up_is_z, up) in [(true, DVec3::Z), (false, DVec3::NEG_Y)] {
            let capture = capture(up_is_z);
            for camera in [birdseye_camera(&capture, up, 640), oblique_camera(&capture, up, 640)] {
                let k = camera.pinhole;
                let pixels: Vec<_> = capture.points.positions[..2000].iter().map(|&p| camera.project(p)).collect();
                let inside = pixels.iter().filter(|(p, depth)| {
                    *depth > 0.0
                        && (0.0..f64::from(k.width)).contains(&p.x)
                        && (0.0..f64::from(k.height)).contains(&p.y)
                });
                assert!(inside.count() >= 1940);
                let left = pixels.iter().map(|(p, _)| p.x).fold(f64::INFINITY, f64::min);
                assert!(left < 0.1 * f64::from(k.width), "the scene is small in the picture: {left}");
            }
        }
    }

    #[test]
    fn straight_down_has_y_up() {
        let camera = birdseye_camera(&capture(true), DVec3::Z, 640);
        assert!((camera.forward() - DVec3::NEG_Z).length() < 1e-9);
        let (south, north) = (camera.project(DVec3::ZERO).0, camera.project(DVec3::new(0.0, 90.0, 0.0)).0);
        assert!(north.y < south.y && (north.x - south.x).abs() < 1.0);
    }

    #[test]
    fn an_empty_capture_still_gets_a_camera() {
        let camera = birdseye_camera(&Capture::default(), DVec3::ZERO, 64);
        assert!(camera.camera_from_world.is_sane());
    }
}
