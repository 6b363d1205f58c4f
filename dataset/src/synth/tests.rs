use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

use city::faults::{Fault, FaultKind};
use city::{CitySettings, Layout, Traffic};
use glam::{DVec2, DVec3};

use super::*;
use crate::depth_samples::DepthSamples;
use crate::open::{OpenOptions, Source, open};

mod kitti_raw;
mod nuscenes;
mod waymo;

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
fn a_synthetic_capture_opens_and_its_points_agree_with_its_views() {
    let (folder, summary) = written(&small(), 2);
    let source = open(folder.path(), &OpenOptions::default()).unwrap();
    let capture = &source.capture;
    assert_eq!((source.format, capture.views.len(), summary.views), ("colmap", 24, 24));
    assert!(source.left_out.is_empty() && capture.geo_origin.is_some());
    assert!(source.photos.iter().all(|photo| photo.mask.is_some()));
    assert!(capture.points.len() > 200 && summary.points == capture.points.len(), "{summary:?}");
    capture.check().unwrap();

    // transforms.json has the same frames and points.
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
    // Aerial views count at the ground that they show.
    let half = 0.5 * small().city.extent_metres();
    let place = |view: &scene::View| {
        let (centre, forward) = (view.camera.centre(), view.camera.forward());
        if forward.z < -0.5 { centre + forward * (centre.z / -forward.z) } else { centre }
    };
    capture.views.iter().for_each(|view| quarters[quarter(place(view))] += 1);
    assert!(capture.views.iter().all(|view| place(view).truncate().abs().max_element() < 1.1 * half));
    assert!(quarters.iter().all(|&n| n >= 3), "{quarters:?}");
    // Aerial photos show the city, not its surroundings.
    let share = |view: &scene::View| {
        let (pose, k) = (view.camera.camera_from_world.inverse(), view.camera.pinhole);
        let places = (0..64).map(|i| (DVec2::new(f64::from(i % 8), f64::from(i / 8)) + 0.5) / 8.0);
        let inside = |at: DVec2| {
            let pixel = at * DVec2::new(f64::from(k.width), f64::from(k.height));
            let ray = pose.rotation * ((pixel - DVec2::new(k.cx, k.cy)) / DVec2::new(k.fx, k.fy)).extend(1.0);
            let ground = pose.translation + ray * (pose.translation.z / -ray.z.min(-1e-3));
            ground.truncate().abs().max_element() <= half
        };
        places.filter(|&at| inside(at)).count() as f64 / 64.0
    };
    let shares: Vec<f64> = capture.views.iter().filter(|v| v.name.starts_with("aerial-")).map(share).collect();
    assert!(shares.iter().all(|&share| share > 0.5), "{shares:?}");
    assert!(shares.iter().sum::<f64>() > 0.7 * shares.len() as f64, "{shares:?}");

    // Reprojection errors of the noisy points against the true surfaces.
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
                .cast(&city::trace::Ray::new(centre.as_vec3(), towards), city::trace::RayMask::Opaque);
            // The distance between the surface along the ray and the point, in pixels at the point's depth.
            let Some(hit) = hit else { continue };
            let footprint = shot.camera.project(point).1 / shot.camera.pinhole.fx;
            all += 1;
            errors.push((f64::from(hit.distance) - centre.distance(point)).abs() / footprint);
            hidden += usize::from(f64::from(hit.distance) < centre.distance(point) - 8.0 * footprint);
        }
    }
    errors.sort_by(f64::total_cmp);
    assert!(errors[errors.len() / 2] < 1.0, "{}", errors[errors.len() / 2]);
    // Noise may move a point at an edge off the surface, but few points may be occluded.
    assert!(hidden * 50 < all, "{hidden} of {all}");
}

#[test]
fn the_same_settings_give_the_same_bytes_on_any_number_of_threads() {
    let settings = Settings { views: 8, width: 48, height: 32, fixed: 0.25, ..everything() };
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

    // Writing again with the same settings succeeds, with other settings it is refused.
    assert_eq!(write(two.0.path(), &settings, &|_, _, _| ()).unwrap(), two.1);
    assert_eq!(files(two.0.path()), a);
    let refusal = write(two.0.path(), &other, &|_, _, _| ()).unwrap_err().to_string();
    assert!(refusal.contains("not empty") && !refusal.contains('\n'), "{refusal}");
}

#[test]
fn faults_change_the_capture_but_not_the_ground_truth() {
    let fault = |kind| Fault { kind, strength: 1.0, seed: 3 };
    let clean = Settings { views: 12, width: 48, height: 32, ..small() };
    let spoilt = |kind| Settings { faults: vec![fault(kind)], ..clean.clone() };
    let (a, noisy) = (written(&clean, 2), written(&spoilt(FaultKind::PoseNoise), 2));
    let (a, noisy) = (files(a.0.path()), files(noisy.0.path()));
    let [model, true_frames] = ["sparse/0/images.bin", "truth/transforms.json"].map(Path::new);
    assert!(a[model] != noisy[model] && a[true_frames] == noisy[true_frames]);
    let sparse = Settings { views: 60, ..spoilt(FaultKind::SparseViews) };
    let views = written(&sparse, 2).1.views;
    assert!((1..20).contains(&views), "{views}");
    let open_masks = files(written(&spoilt(FaultKind::MovingUnmasked), 2).0.path());
    let dark = |files: &BTreeMap<PathBuf, Vec<u8>>| {
        let masks = files.iter().filter(|(name, _)| name.starts_with("masks"));
        let count =
            |bytes: &[u8]| image::load_from_memory(bytes).unwrap().to_luma8().iter().filter(|&&b| b == 0).count();
        masks.map(|(_, bytes)| count(bytes)).sum::<usize>()
    };
    assert!(dark(&a) > 0 && dark(&open_masks) == 0, "{}", dark(&a));
}

#[test]
fn settings_out_of_range_are_refused_before_anything_is_written() {
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
        Settings { aerial: 0.5, fixed: 0.5, nuscenes: true, ..small() },
        Settings { aerial: 0.5, fixed: 0.5, kitti_raw: true, ..small() },
        Settings { faults: vec![Fault { kind: FaultKind::Fog, strength: 2.0, seed: 0 }], ..small() },
        Settings { city: CitySettings { area_km2: 26.0, ..small().city }, ..small() },
    ] {
        let refusal = write(&out, &wrong, &|_, _, _| ()).unwrap_err();
        assert!(matches!(refusal, SynthError::BadInput(_)) && !refusal.to_string().contains('\n'), "{refusal}");
        assert!(!out.exists());
    }
}

/// All outputs enabled, at a small size.
fn everything() -> Settings {
    Settings {
        views: 12,
        width: 64,
        height: 40,
        truth: true,
        lidar: true,
        radar: true,
        mesh: true,
        nuscenes: true,
        kitti_raw: true,
        occupancy: Some(2.0),
        ..small()
    }
}

/// Occupied voxels of regions, read from their files: world centres with classes.
fn occupied_voxels(places: &[VoxelRegion], voxel: f64) -> Vec<Vec<(DVec3, u8)>> {
    let settings =
        Settings { views: 1, width: 16, height: 16, occupancy: Some(voxel), around: places.to_vec(), ..small() };
    let (folder, _) = written(&settings, 2);
    let read = |(name, bytes): (&PathBuf, &Vec<u8>)| {
        let mut archive = zip::ZipArchive::new(std::io::Cursor::new(bytes)).unwrap();
        let mut array = |name: &str| {
            let mut bytes = Vec::new();
            std::io::Read::read_to_end(&mut archive.by_name(name).unwrap(), &mut bytes).unwrap();
            bytes
        };
        assert!(name.to_string_lossy().contains("around_"), "{name:?}");
        let mut numbers =
            |name: &str| scene::npy::read_f32(&array(name)).unwrap().1.into_iter().map(f64::from).collect::<Vec<_>>();
        let (pose, origin) = (numbers("world_from_grid.npy"), numbers("origin.npy"));
        let semantic = array("semantic.npy");
        let pose = glam::DMat4::from_cols_slice(&pose).transpose();
        let side = (((semantic.len() - 128) as f64).cbrt().round()) as usize;
        assert_eq!(side.pow(3) + 128, semantic.len());
        let middle = |i: usize| {
            let at = [i % side, i / side % side, i / side / side].map(|n| (n as f64 + 0.5) * voxel);
            pose.transform_point3(DVec3::from_slice(&origin) + DVec3::from(at))
        };
        let taken = semantic[128..].iter().enumerate().filter(|&(_, &class)| class != city::occupancy::FREE);
        taken.map(|(i, &class)| (middle(i), class)).collect::<Vec<_>>()
    };
    files(folder.path()).iter().filter(|(name, _)| name.starts_with("occupancy")).map(read).collect()
}

#[test]
fn voxels_of_a_region_follow_its_heading_and_time() {
    let city = City::generate(&small().city).unwrap();
    let mover = city.actors.iter().find(|actor| actor.trajectory.is_some() && actor.class == city::Class::Car).unwrap();
    let path = &mover.trajectory.as_ref().unwrap().waypoints;
    let (first, seconds) = (path[0].world_from_asset.translation, path[path.len() / 2].seconds);
    let then = city::trace::motion::pose_at(mover, seconds).translation;
    let at = |place: DVec3, heading_degrees, seconds| VoxelRegion { place, radius: 3.0, heading_degrees, seconds };
    let places = [at(then, 0.0, seconds), at(then, 30.0, seconds), at(first, 0.0, path[0].seconds)];
    let taken = occupied_voxels(&places, 0.25);
    assert_eq!(taken.len(), 3);
    let world = World::new(&city).unwrap();
    for (place, taken) in places.iter().zip(&taken) {
        let car = taken.iter().filter(|(_, class)| *class == city::Class::Car as u8).count();
        assert!(car > 200, "{car} voxels of a car at {place:?}");
        // A ray straight down onto the middle of the cube hits a surface inside an occupied voxel.
        let moment = world.at(place.seconds);
        let from = place.place + DVec3::Z * 2.99;
        let ray = city::trace::Ray::new(from.as_vec3(), -glam::Vec3::Z);
        let hit = moment.cast(&ray, city::trace::RayMask::All).unwrap();
        let met = from - DVec3::Z * f64::from(hit.distance);
        assert!(taken.iter().any(|(p, _)| p.distance(met) < 0.22), "{met}");
        assert!(taken.iter().all(|(p, _)| (*p - place.place).abs().max_element() < 3.0 * 1.5));
    }
    // The corners of the rotated cube lie outside the axis-aligned one.
    let beyond = |taken: &[(DVec3, u8)]| taken.iter().any(|(p, _)| (*p - then).abs().max_element() > 3.1);
    assert!(!beyond(&taken[0]) && beyond(&taken[1]));
}

#[test]
fn ground_truth_is_consistent_across_files() {
    let (folder, _) = written(&everything(), 2);
    let root = folder.path();
    let all = files(root);
    let json = |name: &str| serde_json::from_slice::<serde_json::Value>(&all[Path::new(name)]).unwrap();
    let manifest = json("manifest.json");
    assert_eq!(manifest["complete"], true);

    // The instances of a label image are those of boxes3d.json, and their points lie in the boxes.
    let boxes = json("boxes3d.json");
    let images = boxes["images"].as_array().unwrap();
    assert_eq!(images.len(), 12);
    let mut checked = 0;
    for image in images {
        let name = image["image"].as_str().unwrap().trim_start_matches("images/").trim_end_matches(".png").to_owned();
        let labels = image::open(root.join(format!("instance/{name}.png"))).unwrap().to_rgb8();
        let classes = image::open(root.join(format!("semantic/{name}.png"))).unwrap().to_luma8();
        let materials = image::open(root.join(format!("material/{name}.png"))).unwrap().to_luma16();
        let (shape, depth) = scene::npy::read_f32(&all[Path::new(&format!("depth/{name}.npy"))]).unwrap();
        assert_eq!((shape, labels.dimensions()), (vec![40, 64], (64, 40)));
        for (depth, class) in depth.iter().zip(classes.iter()) {
            assert_eq!(*depth == 0.0, *class == city::Class::Sky as u8);
        }
        let known = manifest["materials"].as_array().unwrap().len();
        assert!(materials.iter().zip(&depth).all(|(m, d)| if *d > 0.0 {
            usize::from(*m) < known
        } else {
            *m == 65535
        }));
        let id = |p: &image::Rgb<u8>| u64::from(p[0]) + 256 * u64::from(p[1]) + 65536 * u64::from(p[2]);
        let shots = crate::open::open(root, &OpenOptions::default()).unwrap();
        let view = shots.capture.views.iter().find(|view| view.name == format!("{name}.png")).unwrap();
        for thing in image["boxes"].as_array().unwrap() {
            let pixels: Vec<usize> = (0..64 * 40)
                .filter(|&i| id(labels.get_pixel(i % 64, i / 64)) == thing["instance"].as_u64().unwrap())
                .map(|i| i as usize)
                .collect();
            assert_eq!(pixels.len() as u64, thing["pixels"].as_u64().unwrap());
            let three = |key: &str| DVec3::from_array(serde_json::from_value(thing[key].clone()).unwrap());
            let turn: [f64; 4] = serde_json::from_value(thing["rotation"].clone()).unwrap();
            let from_world = glam::DQuat::from_array(turn).inverse();
            let k = view.camera.pinhole;
            for i in pixels {
                let (x, y, z) = ((i % 64) as f64 + 0.5, (i / 64) as f64 + 0.5, f64::from(depth[i]));
                let local = DVec3::new((x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0) * z;
                let point = view.camera.camera_from_world.inverse().apply(local);
                let inside = (from_world * (point - three("centre"))).abs() - 0.5 * three("size");
                assert!(inside.max_element() < 0.02, "{thing} has {point} outside by {inside}");
                checked += 1;
            }
        }
    }
    assert!(checked > 20, "{checked}");

    // Moving actors have tracks.
    let tracks = json("tracks.json");
    let moving = manifest["summary"]["moving"].as_u64().unwrap() as usize;
    assert_eq!(tracks["tracks"].as_array().unwrap().len(), moving);
    assert!(moving > 10 && tracks["tracks"][0]["poses"].as_array().unwrap().len() > 1);
    // Objects are where the boxes of the photos are, at their times.
    let capture = crate::open::open(root, &OpenOptions::default()).unwrap().capture;
    capture.check().unwrap();
    assert_eq!(capture.objects.len(), moving);
    let mut compared = 0;
    for image in boxes["images"].as_array().unwrap() {
        let name = image["image"].as_str().unwrap().trim_start_matches("images/");
        let Some(view) = capture.views.iter().find(|view| view.name == name) else { continue };
        assert_eq!(view.seconds, image["seconds"].as_f64());
        for thing in image["boxes"].as_array().unwrap().iter().filter(|of| of["moves"] == true) {
            let id = thing["instance"].to_string();
            let object = capture.objects.iter().find(|object| object.id == id).unwrap();
            let centre = DVec3::from_array(serde_json::from_value(thing["centre"].clone()).unwrap());
            let pose = object.pose(view.seconds.unwrap()).unwrap();
            // Walkers change their shape with their steps.
            let metres = pose.apply(0.5 * (object.low + object.high)).distance(centre);
            assert!(metres < if thing["class"] == "person" { 0.5 } else { 0.02 }, "{thing}: {metres} m");
            compared += 1;
        }
    }
    assert!(compared > 3, "{compared}");
}

#[test]
fn sweeps_and_voxels_follow_their_formats() {
    let (folder, _) = written(&everything(), 2);
    let all = files(folder.path());
    let of = |start: &str, end: &str| -> Vec<(&PathBuf, &Vec<u8>)> {
        all.iter().filter(|(name, _)| name.starts_with(start) && name.to_string_lossy().ends_with(end)).collect()
    };
    let (points, labels, truths) = (of("lidar", ".bin"), of("lidar", ".label"), of("lidar", ".npy"));
    assert!(!points.is_empty() && points.len() == labels.len() && points.len() == truths.len());
    let mut errors = Vec::new();
    for ((name, points), ((_, labels), (_, truth))) in points.iter().zip(labels.iter().zip(&truths)) {
        let (shape, truth) = scene::npy::read_f32(truth).unwrap();
        assert!(points.len() == 16 * shape[0] && labels.len() == 4 * shape[0] && shape[1] == 7, "{name:?}");
        for (point, truth) in points.chunks(16).zip(truth.chunks(7)) {
            let number = |i: usize| f32::from_le_bytes(point[4 * i..4 * i + 4].try_into().unwrap());
            let range = DVec3::new(number(0).into(), number(1).into(), number(2).into()).length();
            errors.push((range - f64::from(truth[3])).abs());
        }
        let row = name.file_stem().unwrap().to_string_lossy().into_owned();
        assert!(all.keys().any(
            |image| image.starts_with("images") && image.to_string_lossy().ends_with(&format!("{}.png", &row[6..]))
        ));
    }
    errors.sort_by(f64::total_cmp);
    let median = errors[errors.len() / 2];
    // The median of normal errors with a standard deviation of 2 cm is 1.35 cm.
    assert!(errors.len() > 1000 && (0.012..0.015).contains(&median), "{median} of {}", errors.len());
    let radar = of("radar", ".csv");
    let columns = |line: &str| line.split(',').count();
    assert!(
        !radar.is_empty()
            && radar.iter().all(|(_, text)| {
                let text = std::str::from_utf8(text).unwrap();
                text.lines().count() > 5 && text.lines().all(|line| columns(line) == 14)
            })
    );

    let voxels = of("occupancy", ".npz");
    // 223.6 m in blocks of 64 m
    assert_eq!(voxels.len(), 16);
    let mut taken = 0;
    for (_, bytes) in voxels {
        let mut archive = zip::ZipArchive::new(std::io::Cursor::new(bytes)).unwrap();
        let mut array = |name: &str| {
            let mut bytes = Vec::new();
            std::io::Read::read_to_end(&mut archive.by_name(name).unwrap(), &mut bytes).unwrap();
            bytes
        };
        let (semantic, instance) = (array("semantic.npy"), array("instance.npy"));
        let (header, side) = (128, scene::npy::read_f32(&array("voxel.npy")).unwrap().1);
        assert_eq!((side, scene::npy::read_f32(&array("origin.npy")).unwrap().0), (vec![2.0], vec![3]));
        let text = String::from_utf8_lossy(&semantic[..header]).into_owned();
        assert!(text.contains("'|u1'") && text.contains(", 32, 32)"), "{text}");
        assert_eq!((semantic.len() - header) * 4, instance.len() - header);
        taken += semantic[header..].iter().filter(|&&class| class != city::occupancy::FREE).count();
    }
    assert!(taken > 100_000 / 8, "{taken}");
}

#[test]
fn the_gallery_shows_every_layout_label_and_fault() {
    let settings = Settings { width: 96, height: 54, ..small() };
    let last_progress = std::sync::Mutex::new((0, 0));
    let sheet = gallery(&settings, &|_, done, total| *last_progress.lock().unwrap() = (done, total)).unwrap();
    let tiles = 2 * Layout::ALL.len() + 8 + FaultKind::ALL.len();
    assert_eq!(*last_progress.lock().unwrap(), (tiles, tiles));
    assert_eq!(sheet.dimensions(), (6 * 98, tiles.div_ceil(6) as u32 * 66));
    let tile = |i: usize| {
        let (left, top) = (i as u32 % 6 * 98, i as u32 / 6 * 66 + 12);
        image::imageops::crop_imm(&sheet, left, top, 96, 54).to_image()
    };
    let differs = |a: &image::RgbImage, b: &image::RgbImage| {
        let pixels = a.pixels().zip(b.pixels());
        pixels.filter(|(a, b)| (0..3).any(|c| a[c].abs_diff(b[c]) > 3)).count() as f64 / 5184.0
    };
    let all: Vec<_> = (0..tiles).map(tile).collect();
    let clean = &all[2 * Layout::ALL.len()];
    for (i, kind) in (2 * Layout::ALL.len() + 8..).zip(FaultKind::ALL) {
        let share = differs(clean, &all[i]);
        assert!(share > 0.005, "{kind} shows in {share} of its pane");
    }
    let light = |from: u32, to: u32| {
        let drift = &all[2 * Layout::ALL.len() + 8];
        (from..to).flat_map(|x| (0..54).map(move |y| f64::from(drift.get_pixel(x, y)[1]))).sum::<f64>()
    };
    let clean_light = |from: u32, to: u32| {
        (from..to).flat_map(|x| (0..54).map(move |y| f64::from(clean.get_pixel(x, y)[1]))).sum::<f64>()
    };
    let (left, right) = (light(0, 48) / clean_light(0, 48), light(48, 96) / clean_light(48, 96));
    assert!(left > 1.1 && right < 0.9, "the exposure drifts to {left} and {right} of the bytes");
    // Every pane is drawn, and no layout appears twice.
    for (i, a) in all.iter().enumerate() {
        assert!(a.pixels().any(|p| p != a.get_pixel(0, 0)), "pane {i} is of one colour");
        let before = &all[..if i < 2 * Layout::ALL.len() { i } else { 0 }];
        assert!(before.iter().all(|b| differs(a, b) > 0.05), "pane {i} appears twice");
    }
}

/// Relative errors of a capture's target depths against the true depths of its photos, ascending.
fn depth_errors(folder: &Path, source: &Source) -> Vec<f32> {
    let store = store::Store::open("memory://").unwrap().blocking();
    let options = crate::ingest::IngestOptions { downscale: 1, threads: 2 };
    let ingested = crate::ingest::ingest(source, &store, &options, &|_, _| ()).unwrap();
    let mut errors = Vec::new();
    for view in &ingested.capture.views {
        let Some(id) = view.depth else { continue };
        let depths = DepthSamples::decode(&store.get(id).unwrap(), 192, 108).unwrap();
        let name = view.name.rsplit_once('.').unwrap().0;
        let truth = fs::read(folder.join(format!("depth/{name}.npy"))).unwrap();
        let (shape, truth) = scene::npy::read_f32(&truth).unwrap();
        assert_eq!(shape, [108, 192]);
        errors.extend(depths.iter().map(|(x, y, depth)| {
            let expected = truth[(y * 192 + x) as usize];
            if expected > 0.0 { (depth / expected - 1.0).abs() } else { f32::INFINITY }
        }));
    }
    errors.sort_by(f32::total_cmp);
    errors
}

fn share_within(errors: &[f32], most: f32) -> f64 {
    errors.partition_point(|error| *error <= most) as f64 / errors.len() as f64
}

#[test]
fn lidar_measures_the_depths_that_photos_show() {
    let settings = Settings { aerial: 0.0, width: 192, height: 108, truth: true, lidar: true, ..small() };
    let (folder, _) = written(&settings, 2);
    let source = open(folder.path(), &OpenOptions { lidar: true, ..OpenOptions::default() }).unwrap();
    assert!(!source.sweeps.is_empty() && source.sweeps.iter().all(|sweep| !sweep.views.is_empty()));
    let errors = depth_errors(folder.path(), &source);
    let [near, far] = [0.05, 0.2].map(|most| share_within(&errors, most));
    println!("{} samples, median {}, within 5 % {near}, 20 % {far}", errors.len(), errors[errors.len() / 2]);
    assert!(errors.len() > 2000 && errors[errors.len() / 2] < 0.01, "{} {}", errors.len(), errors[errors.len() / 2]);
    assert!(near > 0.9 && far > 0.95, "{near} {far}");
}

#[test]
fn a_radar_says_where_the_road_is_that_photos_show() {
    let settings =
        Settings { aerial: 0.0, width: 192, height: 108, truth: true, radar: true, spacing: Some(3.0), ..small() };
    let (folder, _) = written(&settings, 2);
    let options = OpenOptions { radar: true, ..OpenOptions::default() };
    let source = open(folder.path(), &options).unwrap();
    let without = open(folder.path(), &OpenOptions::default()).unwrap();
    assert!(source.is_measured() && !without.is_measured());
    let initial = source.capture.points.len() - without.capture.points.len();
    assert!(initial > 50 && source.seeds.len() == initial, "{initial}");
    let errors = depth_errors(folder.path(), &source);
    let [near, far] = [0.05, 0.2].map(|most| share_within(&errors, most));
    println!("{initial} points, {} samples, within 5 % {near}, 20 % {far}", errors.len());
    assert!(errors.len() > 100 && near > 0.75 && far > 0.9, "{} {near} {far}", errors.len());

    // What is missing is said in one line.
    let poses = folder.path().join("radar/poses.jsonl");
    let text = fs::read_to_string(&poses).unwrap();
    for (key, other) in [("height", "hight"), ("velocity", "speed")] {
        fs::write(&poses, text.replacen(&format!("\"{key}\""), &format!("\"{other}\""), 1)).unwrap();
        let error = open(folder.path(), &options).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains(&format!("does not have the key {key}")) && !error.contains('\n'), "{error}");
    }
    let mut fallen: serde_json::Value = serde_json::from_str(text.lines().next().unwrap()).unwrap();
    fallen["world_from_sensor"]["rotation"] = serde_json::json!([1, 0, 0, 0]);
    fs::write(&poses, fallen.to_string()).unwrap();
    let error = open(folder.path(), &options).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("does not stand upright"), "{error}");
    // One sweep spans no road, so there are no target depths.
    fs::write(&poses, text.lines().next().unwrap()).unwrap();
    let alone = open(folder.path(), &options).unwrap();
    assert!(alone.road.len() == 1 && alone.roads() == 0 && !alone.is_measured());
    fs::write(&poses, &text).unwrap();
    let sweep = fs::read_dir(folder.path().join("radar")).unwrap().map(|entry| entry.unwrap().path());
    let sweep = sweep.filter(|path| path.extension().is_some_and(|of| of == "csv")).min().unwrap();
    fs::write(&sweep, "range,azimuth,velocity\n1,x,1\n").unwrap();
    let error = open(folder.path(), &options).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("has no number in line 2, column azimuth"), "{error}");
}
