use super::*;

const WIDTH: u32 = 200;
const HEIGHT: u32 = 120;

fn lenses() -> [CameraModel; 5] {
    [
        CameraModel::SimpleRadial([150.0, 101.0, 58.5, -0.2]),
        CameraModel::Radial([150.0, 99.0, 61.0, 0.25, 0.05]),
        CameraModel::OpenCv([150.0, 152.0, 97.0, 60.0, -0.1, 0.02, 0.004, -0.006]),
        CameraModel::OpenCv([150.0, 152.0, 97.0, 60.0, 0.1, -0.02, -0.01, 0.01]),
        CameraModel::FullOpenCv([150.0, 150.0, 100.0, 60.0, 0.3, 0.02, 0.001, 0.001, 0.01, 0.4, 0.02, 0.0]),
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
fn the_slope_is_that_of_differences() {
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
fn no_pixel_is_empty_and_none_more_would_fit_all_around() {
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
fn pictures_are_resampled_where_the_lens_sends_them() {
    for lens in lenses() {
        let undistorter = Undistorter::new(&lens, WIDTH, HEIGHT).unwrap();
        let k = undistorter.pinhole();
        let photo: Vec<u8> = (0..HEIGHT).flat_map(|y| (0..WIDTH).flat_map(move |x| [x as u8, y as u8, 7])).collect();
        let mask: Vec<u8> = (0..HEIGHT).flat_map(|_| (0..WIDTH).map(|x| if x < 100 { 0 } else { 255 })).collect();
        let (rgb, mask) = (undistorter.rgb(&photo), undistorter.mask(&mask));
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
fn ideal_lenses_stay_and_impossible_ones_are_refused() {
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
fn a_lens_that_folds_over_in_the_corners_keeps_the_middle() {
    // The model reaches out to 0.72 focal lengths; the middle of the sides lies at 0.66, the corners at 0.77.
    let lens = CameraModel::SimpleRadial([150.0, 100.0, 60.0, -0.286]);
    let k = ideal_pinhole(&lens, WIDTH, HEIGHT);
    assert!(k.is_some_and(|k| k.width > WIDTH / 2 && k.height > HEIGHT / 2), "{k:?}");
}
