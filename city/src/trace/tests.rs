use glam::{DVec2, DVec3, Vec3, vec3};
use scene::Camera;

use super::{frame::NO_SURFACE, *};
use crate::{
    City, CitySettings, Class,
    faults::{self, Fault, FaultKind},
    random::Random,
    sense::{Motion, Shot, camera_towards, pinhole},
    test_scene,
};

fn camera(centre: DVec3, target: DVec3, side: u32) -> Camera {
    camera_towards(pinhole(side, side, 80.0).unwrap(), centre, target - centre, DVec3::Y)
}

fn shot(centre: DVec3, target: DVec3, seconds: f64) -> Shot {
    Shot::new("shot".into(), "test", seconds, camera(centre, target, 96))
}

fn take(shot: &Shot, faults: &[Fault]) -> Frame {
    let city = test_scene::city();
    let world = World::new(&city).unwrap();
    render_frame(&world, shot, &RenderOptions { faults: faults.to_vec(), ..RenderOptions::default() }).unwrap()
}

#[test]
fn rays_hit_boxes_at_the_computed_distance() {
    let city = test_scene::city();
    let world = World::new(&city).unwrap();
    let moment = world.at(0.0);
    let cast = |from: Vec3, to: Vec3| {
        let ray = Ray::new(from, (to - from).normalize());
        moment.cast(&ray, RayMask::All).map(|hit| (hit, ray))
    };
    let (wall, ray) = cast(vec3(0.0, 12.0, 6.0), vec3(14.0, 12.0, 6.0)).unwrap();
    assert!((wall.distance - 14.0).abs() < 1e-4 && wall.normal == -Vec3::X && moment.actor(&wall).instance == 1);
    assert!(ray.at(wall.distance).distance(vec3(14.0, 12.0, 6.0)) < 1e-4);
    // obliquely onto the roof: from 5 m over it, 12 m aside
    let (roof, _) = cast(vec3(19.0, 0.0, 14.0), vec3(19.0, 12.0, 9.0)).unwrap();
    assert!((roof.distance - 13.0).abs() < 1e-4 && roof.normal == Vec3::Z);
    assert!(cast(vec3(0.0, 0.0, 5.0), vec3(0.0, 0.0, 9.0)).is_none());
    // along an axis, for both signs of zero
    for direction in [-Vec3::Z, vec3(0.0, 0.0, -1.0), vec3(-0.0, 0.0, -1.0)] {
        let ray = Ray::new(vec3(20.5, 12.25, 14.0), direction);
        let hit = moment.cast(&ray, RayMask::All);
        assert!(hit.is_some_and(|hit| (hit.distance - 5.0).abs() < 1e-4), "{direction}");
        assert!(moment.is_occluded(&ray));
    }
    // the van at its start, and three seconds later
    let at = |seconds: f64| {
        let ray = Ray::new(vec3(-50.0, -2.0, 1.0), Vec3::X);
        world.at(seconds).cast(&ray, RayMask::All).unwrap().distance
    };
    assert!((at(0.0) - 17.75).abs() < 1e-4 && (at(3.0) - 47.75).abs() < 1e-4 && (at(100.0) - 77.75).abs() < 1e-4);
}

#[test]
fn every_instruction_set_gives_the_same_hits() {
    let city = City::generate(&CitySettings { area_km2: 0.05, ..CitySettings::default() }).unwrap();
    let world = World::new(&city).unwrap();
    let moment = world.at(3.0);
    let mut random = Random::new(5);
    let mut met = 0;
    for i in 0..20_000 {
        let origin = vec3(random.range(-120.0, 120.0), random.range(-120.0, 120.0), random.range(0.5, 60.0));
        let direction = vec3(random.normal(), random.normal(), random.normal() - 0.5).normalize_or(Vec3::Z);
        let ray = Ray { t_max: if i % 3 == 0 { 4.0 } else { f32::INFINITY }, ..Ray::new(origin, direction) };
        let hit = moment.cast(&ray, RayMask::Opaque);
        assert_eq!(hit, moment.cast_by::<traversal::Portable>(&ray, RayMask::Opaque), "{ray:?}");
        let blocked = moment.is_occluded(&ray);
        assert_eq!(blocked, moment.is_occluded_by::<traversal::Portable>(&ray), "{ray:?}");
        assert_eq!(blocked, hit.is_some(), "{ray:?}");
        met += u32::from(blocked);
    }
    assert!((5_000..19_000).contains(&met), "{met}");
}

#[test]
fn no_ray_passes_between_two_triangles() {
    let city = test_scene::city();
    let world = World::new(&city).unwrap();
    let moment = world.at(0.0);
    // along the diagonal that splits the ground, and around an edge of the house
    for i in 0..20_000 {
        let d = i as f32 * 0.0031 - 31.0;
        let ray = Ray::new(vec3(d * 0.5, d * 0.4, 30.0), (vec3(d, d, 0.0) - vec3(d * 0.5, d * 0.4, 30.0)).normalize());
        assert!(moment.is_occluded(&ray), "{d}");
    }
}

#[test]
fn depth_of_one_view_reprojects_into_another() {
    let (a, b) = (DVec3::new(-6.0, -9.0, 3.0), DVec3::new(-2.0, -8.0, 4.0));
    let (target, there) = (DVec3::new(6.0, 10.0, 2.0), shot(b, DVec3::new(6.0, 10.0, 2.0), 100.0));
    let first = take(&shot(a, target, 100.0), &[]);
    let city = test_scene::city();
    let world = World::new(&city).unwrap();
    let moment = world.at(100.0);
    let from = camera(a, target, 96);
    let (world_from_camera, k) = (from.camera_from_world.inverse(), from.pinhole);
    let mut errors = Vec::new();
    for (i, &depth) in first.first.depth.iter().enumerate().filter(|(_, d)| **d > 0.0) {
        let pixel = DVec2::new((i % 96) as f64 + 0.5, (i / 96) as f64 + 0.5);
        let local = DVec3::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy, 1.0) * f64::from(depth);
        let point = world_from_camera.apply(local);
        let (seen, far) = there.camera.project(point);
        if far <= 0.0 {
            continue;
        }
        // what the other view sees there is either nearer (hidden) or the same point, back in its own pixel
        let towards = (point - b).as_vec3();
        let ray = Ray::new(b.as_vec3(), towards.normalize());
        let hit = moment.cast(&ray, RayMask::All).expect("something is there");
        if (hit.distance - towards.length()).abs() < 0.02 {
            let met = ray.at(hit.distance).as_dvec3();
            errors.push(there.camera.project(met).0.distance(seen) + from.project(met).0.distance(pixel));
        }
    }
    errors.sort_by(f64::total_cmp);
    assert!(errors.len() > 3000, "{}", errors.len());
    assert!(errors[errors.len() / 2] < 0.01, "{}", errors[errors.len() / 2]);
}

#[test]
fn glass_has_two_depths() {
    let seen = take(&shot(DVec3::new(0.0, 2.0, 1.5), DVec3::new(0.0, 12.0, 1.5), 100.0), &[]);
    let middle = 48 * 96 + 48;
    assert!((seen.first.depth[middle] - 8.0).abs() < 1e-3 && (seen.behind.depth[middle] - 10.0).abs() < 1e-3);
    assert_eq!((seen.first.instance[middle], seen.behind.instance[middle]), (3, 2));
    assert_eq!((seen.first.material[middle], seen.behind.material[middle]), (test_scene::GLASS, test_scene::PLASTER));
    assert_eq!((seen.first.semantic[middle], seen.behind.semantic[middle]), (Class::Building as u8, Class::Wall as u8));
    // the wall beside the pane has no second layer, the sky no depth
    let sky = 5 * 96 + 48;
    assert_eq!(
        (seen.first.semantic[sky], seen.first.depth[sky], seen.behind.semantic[sky]),
        (Class::Sky as u8, 0.0, NO_SURFACE)
    );
    assert_eq!(seen.normals[middle], [0.0, -1.0, 0.0]);
}

#[test]
fn shadows_fall_away_from_the_sun() {
    let city = test_scene::city();
    let world = World::new(&city).unwrap();
    let moment = world.at(100.0);
    let light = Light { road_pattern: 0.0, ..Light::default() };
    let brightness = |at: Vec3| {
        let ray = Ray::new(at + Vec3::Z * 20.0, Vec3::NEG_Z);
        let radiance = shade::Shader { moment: &moment, light: &light, spread: 1e-3 }.radiance(&ray);
        (radiance.direct + radiance.ambient).element_sum()
    };
    // the pole's tip at 5 m is over (8, 4); its shadow ends 5 m × cot of the sun's height away from it
    let sun = light.towards_sun;
    let tip = vec3(8.0, 4.0, 0.0) - 5.0 * (sun / sun.z).with_z(0.0);
    let inside = vec3(8.0, 4.0, 0.0).lerp(tip, 0.95);
    let beyond = vec3(8.0, 4.0, 0.0).lerp(tip, 1.1);
    assert!(brightness(inside) < 0.5 * brightness(beyond), "{} {}", brightness(inside), brightness(beyond));
    // glass throws none
    let under = vec3(0.0, 10.0, 0.0) - 1.5 * (sun / sun.z).with_z(0.0);
    assert!((brightness(under) - brightness(beyond)).abs() < 1e-3);
}

#[test]
fn ambient_occlusion_darkens_only_near_occluders() {
    let shot = shot(DVec3::new(10.0, 0.0, 2.0), DVec3::new(14.0, 12.0, 0.0), 100.0);
    let city = test_scene::city();
    let world = World::new(&city).unwrap();
    let with = |corners| render_frame(&world, &shot, &RenderOptions { corners, ..RenderOptions::default() }).unwrap();
    let (dark, open) = (with(true), with(false));
    let pairs = || dark.rgb.iter().zip(&open.rgb);
    assert!(pairs().all(|(a, b)| a <= b) && pairs().filter(|(a, b)| a < b).count() > 1000);
    let sky: Vec<usize> = (0..96 * 96).filter(|&i| dark.first.semantic[i] == Class::Sky as u8).collect();
    assert!(!sky.is_empty() && sky.iter().all(|&i| dark.rgb[3 * i] == open.rgb[3 * i]));
}

#[test]
fn rolling_shutter_skews_and_motion_blur_smears() {
    let still = shot(DVec3::new(-10.0, -12.0, 2.0), DVec3::new(-10.0, 0.0, 1.0), 2.0);
    let (sharp, mut rolling, mut blurred) = (take(&still, &[]), still.clone(), still);
    let first = |frame: &Frame, row: usize| (0..96).find(|x| frame.moves[row * 96 + x] == 1);
    let rows: Vec<usize> = (0..96).filter(|&y| first(&sharp, y).is_some()).collect();
    let (top, bottom) = (rows[2], rows[rows.len() - 3]);
    assert!(first(&sharp, top).unwrap().abs_diff(first(&sharp, bottom).unwrap()) <= 1);
    // 10 m/s to the right for 0.6 s, at 10 m with 57 pixels of focal length: about 34 pixels over the whole picture
    rolling.rolling_shutter_seconds = 0.6;
    let leaning = take(&rolling, &[]);
    assert!(first(&leaning, bottom).unwrap() > first(&leaning, top).unwrap() + 1);
    blurred.shutter_seconds = 0.1;
    let smeared = take(&blurred, &[]);
    assert_eq!(sharp.first, smeared.first);
    let changed = (0..96 * 96).filter(|&i| sharp.rgb[3 * i].abs_diff(smeared.rgb[3 * i]) > 20).count();
    assert!((20..2000).contains(&changed), "{changed}");
}

#[test]
fn the_same_shot_gives_the_same_bytes_on_one_thread_and_two() {
    let city = test_scene::city();
    let world = World::new(&city).unwrap();
    let mut shot = shot(DVec3::new(-8.0, -9.0, 2.2), DVec3::new(4.0, 10.0, 1.0), 2.0);
    shot.rolling_shutter_seconds = 0.03;
    let faults = FaultKind::ALL.iter().map(|&kind| Fault { kind, strength: 0.4, seed: 9 }).collect();
    let options = RenderOptions { faults, ..RenderOptions::default() };
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| render_frame(&world, &shot, &options).unwrap())
    };
    assert_eq!(with(1), with(2));
}

#[test]
fn every_fault_changes_nothing_at_zero_and_something_at_one() {
    let city = test_scene::city();
    let world = World::new(&city).unwrap();
    let shots: Vec<Shot> = (0..40)
        .map(|i| {
            let mut shot = shot(DVec3::new(-10.0, -12.0, 2.0), DVec3::new(-8.0, 0.0, 1.0), 2.0 + f64::from(i));
            shot.name = format!("test-{i}");
            shot.motion = Motion { velocity: DVec3::new(9.0, 3.0, 0.0), spin: DVec3::ZERO };
            shot
        })
        .collect();
    for &kind in FaultKind::ALL {
        let with = |strength| {
            let options = RenderOptions { faults: vec![Fault { kind, strength, seed: 4 }], ..RenderOptions::default() };
            let degraded = faults::degrade_shots(shots.clone(), &options.faults);
            (render_frame(&world, degraded.first().unwrap_or(&shots[0]), &options).unwrap(), degraded)
        };
        let plain = render_frame(&world, &shots[0], &RenderOptions::default()).unwrap();
        let (none, unchanged) = with(0.0);
        assert!(none == plain && unchanged == shots, "{kind:?} at 0");
        let (full, degraded) = with(1.0);
        let differs = |a: &Frame, b: &Frame| a.rgb.iter().zip(&b.rgb).filter(|(a, b)| a != b).count() > 50;
        match kind {
            FaultKind::PoseNoise => {
                let off = |s: &Shot| s.reported.centre().distance(s.camera.centre());
                assert!(degraded.iter().all(|s| (0.01..3.0).contains(&off(s))) && full.rgb == plain.rgb);
            }
            FaultKind::ClockSkew => {
                let off = |s: &Shot| s.reported.centre().distance(s.camera.centre());
                assert!(degraded.iter().all(|s| off(s) > 0.01 && (off(s) - off(&degraded[0])).abs() < 1e-9));
            }
            FaultKind::WrongCalibration => {
                let first = degraded[0].reported.pinhole;
                assert!(first.fx != shots[0].reported.pinhole.fx && (first.fx / first.fy - 1.0).abs() < 1e-9);
                assert!(degraded.iter().all(|s| s.reported.pinhole == first) && full.rgb == plain.rgb);
            }
            FaultKind::SparseViews => assert!((1..12).contains(&degraded.len()), "{}", degraded.len()),
            FaultKind::SensorDropout => assert!((8..32).contains(&degraded.len()), "{}", degraded.len()),
            FaultKind::MovingUnmasked => {
                assert!(plain.mask.contains(&1) && full.mask.iter().all(|&m| m == 0) && full.moves == plain.moves);
            }
            FaultKind::ExposureDrift => {
                assert!(degraded.iter().any(|s| (s.exposure - 1.0).abs() > 0.3) && differs(&full, &plain))
            }
            _ => assert!(differs(&full, &plain) && full.first == plain.first, "{kind:?} at 1"),
        }
    }
}

#[test]
fn invalid_cities_and_shots_are_refused() {
    let broken = |change: &dyn Fn(&mut City)| {
        let mut city = test_scene::city();
        change(&mut city);
        World::new(&city).err()
    };
    assert_eq!(broken(&|c| c.assets[1].mesh.triangles[0][2] = 99), Some(WorldError::Asset(1)));
    assert_eq!(broken(&|c| c.assets[1].mesh.materials[0] = 99), Some(WorldError::Asset(1)));
    assert_eq!(broken(&|c| c.assets[2].mesh.positions[0].x = f32::NAN), Some(WorldError::Coordinate(2)));
    assert_eq!(broken(&|c| c.actors[3].asset = 99), Some(WorldError::Actor(3)));
    assert_eq!(broken(&|c| c.actors[3].world_from_asset.translation.x = f64::INFINITY), Some(WorldError::Actor(3)));
    assert_eq!(broken(&|c| c.assets.clear()), Some(WorldError::Actor(0)));
    assert_eq!(broken(&|c| (c.assets[1].mesh, c.actors[1].trajectory) = (crate::Mesh::default(), None)), None);
    assert!(World::new(&City::default()).unwrap().at(0.0).cast(&Ray::new(Vec3::ZERO, Vec3::X), RayMask::All).is_none());
    let city = test_scene::city();
    let world = World::new(&city).unwrap();
    let refused = |change: &dyn Fn(&mut Shot, &mut RenderOptions)| {
        let (mut shot, mut options) = (shot(DVec3::ZERO, DVec3::Y, 0.0), RenderOptions::default());
        change(&mut shot, &mut options);
        render_frame(&world, &shot, &options).is_err()
    };
    assert!(refused(&|s, _| s.camera.pinhole.width = u32::MAX));
    assert!(refused(&|s, _| s.camera.pinhole.fx = 0.0));
    assert!(refused(&|s, _| s.exposure = f32::NAN));
    assert!(refused(&|s, _| s.rolling_shutter_seconds = f64::INFINITY));
    assert!(refused(&|_, o| o.samples = 0));
    assert!(refused(&|_, o| o.faults.push(Fault { kind: FaultKind::Fog, strength: 2.0, seed: 0 })));
}
