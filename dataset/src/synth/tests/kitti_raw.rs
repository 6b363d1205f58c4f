use super::*;
use crate::open::Source;

/// The drives below `kitti_raw/`, by name.
fn opened(folder: &Path) -> Vec<Source> {
    let date = folder.join("kitti_raw/1970_01_01");
    let names = fs::read_dir(&date).unwrap().map(|entry| entry.unwrap().path());
    let mut drives: Vec<PathBuf> = names.filter(|path| path.is_dir()).collect();
    drives.sort();
    let options = OpenOptions { lidar: true, ..OpenOptions::default() };
    drives.iter().map(|drive| open(drive, &options).unwrap()).collect()
}

#[test]
fn drives_as_kitti_raw_have_the_cameras_and_sweeps_of_the_capture() {
    let settings = Settings { aerial: 0.0, lidar: true, kitti_raw: true, spacing: Some(12.0), views: 120, ..small() };
    let (folder, _) = written(&settings, 2);
    let plain = open(folder.path(), &OpenOptions { lidar: true, ..OpenOptions::default() }).unwrap();
    let drives = opened(folder.path());
    assert!(drives.len() > 1 && drives.iter().all(|drive| drive.format == "kitti-raw"), "{}", drives.len());
    let error = open(&folder.path().join("kitti_raw"), &OpenOptions::default()).unwrap_err().to_string();
    assert!(error.contains("drives") && error.contains("_sync") && !error.contains('\n'), "{error}");

    let legs: Vec<usize> = {
        let names = plain.capture.views.iter().filter_map(|view| view.name.strip_prefix("street-front-left-"));
        let mut legs: Vec<usize> = names.map(|name| name[..4].parse().unwrap()).collect();
        legs.dedup();
        legs
    };
    assert_eq!(drives.len(), legs.len());
    let (mut views, mut sweeps, mut compared, mut largest) = (0, 0, 0, 0.0_f64);
    for (drive, leg) in drives.iter().zip(legs) {
        // A drive has an origin of its own: the place of its first frame.
        let of_leg = |prefix: &str| {
            let prefix = format!("street-{prefix}-{leg:04}-");
            plain.capture.views.iter().filter(move |view| view.name.starts_with(&prefix)).map(|view| view.camera)
        };
        let expected: Vec<scene::Camera> = of_leg("front-left").chain(of_leg("front-right")).collect();
        assert_eq!(expected.len(), drive.capture.views.len());
        let origin = expected[0].centre() - drive.capture.views[0].camera.centre();
        for (view, expected) in drive.capture.views.iter().zip(&expected) {
            let (ours, off) = (&view.camera, (view.camera.centre() + origin).distance(expected.centre()));
            let turn = ours.camera_from_world.rotation.angle_between(expected.camera_from_world.rotation);
            assert!(off < 1e-4 && turn < 1e-6 && ours.pinhole == expected.pinhole, "{}: {off} {turn}", view.name);
            views += 1;
        }
        // The same points, once corrected by the reader for a turn to the left, once for one to the right.
        let all = plain.sweeps.iter().filter(|sweep| {
            let name = sweep.path.file_name().unwrap().to_string_lossy().into_owned();
            name.starts_with(&format!("street-{leg:04}-"))
        });
        assert_eq!(all.clone().count(), drive.sweeps.len());
        for (sweep, expected) in drive.sweeps.iter().zip(all) {
            let sensor = expected.world_from_sensor.translation;
            let places = |sweep: &crate::lidar::Sweep, by: DVec3| -> Vec<DVec3> {
                let places = sweep.read().unwrap().into_iter().map(|found| found.place + by);
                places.filter(|place| (4.0..70.0).contains(&place.distance(sensor))).collect()
            };
            let (ours, theirs) = (places(sweep, origin), places(expected, DVec3::ZERO));
            assert!(ours.len() > 1000 && theirs.len() - ours.len() < 40, "{} and {}", ours.len(), theirs.len());
            // Points at the seam are left out, so each is compared with the nearest of the next few.
            let mut from = 0;
            for place in &ours {
                let near = theirs[from..].iter().take(40).map(|other| other.distance(*place)).enumerate();
                let (skipped, metres) = near.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
                from += skipped + 1;
                largest = largest.max(metres);
                compared += 1;
            }
            sweeps += 1;
        }
    }
    assert!(views > 30 && 3 * views == plain.capture.views.len(), "{views} of {}", plain.capture.views.len());
    assert_eq!(sweeps, plain.sweeps.len());
    compare_objects(&plain, &drives);
    // A firing's azimuth gives its time only up to the half column that the reader of the plain capture does not know of.
    assert!(largest < 0.02, "{largest} m in {compared} points");
}

/// The moving objects of the drives are where the capture's own are.
fn compare_objects(plain: &Source, drives: &[Source]) {
    let (mut compared, mut labels) = (0, 0);
    for drive in drives {
        labels += drive.labels.values().sum::<usize>();
        for view in &drive.capture.views {
            // Photos of the capture that look the same way: the drive's origin is another one.
            let Some(seconds) = view.seconds else { continue };
            let same = |other: &&scene::View| {
                let turn =
                    other.camera.camera_from_world.rotation.angle_between(view.camera.camera_from_world.rotation);
                turn < 1e-6 && other.seconds.is_some()
            };
            for object in &drive.capture.objects {
                let Some(pose) = object.pose(seconds) else { continue };
                let here = view.camera.camera_from_world.apply(pose.translation);
                let near = plain.capture.views.iter().filter(same).flat_map(|other| {
                    plain.capture.objects.iter().filter_map(move |own| {
                        let middle = own.pose(other.seconds.unwrap())?.apply(0.5 * (own.low + own.high));
                        Some(other.camera.camera_from_world.apply(middle).distance(here))
                    })
                });
                let metres = near.fold(f64::INFINITY, f64::min);
                assert!(metres < 0.02, "{metres} m: {} in {}", object.id, view.name);
                compared += 1;
            }
        }
    }
    assert!(compared > 10 && labels > 50, "{compared} of {labels}");
}
