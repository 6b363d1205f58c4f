use glam::Vec3;
use scene::{Splat, ply};

use super::*;

/// A model as a file: a street of splats, and a few far behind it.
fn model(folder: &Path, count: usize) -> std::path::PathBuf {
    let mut splats = Splats::new(1);
    for i in 0..count {
        let (x, y) = ((i % 300) as f32 * 0.4, (i / 300) as f32 * 0.4);
        let mut splat = Splat::round(Vec3::new(x, y, (x * 0.3).sin()), -1.5, Vec3::new(0.2, 0.4, x / 120.0), 0.7);
        splat.sh[2] = [0.1, -0.2, 0.05];
        splats.push(&splat);
    }
    (0..20).for_each(|i| splats.push(&Splat::round(Vec3::new(i as f32 * 900.0, -9e3, 4e3), 4.0, Vec3::ONE, 0.9)));
    let path = folder.join("model.ply");
    std::fs::write(&path, ply::write(&splats, &[])).unwrap();
    path
}

#[test]
fn all_splats_are_leaves_and_nothing_is_left_behind() {
    let folder = tempfile::tempdir().unwrap();
    let (path, out) = (model(folder.path(), 70_000), folder.path().join("city.rad"));
    let mut parts = Vec::new();
    let exported = write_rad(&path, &out, &mut |done, all| parts.push((done, all))).unwrap();
    let bytes = std::fs::read(&out).unwrap();
    assert_eq!((exported.splats, exported.bytes, parts.last()), (70_020, bytes.len() as u64, Some(&(2, 2))));
    let read = rad::read(&bytes).unwrap();
    let model = crate::read(&path).unwrap().splats;
    let comment: serde_json::Value = serde_json::from_str(read.comment.as_deref().unwrap()).unwrap();
    let origin = DVec3::from_array(serde_json::from_value(comment["origin"].clone()).unwrap());
    assert_eq!(comment["splats"], 70_020);
    let places = |splats: &Splats, origin: DVec3| {
        let place = |i: usize| (splats.mean(i).as_dvec3() - origin).as_vec3().to_array().map(f32::to_bits);
        let mut places: Vec<_> = (0..splats.len()).map(place).collect();
        places.sort_unstable();
        places
    };
    assert_eq!(places(&read.leaves(), DVec3::ZERO), places(&model, origin));
    // Each node but the root has one parent, before it.
    let mut parents = vec![0; read.nodes.len()];
    for (index, &(start, count)) in read.children.iter().enumerate() {
        (start..start + u32::from(count)).for_each(|child| {
            assert!(child as usize > index);
            parents[child as usize] += 1;
        });
    }
    assert!(parents[0] == 0 && parents[1..].iter().all(|&parents| parents == 1));

    let again = folder.path().join("again.rad");
    write_rad(&path, &again, &mut |_, _| ()).unwrap();
    assert_eq!(std::fs::read(&again).unwrap(), bytes);
    let mut names: Vec<_> = folder.path().read_dir().unwrap().map(|entry| entry.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["again.rad", "city.rad", "model.ply"]);
}

#[test]
fn a_model_without_splats_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.ply");
    std::fs::write(&path, ply::write(&Splats::new(0), &[])).unwrap();
    let error = write_rad(&path, &folder.path().join("city.rad"), &mut |_, _| ()).unwrap_err().to_string();
    assert!(error.contains("no splat"), "{error}");
    assert_eq!(folder.path().read_dir().unwrap().count(), 1);
    let error = write_rad(&path, &folder.path().join("none/city.rad"), &mut |_, _| ()).unwrap_err().to_string();
    assert!(error.contains("city.rad"), "{error}");
}
