use super::*;
use crate::lidar::Return;
use crate::open::Source;

/// A city with several drives, as a plain capture and as nuScenes.
fn drives() -> (tempfile::TempDir, Source, Vec<Source>) {
    let settings = Settings { aerial: 0.0, lidar: true, nuscenes: true, spacing: Some(12.0), views: 120, ..small() };
    let (folder, _) = written(&settings, 2);
    let options = OpenOptions { lidar: true, ..OpenOptions::default() };
    let plain = open(folder.path(), &options).unwrap();
    let root = folder.path().join("nuscenes");
    let scenes: Vec<serde_json::Value> =
        serde_json::from_slice(&fs::read(root.join("v1.0-mini/scene.json")).unwrap()).unwrap();
    let opened = |scene: &serde_json::Value| open(&root.join(scene["name"].as_str().unwrap()), &options).unwrap();
    let scenes: Vec<Source> = scenes.iter().map(opened).collect();
    (folder, plain, scenes)
}

#[test]
fn drives_as_nuscenes_have_the_cameras_and_sweeps_of_the_capture() {
    let (folder, plain, scenes) = drives();
    assert!(scenes.len() > 1 && scenes.iter().all(|scene| scene.format == "nuscenes"), "{}", scenes.len());
    let error = open(&folder.path().join("nuscenes"), &OpenOptions::default()).unwrap_err().to_string();
    assert!(error.contains("scenes") && error.contains("nuscenes/scene-") && !error.contains('\n'), "{error}");

    let (mut views, mut masked) = (0, 0);
    for view in scenes.iter().flat_map(|scene| &scene.capture.views) {
        let (channel, name) = view.name.strip_prefix("samples/").unwrap().split_once('/').unwrap();
        let expected = plain.capture.views.iter().find(|other| other.name == name).unwrap();
        let (ours, theirs) = (&view.camera, &expected.camera);
        assert!(ours.centre().distance(theirs.centre()) < 1e-4, "{name}");
        let turn = ours.camera_from_world.rotation.angle_between(theirs.camera_from_world.rotation);
        assert!(turn < 1e-4 && ours.pinhole == theirs.pinhole, "{name}: {turn}");
        assert!(
            channel.starts_with("CAM_") && channel.contains("BACK") == name.contains("rear"),
            "{channel} of {name}"
        );
        views += 1;
        masked += usize::from(view.masked);
    }
    assert_eq!(views, plain.capture.views.len());
    assert!(masked > 0 && masked < views, "{masked} of {views} show something that moves");

    // The same points, once corrected for the car's motion by the reader and once by the writer.
    let stem = |path: &Path| path.file_name().unwrap().to_string_lossy().split('.').next().unwrap().to_owned();
    let (mut sweeps, mut compared, mut largest) = (0, 0, 0.0_f64);
    for sweep in scenes.iter().flat_map(|scene| &scene.sweeps) {
        let expected = plain.sweeps.iter().find(|other| stem(&other.path) == stem(&sweep.path)).unwrap();
        assert!(expected.turn.is_some() && sweep.turn.is_none() && sweep.views.len() == expected.views.len());
        let (ours, theirs) = (sweep.read().unwrap(), expected.read().unwrap());
        // The returns at the ends of the range are left out by one and not by the other: it counts from where the sensor was
        // when it fired, or in the middle of the turn.
        let sensor = sweep.world_from_sensor.translation;
        let places = |returns: Vec<Return>| -> Vec<DVec3> {
            let places = returns.into_iter().map(|found| found.place);
            places.filter(|place| (4.0..70.0).contains(&place.distance(sensor))).collect()
        };
        let [ours, theirs] = [ours, theirs].map(places);
        assert!(ours.len() > 1000 && ours.len().abs_diff(theirs.len()) < 5, "{} and {}", ours.len(), theirs.len());
        if ours.len() == theirs.len() {
            compared += 1;
            largest = ours.iter().zip(&theirs).map(|(a, b)| a.distance(*b)).fold(largest, f64::max);
        }
        sweeps += 1;
    }
    assert_eq!(sweeps, plain.sweeps.len());
    // A firing's azimuth gives its time only up to the half column that the reader does not know of.
    assert!(2 * compared > sweeps && largest < 0.02, "{largest} m in {compared} of {sweeps} sweeps");
    let labels: usize = scenes.iter().flat_map(|scene| scene.labels.values()).sum();
    assert!(labels > 20 && scenes.iter().any(|scene| scene.labels.contains_key("vehicle.car")), "{labels}");
}

#[test]
fn boxes_hold_the_returns_that_they_count() {
    let (folder, _, scenes) = drives();
    let table = |name: &str| -> Vec<serde_json::Value> {
        let path = folder.path().join(format!("nuscenes/v1.0-mini/{name}.json"));
        serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
    };
    let numbers = |value: &serde_json::Value| -> Vec<f64> { serde_json::from_value(value.clone()).unwrap() };
    let sweeps: BTreeMap<String, String> = table("sample_data")
        .iter()
        .filter(|row| row["fileformat"] == "pcd")
        .map(|row| [&row["sample_token"], &row["filename"]].map(|text| text.as_str().unwrap().to_owned()).into())
        .collect();
    let (mut told, mut found) = (0, 0);
    for row in table("sample_annotation") {
        let Some(file) = sweeps.get(row["sample_token"].as_str().unwrap()) else { continue };
        let all = scenes.iter().flat_map(|scene| &scene.sweeps);
        let sweep = all.into_iter().find(|sweep| sweep.path.ends_with(file)).unwrap();
        let (at, size, q) = (numbers(&row["translation"]), numbers(&row["size"]), numbers(&row["rotation"]));
        let from_world = glam::DQuat::from_xyzw(q[1], q[2], q[3], q[0]).inverse();
        // Width, length, height. Half a turn takes 25 ms, in which a car moves by up to 0.3 m.
        let half = 0.5 * DVec3::new(size[1], size[0], size[2]) + DVec3::splat(0.4);
        let inside = |place: DVec3| ((from_world * (place - DVec3::from_slice(&at))).abs() - half).max_element() < 0.0;
        let count = row["num_lidar_pts"].as_u64().unwrap() as usize;
        if count > 0 {
            told += 1;
            let in_box = sweep.read().unwrap().iter().filter(|seen| inside(seen.place)).count();
            // Returns within 2 m are not read.
            found += usize::from(2 * in_box >= count);
        }
    }
    assert!(told > 20 && found * 20 >= told * 19, "{found} of {told}");
    // Rows in sequence name each other.
    for (table_name, start) in [("sample", "scene"), ("sample_annotation", "instance"), ("sample_data", "")] {
        let rows = table(table_name);
        let by_token: BTreeMap<&str, &serde_json::Value> =
            rows.iter().map(|row| (row["token"].as_str().unwrap(), row)).collect();
        assert_eq!(by_token.len(), rows.len(), "{table_name} repeats a token");
        let linked = |row: &serde_json::Value| match row["next"].as_str().unwrap() {
            "" => true,
            next => by_token[next]["prev"] == row["token"],
        };
        assert!(rows.iter().all(linked), "{table_name}");
        let starts = rows.iter().filter(|row| row["prev"] == "").count();
        assert!(start.is_empty() || starts == table(start).len(), "{starts} in {table_name}");
    }
}
