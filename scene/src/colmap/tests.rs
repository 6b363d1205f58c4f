use std::collections::BTreeMap;

use glam::{DQuat, DVec3};
use proptest::prelude::*;

use super::*;
use crate::camera::{CameraModel, Rigid};

fn model(lens: CameraModel, turn: [f64; 4], at: [f64; 3], tracks: &[Vec<bool>]) -> Reconstruction {
    let pose = Rigid { rotation: DQuat::from_array(turn).normalize(), translation: DVec3::from_array(at) };
    let images = (0..3).map(|i| ColmapImage {
        id: 7 * i + 1,
        name: format!("left/ä {i}.jpg"),
        camera_id: 5,
        camera_from_world: pose,
    });
    let mut points = ColmapPoints::default();
    for (i, track) in tracks.iter().enumerate() {
        let seen_by = track.iter().zip([1, 8, 15]).filter(|(seen, _)| **seen).map(|(_, id)| id);
        points.push(10 + i as u64, DVec3::from_array(at) + i as f64, [i as u8, 2, 3], seen_by).unwrap();
    }
    let camera = ColmapCamera { width: 640, height: 480, model: lens };
    Reconstruction { cameras: BTreeMap::from([(5, camera)]), images: images.collect(), points }
}

fn example() -> Reconstruction {
    let lens = CameraModel::OpenCv([500.0, 501.0, 320.0, 240.0, 0.1, -0.01, 0.001, 0.002]);
    model(lens, [0.1, 0.2, 0.3, 0.9], [1.0, 2.0, 30.0], &[vec![true, false, true], vec![], vec![true; 3]])
}

/// The model as COLMAP would write it in text.
fn texts(model: &Reconstruction) -> [String; 3] {
    let words = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let mut texts = ["# cameras\n".to_string(), "# images\n#\n".to_string(), "# points\n".to_string()];
    for (id, camera) in &model.cameras {
        let CameraModel::OpenCv(parameters) = &camera.model else { panic!("an OPENCV camera") };
        texts[0] += &format!("{id} OPENCV {} {} {}\n", camera.width, camera.height, words(parameters));
    }
    for image in &model.images {
        let (q, t) = (image.camera_from_world.rotation, image.camera_from_world.translation);
        let pose = words(&[q.w, q.x, q.y, q.z, t.x, t.y, t.z]);
        texts[1] += &format!("{} {pose} {} {}\n1.5 2.5 10 3 4 -1\n", image.id, image.camera_id, image.name);
    }
    for i in 0..model.points.len() {
        let track: Vec<String> = model.points.track(i).iter().map(|id| format!(" {id} 0")).collect();
        let position = words(&model.points.positions[i].to_array());
        let [r, g, b] = model.points.colours[i];
        texts[2] += &format!("{} {position} {r} {g} {b} 0.5{}\n", model.points.ids[i], track.concat());
    }
    texts
}

fn near(a: &[ColmapImage], b: &[ColmapImage]) -> bool {
    let pose = |image: &ColmapImage| image.camera_from_world;
    a.len() == b.len()
        && a.iter().zip(b).all(|(a, b)| {
            (a.id, &a.name, a.camera_id) == (b.id, &b.name, b.camera_id)
                && pose(a).rotation.dot(pose(b).rotation) > 1.0 - 1e-12
                && pose(a).translation == pose(b).translation
        })
}

#[test]
fn text_and_binary_agree() {
    let model = example();
    let [cameras, images, points] = texts(&model);
    assert_eq!(read_cameras_txt(cameras.as_bytes()), Ok(model.cameras.clone()));
    assert!(near(&read_images_txt(images.as_bytes()).unwrap(), &model.images));
    assert_eq!(read_points_txt(points.as_bytes()), Ok(model.points.clone()));
    // An image that observes nothing is followed by an empty line, the last one too.
    let bare = images.replace("1.5 2.5 10 3 4 -1\n", "\n");
    assert!(near(&read_images_txt(bare.as_bytes()).unwrap(), &model.images));
    assert!(read_images_txt(bare.trim_end().as_bytes()).unwrap_err().to_string().contains("cut short"));
}

#[test]
fn truncated_text_is_refused() {
    let [cameras, images, points] = texts(&example());
    let comment = |what: &str, count: usize| format!("# List\n# Number of {what}: {count}, mean of something: 2.5\n");
    let (cameras, images, points) =
        (comment("cameras", 1) + &cameras, comment("images", 3) + &images, comment("points", 3) + &points);
    let check = |text: &str, is_err: &dyn Fn(&[u8]) -> bool| {
        assert!(!is_err(text.as_bytes()));
        let header = text.find("# Number").unwrap() + 40;
        assert!((header..text.len()).all(|end| is_err(&text.as_bytes()[..end])));
    };
    check(&cameras, &|bytes| read_cameras_txt(bytes).is_err());
    check(&images, &|bytes| read_images_txt(bytes).is_err());
    check(&points, &|bytes| read_points_txt(bytes).is_err());
    let error = read_images_txt(images.replace("images: 3", "images: 4").as_bytes()).unwrap_err().to_string();
    assert!(error.contains('4') && error.contains('3') && !error.contains('\n'), "{error}");
}

#[test]
fn keypoints_match_the_tracks() {
    let model = example();
    let keypoints = read_keypoints_bin(&write_images_bin(&model)).unwrap();
    assert_eq!(keypoints.values().map(Vec::len).collect::<Vec<_>>(), [2, 1, 2]);
    assert_eq!(keypoints[&8][0].1, 12);
}

#[test]
fn truncated_and_padded_files_are_refused() {
    let model = example();
    let (cameras, images, points) = (write_cameras_bin(&model), write_images_bin(&model), write_points_bin(&model));
    let check = |bytes: &[u8], is_err: &dyn Fn(&[u8]) -> bool| {
        assert!(!is_err(bytes));
        assert!((0..bytes.len()).all(|end| is_err(&bytes[..end])));
        assert!(is_err(&[bytes, &[0]].concat()));
        for count in [u64::MAX, u64::MAX / 8, 1 << 40, 1000] {
            let mut absurd = bytes.to_vec();
            absurd[..8].copy_from_slice(&count.to_le_bytes());
            assert!(is_err(&absurd), "{count}");
        }
        // Damaged bytes must not panic.
        for at in 0..bytes.len() {
            let mut damaged = bytes.to_vec();
            damaged[at] ^= 0xff;
            is_err(&damaged);
        }
    };
    check(&cameras, &|bytes| read_cameras_bin(bytes).is_err());
    check(&images, &|bytes| read_images_bin(bytes).is_err());
    check(&points, &|bytes| read_points_bin(bytes).is_err());
    let [cameras, images, points] = texts(&model);
    for end in 0..images.len() {
        let cut = |text: &str| text.as_bytes()[..end.min(text.len())].to_vec();
        let _ = (read_cameras_txt(&cut(&cameras)), read_images_txt(&cut(&images)), read_points_txt(&cut(&points)));
    }
}

#[test]
fn fisheyes_with_fewer_parameters_become_opencv_fisheyes() {
    let lens = |line: &str| read_cameras_txt(line.as_bytes()).unwrap()[&1].model;
    let bent = |k1, k2| CameraModel::OpenCvFisheye([9.0, 9.0, 5.0, 4.0, k1, k2, 0.0, 0.0]);
    assert_eq!(lens("1 SIMPLE_RADIAL_FISHEYE 10 8 9 5 4 0.1"), bent(0.1, 0.0));
    assert_eq!(lens("1 RADIAL_FISHEYE 10 8 9 5 4 0.1 0.2"), bent(0.1, 0.2));
}

#[test]
fn errors_name_the_entry() {
    let images = |line: &str| read_images_txt(line.as_bytes()).unwrap_err().to_string();
    assert!(images("3 0 0 0 0 1 2 3 1 a.jpg\n\n").contains("a.jpg"));
    assert!(images("3 1 0 0 0 1 NaN 3 1 b c.jpg\n\n").contains("b c.jpg"));
    assert!(images("3 1 0 0 0 1 2 3 1\n\n").contains("image 3 has no name"));
    assert!(images("3 1 0 0 0 1 2 3 1 a\n\n3 1 0 0 0 1 2 3 1 b\n\n").contains("twice"));
    assert!(images("3 1 0 0 0 1 2 3 1 a\n1 2\n").contains("line 2"));
    let cameras = |line: &str| read_cameras_txt(line.as_bytes()).unwrap_err().to_string();
    let fisheye = cameras("1 THIN_PRISM_FISHEYE 10 10 1 2 3 4 5 6 7 8 9 10 11 12");
    assert!(fisheye.contains("THIN_PRISM_FISHEYE") && fisheye.contains("colmap image_undistorter"), "{fisheye}");
    for bad in
        ["1 PINHOLE 10 10 1 2 3", "1 PINHOLE 0 10 1 1 1 1", "1 PINHOLE 10 10 -1 1 1 1", "1 PINHOLE 10 10 inf 1 1 1"]
    {
        assert!(cameras(bad).contains("camera 1"), "{bad}");
    }
    assert!(read_points_txt(b"1 0 0 inf 1 2 3 0").unwrap_err().to_string().contains("point 1"));
    assert!(read_points_txt(b"1 0 0 0 1 2 256 0").is_err() && read_points_txt(b"1 0 0 0 1 2 3 0 4").is_err());
    let mut bytes = write_cameras_bin(&example());
    bytes[12] = 5;
    assert!(matches!(read_cameras_bin(&bytes).unwrap()[&5].model, CameraModel::OpenCvFisheye(_)));
    bytes[12] = 7;
    assert!(read_cameras_bin(&bytes).unwrap_err().to_string().contains("FOV"));
    bytes[12] = 99;
    assert!(read_cameras_bin(&bytes).unwrap_err().to_string().contains("number 99"));
}

proptest! {
    #[test]
    fn round_trips(
        kind in 0usize..7,
        lens in prop::array::uniform12(0.01f64..2e3),
        turn in prop::array::uniform4(-1.0f64..1.0),
        at in prop::array::uniform3(-1e4f64..1e4),
        tracks in prop::collection::vec(prop::collection::vec(any::<bool>(), 0..4), 0..20),
    ) {
        prop_assume!(DQuat::from_array(turn).length() > 0.1);
        let [a, b, c, d, e, f, g, h, ..] = lens;
        let lens = match kind {
            0 => CameraModel::SimplePinhole([a, b, c]),
            1 => CameraModel::Pinhole([a, b, c, d]),
            2 => CameraModel::SimpleRadial([a, b, c, d]),
            3 => CameraModel::Radial([a, b, c, d, e]),
            4 => CameraModel::OpenCv([a, b, c, d, e, f, g, h]),
            5 => CameraModel::OpenCvFisheye([a, b, c, d, e, f, g, h]),
            _ => CameraModel::FullOpenCv(lens),
        };
        let model = model(lens, turn, at, &tracks);
        prop_assert_eq!(read_cameras_bin(&write_cameras_bin(&model)), Ok(model.cameras.clone()));
        prop_assert!(near(&read_images_bin(&write_images_bin(&model)).unwrap(), &model.images));
        prop_assert_eq!(read_points_bin(&write_points_bin(&model)), Ok(model.points.clone()));
    }

    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = (read_cameras_bin(&bytes), read_images_bin(&bytes), read_points_bin(&bytes));
        let _ = (read_cameras_txt(&bytes), read_images_txt(&bytes), read_points_txt(&bytes));
    }
}
