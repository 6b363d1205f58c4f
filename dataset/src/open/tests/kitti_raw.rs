//! Drives of KITTI raw, whole and damaged.

use std::fs;

use glam::DVec2;

use super::*;

const DATE: &str = "2011_09_26";
const DRIVE: &str = "2011_09_26/2011_09_26_drive_0005_sync";
const CAMERAS: &str = "calib_time: 09-Jan-2012 13:57:47\nS_rect_02: 48 32\nR_rect_00: 1 0 0 0 1 0 0 0 1\n\
    P_rect_02: 40 0 24 0 0 40 16 0 0 0 1 0\nS_rect_03: 48 32\nP_rect_03: 40 0 24 -20 0 40 16 0 0 0 1 0\n";
/// Ahead of the scanner by 0.3 m: x ahead, y left, z up to x right, y down, z ahead.
const VELO_TO_CAM: &str = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.3\n";
/// The scanner is 0.8 m above the IMU.
const IMU_TO_VELO: &str = "R: 1 0 0 0 1 0 0 0 1\nT: 0 0 -0.8\n";

fn write(path: &Path, bytes: impl AsRef<[u8]>) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, bytes).unwrap();
}

/// A car that drives north from 49° N at 10 m/s: position, roll, pitch, yaw, then motion.
fn oxts(metres: f64) -> String {
    let degrees = 49.0 + (metres / 6_378_137.0).to_degrees();
    format!("{degrees} 8.4 112 0 0 {} 10 0 10 0 0{}\n", std::f64::consts::FRAC_PI_2, " 0".repeat(19))
}

/// Three frames a metre apart; the second one has no sweep, the third one no photo of camera 3.
fn archive() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write(&at(&format!("{DATE}/calib_cam_to_cam.txt")), CAMERAS);
    write(&at(&format!("{DATE}/calib_velo_to_cam.txt")), VELO_TO_CAM);
    write(&at(&format!("{DATE}/calib_imu_to_velo.txt")), IMU_TO_VELO);
    for frame in 0..3u32 {
        write(&at(&format!("{DRIVE}/oxts/data/{frame:010}.txt")), oxts(frame.into()));
        for camera in [2, 3] {
            let photo = at(&format!("{DRIVE}/image_0{camera}/data/{frame:010}.png"));
            fs::create_dir_all(photo.parent().unwrap()).unwrap();
            if (camera, frame) != (3, 2) {
                RgbImage::new(48, 32).save(photo).unwrap();
            }
        }
        // Ahead, to the left, which was measured a quarter of a turn later, and nothing.
        let points = [10.0f32, 0.0, 0.0, 0.5, 0.0, 5.0, -1.0, 0.5, f32::NAN, 0.0, 0.0, 0.0];
        let bytes: Vec<u8> = points.iter().flat_map(|value| value.to_le_bytes()).collect();
        if frame != 1 {
            write(&at(&format!("{DRIVE}/velodyne_points/data/{frame:010}.bin")), bytes);
        }
    }
    folder
}

fn with_lidar(path: &Path) -> Result<Source, String> {
    open(path, &OpenOptions { lidar: true, ..OpenOptions::default() }).map_err(|error| error.to_string())
}

#[test]
fn a_drive_has_its_photos_and_sweeps() {
    let folder = archive();
    let source = with_lidar(folder.path()).unwrap();
    let views = &source.capture.views;
    assert_eq!((source.format, views.len(), source.sweeps.len(), source.left_out.len()), ("kitti-raw", 5, 2, 0));
    assert_eq!(
        (views[2].name.as_str(), views[3].name.as_str()),
        ("image_02/0000000002.png", "image_03/0000000000.png")
    );
    let origin = source.capture.geo_origin.unwrap();
    assert_eq!((origin.latitude_degrees, origin.longitude_degrees, origin.altitude_metres), (49.0, 8.4, 112.0));
    // 0.3 m ahead of the scanner, 0.8 m above the IMU; the car looks to the north, and camera 3 is half a metre to the right.
    let camera = |i: usize| views[i].camera;
    assert!(camera(0).centre().distance(DVec3::new(0.0, 0.3, 0.8)) < 1e-6, "{}", camera(0).centre());
    assert!(camera(3).centre().distance(DVec3::new(0.5, 0.3, 0.8)) < 1e-6, "{}", camera(3).centre());
    assert!(camera(2).centre().distance(DVec3::new(0.0, 2.3, 0.8)) < 1e-4, "{}", camera(2).centre());
    assert!(camera(1).forward().distance(DVec3::Y) < 1e-9);
    let (pixel, depth) = camera(0).project(DVec3::new(1.0, 10.3, 0.8));
    assert!((depth - 10.0).abs() < 1e-6 && pixel.distance(DVec2::new(28.0, 16.0)) < 1e-5, "{pixel}");
    // Sweeps belong to the photos of their frames. The left is measured 25 ms later, a quarter of a metre farther on.
    assert_eq!((&source.sweeps[0].views[..], &source.sweeps[1].views[..]), (&[0, 3][..], &[2][..]));
    let places: Vec<DVec3> = source.sweeps[0].read().unwrap().iter().map(|found| found.place).collect();
    let expected = [DVec3::new(0.0, 10.0, 0.8), DVec3::new(-5.0, 0.25, -0.2)];
    assert!(places.len() == 2 && places.iter().zip(expected).all(|(a, b)| a.distance(b) < 1e-6), "{places:?}");
    // Without the colour cameras the grey ones are used, and JPEG instead of PNG.
    let drive = folder.path().join(DRIVE);
    fs::rename(drive.join("image_03"), drive.join("image_00")).unwrap();
    fs::remove_dir_all(drive.join("image_02")).unwrap();
    refused(folder.path(), &["calib_cam_to_cam.txt", "no row P_rect_00"]);
    let grey = CAMERAS.replace("_03", "_00");
    write(&folder.path().join(DATE).join("calib_cam_to_cam.txt"), grey);
    let photo = drive.join("image_00/data/0000000001.png");
    RgbImage::new(48, 32).save(photo.with_extension("jpg")).unwrap();
    fs::remove_file(photo).unwrap();
    let views = opened(&drive).unwrap().capture.views;
    assert_eq!((views.len(), views[1].name.as_str()), (2, "image_00/0000000001.jpg"));
}

/// A car that keeps 10 m ahead of the scanner, 2 m to its left, in all frames; and one that is parked, in the last two.
fn tracklets() -> String {
    let pose = |[x, y, z]: [f64; 3], yaw: f64| {
        format!("<item><tx>{x}</tx><ty>{y}</ty><tz>{z}</tz><rx>0</rx><ry>0</ry><rz>{yaw}</rz><state>2</state></item>")
    };
    let item = |class: &str, first: u32, poses: &[String]| {
        let poses = poses.concat();
        format!(
            "<item><objectType>{class}</objectType><h>1.5</h><w>2</w><l>4</l><first_frame>{first}</first_frame>\
             <poses><count>9</count>{poses}</poses><finished>1</finished></item>"
        )
    };
    let ahead: Vec<String> = (0..3).map(|_| pose([10.0, 2.0, -1.6], 0.0)).collect();
    let parked: Vec<String> = (1..3).map(|frame| pose([20.0 - f64::from(frame), -3.0, -1.6], 1.0)).collect();
    let items = [item("Car", 0, &ahead), item("Van", 1, &parked)].concat();
    format!("<boost_serialization><tracklets><count>2</count>{items}</tracklets></boost_serialization>")
}

#[test]
fn a_drive_has_its_annotated_objects() {
    let folder = archive();
    let at = |name: &str| folder.path().join(DRIVE).join(name);
    assert!(with_lidar(folder.path()).unwrap().labels.is_empty());
    write(&at("tracklet_labels.xml"), tracklets());
    let times = |by: u32| -> String {
        (25..28).map(|second| format!("2011-09-26 13:02:{second}.{}00000000\n", 5 + by)).collect()
    };
    for (sensor, by) in [("oxts", 0), ("image_02", 0), ("image_03", 1)] {
        write(&at(&format!("{sensor}/timestamps.txt")), times(by));
    }
    let source = with_lidar(folder.path()).unwrap();
    assert_eq!(source.labels, BTreeMap::from([("Car".into(), 3), ("Van".into(), 2)]));
    let [car] = &source.capture.objects[..] else { panic!("{:?}", source.capture.objects) };
    assert_eq!((car.class.as_str(), car.high - car.low, car.path.len()), ("Car", DVec3::new(4.0, 2.0, 1.5), 3));
    let views = &source.capture.views;
    // Of camera 2, then of camera 3, a tenth of a second later.
    let seconds: Vec<f64> = views.iter().map(|view| view.seconds.unwrap()).collect();
    assert!(seconds.iter().zip([0.0, 1.0, 2.0, 0.1, 1.1]).all(|(a, b)| (a - b).abs() < 1e-6), "{seconds:?}");
    for (view, photo) in views.iter().zip(&source.photos).take(3) {
        let place = view.camera.camera_from_world.after(&car.pose(view.seconds.unwrap()).unwrap()).translation;
        // The camera is 0.3 m ahead of the scanner; the box's middle is 0.85 m below it.
        assert!(place.distance(DVec3::new(-2.0, 0.85, 9.7)) < 1e-3, "{place}");
        let [corners] = &photo.moving()[..] else { panic!("{:?}", photo.boxes) };
        assert!((corners.iter().sum::<DVec3>() / 8.0).distance(place) < 1e-6);
    }
    source.capture.check().unwrap();

    // Without times, frames are ten a second.
    for sensor in ["oxts", "image_02", "image_03"] {
        fs::remove_file(at(&format!("{sensor}/timestamps.txt"))).unwrap();
    }
    let views = with_lidar(folder.path()).unwrap().capture.views;
    assert!((views[2].seconds.unwrap() - 0.2).abs() < 1e-9);
}

#[test]
fn a_drive_is_named_by_its_folder_its_date_or_the_archive() {
    let folder = archive();
    let at = |name: &str| folder.path().join(name);
    let whole = with_lidar(folder.path()).unwrap();
    assert_eq!(whole, with_lidar(&at(DATE)).unwrap());
    assert_eq!(whole, with_lidar(&at(DRIVE)).unwrap());
    // A second drive on another day, and one that is not rectified.
    let copied = |to: &str| {
        for name in ["oxts/data/0000000000.txt", "image_02/data/0000000000.png"] {
            write(&at(&format!("{to}/{name}")), fs::read(at(&format!("{DRIVE}/{name}"))).unwrap());
        }
    };
    copied("2011_09_26/2011_09_26_drive_0009_extract");
    assert_eq!(whole, with_lidar(folder.path()).unwrap());
    copied("2011_09_28/2011_09_28_drive_0001_sync");
    refused(&at("2011_09_28/2011_09_28_drive_0001_sync"), &["calib_cam_to_cam.txt", "is not there"]);
    write(&at("2011_09_28/calib_cam_to_cam.txt"), CAMERAS);
    let named = "/2011_09_26/2011_09_26_drive_0005_sync";
    refused(folder.path(), &["has 2 drives", "2011_09_26_drive_0005_sync, 2011_09_28_drive_0001_sync", named]);
    assert_eq!(whole, with_lidar(&at(DRIVE)).unwrap());
    fs::remove_dir_all(at(DRIVE)).unwrap();
    refused(&at(DATE), &["not rectified", "2011_09_26_drive_0009_extract"]);
}

#[test]
fn damaged_drives_are_refused_in_a_line() {
    let damaged = |words: &[&str], damage: &dyn Fn(&Path)| {
        let folder = archive();
        damage(folder.path());
        let error = with_lidar(folder.path()).map(|source| source.capture.views.len()).unwrap_err();
        assert!(words.iter().all(|word| error.contains(word)) && !error.contains('\n'), "{words:?}: {error}");
    };
    let date = |name: &'static str, text: String| move |root: &Path| write(&root.join(DATE).join(name), &text);
    let drive = |name: &'static str, bytes: Vec<u8>| move |root: &Path| write(&root.join(DRIVE).join(name), &bytes);
    damaged(
        &["calib_cam_to_cam.txt", "no row S_rect_03"],
        &date("calib_cam_to_cam.txt", CAMERAS.replace("S_rect_03", "S_03")),
    );
    damaged(
        &["calib_cam_to_cam.txt", "no row R_rect_00"],
        &date("calib_cam_to_cam.txt", CAMERAS.replace("R_rect", "R")),
    );
    damaged(&["calib_velo_to_cam.txt", "no row T"], &date("calib_velo_to_cam.txt", VELO_TO_CAM.replace("T: 0", "T:")));
    damaged(
        &["calib_imu_to_velo.txt", "not a rigid"],
        &date("calib_imu_to_velo.txt", IMU_TO_VELO.replace("R: 1", "R: 2")),
    );
    damaged(&["calib_imu_to_velo.txt", "is not there"], &|root| {
        fs::remove_file(root.join(DATE).join("calib_imu_to_velo.txt")).unwrap();
    });
    let nan = oxts(1.0).replace("8.4", "nan").into_bytes();
    damaged(&["0000000001.txt", "not a number"], &drive("oxts/data/0000000001.txt", nan));
    damaged(&["0000000001.txt", "3 numbers instead of 30"], &drive("oxts/data/0000000001.txt", b"1 2 3".to_vec()));
    damaged(&["0000000000.txt", "larger than 1 MB"], &drive("oxts/data/0000000000.txt", vec![b' '; 2 << 20]));
    let broken = tracklets().replace("<h>1.5</h>", "").into_bytes();
    damaged(&["tracklet_labels.xml", "`h`"], &drive("tracklet_labels.xml", broken));
    damaged(&["oxts/timestamps.txt", "line 2"], &drive("oxts/timestamps.txt", b"2011-09-26 13:02:25\nnoon\n".to_vec()));
    damaged(&["0000000002.bin", "cut short"], &drive("velodyne_points/data/0000000002.bin", vec![0; 33]));
    let nothing = f32::NAN.to_le_bytes().repeat(8);
    damaged(&["0000000002.bin", "none of which is finite"], &drive("velodyne_points/data/0000000002.bin", nothing));
    damaged(&["0000000001.png", "not an image"], &drive("image_02/data/0000000001.png", b"no image".to_vec()));
    damaged(&["no photo of a frame with a position"], &|root| {
        fs::remove_dir_all(root.join(DRIVE).join("oxts/data")).unwrap();
        fs::create_dir(root.join(DRIVE).join("oxts/data")).unwrap();
    });
}
