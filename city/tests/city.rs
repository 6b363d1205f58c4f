//! Laws that every city keeps: sound meshes, ground without holes or overlaps, nothing on the roads that should not be, feet
//! and wheels on the ground, distances kept.

use city::{Actor, City, CitySettings, Class, Layout, Mesh, Pattern, Traffic, Waypoint};
use glam::{DVec2, DVec3, Vec3};
use scene::Rigid;

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
fn every_corner_of_the_settings_gives_a_sound_city() {
    for &layout in Layout::ALL {
        for (seed, plain, area_km2) in [(1, 0.0, 0.05), (2, 0.8, 0.05), (3, 0.4, 0.07), (u64::MAX, 0.0, 0.11)] {
            let traffic = Traffic::ALL[(seed % 4) as usize];
            let city = generate(CitySettings { seed, plain, area_km2, layout, traffic });
            city.assets.iter().for_each(|asset| check_mesh(&city, &asset.mesh, &asset.name));
            check_actors(&city);
            assert!(city.streets.iter().all(|s| s.len() > 3 && s.iter().all(|p| p.is_finite())), "{layout} {seed}");
            assert!(!city.streets.is_empty());
        }
    }
}

fn check_mesh(city: &City, mesh: &Mesh, name: &str) {
    assert!(!mesh.triangles.is_empty(), "{name} is empty");
    assert_eq!(mesh.positions.len(), mesh.uvs.len(), "{name}");
    assert_eq!(mesh.triangles.len(), mesh.materials.len(), "{name}");
    assert_eq!(mesh.triangles.len(), mesh.classes.len(), "{name}");
    assert!(mesh.positions.iter().all(|p| p.is_finite() && p.length() < 3000.0), "{name}");
    assert!(mesh.uvs.iter().all(|p| p.is_finite()), "{name}");
    for (triangle, &material) in mesh.triangles.iter().zip(&mesh.materials) {
        let [a, b, c] = triangle.map(|i| mesh.positions[i as usize]);
        assert!((b - a).cross(c - a).length() > 1e-7, "{name}: a triangle without an area at {a}");
        if let Pattern::Text { row, .. } = city.materials[usize::from(material)].pattern {
            assert!(city.texts[row as usize].is_ascii());
            let unit = triangle
                .map(|i| mesh.uvs[i as usize])
                .iter()
                .all(|uv| uv.min_element() >= 0.0 && uv.max_element() <= 1.0);
            assert!(unit, "{name}");
        }
    }
}

fn check_actors(city: &City) {
    let mut instances = Vec::new();
    for actor in &city.actors {
        let name = &city.assets[actor.asset as usize].name;
        assert!(actor.world_from_asset.is_sane(), "{name}");
        if actor.instance > 0 {
            instances.push(actor.instance);
        }
        let Some(trajectory) = &actor.trajectory else { continue };
        let waypoints = &trajectory.waypoints;
        assert!(waypoints.iter().all(|w| w.world_from_asset.is_sane() && w.seconds.is_finite()), "{name}");
        assert!(waypoints.windows(2).all(|w| w[0].seconds < w[1].seconds), "{name}");
        assert!(waypoints[0].seconds <= 0.0 && waypoints[waypoints.len() - 1].seconds >= 600.0, "{name}");
        if actor.class == Class::Person {
            assert_eq!(trajectory.gait.len(), 16);
            assert!(trajectory.gait.iter().all(|&a| city.assets[a as usize].name.starts_with("person")));
            assert!((0.5..2.0).contains(&trajectory.gait_seconds), "{}", trajectory.gait_seconds);
        }
        let speed = |w: &[Waypoint]| {
            w[0].world_from_asset.translation.distance(w[1].world_from_asset.translation)
                / (w[1].seconds - w[0].seconds)
        };
        assert!(waypoints.windows(2).all(|w| speed(w) < 14.0), "{name} races");
    }
    let count = instances.len();
    instances.sort_unstable();
    instances.dedup();
    assert!(count > 50 && instances.len() == count && instances[0] == 1, "instances are not one each");
}

/// All triangles of the ground, to be asked from above.
struct Ground {
    triangles: Vec<([DVec3; 3], Class, bool)>,
    cells: std::collections::HashMap<(i64, i64), Vec<usize>>,
}

const CELL: f64 = 8.0;

impl Ground {
    fn new(city: &City) -> Self {
        let mut ground = Self { triangles: Vec::new(), cells: std::collections::HashMap::new() };
        for actor in city.actors.iter().filter(|a| a.instance == 0) {
            let mesh = &city.assets[actor.asset as usize].mesh;
            for k in 0..mesh.triangles.len() {
                let corners =
                    mesh.triangles[k].map(|i| actor.world_from_asset.apply(mesh.positions[i as usize].as_dvec3()));
                let up = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero().z > 0.3;
                let patch = city.materials[usize::from(mesh.materials[k])].name == "asphalt, patch";
                let lies = matches!(mesh.classes[k], Class::Road | Class::Sidewalk | Class::Terrain) && !patch;
                if up && lies {
                    ground.add(corners, mesh.classes[k], actor.class == Class::Bridge);
                }
            }
        }
        ground
    }

    fn add(&mut self, corners: [DVec3; 3], class: Class, deck: bool) {
        let low = corners.iter().fold(DVec3::MAX, |a, &b| a.min(b)) / CELL;
        let high = corners.iter().fold(DVec3::MIN, |a, &b| a.max(b)) / CELL;
        for x in low.x.floor() as i64..=high.x.floor() as i64 {
            for y in low.y.floor() as i64..=high.y.floor() as i64 {
                self.cells.entry((x, y)).or_default().push(self.triangles.len());
            }
        }
        self.triangles.push((corners, class, deck));
    }

    /// Height, class and whether it is the deck of all that lies at a place; `margin` > 0 takes only what holds it well.
    fn at(&self, p: DVec2, margin: f64) -> Vec<(f64, Class, bool)> {
        let cell = ((p.x / CELL).floor() as i64, (p.y / CELL).floor() as i64);
        let mut hits = Vec::new();
        for &t in self.cells.get(&cell).into_iter().flatten() {
            let ([a, b, c], class, deck) = self.triangles[t];
            let area = (b - a).truncate().perp_dot((c - a).truncate());
            let weight = |q: DVec3, r: DVec3| (q.truncate() - p).perp_dot(r.truncate() - p) / area;
            let weights = [weight(b, c), weight(c, a), weight(a, b)];
            if weights.iter().all(|&w| w >= margin) {
                hits.push((weights[0] * a.z + weights[1] * b.z + weights[2] * c.z, class, deck));
            }
        }
        hits
    }
}

#[test]
fn the_ground_has_neither_holes_nor_overlaps() {
    for &layout in Layout::ALL {
        for (seed, plain) in [(1, 0.0), (5, 0.5)] {
            let city = generate(CitySettings { seed, plain, area_km2: 0.09, ..settings(layout) });
            let ground = Ground::new(&city);
            let mut random = city::random::Random::new(seed);
            for _ in 0..6000 {
                let half = 0.55 * city.extent_metres as f32;
                let p = random.between(glam::Vec2::splat(-half), glam::Vec2::splat(half)).as_dvec2();
                let hits: Vec<_> = ground.at(p, -1e-4).into_iter().filter(|h| !h.2).collect();
                assert!(!hits.is_empty(), "{layout}: a hole at {p}");
                let sure: Vec<_> = ground.at(p, 1e-3).into_iter().filter(|h| !h.2).collect();
                assert!(sure.len() < 2, "{layout}: {} layers at {p}: {sure:?}", sure.len());
            }
        }
    }
}

/// A house's or vehicle's rectangle on the ground, from its corners up to a height.
struct Rectangle {
    low: Vec3,
    high: Vec3,
    pose: Rigid,
}

impl Rectangle {
    fn new(city: &City, actor: &Actor, pose: Rigid, below: f32) -> Self {
        let mesh = &city.assets[actor.asset as usize].mesh;
        let corners = mesh.positions.iter().filter(|p| p.z < below);
        let (low, high) = corners.fold((Vec3::MAX, Vec3::MIN), |(a, b), &p| (a.min(p), b.max(p)));
        Self { low, high, pose }
    }

    /// Points along its outline.
    fn outline(&self) -> Vec<DVec3> {
        let corners = [
            (self.low.x, self.low.y),
            (self.high.x, self.low.y),
            (self.high.x, self.high.y),
            (self.low.x, self.high.y),
        ];
        let corners = corners.map(|(x, y)| Vec3::new(x, y, 0.0));
        let along = |k: usize| (0..8).map(move |t| corners[k].lerp(corners[(k + 1) % 4], t as f32 / 8.0));
        (0..4).flat_map(along).map(|p| self.pose.apply(p.as_dvec3())).collect()
    }

    /// Whether it holds a place, by more than `margin`.
    fn holds(&self, p: DVec3, margin: f32) -> bool {
        let local = self.pose.inverse().apply(p).as_vec3();
        let inside = |low: f32, high: f32, x: f32| x > low + margin && x < high - margin;
        inside(self.low.x, self.high.x, local.x) && inside(self.low.y, self.high.y, local.y)
    }

    fn meets(&self, other: &Self) -> bool {
        let near = self.pose.translation.distance(other.pose.translation) < 14.0;
        near && (self.outline().iter().any(|&p| other.holds(p, 0.0))
            || other.outline().iter().any(|&p| self.holds(p, 0.0)))
    }
}

fn houses(city: &City) -> Vec<Rectangle> {
    let houses = city.actors.iter().filter(|a| a.class == Class::Building && a.instance > 0);
    houses.map(|a| Rectangle::new(city, a, a.world_from_asset, 2.0)).collect()
}

fn is_vehicle(class: Class) -> bool {
    matches!(class, Class::Car | Class::Truck | Class::Bus | Class::Motorcycle | Class::Bicycle)
}

/// Where an actor is at a moment.
fn pose_at(actor: &Actor, seconds: f64) -> Rigid {
    let Some(trajectory) = &actor.trajectory else { return actor.world_from_asset };
    let waypoints = &trajectory.waypoints;
    let k = waypoints.partition_point(|w| w.seconds <= seconds).clamp(1, waypoints.len() - 1);
    let (a, b) = (&waypoints[k - 1], &waypoints[k]);
    let t = ((seconds - a.seconds) / (b.seconds - a.seconds)).clamp(0.0, 1.0);
    Rigid {
        rotation: a.world_from_asset.rotation.slerp(b.world_from_asset.rotation, t),
        translation: a.world_from_asset.translation.lerp(b.world_from_asset.translation, t),
    }
}

#[test]
fn houses_stand_behind_the_pavement() {
    for &layout in Layout::ALL {
        let city = generate(CitySettings { area_km2: 0.12, ..settings(layout) });
        let ground = Ground::new(&city);
        let houses = houses(&city);
        assert!(houses.len() > 20, "{layout}: {} houses", houses.len());
        for house in &houses {
            for p in house.outline() {
                let road = ground.at(p.truncate(), 0.0).into_iter().find(|hit| hit.1 == Class::Road);
                assert!(road.is_none(), "{layout}: a house on a road at {p}");
                // a plinth goes down four metres
                let below = ground.at(p.truncate(), 0.0).iter().map(|hit| hit.0).fold(f64::INFINITY, f64::min);
                assert!(p.z - below < 4.0, "{layout}: a house floats {} m above the ground at {p}", p.z - below);
            }
        }
    }
}

#[test]
fn feet_and_wheels_are_on_the_ground_and_out_of_houses() {
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
fn vehicles_never_meet_and_keep_off_the_free_lanes() {
    for &layout in Layout::ALL {
        let city = generate(CitySettings { area_km2: 0.15, seed: 9, ..settings(layout) });
        let vehicles: Vec<_> = city.actors.iter().filter(|a| is_vehicle(a.class)).collect();
        let moving = vehicles.iter().filter(|a| a.trajectory.is_some()).count();
        assert!(moving > 10, "{layout}: {moving}");
        for seconds in [0.0, 17.3, 111.1, 480.0] {
            let at: Vec<Rectangle> =
                vehicles.iter().map(|a| Rectangle::new(&city, a, pose_at(a, seconds), f32::INFINITY)).collect();
            for (k, one) in at.iter().enumerate() {
                for (j, other) in at.iter().enumerate().take(k) {
                    let apart = (one.pose.translation.z - other.pose.translation.z).abs() > 4.0;
                    assert!(
                        apart || !one.meets(other),
                        "{layout}: {} meets {} at {} after {seconds} s ({} {})",
                        city.assets[vehicles[k].asset as usize].name,
                        city.assets[vehicles[j].asset as usize].name,
                        one.pose.translation,
                        vehicles[k].trajectory.is_some(),
                        vehicles[j].trajectory.is_some(),
                    );
                }
                let near = |p: &DVec3| p.distance(one.pose.translation) < 1.2;
                let free = vehicles[k].trajectory.is_none() || !city.streets.iter().flatten().any(near);
                assert!(free, "{layout}: traffic in a free lane at {}", one.pose.translation);
            }
        }
    }
}

#[test]
fn traffic_grows_by_level_and_parked_vehicles_stay() {
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
fn each_layout_has_what_its_name_says() {
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
