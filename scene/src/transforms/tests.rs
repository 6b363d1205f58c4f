use super::*;
use proptest::prelude::*;

const IDENTITY: &str = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";

/// A file of one frame `a.png`.
fn file(shared: &str, frame: &str, matrix: &str) -> Vec<u8> {
    format!(r#"{{{shared} "frames": [{{"file_path": "a.png", {frame} "transform_matrix": {matrix}}}]}}"#).into_bytes()
}

fn frame(shared: &str, frame: &str) -> Result<Frame, CodecError> {
    read(&file(shared, frame, IDENTITY)).map(|transforms| transforms.frames[0].clone())
}

#[test]
fn opengl_axes_become_opencv_axes() {
    // At (1, 2, 3), looking along world +x (backward is -x), up along +z, so right is -y.
    let bytes = file(r#""fl_x": 10,"#, "", "[[0,0,-1,1],[-1,0,0,2],[0,1,0,3],[0,0,0,1]]");
    let pose = read(&bytes).unwrap().frames[0].camera_from_world;
    let near = |world: DVec3, camera: DVec3| assert!((pose.apply(world) - camera).length() < 1e-12, "{world}");
    near(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO);
    near(DVec3::new(6.0, 2.0, 3.0), DVec3::new(0.0, 0.0, 5.0));
    near(DVec3::new(1.0, 2.0, 4.0), DVec3::new(0.0, -1.0, 0.0));
    near(DVec3::new(1.0, 1.0, 3.0), DVec3::new(1.0, 0.0, 0.0));
}

#[test]
fn frame_intrinsics_override_those_of_the_file() {
    let shared =
        r#""w": 100, "h": 50.0, "fl_x": 80, "fl_y": 81, "cx": 49, "k1": 0.1, "p2": 0.2, "k4": 0, "other": {},"#;
    let taken = frame(shared, r#""mask_path": "m.png", "depth_file_path": "d.npy", "fl_x": 90, "cy": 20, "k1": null,"#)
        .unwrap();
    assert_eq!((taken.file_path.as_str(), taken.mask_path.as_deref()), ("a.png", Some("m.png")));
    assert_eq!(taken.depth_file_path.as_deref(), Some("d.npy"));
    assert_eq!(taken.intrinsics.size, Some((100, 50)));
    let expected = CameraModel::OpenCv([90.0, 81.0, 49.0, 20.0, 0.1, 0.0, 0.0, 0.2]);
    assert_eq!(taken.intrinsics.model(100, 50), expected);
    let k3 = frame(r#""fl_x": 8, "k3": 0.5,"#, "").unwrap().intrinsics.model(10, 20);
    assert_eq!(k3, CameraModel::FullOpenCv([8.0, 8.0, 5.0, 10.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0]));
}

#[test]
fn fields_of_view_need_the_image_size() {
    let quarter = std::f64::consts::FRAC_PI_2;
    let angle = format!(r#""camera_angle_x": {quarter}, "#);
    let focal = |shared: &str, own: &str| frame(shared, own).unwrap().intrinsics.model(800, 600).focal_and_centre();
    let near = |a: [f64; 4], b: [f64; 4]| assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9), "{a:?} {b:?}");
    near(focal(&angle, ""), [400.0, 400.0, 400.0, 300.0]);
    near(focal(&format!(r#"{angle} "camera_angle_y": {quarter},"#), ""), [400.0, 300.0, 400.0, 300.0]);
    near(focal(&angle, r#""fl_x": 7,"#), [7.0, 7.0, 400.0, 300.0]);
    near(focal(r#""fl_x": 7,"#, &angle), [400.0, 400.0, 400.0, 300.0]);
    assert_eq!(frame(&angle, "").unwrap().intrinsics.size, None);
}

#[test]
fn scale_is_dropped_and_non_rotations_are_refused() {
    let scaled = "[[0,-2,0,1],[2,0,0,2],[0,0,2,3]]";
    let plain = "[[0,-1,0,1],[1,0,0,2],[0,0,1,3],[0,0,0,1]]";
    let pose = |matrix: &str| read(&file(r#""fl_x": 1,"#, "", matrix)).map(|t| t.frames[0].camera_from_world);
    assert_eq!(pose(scaled), pose(plain));
    assert!(pose(&IDENTITY.replacen("[1,0", "[1,0.0009", 1)).is_ok());
    for bad in [
        IDENTITY.replacen("[1,0", "[1,0.01", 1),
        IDENTITY.replacen("[1,", "[-1,", 1),
        IDENTITY.replacen("[1,", "[0,", 1),
        IDENTITY.replacen("[1,", "[1e999,", 1),
        IDENTITY.replacen("[1,", "[NaN,", 1),
        IDENTITY.replacen("[1,", "[null,", 1),
        IDENTITY.replacen("0,1]]", "0,2]]", 1),
        "[[1,0,0,0],[0,1,0,0]]".into(),
        "[[1,0,0],[0,1,0],[0,0,1]]".into(),
        "[[1,0,0,1e308],[0,1,0,1e308],[0,0,1,1e308],[0,0,0,1e308]]".into(),
    ] {
        assert!(pose(&bad).is_err(), "{bad}");
    }
    let error = pose("[[1,1,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]").unwrap_err().to_string();
    assert!(error.contains("a.png"), "{error}");
}

#[test]
fn fisheyes_are_recognised_by_model_or_flag() {
    let expected = CameraModel::OpenCvFisheye([9.0, 9.0, 10.0, 5.0, 0.1, 0.2, 0.3, 0.4]);
    let bend = r#""fl_x": 9, "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4,"#;
    for name in [r#""camera_model": "OPENCV_FISHEYE","#, r#""is_fisheye": true,"#] {
        assert_eq!(frame(&format!("{bend} {name}"), "").unwrap().intrinsics.model(20, 10), expected);
    }
    let transforms = read(&file(bend, r#""is_fisheye": true,"#, IDENTITY)).unwrap();
    assert_eq!(read(&write(&transforms)).unwrap().frames[0].intrinsics.model(20, 10), expected);
}

#[test]
fn unsupported_lenses_are_refused() {
    for bad in [
        r#""fl_x": 9, "camera_model": "EQUIRECTANGULAR","#,
        r#""fl_x": 9, "k4": 0.1,"#,
        r#""fl_x": 0,"#,
        r#""fl_x": -9,"#,
        r#""camera_angle_x": 3.2,"#,
        r#""fl_x": 9, "w": 10.5, "h": 9,"#,
        r#""fl_x": 9, "w": 0, "h": 9,"#,
        r#""fl_x": 9, "w": 1e12, "h": 9,"#,
        r#""fl_x": 9, "cx": "left","#,
        "",
    ] {
        assert!(frame(bad, "").is_err() && frame("", bad).is_err(), "{bad}");
    }
    for good in ["PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"] {
        assert!(frame(&format!(r#""fl_x": 9, "camera_model": "{good}","#), "").is_ok(), "{good}");
    }
    assert!(read(br#"{"fl_x": 9, "frames": []}"#).is_err());
    assert!(read("[".repeat(100_000).as_bytes()).is_err());
    assert!(read(format!(r#"{{"a": {}"#, "[".repeat(100_000)).as_bytes()).is_err());
}

fn near(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-9 * b.abs().max(1.0)
}

proptest! {
    #[test]
    fn round_trips(
        turn in prop::array::uniform4(-1.0f64..1.0),
        at in prop::array::uniform3(-1e4f64..1e4),
        lens in prop::array::uniform4(1.0f64..5e3),
        bend in prop::array::uniform8(-0.5f64..0.5),
        terms in 0usize..=8,
        sized: bool,
        angle: bool,
    ) {
        prop_assume!(DQuat::from_array(turn).length() > 0.1);
        let camera_from_world =
            Rigid { rotation: DQuat::from_array(turn).normalize(), translation: DVec3::from_array(at) };
        let [fx, fy, cx, cy] = lens;
        let mut distortion = [0.0; 8];
        distortion[..terms].copy_from_slice(&bend[..terms]);
        let fy = if angle { Focal::Angle(fy / 5e3) } else { Focal::Pixels(fy) };
        let intrinsics = Intrinsics {
            size: sized.then_some((640, 480)),
            focal: [Some(Focal::Pixels(fx)), Some(fy)],
            centre: [Some(cx), Some(cy)],
            distortion,
            fisheye: false,
        };
        let frame =
            Frame { file_path: "images/\"ä\".png".into(), mask_path: None, depth_file_path: Some("d".into()), intrinsics, camera_from_world };
        let transforms = Transforms { frames: vec![frame.clone(); 2], ply_file_path: Some("points.ply".into()) };
        let bytes = write(&transforms);
        let again = read(&bytes).unwrap();
        prop_assert_eq!(&again.ply_file_path, &transforms.ply_file_path);
        prop_assert_eq!(again.frames.len(), 2);
        for read in &again.frames {
            prop_assert_eq!(&read.file_path, &frame.file_path);
            prop_assert_eq!(&read.depth_file_path, &frame.depth_file_path);
            prop_assert_eq!(read.intrinsics.size, intrinsics.size);
            let (a, b) = (read.intrinsics.model(640, 480), intrinsics.model(640, 480));
            prop_assert!(a.focal_and_centre().iter().zip(b.focal_and_centre()).all(|(a, b)| near(*a, b)));
            prop_assert!(a.distortion().iter().zip(b.distortion()).all(|(a, b)| near(*a, b)));
            let pose = read.camera_from_world;
            prop_assert!((pose.rotation.dot(camera_from_world.rotation).abs() - 1.0).abs() < 1e-12);
            prop_assert!((pose.translation - camera_from_world.translation).length() < 1e-8);
        }
        for end in (0..bytes.len()).step_by(97) {
            prop_assert!(super::read(&bytes[..end]).is_err());
        }
    }

    #[test]
    fn models_pass_through_intrinsics(values in prop::array::uniform12(0.1f64..9.0)) {
        for model in [
            CameraModel::FullOpenCv(values),
            CameraModel::OpenCv(*values.first_chunk().unwrap()),
            CameraModel::Pinhole(*values.first_chunk().unwrap()),
            CameraModel::OpenCvFisheye(*values.first_chunk().unwrap()),
        ] {
            prop_assert_eq!(Intrinsics::from_model(&model, None).model(1, 1), model);
        }
    }
}
