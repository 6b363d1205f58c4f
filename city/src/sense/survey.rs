//! Camera shots other than from cars: aerial blocks with a given overlap (nadir, or nadir and four obliques),
//! surveillance cameras over streets, and free camera paths.

use glam::{DVec2, DVec3};
use scene::{Camera, Pinhole};
use serde::{Deserialize, Serialize};

use super::{Motion, SenseError, Shot, camera_towards, check_count, check_range, pinhole, rig::Polyline};
use crate::{
    City, Waypoint,
    random::Random,
    trace::{Moment, Ray, motion},
};

/// An aerial block in parallel flight lines.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Survey {
    /// Flight height over the mean height of the streets, metres.
    pub height_metres: f64,
    /// Overlap of consecutive nadir images of a line, 0 to 0.95.
    pub forward_overlap: f64,
    /// Overlap of adjacent lines, 0 to 0.95.
    pub side_overlap: f64,
    /// Tilt of the four oblique cameras (forward, back, left, right) off the vertical, degrees; 0 for nadir only.
    pub tilt_degrees: f64,
    /// Pixels across the flight line.
    pub width: u32,
    /// Pixels along the flight line.
    pub height: u32,
    /// Field of view across the flight line, degrees.
    pub field_degrees: f64,
    /// Flight speed, metres per second.
    pub speed: f64,
    /// City time of the first shot, seconds.
    pub start_seconds: f64,
    /// Area to cover, two opposite corners, world metres; `None` for the whole city.
    pub area: Option<[DVec2; 2]>,
    /// Exposure time, seconds.
    pub shutter_seconds: f64,
}

impl Default for Survey {
    fn default() -> Self {
        Self {
            height_metres: 120.0,
            forward_overlap: 0.8,
            side_overlap: 0.6,
            tilt_degrees: 0.0,
            width: 1600,
            height: 1200,
            field_degrees: 70.0,
            speed: 12.0,
            start_seconds: 0.0,
            area: None,
            shutter_seconds: 0.0,
        }
    }
}

impl Survey {
    /// Number of flight lines, and of stops per line; every stop has a shot per heading.
    ///
    /// # Errors
    /// [`SenseError`] for settings out of range, or more stops than [`super::MAX_READINGS`].
    pub fn stops(&self, city: &City) -> Result<[u32; 2], SenseError> {
        let lens = pinhole(self.width, self.height, self.field_degrees)?;
        let height = check_range("height_metres", self.height_metres, 5.0, 2e4)?;
        let forward = check_range("forward_overlap", self.forward_overlap, 0.0, 0.95)?;
        let side = check_range("side_overlap", self.side_overlap, 0.0, 0.95)?;
        check_range("tilt_degrees", self.tilt_degrees, 0.0, 80.0)?;
        let [low, high] = self.corners(city);
        let size = high - low;
        if !(size.min_element() >= 0.0 && size.max_element() < 1e6 && low.abs().max_element() < 1e6) {
            return Err(SenseError::Setting("area"));
        }
        // a metre on the ground is fx / height pixels
        let covered = DVec2::new(f64::from(lens.width), f64::from(lens.height)) * height / lens.fx;
        let step = covered * (DVec2::ONE - DVec2::new(side, forward));
        let stops = (size / step).ceil() + 1.0;
        check_count(stops.x * stops.y)?;
        Ok([stops.x as u32, stops.y as u32])
    }

    /// Two opposite corners of the area.
    fn corners(&self, city: &City) -> [DVec2; 2] {
        self.area.unwrap_or([-0.5, 0.5].map(|side| DVec2::splat(side * city.extent_metres)))
    }
}

/// The shots of an aerial block, line by line in alternating direction.
///
/// # Errors
/// [`SenseError`] for settings out of range, or more shots than [`super::MAX_READINGS`].
pub fn survey(city: &City, settings: &Survey) -> Result<Vec<Shot>, SenseError> {
    let lens = pinhole(settings.width, settings.height, settings.field_degrees)?;
    let [lines, stops] = settings.stops(city)?;
    let headings = if settings.tilt_degrees > 0.0 { 5.0 } else { 1.0 };
    check_count(f64::from(lines) * f64::from(stops) * headings)?;
    let (height, tilt) = (settings.height_metres, settings.tilt_degrees);
    let speed = check_range("speed", settings.speed, 0.1, 300.0)?;
    let start = check_range("start_seconds", settings.start_seconds, -1e9, 1e9)?;
    let shutter = check_range("shutter_seconds", settings.shutter_seconds, 0.0, 1.0)?;
    let [low, high] = settings.corners(city);
    let size = high - low;
    let even = |i: u32, n: u32| if n > 1 { f64::from(i) / f64::from(n - 1) } else { 0.5 };
    let (top, mut way, mut shots) = (ground(city) + height, 0.0, Vec::new());
    let mut last: Option<DVec3> = None;
    for line in 0..lines {
        let ahead = if line % 2 == 0 { DVec3::Y } else { -DVec3::Y };
        for stop in 0..stops {
            let along = if line % 2 == 0 { even(stop, stops) } else { 1.0 - even(stop, stops) };
            let place = (low + size * DVec2::new(even(line, lines), along)).extend(top);
            way += last.map_or(0.0, |p| p.distance(place));
            last = Some(place);
            for (name, heading) in headings_of(ahead, tilt) {
                let camera = camera_towards(lens, place, heading, ahead);
                let mut shot = Shot::new(format!("{name}-{line:04}-{stop:04}"), name, start + way / speed, camera);
                shot.motion.velocity = ahead * speed;
                shot.shutter_seconds = shutter;
                shots.push(shot);
            }
        }
    }
    Ok(shots)
}

/// The nadir direction, and four oblique ones if there is a tilt.
fn headings_of(ahead: DVec3, tilt: f64) -> Vec<(&'static str, DVec3)> {
    let mut headings = vec![("nadir", DVec3::NEG_Z)];
    if tilt > 0.0 {
        let (sine, cosine) = tilt.to_radians().sin_cos();
        let right = ahead.cross(DVec3::Z);
        let ways = [("ahead", ahead), ("back", -ahead), ("left", -right), ("right", right)];
        headings.extend(ways.map(|(name, way)| (name, way * sine - DVec3::Z * cosine)));
    }
    headings
}

/// Mean height of the streets.
fn ground(city: &City) -> f64 {
    let heights: Vec<f64> = city.streets.iter().flatten().map(|p| p.z).filter(|z| z.is_finite()).collect();
    heights.iter().sum::<f64>() / heights.len().max(1) as f64
}

/// Surveillance cameras: static cameras along streets that take images at a fixed interval.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Fixed {
    /// Number of cameras.
    pub cameras: u32,
    /// Height over the street, metres.
    pub height_metres: f64,
    /// Lateral offset from a line of [`City::streets`], metres.
    pub side_metres: f64,
    /// Tilt below the horizon, degrees.
    pub tilt_degrees: f64,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Horizontal field of view, degrees.
    pub field_degrees: f64,
    /// Images per camera.
    pub pictures: u32,
    /// Interval between images, seconds.
    pub every_seconds: f64,
    /// City time of the first image, seconds.
    pub start_seconds: f64,
    /// Seed of the camera positions.
    pub seed: u64,
}

impl Default for Fixed {
    fn default() -> Self {
        Self {
            cameras: 8,
            height_metres: 6.0,
            side_metres: 5.0,
            tilt_degrees: 18.0,
            width: 1280,
            height: 720,
            field_degrees: 80.0,
            pictures: 10,
            every_seconds: 0.5,
            start_seconds: 0.0,
            seed: 1,
        }
    }
}

/// The shots of surveillance cameras, camera by camera. Positions have a free line of sight to the street; there may be
/// fewer cameras than requested if not enough such positions are found.
///
/// # Errors
/// [`SenseError`] for settings out of range, or more shots than [`super::MAX_READINGS`].
pub fn fixed(moment: &Moment, settings: &Fixed) -> Result<Vec<Shot>, SenseError> {
    let lens = pinhole(settings.width, settings.height, settings.field_degrees)?;
    let height = check_range("height_metres", settings.height_metres, 0.1, 200.0)?;
    let side = check_range("side_metres", settings.side_metres, -50.0, 50.0)?;
    let tilt = check_range("tilt_degrees", settings.tilt_degrees, -89.0, 89.0)?.to_radians();
    let every = check_range("every_seconds", settings.every_seconds, 0.0, 1e6)?;
    let start = check_range("start_seconds", settings.start_seconds, -1e9, 1e9)?;
    check_count(f64::from(settings.cameras) * f64::from(settings.pictures))?;
    let streets: Vec<Polyline> = moment.city().streets.iter().filter_map(|street| Polyline::new(street)).collect();
    let mut random = Random::new(settings.seed).fork(17);
    let mut shots = Vec::new();
    let mut found = 0;
    for _ in 0..settings.cameras.saturating_mul(20) {
        if found == settings.cameras || streets.is_empty() {
            break;
        }
        let line = random.one_of(&streets);
        let (way, right) = (f64::from(random.unit()) * line.length(), if random.chance(0.5) { side } else { -side });
        let Some(camera) = post_camera(moment, line, way, right, height, tilt, lens) else { continue };
        let sensor = format!("fixed-{found:03}");
        shots.extend(
            (0..settings.pictures)
                .map(|i| Shot::new(format!("{sensor}-{i:05}"), &sensor, start + f64::from(i) * every, camera)),
        );
        found += 1;
    }
    Ok(shots)
}

/// A camera beside a street; `None` if its line of sight is blocked.
fn post_camera(
    moment: &Moment,
    line: &Polyline,
    way: f64,
    right: f64,
    height: f64,
    tilt: f64,
    lens: Pinhole,
) -> Option<Camera> {
    let road = line.pose(way, 0.0);
    let place = line.pose(way, right).translation + DVec3::Z * height;
    // turned back to the middle of the street
    let ahead = road.rotation * DVec3::X;
    let seen = line.at((way + 15.0).min(line.length())) + DVec3::Z;
    let over = road.translation + DVec3::Z * height;
    let is_free = |a: DVec3, b: DVec3| {
        let direction = (b - a).as_vec3().normalize_or_zero();
        !moment.is_occluded(&Ray { t_max: a.distance(b) as f32, ..Ray::new(a.as_vec3(), direction) })
    };
    let towards =
        (ahead * tilt.cos() - DVec3::Z * tilt.sin() - 0.25 * right.signum() * -(road.rotation * DVec3::Y)).normalize();
    (is_free(over, place) && is_free(place, seen)).then(|| camera_towards(lens, place, towards, ahead))
}

/// Shots along a path of camera poses (`world_from_camera`, OpenCV axes): Catmull–Rom spline for positions, slerp for
/// rotations.
///
/// # Errors
/// [`SenseError`] for settings out of range, or more shots than [`super::MAX_READINGS`].
pub fn free(sensor: &str, path: &[Waypoint], lens: Pinhole, every_seconds: f64) -> Result<Vec<Shot>, SenseError> {
    let every = check_range("every_seconds", every_seconds, 1e-4, 1e6)?;
    let sane = path.iter().all(|w| w.seconds.is_finite() && w.world_from_asset.is_sane());
    if !sane || path.windows(2).any(|pair| pair[0].seconds >= pair[1].seconds) {
        return Err(SenseError::Setting("the path"));
    }
    let (Some(first), Some(last)) = (path.first(), path.last()) else { return Ok(Vec::new()) };
    let pictures = check_count((last.seconds - first.seconds) / every + 1.0)?;
    let mut shots = Vec::with_capacity(pictures);
    for i in 0..pictures {
        let seconds = first.seconds + i as f64 * every;
        let Some(pose) = catmull_rom(path, seconds) else { continue };
        let mut shot = Shot::new(
            format!("{sensor}-{i:06}"),
            sensor,
            seconds,
            Camera { pinhole: lens, camera_from_world: pose.inverse() },
        );
        if let (Some(before), Some(after)) = (catmull_rom(path, seconds - 5e-3), catmull_rom(path, seconds + 5e-3)) {
            shot.motion = Motion::between(&before, &after, 1e-2);
        }
        shots.push(shot);
    }
    Ok(shots)
}

/// The pose on a Catmull–Rom spline through waypoints at a time; `None` without waypoints.
pub fn catmull_rom(path: &[Waypoint], seconds: f64) -> Option<scene::Rigid> {
    let straight = motion::between(path, seconds)?;
    let next = path.partition_point(|w| w.seconds <= seconds);
    if next == 0 || next == path.len() {
        return Some(straight);
    }
    let at = |i: usize| (path[i].seconds, path[i].world_from_asset.translation);
    let ((s0, p0), (s1, p1)) = (at(next - 1), at(next));
    let span = s1 - s0;
    let (before, after) = (at(next.saturating_sub(2)), at((next + 1).min(path.len() - 1)));
    let tangent = |a: (f64, DVec3), b: (f64, DVec3)| (b.1 - a.1) * (span / (b.0 - a.0).max(1e-9));
    let (m0, m1) = (tangent(before, (s1, p1)), tangent((s0, p0), after));
    let t = (seconds - s0) / span;
    let (t2, t3) = (t * t, t * t * t);
    let translation =
        p0 * (2.0 * t3 - 3.0 * t2 + 1.0) + m0 * (t3 - 2.0 * t2 + t) + p1 * (3.0 * t2 - 2.0 * t3) + m1 * (t3 - t2);
    Some(scene::Rigid { translation, ..straight })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{test_scene, trace::World};

    #[test]
    fn neighbouring_images_have_the_requested_overlap() {
        let city = test_scene::city();
        let settings = Survey { height_metres: 50.0, forward_overlap: 0.8, side_overlap: 0.5, ..Survey::default() };
        let shots = survey(&city, &settings).unwrap();
        let covered = 50.0 / shots[0].camera.pinhole.fx * 1200.0;
        let along = shots[0].camera.centre().distance(shots[1].camera.centre());
        let overlap = 1.0 - along / covered;
        assert!((0.8..0.86).contains(&overlap), "{overlap}");
        // the city's corner is seen, the picture's top is ahead
        let (corner, depth) = shots[0].camera.project(DVec3::new(-99.0, -99.0, 0.0));
        assert!(depth > 49.0 && shots[0].camera.pinhole.width as f64 > corner.x && corner.x > 0.0);
        assert!(
            shots[0].camera.project(DVec3::new(-100.0, -90.0, 0.0)).0.y
                < shots[0].camera.project(DVec3::new(-100.0, -99.0, 0.0)).0.y
        );
        let cross = survey(&city, &Survey { tilt_degrees: 45.0, ..settings.clone() }).unwrap();
        assert_eq!(cross.len(), 5 * shots.len());
        assert!(cross[1..5].iter().all(|s| (s.camera.forward().z + 0.5f64.sqrt()).abs() < 1e-9));
        let all: DVec3 = cross[1..5].iter().map(|s| s.camera.forward().with_z(0.0)).sum();
        assert!(all.length() < 1e-9);
        assert!(survey(&city, &Survey { forward_overlap: 1.0, ..settings.clone() }).is_err());
        assert!(matches!(survey(&City { extent_metres: 9e5, ..city }, &settings), Err(SenseError::TooMany(_))));
    }

    #[test]
    fn surveillance_cameras_are_static_and_face_down() {
        let city = test_scene::city();
        let world = World::new(&city).unwrap();
        let shots = fixed(&world.at(0.0), &Fixed { cameras: 3, pictures: 4, ..Fixed::default() }).unwrap();
        assert_eq!(shots.len(), 12);
        assert!(shots[..4].iter().all(|s| s.camera == shots[0].camera) && shots[3].seconds == 1.5);
        assert!(shots.iter().all(|s| s.camera.forward().z < 0.0 && (s.camera.centre().z - 6.0).abs() < 1e-9));
    }

    #[test]
    fn a_free_path_passes_through_its_waypoints() {
        let at = |seconds: f64, x: f64, y: f64| Waypoint {
            seconds,
            world_from_asset: test_scene::pose_at_point(DVec3::new(x, y, 2.0)),
        };
        let path = [at(0.0, 0.0, 0.0), at(1.0, 1.0, 0.5), at(2.0, 2.0, 0.0), at(3.0, 3.0, 0.5)];
        let shots = free("free", &path, pinhole(64, 64, 90.0).unwrap(), 0.5).unwrap();
        assert_eq!(shots.len(), 7);
        assert!((shots[2].camera.centre() - DVec3::new(1.0, 0.5, 2.0)).length() < 1e-9);
        assert!((shots[3].motion.velocity.x - 1.0).abs() < 0.05, "{}", shots[3].motion.velocity);
        assert!(free("free", &[path[1], path[0]], pinhole(64, 64, 90.0).unwrap(), 0.5).is_err());
    }
}
