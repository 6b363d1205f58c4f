//! Errors of the normals of rendered surfaces: angles to the true ones, as Fouhey et al. (2013) report them.
//!
//! Both normals come from depths alone, the rendered and the true ones alike: the cross product of the steps from a pixel
//! to its neighbours on the right and below, in the camera's axes. So a surface that is shifted but parallel to the true one has no
//! error here, and one at the right depth that is rough has. Where the true depth changes by more than [`STEP`] between
//! neighbours there is an edge, and no normal.

use dataset::depth_samples::DepthSamples;
use glam::DVec3;
use render::Frame;
use scene::Pinhole;

/// Largest share by which the true depth changes from a pixel to the next of one surface.
const STEP: f64 = 0.1;
/// Error of a pixel where nothing is rendered, degrees.
const EMPTY_DEGREES: f64 = 90.0;
/// Least share of the samples that have both neighbours: those of lidar lie apart, and show no surface.
const MIN_SHARE: f64 = 0.1;

/// Angles between rendered and true normals of a view, degrees, ascending. Empty where true depths are too sparse. The frame's
/// pixels are those of the camera; `depth_of` gives a rendered pixel's depth, metres, or `None` where nothing is.
pub(crate) fn angles_degrees(
    frame: &Frame,
    depth_of: impl Fn(usize) -> Option<f64>,
    truth: &DepthSamples,
    camera: &Pinhole,
) -> Vec<f64> {
    let (width, height) = (frame.width, frame.height);
    let mut depths = vec![0f32; width * height];
    // Of large views every n-th pixel has a true depth.
    let (mut stride, mut last) = (usize::MAX, None);
    for (x, y, depth) in truth.iter() {
        let (x, y) = (x as usize, y as usize);
        if x >= width || y >= height {
            continue;
        }
        depths[y * width + x] = depth;
        if let Some((before, _)) = last.replace((x, y)).filter(|&(_, row)| row == y) {
            stride = stride.min(x - before);
        }
    }
    let point = |i: usize, depth: f64| {
        let (x, y) = ((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        DVec3::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0) * depth
    };
    let normal = |[at, right, below]: [DVec3; 3]| (right - at).cross(below - at).try_normalize();
    let mut angles = Vec::new();
    for (x, y, _) in truth.iter() {
        let (x, y) = (x as usize, y as usize);
        if stride == usize::MAX || x + stride >= width || y + stride >= height {
            continue;
        }
        let places = [y * width + x, y * width + x + stride, (y + stride) * width + x];
        let of_truth = places.map(|i| f64::from(depths[i]));
        let is_surface = of_truth.iter().all(|depth| *depth > 0.0 && (depth / of_truth[0]).ln().abs() < STEP);
        let Some(wanted) = is_surface.then(|| normal([0, 1, 2].map(|k| point(places[k], of_truth[k])))).flatten()
        else {
            continue;
        };
        let [Some(at), Some(right), Some(below)] = places.map(&depth_of) else {
            angles.push(EMPTY_DEGREES);
            continue;
        };
        let found = normal([point(places[0], at), point(places[1], right), point(places[2], below)]);
        angles.push(found.map_or(EMPTY_DEGREES, |found| found.dot(wanted).clamp(-1.0, 1.0).acos().to_degrees()));
    }
    if (angles.len() as f64) < MIN_SHARE * truth.len() as f64 {
        return Vec::new();
    }
    angles.sort_by(f64::total_cmp);
    angles
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Pinhole = Pinhole { width: 32, height: 24, fx: 20.0, fy: 20.0, cx: 16.0, cy: 12.0 };

    /// Depth at a pixel of the plane `normal · p = -distance` in the camera's axes.
    fn plane(normal: DVec3, distance: f64) -> impl Fn(usize) -> Option<f64> {
        move |i| {
            let (x, y) = ((i % 32) as f64 + 0.5, (i / 32) as f64 + 0.5);
            let ray = DVec3::new((x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, 1.0);
            Some(-distance / normal.dot(ray)).filter(|depth| *depth > 0.0)
        }
    }

    fn samples(depth_of: impl Fn(usize) -> Option<f64>, every: u32) -> DepthSamples {
        let on = |v: u32| v.is_multiple_of(every);
        let pixels = (0..32 * 24u32).map(|i| (i % 32, i / 32)).filter(|&(x, y)| on(x) && on(y));
        DepthSamples::new(32, 24, pixels.filter_map(|(x, y)| Some((x, y, depth_of((y * 32 + x) as usize)? as f32))))
    }

    fn frame() -> Frame {
        Frame { width: 32, height: 24, ..Frame::default() }
    }

    #[test]
    fn planes_are_as_far_apart_as_their_normals() {
        let turned = |degrees: f64| glam::DQuat::from_rotation_y(degrees.to_radians()) * -DVec3::Z;
        let truth = samples(plane(-DVec3::Z, 8.0), 1);
        for (degrees, distance) in [(0.0, 8.0), (0.0, 9.0), (25.0, 8.0)] {
            let angles = angles_degrees(&frame(), plane(turned(degrees), distance), &truth, &CAMERA);
            assert_eq!(angles.len(), 31 * 23);
            assert!(angles.iter().all(|angle| (angle - degrees).abs() < 0.1), "{degrees}: {:?}", &angles[..4]);
        }
    }

    #[test]
    fn every_other_pixel_is_enough_and_sparse_ones_are_not() {
        let wall = || plane(-DVec3::Z, 8.0);
        assert_eq!(angles_degrees(&frame(), wall(), &samples(wall(), 2), &CAMERA).len(), 15 * 11);
        let scattered = DepthSamples::new(32, 24, (0..30).map(|i| (i, (7 * i) % 24, 8.0)));
        assert!(angles_degrees(&frame(), wall(), &scattered, &CAMERA).is_empty());
    }

    #[test]
    fn edges_have_no_normal_and_holes_are_wrong() {
        let step = |i: usize| Some(if i % 32 < 16 { 8.0 } else { 12.0 });
        let angles = angles_degrees(&frame(), step, &samples(step, 1), &CAMERA);
        assert!(angles.len() == 30 * 23 && angles.iter().all(|angle| *angle < 0.1));
        let hole = |i: usize| (i % 32 < 16).then_some(8.0);
        let wrong = angles_degrees(&frame(), hole, &samples(step, 1), &CAMERA);
        assert_eq!(wrong.iter().filter(|angle| **angle == EMPTY_DEGREES).count(), 15 * 23);
    }
}
