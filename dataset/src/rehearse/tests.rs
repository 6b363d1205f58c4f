use std::collections::BTreeMap;
use std::path::PathBuf;

use city::faults::Kind;
use city::{Layout, Traffic};
use glam::DVec3;

use super::*;
use crate::open::{OpenOptions, open};

fn small() -> Settings {
    let city = CitySettings { layout: Layout::Grid, traffic: Traffic::Heavy, ..CitySettings::default() };
    Settings { city, views: 24, width: 96, height: 54, ..Settings::default() }
}

fn written(settings: &Settings, threads: usize) -> (tempfile::TempDir, Summary) {
    let folder = tempfile::tempdir().unwrap();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let summary = pool.install(|| write(folder.path(), settings, &|_, _, _| ())).unwrap();
    (folder, summary)
}

/// All files below a folder with their bytes.
fn files(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                all.insert(path.strip_prefix(root).unwrap().to_path_buf(), fs::read(&path).unwrap());
            }
        }
    }
    all
}

#[test]
fn a_rehearsal_opens_as_a_capture_and_its_points_are_where_views_see_them() {
    let (folder, summary) = written(&small(), 2);
    let source = open(folder.path(), &OpenOptions::default()).unwrap();
    let capture = &source.capture;
    assert_eq!((source.format, capture.views.len(), summary.views), ("colmap", 24, 24));
    assert!(source.left_out.is_empty() && capture.geo_origin.is_some());
    assert!(source.photos.iter().all(|photo| photo.mask.is_some()));
    assert!(capture.points.len() > 200 && summary.points == capture.points.len(), "{summary:?}");
    capture.check().unwrap();

    // the same frames and points as nerfstudio reads them
    let frames = open(&folder.path().join("transforms.json"), &OpenOptions::default()).unwrap();
    assert_eq!(frames.capture.views.len(), 24);
    assert_eq!(frames.capture.points.len(), capture.points.len());
    for (a, b) in frames.capture.views.iter().zip(&capture.views) {
        assert!(a.name.ends_with(&b.name) && a.camera.centre().distance(b.camera.centre()) < 1e-6);
    }

    // half from the air, half from the street, all over the city
    let aerial = capture.views.iter().filter(|view| view.name.starts_with("aerial-")).count();
    let street = capture.views.iter().filter(|view| view.name.starts_with("street-")).count();
    assert_eq!((aerial, street), (12, 12));
    let quarter = |p: DVec3| usize::from(p.x > 0.0) + 2 * usize::from(p.y > 0.0);
    let mut quarters = [0; 4];
    capture.views.iter().for_each(|view| quarters[quarter(view.camera.centre())] += 1);
    assert!(quarters.iter().all(|&n| n >= 3), "{quarters:?}");

    // what was found in a picture, against where the noisy point falls in it
    let bytes = fs::read(folder.path().join("truth/shots.jsonl")).unwrap();
    let shots: Vec<city::sense::Shot> =
        bytes.split(|&b| b == b'\n').filter(|l| !l.is_empty()).map(|l| serde_json::from_slice(l).unwrap()).collect();
    assert_eq!(shots.len(), 24);
    let city = City::generate(&small().city).unwrap();
    let world = World::new(&city).unwrap();
    let (mut errors, mut hidden, mut all) = (Vec::new(), 0, 0);
    for i in 0..capture.points.len() {
        for &view in capture.points.track(i).unwrap() {
            let (shot, point) = (&shots[view as usize], capture.points.positions[i]);
            assert_eq!(format!("{}.png", shot.name), capture.views[view as usize].name);
            let centre = shot.camera.centre();
            let towards = (point - centre).normalize().as_vec3();
            let hit = world
                .at(shot.seconds)
                .cast(&city::trace::Ray::new(centre.as_vec3(), towards), city::trace::Meets::Opaque);
            // the surface along the ray, put where the point's own depth is: how far is it from there, in pixels?
            let Some(hit) = hit else { continue };
            let footprint = shot.camera.project(point).1 / shot.camera.pinhole.fx;
            all += 1;
            errors.push((f64::from(hit.distance) - centre.distance(point)).abs() / footprint);
            hidden += usize::from(f64::from(hit.distance) < centre.distance(point) - 8.0 * footprint);
        }
    }
    errors.sort_by(f64::total_cmp);
    assert!(errors[errors.len() / 2] < 1.0, "{}", errors[errors.len() / 2]);
    // a noisy point at an edge may fall beside it; a point behind a house may not
    assert!(hidden * 50 < all, "{hidden} of {all}");
}

#[test]
fn the_same_settings_give_the_same_bytes_on_any_number_of_threads() {
    let settings = Settings { views: 8, width: 48, height: 32, fixed: 0.25, ..small() };
    let (one, two) = (written(&settings, 1), written(&settings, 2));
    let (a, b) = (files(one.0.path()), files(two.0.path()));
    assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>());
    assert!(a.iter().all(|(name, bytes)| &b[name] == bytes));
    assert!(a.keys().any(|name| name.starts_with("images") && name.to_string_lossy().contains("fixed-")));
    let other = Settings { city: CitySettings { seed: 2, ..settings.city }, ..settings.clone() };
    assert_ne!(
        files(written(&other, 2).0.path())[Path::new("sparse/0/points3D.bin")],
        a[Path::new("sparse/0/points3D.bin")]
    );

    // the same again is fine, other settings over it are not
    assert_eq!(write(two.0.path(), &settings, &|_, _, _| ()).unwrap(), two.1);
    assert_eq!(files(two.0.path()), a);
    let refusal = write(two.0.path(), &other, &|_, _, _| ()).unwrap_err().to_string();
    assert!(refusal.contains("not empty") && !refusal.contains('\n'), "{refusal}");
}

#[test]
fn faults_reach_the_capture_and_the_truth_stays() {
    let fault = |kind| Fault { kind, strength: 1.0, seed: 3 };
    let clean = Settings { views: 12, width: 48, height: 32, ..small() };
    let spoilt = |kind| Settings { faults: vec![fault(kind)], ..clean.clone() };
    let (a, noisy) = (written(&clean, 2), written(&spoilt(Kind::PoseNoise), 2));
    let (a, noisy) = (files(a.0.path()), files(noisy.0.path()));
    let [model, told] = ["sparse/0/images.bin", "truth/transforms.json"].map(Path::new);
    assert!(a[model] != noisy[model] && a[told] == noisy[told]);
    let sparse = Settings { views: 60, ..spoilt(Kind::SparseViews) };
    let views = written(&sparse, 2).1.views;
    assert!((1..20).contains(&views), "{views}");
    let open_masks = files(written(&spoilt(Kind::MovingUnmasked), 2).0.path());
    let dark = |files: &BTreeMap<PathBuf, Vec<u8>>| {
        let masks = files.iter().filter(|(name, _)| name.starts_with("masks"));
        let count =
            |bytes: &[u8]| image::load_from_memory(bytes).unwrap().to_luma8().iter().filter(|&&b| b == 0).count();
        masks.map(|(_, bytes)| count(bytes)).sum::<usize>()
    };
    assert!(dark(&a) > 0 && dark(&open_masks) == 0, "{}", dark(&a));
}

#[test]
fn settings_out_of_range_are_refused_before_anything_is_made() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    for wrong in [
        Settings { views: 0, ..small() },
        Settings { views: 50_001, ..small() },
        Settings { width: 15, ..small() },
        Settings { height: 8193, ..small() },
        Settings { aerial: f64::NAN, ..small() },
        Settings { aerial: 0.6, fixed: 0.5, ..small() },
        Settings { fixed: -0.1, ..small() },
        Settings { faults: vec![Fault { kind: Kind::Fog, strength: 2.0, seed: 0 }], ..small() },
        Settings { city: CitySettings { area_km2: 26.0, ..small().city }, ..small() },
    ] {
        let refusal = write(&out, &wrong, &|_, _, _| ()).unwrap_err();
        assert!(matches!(refusal, RehearseError::BadInput(_)) && !refusal.to_string().contains('\n'), "{refusal}");
        assert!(!out.exists());
    }
}
