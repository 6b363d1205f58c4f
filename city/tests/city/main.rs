//! Invariants of generated cities: valid meshes, ground without holes or overlaps, houses clear of roads, actors on the
//! ground, vehicles apart from each other.

mod checks;

use city::{Actor, City, CitySettings, Class, Layout, Traffic};
use glam::DVec3;
use scene::Rigid;

use checks::{Ground, check_actors, check_houses, check_mesh, check_vehicles, houses, is_vehicle, pose_at};

fn settings(layout: Layout) -> CitySettings {
    CitySettings { layout, traffic: Traffic::Heavy, ..CitySettings::default() }
}

fn generate(settings: CitySettings) -> City {
    City::generate(&settings).unwrap()
}

/// A hash of every number of a city.
fn fingerprint(city: &City) -> u64 {
    let mut hash = 0;
    let mut add = |bits: u64| hash = city::random::bits(hash, bits);
    let pose = |pose: &Rigid, add: &mut dyn FnMut(u64)| {
        pose.rotation.to_array().iter().chain(&pose.translation.to_array()).for_each(|x| add(x.to_bits()));
    };
    for mesh in city.assets.iter().map(|a| &a.mesh) {
        mesh.positions.iter().flat_map(|p| p.to_array()).for_each(|x| add(x.to_bits().into()));
        mesh.uvs.iter().flat_map(|p| p.to_array()).for_each(|x| add(x.to_bits().into()));
        mesh.triangles.iter().flatten().for_each(|&i| add(i.into()));
        mesh.materials.iter().for_each(|&i| add(i.into()));
        mesh.classes.iter().for_each(|&c| add(c as u64));
    }
    for actor in &city.actors {
        [u64::from(actor.asset), actor.class as u64, actor.instance.into()].into_iter().for_each(&mut add);
        pose(&actor.world_from_asset, &mut add);
        for waypoint in actor.trajectory.iter().flat_map(|t| &t.waypoints) {
            add(waypoint.seconds.to_bits());
            pose(&waypoint.world_from_asset, &mut add);
        }
    }
    city.streets.iter().flatten().flat_map(|p| p.to_array()).for_each(|x| add(x.to_bits()));
    hash
}

#[test]
fn the_same_settings_give_the_same_city_with_any_number_of_threads() {
    let with = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| fingerprint(&generate(CitySettings { seed, ..settings(Layout::Mixed) })))
    };
    assert_eq!(with(1, 7), with(2, 7));
    assert_eq!(with(1, 7), with(5, 7));
    assert_ne!(with(2, 7), with(2, 8));
}

#[test]
fn extreme_settings_give_a_valid_city() {
    for &layout in Layout::ALL {
        for (seed, plain, area_km2) in [(1, 0.0, 0.05), (2, 0.8, 0.05), (3, 0.4, 0.07), (u64::MAX, 0.0, 0.11)] {
            let traffic = Traffic::ALL[(seed % 4) as usize];
            let city = generate(CitySettings { seed, plain, area_km2, layout, traffic });
            city.assets.iter().for_each(|asset| check_mesh(&city, &asset.mesh, &asset.name));
            check_actors(&city, 50);
            assert!(city.streets.iter().all(|s| s.len() > 3 && s.iter().all(|p| p.is_finite())), "{layout} {seed}");
            assert!(!city.streets.is_empty());
        }
    }
}

#[test]
fn the_ground_has_neither_holes_nor_overlaps() {
    for &layout in Layout::ALL {
        for (seed, plain, area_km2) in [(1, 0.0, 0.09), (5, 0.5, 0.09), (1, 0.0, 0.005), (5, 0.3, 0.01), (6, 0.0, 0.02)]
        {
            let city = generate(CitySettings { seed, plain, area_km2, ..settings(layout) });
            let ground = Ground::new(&city);
            let mut random = city::random::Random::new(seed);
            for _ in 0..6000 {
                let half = 0.55 * city.extent_metres as f32;
                let p = random.between(glam::Vec2::splat(-half), glam::Vec2::splat(half)).as_dvec2();
                let hits: Vec<_> = ground.at(p, -1e-4).into_iter().filter(|h| !h.2).collect();
                assert!(!hits.is_empty(), "{layout} {area_km2} km²: a hole at {p}");
                let sure: Vec<_> = ground.at(p, 1e-3).into_iter().filter(|h| !h.2).collect();
                assert!(sure.len() < 2, "{layout} {area_km2} km²: {} layers at {p}: {sure:?}", sure.len());
            }
        }
    }
}

#[test]
fn houses_are_clear_of_roads_and_on_the_ground() {
    for &layout in Layout::ALL {
        let city = generate(CitySettings { area_km2: 0.12, ..settings(layout) });
        assert!(houses(&city).len() > 20, "{layout}: {} houses", houses(&city).len());
        check_houses(&city, &layout.to_string());
    }
}

#[test]
fn people_and_vehicles_are_on_the_ground_and_outside_houses() {
    for &layout in Layout::ALL {
        let city = generate(CitySettings { area_km2: 0.09, seed: 4, ..settings(layout) });
        let (ground, houses) = (Ground::new(&city), houses(&city));
        let mut checked = [0, 0];
        for actor in &city.actors {
            let walks = actor.class == Class::Person;
            if !walks && !is_vehicle(actor.class) {
                continue;
            }
            let mesh = &city.assets[actor.asset as usize].mesh;
            let lowest = mesh.positions.iter().fold(f32::INFINITY, |z, p| z.min(p.z));
            assert!(lowest.abs() < 0.02, "{} hovers at {lowest}", city.assets[actor.asset as usize].name);
            let moments: &[f64] = if actor.trajectory.is_some() { &[0.0, 3.7, 41.0, 333.3, 599.0] } else { &[0.0] };
            for &seconds in moments {
                let pose = pose_at(actor, seconds);
                let at = pose.translation;
                let gap = ground
                    .at(at.truncate(), -1e-4)
                    .iter()
                    .map(|hit| (hit.0 - at.z).abs())
                    .fold(f64::INFINITY, f64::min);
                assert!(
                    gap < 0.04,
                    "{layout}: {} is {gap} m off the ground at {at}",
                    city.assets[actor.asset as usize].name
                );
                assert!(!houses.iter().any(|h| h.holds(at, -0.1)), "{layout}: somebody in a house at {at}");
                checked[usize::from(walks)] += 1;
            }
        }
        assert!(checked[0] > 100 && checked[1] > 50, "{layout}: {checked:?}");
    }
}

#[test]
fn vehicles_never_overlap_and_stay_off_the_free_lanes() {
    for &layout in Layout::ALL {
        let city = generate(CitySettings { area_km2: 0.15, seed: 9, ..settings(layout) });
        check_vehicles(&city, 10, &layout.to_string());
    }
}

#[test]
fn traffic_grows_by_level_and_parked_vehicles_are_the_same() {
    let count = |traffic: Traffic| {
        let city = generate(CitySettings { traffic, area_km2: 0.2, layout: Layout::Grid, ..CitySettings::default() });
        let parked = city.actors.iter().filter(|a| is_vehicle(a.class) && a.trajectory.is_none()).count();
        let drive = city.actors.iter().filter(|a| is_vehicle(a.class) && a.trajectory.is_some()).count();
        let walk = city.actors.iter().filter(|a| a.class == Class::Person).count();
        (parked, drive, walk)
    };
    let levels: Vec<_> = Traffic::ALL.iter().map(|&t| count(t)).collect();
    assert!(levels[0].0 > 50 && levels.iter().all(|l| l.0 == levels[0].0), "{levels:?}");
    assert_eq!((levels[0].1, levels[0].2), (0, 0));
    assert!(levels.windows(2).all(|w| w[0].1 < w[1].1 && w[0].2 < w[1].2), "{levels:?}");
}

#[test]
fn each_layout_has_its_characteristic_features() {
    let city = |layout| generate(CitySettings { area_km2: 0.2, ..settings(layout) });
    let has = |city: &City, class: Class| city.assets.iter().any(|a| a.mesh.classes.contains(&class));
    let steepest = |city: &City| {
        let slopes = city.streets.iter().flat_map(|s| s.windows(2)).map(|w| w[1] - w[0]);
        slopes.map(|d| d.z.abs() / d.truncate().length()).fold(0.0, f64::max)
    };
    let turning = |city: &City| {
        let street = &city.streets[0];
        let turn = |w: &[DVec3]| (w[1] - w[0]).truncate().angle_to((w[2] - w[1]).truncate()).abs();
        street.windows(3).map(turn).filter(|t| *t < 0.2).sum::<f64>()
    };
    let (grid, corridor, alley) = (city(Layout::Grid), city(Layout::CurvedCorridor), city(Layout::Alley));
    let (winding, deck, mixed) = (city(Layout::Winding), city(Layout::Deck), city(Layout::Mixed));
    assert!(turning(&corridor) > turning(&grid) + 2.0, "{} {}", turning(&corridor), turning(&grid));
    assert!(turning(&winding) > turning(&grid) + 2.0);
    assert!(steepest(&winding) > 0.06, "{}", steepest(&winding));
    let cobbled = |city: &City| {
        let row = city.materials.iter().position(|m| m.name == "cobbles").unwrap() as u16;
        city.assets.iter().any(|a| a.mesh.materials.contains(&row))
    };
    assert!(cobbled(&alley) && cobbled(&mixed) && !cobbled(&grid));
    for bridged in [&deck, &mixed] {
        assert!(has(bridged, Class::GuardRail) && has(bridged, Class::Bridge));
        let ground = Ground::new(bridged);
        let below = |p: &DVec3| ground.at(p.truncate(), 0.0).iter().map(|hit| p.z - hit.0).fold(0.0, f64::max);
        let high = bridged.streets.iter().flatten().map(below).fold(0.0, f64::max);
        assert!(high > 4.5, "no lane on the deck: {high}");
    }
    assert!(!has(&grid, Class::Bridge) || !has(&alley, Class::GuardRail));
}

#[test]
fn compact_cities_of_every_layout_are_complete() {
    for &layout in Layout::ALL {
        for (area_km2, min_houses) in [(0.005, 4), (0.01, 8), (0.02, 16)] {
            for seed in 1..9 {
                let name = format!("{layout} {area_km2} km², seed {seed}");
                let city = generate(CitySettings { seed, area_km2, layout, ..CitySettings::default() });
                city.assets.iter().for_each(|asset| check_mesh(&city, &asset.mesh, &asset.name));
                check_actors(&city, 20);
                let count = |is: &dyn Fn(&Actor) -> bool| city.actors.iter().filter(|a| is(a)).count();
                assert!(count(&|a| a.class == Class::Road) >= 4, "{name}: no roads");
                assert!(houses(&city).len() >= min_houses, "{name}: {} houses", houses(&city).len());
                assert!(count(&|a| a.class == Class::Person) > 0, "{name}: no pedestrians");
                check_houses(&city, &name);
                check_vehicles(&city, 0, &name);
            }
        }
    }
}

#[test]
fn light_traffic_drives_in_compact_cities_and_no_traffic_stands_still() {
    let moving = |layout, traffic, seed| {
        let city = generate(CitySettings { area_km2: 0.005, layout, traffic, seed, ..CitySettings::default() });
        city.actors.iter().filter(|a| a.trajectory.is_some() && is_vehicle(a.class)).count()
    };
    for &layout in Layout::ALL {
        assert!((1..9).all(|seed| moving(layout, Traffic::Light, seed) > 0), "{layout}");
        assert_eq!(moving(layout, Traffic::None, 1), 0, "{layout}");
    }
}

#[test]
fn camera_cars_drive_every_road_of_a_compact_city() {
    use city::sense::{rig, survey};
    for &layout in Layout::ALL {
        for area_km2 in [0.005, 0.01, 0.02] {
            let city = generate(CitySettings { area_km2, layout, ..CitySettings::default() });
            let name = format!("{layout} {area_km2} km²");
            let car = rig::Rig { width: 64, height: 32, ..rig::Rig::default() };
            let legs = rig::legs(&city, &car).unwrap();
            assert!(legs.len() >= 2 && legs.iter().all(|leg| leg.len() > 1), "{name}: {} legs", legs.len());
            let metres: f64 = legs.iter().map(|leg| leg.len() as f64 * car.spacing_metres).sum();
            assert!(metres > 6.0 * 0.8 * city.extent_metres, "{name}: {metres} m");
            assert!(!rig::drive(&city, &car).unwrap().is_empty());
            assert!(!survey::survey(&city, &survey::Survey::default()).unwrap().is_empty());
            // the origin of a road mesh is its crossing
            let driven: Vec<DVec3> = legs.iter().flatten().map(|w| w.world_from_asset.translation).collect();
            for road in city.actors.iter().filter(|a| a.class == Class::Road) {
                let near = driven.iter().any(|p| p.distance(road.world_from_asset.translation) < 12.0);
                assert!(near, "{name}: no leg passes {}", road.world_from_asset.translation);
            }
        }
    }
}
