use super::*;

const WIDTH: u32 = 200;
const HEIGHT: u32 = 120;

fn lenses() -> [CameraModel; 6] {
    [
        CameraModel::SimpleRadial([150.0, 101.0, 58.5, -0.2]),
        CameraModel::Radial([150.0, 99.0, 61.0, 0.25, 0.05]),
        CameraModel::OpenCv([150.0, 152.0, 97.0, 60.0, -0.1, 0.02, 0.004, -0.006]),
        CameraModel::OpenCv([150.0, 152.0, 97.0, 60.0, 0.1, -0.02, -0.01, 0.01]),
        CameraModel::FullOpenCv([150.0, 150.0, 100.0, 60.0, 0.3, 0.02, 0.001, 0.001, 0.01, 0.4, 0.02, 0.0]),
        CameraModel::OpenCvFisheye([115.0, 116.0, 98.0, 61.0, 0.03, -0.02, 0.004, -0.001]),
    ]
}

#[test]
fn undistort_is_the_inverse_of_distort() {
    for lens in lenses() {
        let [fx, fy, cx, cy] = lens.focal_and_centre();
        for y in (0..=HEIGHT).step_by(5) {
            for x in (0..=WIDTH).step_by(5) {
                let bent = DVec2::new((f64::from(x) - cx) / fx, (f64::from(y) - cy) / fy);
                let ideal = undistort(&lens, bent).unwrap();
                assert!((lens.distort(ideal) - bent).length() < 1e-9, "{lens:?} at {x}, {y}");
            }
        }
    }
}

#[test]
fn the_jacobian_agrees_with_finite_differences() {
    for lens in lenses() {
        let (at, step) = (DVec2::new(0.4, -0.3), 1e-6);
        let slope = jacobian(&lens, at);
        for (axis, column) in [(DVec2::X, slope.col(0)), (DVec2::Y, slope.col(1))] {
            let difference = (lens.distort(at + step * axis) - lens.distort(at - step * axis)) / (2.0 * step);
            assert!((difference - column).length() < 1e-8, "{lens:?}");
        }
    }
}

#[test]
fn the_ideal_image_lies_inside_the_photo_and_is_maximal() {
    for lens in lenses() {
        let undistorter = Undistorter::new(&lens, WIDTH, HEIGHT).unwrap();
        let k = undistorter.pinhole();
        for y in 0..k.height {
            for x in 0..k.width {
                let source = undistorter.source(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
                let last = DVec2::new(f64::from(WIDTH), f64::from(HEIGHT)) - 0.5;
                assert!((source - source.clamp(DVec2::splat(0.5), last)).length() < 1e-5, "{lens:?} {k:?} {x} {y}");
            }
        }
        for side in 0..4 {
            let mut larger = k;
            match side {
                0 => (larger.width, larger.cx) = (k.width + 4, k.cx + 4.0),
                1 => larger.width += 4,
                2 => (larger.height, larger.cy) = (k.height + 4, k.cy + 4.0),
                _ => larger.height += 4,
            }
            assert!(!Undistorter { pinhole: larger, ..undistorter.clone() }.is_inside(), "{lens:?} {k:?} {side}");
        }
    }
}

#[test]
fn photos_and_masks_are_resampled_at_the_distorted_positions() {
    for lens in lenses() {
        let undistorter = Undistorter::new(&lens, WIDTH, HEIGHT).unwrap();
        let k = undistorter.pinhole();
        let photo: Vec<u8> = (0..HEIGHT).flat_map(|y| (0..WIDTH).flat_map(move |x| [x as u8, y as u8, 7])).collect();
        let mask: Vec<u8> = (0..HEIGHT).flat_map(|_| (0..WIDTH).map(|x| if x < 100 { 0 } else { 255 })).collect();
        let (rgb, mask) = (undistorter.rgb(&photo), undistorter.nearest(&mask));
        assert_eq!((rgb.len(), mask.len()), (3 * undistorter.area(), undistorter.area()));
        for (i, (pixel, usable)) in rgb.chunks_exact(3).zip(mask).enumerate() {
            let (x, y) = (i as u32 % k.width, i as u32 / k.width);
            let source = undistorter.source(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)) - 0.5;
            assert!((f64::from(pixel[0]) - source.x).abs() < 0.51 && (f64::from(pixel[1]) - source.y).abs() < 0.51);
            assert!(pixel[2] == 7 && (usable == 255) == (source.x >= 99.5));
        }
    }
}

#[test]
fn undistorted_lenses_are_kept_and_invalid_ones_refused() {
    let pinhole = CameraModel::Pinhole([150.0, 151.0, -5.0, 60.0]);
    let undistorter = Undistorter::new(&pinhole, WIDTH, HEIGHT).unwrap();
    assert!(undistorter.is_identity());
    let same = Pinhole { width: WIDTH, height: HEIGHT, fx: 150.0, fy: 151.0, cx: -5.0, cy: 60.0 };
    assert_eq!(undistorter.pinhole(), same);
    let straight = Undistorter::new(&CameraModel::Radial([150.0, 100.0, 60.0, 0.0, 0.0]), WIDTH, HEIGHT).unwrap();
    assert!(straight.is_identity());
    for bad in [
        CameraModel::Pinhole([0.0, 151.0, 100.0, 60.0]),
        CameraModel::Pinhole([f64::NAN, 151.0, 100.0, 60.0]),
        CameraModel::SimpleRadial([150.0, -5.0, 60.0, 0.1]),
        CameraModel::SimpleRadial([150.0, 100.0, 60.0, -40.0]),
        CameraModel::SimpleRadial([150.0, 100.0, 60.0, 1e300]),
        CameraModel::Radial([1e-300, 100.0, 60.0, 0.1, 1e300]),
    ] {
        assert_eq!(ideal_pinhole(&bad, WIDTH, HEIGHT), None, "{bad:?}");
    }
    assert_eq!(ideal_pinhole(&pinhole, 0, 10), None);
}

#[test]
fn a_lens_that_folds_over_in_the_corners_keeps_the_centre() {
    // The model folds over at 0.72 focal lengths; the middle of the sides lies at 0.66, the corners at 0.77.
    let lens = CameraModel::SimpleRadial([150.0, 100.0, 60.0, -0.286]);
    let k = ideal_pinhole(&lens, WIDTH, HEIGHT);
    assert!(k.is_some_and(|k| k.width > WIDTH / 2 && k.height > HEIGHT / 2), "{k:?}");
}

#[test]
fn a_fisheye_of_a_half_space_keeps_110_degrees() {
    let lens = CameraModel::OpenCvFisheye([64.0, 64.0, 100.0, 100.0, 0.0, 0.0, 0.0, 0.0]);
    let k = ideal_pinhole(&lens, 200, 200).unwrap();
    let angle = |side: f64| (side / k.fx).atan().to_degrees();
    for side in [k.cx, f64::from(k.width) - k.cx, k.cy, f64::from(k.height) - k.cy] {
        assert!((54.0..55.5).contains(&angle(side)), "{k:?}");
    }
    // The ideal plane has no point at a right angle to the axis or beyond.
    assert_eq!(undistort(&lens, DVec2::new(1.6, 0.0)), None);
    let ideal = undistort(&lens, DVec2::new(0.0, 1.0)).unwrap();
    assert!((ideal - DVec2::new(0.0, 1.0f64.tan())).length() < 1e-9, "{ideal}");
}

/// Reference implementation: the point on the plane `z = 1` that a pixel of the photo shows. The lens models are written from
/// their documentation and inverted by fixed-point iteration and bisection.
fn unprojected(lens: &CameraModel, pixel: DVec2) -> DVec2 {
    let undo = |[fx, fy, cx, cy]: [f64; 4], [k1, k2, p1, p2, k3, k4, k5, k6]: [f64; 8]| {
        let bent = DVec2::new((pixel.x - cx) / fx, (pixel.y - cy) / fy);
        let mut at = bent;
        for _ in 0..500 {
            let (x, y) = (at.x, at.y);
            let r2 = x * x + y * y;
            let above = 1.0 + k1 * r2 + k2 * r2.powi(2) + k3 * r2.powi(3);
            let below = 1.0 + k4 * r2 + k5 * r2.powi(2) + k6 * r2.powi(3);
            let dx = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
            let dy = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
            at = DVec2::new((bent.x - dx) * below / above, (bent.y - dy) * below / above);
        }
        at
    };
    match *lens {
        CameraModel::SimplePinhole([f, cx, cy]) => undo([f, f, cx, cy], [0.0; 8]),
        CameraModel::Pinhole(k) => undo(k, [0.0; 8]),
        CameraModel::SimpleRadial([f, cx, cy, k]) => undo([f, f, cx, cy], [k, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        CameraModel::Radial([f, cx, cy, k1, k2]) => undo([f, f, cx, cy], [k1, k2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        CameraModel::OpenCv([fx, fy, cx, cy, k1, k2, p1, p2]) => {
            undo([fx, fy, cx, cy], [k1, k2, p1, p2, 0.0, 0.0, 0.0, 0.0])
        }
        CameraModel::FullOpenCv([fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
            undo([fx, fy, cx, cy], [k1, k2, p1, p2, k3, k4, k5, k6])
        }
        CameraModel::OpenCvFisheye([fx, fy, cx, cy, k1, k2, k3, k4]) => {
            let bent = DVec2::new((pixel.x - cx) / fx, (pixel.y - cy) / fy);
            let (mut low, mut high) = (0.0f64, 1.5f64);
            for _ in 0..80 {
                let t: f64 = 0.5 * (low + high);
                let reached = t + k1 * t.powi(3) + k2 * t.powi(5) + k3 * t.powi(7) + k4 * t.powi(9);
                *(if reached < bent.length() { &mut low } else { &mut high }) = t;
            }
            bent * (low.tan() / bent.length().max(1e-12))
        }
    }
}

/// Waves on the plane `z = 1`, 40 pixels long; 80 for a fisheye, whose photo shows them shorter at its edge.
fn pattern(lens: &CameraModel, at: DVec2) -> [f64; 3] {
    let length = if lens.is_fisheye() { 80.0 } else { 40.0 };
    let DVec2 { x, y } = at * (150.0 / length * std::f64::consts::TAU);
    [128.0 + 100.0 * x.sin() * y.cos(), 128.0 + 100.0 * (0.6 * x + 0.8 * y).sin(), 128.0 + 100.0 * y.sin()]
}

#[test]
fn a_pattern_photographed_through_each_lens_is_resampled_to_that_of_the_pinhole() {
    let ideal = [CameraModel::SimplePinhole([150.0, 101.0, 58.5]), CameraModel::Pinhole([150.0, 151.0, 99.0, 61.0])];
    for lens in ideal.into_iter().chain(lenses()) {
        let centre = |x: u32, y: u32| DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let mut photo = Vec::new();
        for (y, x) in (0..HEIGHT).flat_map(|y| (0..WIDTH).map(move |x| (y, x))) {
            photo.extend(pattern(&lens, unprojected(&lens, centre(x, y))).map(|v| v.round() as u8));
        }
        let undistorter = Undistorter::new(&lens, WIDTH, HEIGHT).unwrap();
        let k = undistorter.pinhole();
        let mut worst = 0.0f64;
        for (i, pixel) in undistorter.rgb(&photo).chunks_exact(3).enumerate() {
            let at = centre(i as u32 % k.width, i as u32 / k.width);
            let expected = pattern(&lens, DVec2::new((at.x - k.cx) / k.fx, (at.y - k.cy) / k.fy));
            worst = pixel.iter().zip(expected).map(|(&a, b)| (f64::from(a) - b).abs()).fold(worst, f64::max);
        }
        // Half a level for each rounding, 1.5 for bilinear interpolation. A shift of a tenth of a pixel would double the error.
        assert!(worst < 2.5, "{lens:?}: {worst}");
    }
}
