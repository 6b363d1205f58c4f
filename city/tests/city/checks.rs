//! Checks that hold for every generated city, and queries of its ground and of actors' outlines.

use city::{Actor, City, Class, Mesh, Pattern, Waypoint};
use glam::{DVec2, DVec3, Vec3};
use scene::Rigid;

pub(super) fn check_mesh(city: &City, mesh: &Mesh, name: &str) {
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
            let is_unit = triangle
                .map(|i| mesh.uvs[i as usize])
                .iter()
                .all(|uv| uv.min_element() >= 0.0 && uv.max_element() <= 1.0);
            assert!(is_unit, "{name}");
        }
    }
}

pub(super) fn check_actors(city: &City, min_instances: usize) {
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
    assert!(count > min_instances, "{count} instances");
    assert!(instances.len() == count && instances[0] == 1, "instance numbers are not unique");
}

/// All triangles of the ground, for vertical queries.
pub(super) struct Ground {
    triangles: Vec<([DVec3; 3], Class, bool)>,
    cells: std::collections::HashMap<(i64, i64), Vec<usize>>,
}

pub(super) const CELL: f64 = 8.0;

impl Ground {
    pub(super) fn new(city: &City) -> Self {
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

    pub(super) fn add(&mut self, corners: [DVec3; 3], class: Class, deck: bool) {
        let low = corners.iter().fold(DVec3::MAX, |a, &b| a.min(b)) / CELL;
        let high = corners.iter().fold(DVec3::MIN, |a, &b| a.max(b)) / CELL;
        for x in low.x.floor() as i64..=high.x.floor() as i64 {
            for y in low.y.floor() as i64..=high.y.floor() as i64 {
                self.cells.entry((x, y)).or_default().push(self.triangles.len());
            }
        }
        self.triangles.push((corners, class, deck));
    }

    /// Height, class and deck flag of all ground triangles at a point; `margin` > 0 excludes points near a triangle's
    /// edge.
    pub(super) fn at(&self, p: DVec2, margin: f64) -> Vec<(f64, Class, bool)> {
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

/// The bounding rectangle of a house or vehicle, from its corners below a height.
pub(super) struct Rectangle {
    low: Vec3,
    high: Vec3,
    pub(super) pose: Rigid,
}

impl Rectangle {
    pub(super) fn new(city: &City, actor: &Actor, pose: Rigid, below: f32) -> Self {
        let mesh = &city.assets[actor.asset as usize].mesh;
        let corners = mesh.positions.iter().filter(|p| p.z < below);
        let (low, high) = corners.fold((Vec3::MAX, Vec3::MIN), |(a, b), &p| (a.min(p), b.max(p)));
        Self { low, high, pose }
    }

    /// Points along the outline.
    pub(super) fn outline(&self) -> Vec<DVec3> {
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

    /// Whether the rectangle, shrunk by `margin`, contains a point.
    pub(super) fn holds(&self, p: DVec3, margin: f32) -> bool {
        let local = self.pose.inverse().apply(p).as_vec3();
        let inside = |low: f32, high: f32, x: f32| x > low + margin && x < high - margin;
        inside(self.low.x, self.high.x, local.x) && inside(self.low.y, self.high.y, local.y)
    }

    pub(super) fn meets(&self, other: &Self) -> bool {
        let near = self.pose.translation.distance(other.pose.translation) < 14.0;
        near && (self.outline().iter().any(|&p| other.holds(p, 0.0))
            || other.outline().iter().any(|&p| self.holds(p, 0.0)))
    }
}

pub(super) fn houses(city: &City) -> Vec<Rectangle> {
    let houses = city.actors.iter().filter(|a| a.class == Class::Building && a.instance > 0);
    houses.map(|a| Rectangle::new(city, a, a.world_from_asset, 2.0)).collect()
}

pub(super) fn is_vehicle(class: Class) -> bool {
    matches!(class, Class::Car | Class::Truck | Class::Bus | Class::Motorcycle | Class::Bicycle)
}

/// The pose of an actor at a time.
pub(super) fn pose_at(actor: &Actor, seconds: f64) -> Rigid {
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

pub(super) fn check_houses(city: &City, name: &str) {
    let ground = Ground::new(city);
    for p in houses(city).iter().flat_map(Rectangle::outline) {
        let hits = ground.at(p.truncate(), 0.0);
        assert!(hits.iter().all(|hit| hit.1 != Class::Road), "{name}: a house on a road at {p}");
        // a plinth goes down four metres
        let below = hits.iter().map(|hit| hit.0).fold(f64::INFINITY, f64::min);
        assert!(p.z - below < 4.0, "{name}: a house floats {} m above the ground at {p}", p.z - below);
    }
}

/// Checks that there are more than `min_moving` moving vehicles, that no two vehicles overlap, and that the free lanes
/// have no traffic.
pub(super) fn check_vehicles(city: &City, min_moving: usize, layout: &str) {
    let vehicles: Vec<_> = city.actors.iter().filter(|a| is_vehicle(a.class)).collect();
    let moving = vehicles.iter().filter(|a| a.trajectory.is_some()).count();
    assert!(moving > min_moving, "{layout}: {moving}");
    for seconds in [0.0, 17.3, 111.1, 480.0] {
        let at: Vec<Rectangle> =
            vehicles.iter().map(|a| Rectangle::new(city, a, pose_at(a, seconds), f32::INFINITY)).collect();
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
