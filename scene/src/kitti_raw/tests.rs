use super::*;

const CAMERAS: &str = "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\nS_00: 1392 512\n\
    S_rect_00: 1242 375\n\
    R_rect_00: 9.999239e-01 9.837760e-03 -7.445048e-03 -9.869795e-03 9.999421e-01 -4.278459e-03 7.402527e-03 4.351614e-03 9.999631e-01\n\
    P_rect_00: 721.5 0 609.5 0 0 721.5 172.8 0 0 0 1 0\n\
    S_rect_02: 1242 375\nP_rect_02: 721.5 0 609.5 44.75 0 721.5 172.8 0 0 0 1 0\n\
    S_rect_03: 1242 375\nP_rect_03: 721.5 0 609.5 -339.5 0 721.5 172.8 0 0 0 1 0\n";
const VELO_TO_CAM: &str = "calib_time: 15-Mar-2012 11:37:16\n\
    R: 7.533745e-03 -9.999714e-01 -6.166020e-04 1.480249e-02 7.280733e-04 -9.998902e-01 9.998621e-01 7.523790e-03 1.480755e-02\n\
    T: -4.069766e-03 -7.631618e-02 -2.717806e-01\ndelta_f: 0.000000e+00 0.000000e+00\n";
const IMU_TO_VELO: &str = "calib_time: 25-May-2012 16:47:16\n\
    R: 9.999976e-01 7.553071e-04 -2.035826e-03 -7.854027e-04 9.998898e-01 -1.482298e-02 2.024406e-03 1.482454e-02 9.998881e-01\n\
    T: -8.086759e-01 3.195559e-01 -7.997231e-01\n";
const OXTS: [&str; 2] = [
    "49.011212804408 8.4228850417969 112.83492279053 0.022447 1e-05 -1.2219096732051 -3.3256321640686 1.1384311814592 \
     3.5147680214713 0.037 -0.038 -0.29 0.037 9.99 -0.30 -0.19 9.99 -0.017 0.024 0.145 -0.017 0.021 0.145 0.49 0.068 4 10 4 4 0\n",
    "49.011184392846 8.4228990208692 112.83110046387 0.0207 0.0021 -1.2068 -3.3 1.1 3.5 0.03 -0.03 -0.29 0.03 9.99 -0.3 \
     -0.19 9.99 -0.01 0.02 0.14 -0.01 0.02 0.14 0.49 0.06 4 10 4 4 0\n",
];

/// Figures of pykitti 0.3.1 (`pykitti.raw`) for a folder with these files.
#[test]
fn poses_are_those_of_pykitti() {
    let cameras = read_cameras(CAMERAS.as_bytes()).unwrap();
    let camera_from_velo = read_mounting(VELO_TO_CAM.as_bytes()).unwrap();
    let velo_from_imu = read_mounting(IMU_TO_VELO.as_bytes()).unwrap();
    let [first, second] = OXTS.map(|text| read_oxts(text.as_bytes()).unwrap());
    let world = Mercator::new(&first.place);
    assert_eq!(world.place(&first.place), DVec3::ZERO);

    let near = |pose: &Rigid, rows: [f64; 12]| {
        let expected = rigid(&rows).unwrap();
        let turn = pose.rotation.angle_between(expected.rotation);
        let metres = pose.translation.distance(expected.translation);
        assert!(turn < 3e-6 && metres < 1e-6, "{turn} rad and {metres} m off {rows:?}");
    };
    let imu = world.world_from_imu(&second);
    near(
        &imu,
        [
            0.3560107748516,
            0.934296824902471,
            -0.018594923143813,
            1.020691946498118,
            -0.934479490516537,
            0.355894669901446,
            -0.009330902405154,
            -3.16275971243158,
            -0.0020999984565,
            0.020698476100948,
            0.999783558123248,
            -0.00382232666,
        ],
    );
    let velodyne = imu.after(&velo_from_imu.inverse());
    near(
        &velodyne,
        [
            0.356753487719614,
            0.934189932656474,
            -0.004021606447716,
            1.00744781798159,
            -0.934189521251025,
            0.356727722758486,
            -0.005945647139465,
            -4.036965584162739,
            -0.004119745453398,
            0.005878078029293,
            0.999974198784251,
            0.790670226134539,
        ],
    );
    let first_camera = velodyne.after(&camera_from_velo.inverse()).after(&cameras.rectified_from_camera.inverse());
    for (number, place) in [
        (0, [1.103258104406942, -4.292181811072751, 0.717250322532998]),
        (2, [1.16118882874154, -4.270047813948925, 0.718270109103477]),
        (3, [0.663761324259546, -4.460103420537301, 0.709513617713389]),
    ] {
        near(
            &first_camera.after(&cameras.cameras[&number].from_first.inverse()),
            [
                -0.934011566646086,
                0.01761907255413,
                0.35680814600775,
                place[0],
                -0.356864333515976,
                -0.000047779736797,
                -0.934156255238186,
                place[1],
                -0.016441922024591,
                -0.999844743426707,
                0.006332245567881,
                place[2],
            ],
        );
    }
    assert_eq!(cameras.cameras[&2].model, CameraModel::Pinhole([721.5, 721.5, 609.5, 172.8]));
    assert_eq!((cameras.cameras[&2].width, cameras.cameras[&2].height, cameras.cameras.len()), (1242, 375, 3));
    // North is the seventh number and east the eighth.
    assert_eq!((second.velocity, second.spin), (DVec3::new(1.1, -3.3, -0.03), DVec3::new(-0.01, 0.02, 0.14)));
}

#[test]
fn the_projection_has_its_inverse() {
    let place =
        |latitude_degrees, longitude_degrees| GeoOrigin { latitude_degrees, longitude_degrees, altitude_metres: 9.0 };
    for first in [place(49.0, 8.4), place(-33.5, 151.0), place(0.0, 0.0)] {
        let world = Mercator::new(&first);
        for metres in [DVec3::new(0.5, -0.25, 1.0), DVec3::new(-2000.0, 3000.0, -5.0)] {
            assert!(world.place(&world.geo(metres)).distance(metres) < 1e-7);
        }
        // A thousandth of a degree to the north is 111 m.
        let north = place(first.latitude_degrees + 1e-3, first.longitude_degrees);
        assert!((world.place(&north).y - 111.32).abs() < 0.02);
    }
}

#[test]
fn invalid_files_are_refused() {
    for (from, to) in [
        ("P_rect_02: 721.5", "P_rect_02: -721.5"),
        ("P_rect_02: 721.5", "P_rect_02: nan"),
        ("P_rect_02", "P_rect_05"),
        ("S_rect_03: 1242", "S_rect_03: 0"),
        ("S_rect_03: 1242", "S_rect_03:"),
        ("R_rect_00: 9.9", "R_rect_00: 8.9"),
        ("R_rect_00", "R_rect_01"),
    ] {
        assert!(read_cameras(CAMERAS.replacen(from, to, 1).as_bytes()).is_err(), "{to}");
    }
    assert!(read_cameras(b"S_00: 1392 512").is_err());
    let lacks = read_mounting(VELO_TO_CAM.replace("T:", "t:").as_bytes()).unwrap_err().to_string();
    assert_eq!(lacks, "has no row T of 3 numbers");
    assert!(read_mounting(VELO_TO_CAM.replace("R: 7", "R: 77").as_bytes()).is_err());
    for (from, to) in
        [("49.0", "nan"), ("49.0", "89.9"), ("8.4", "1e999"), ("112.8", "1e7"), ("-3.3256", "-3e4"), (" 4 10", " 4")]
    {
        assert!(read_oxts(OXTS[0].replacen(from, to, 1).as_bytes()).is_err(), "{to}");
    }
    assert!(read_oxts(b"").is_err() && read_oxts(b"\xff").is_err());
}
