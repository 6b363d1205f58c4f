//! A car with six cameras that drives all free lanes of a city.
//!
//! Mounting follows KITTI-360 with the additions of CarlaOcc (supplement 1.1): no tilt, perspective lenses with the
//! same field of view (103.7°, 1408 × 376), a forward stereo pair, one camera to each side and a rear stereo pair.
//! Offsets in metres from the point of the road under the car's centre, x forward, y left, z up:
//!
//! | camera | x | y | z | yaw |
//! |---|---|---|---|---|
//! | `front-left`, `front-right` | 0.80 | ±0.30 | 1.65 | 0° |
//! | `left`, `right` | 0.00 | ±0.55 | 1.65 | ±90° |
//! | `rear-left`, `rear-right` | −0.80 | ±0.30 | 1.65 | 180° |

use glam::{DMat3, DQuat, DVec3};
use scene::Rigid;
use serde::{Deserialize, Serialize};

use super::{Motion, SenseError, Shot, camera_towards, check_count, check_range, pinhole};
use crate::{City, Waypoint, trace::motion};

/// Mounting of a sensor on a car, relative to the point of the road under the car's centre.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mount {
    /// Name of the sensor.
    pub name: String,
    /// x forward, y left, z up, metres.
    pub offset: DVec3,
    /// Yaw to the left, degrees.
    pub yaw_degrees: f64,
}

/// A car with cameras, and its motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Rig {
    /// The cameras.
    pub cameras: Vec<Mount>,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Horizontal field of view, degrees.
    pub field_degrees: f64,
    /// Distance between exposures of all cameras, metres.
    pub spacing_metres: f64,
    /// Speed, metres per second.
    pub speed: f64,
    /// Offset to the right of the lines of [`City::streets`], metres.
    pub lane_metres: f64,
    /// City time at the start, seconds.
    pub start_seconds: f64,
    /// Whether each street has its own car, all starting at the same time. Otherwise one car drives the streets in
    /// turn.
    pub fleet: bool,
    /// Readout time of the rolling shutter, seconds.
    pub rolling_shutter_seconds: f64,
    /// Exposure time, seconds.
    pub shutter_seconds: f64,
}

impl Default for Rig {
    fn default() -> Self {
        let mount =
            |name: &str, x, y, yaw_degrees| Mount { name: name.into(), offset: DVec3::new(x, y, 1.65), yaw_degrees };
        Self {
            cameras: vec![
                mount("front-left", 0.8, 0.3, 0.0),
                mount("front-right", 0.8, -0.3, 0.0),
                mount("left", 0.0, 0.55, 90.0),
                mount("right", 0.0, -0.55, -90.0),
                mount("rear-left", -0.8, 0.3, 180.0),
                mount("rear-right", -0.8, -0.3, 180.0),
            ],
            width: 1408,
            height: 376,
            field_degrees: 103.7,
            spacing_metres: 2.0,
            speed: 10.0,
            lane_metres: 0.0,
            start_seconds: 0.0,
            fleet: false,
            rolling_shutter_seconds: 0.0,
            shutter_seconds: 0.0,
        }
    }
}

impl Rig {
    /// One camera, which looks ahead: a dashboard camera.
    pub fn front() -> Self {
        let mount = Mount { name: "front".into(), offset: DVec3::new(0.8, 0.0, 1.65), yaw_degrees: 0.0 };
        Self { cameras: vec![mount], ..Self::default() }
    }
}

/// Drives every street of a city and lists the shots, in order of street, position and camera.
///
/// # Errors
/// [`SenseError`] for settings out of range, or more shots than [`super::MAX_READINGS`].
pub fn drive(city: &City, rig: &Rig) -> Result<Vec<Shot>, SenseError> {
    shots_of(&legs(city, rig)?, rig)
}

/// The shots of all cameras at every waypoint of these legs, in order of leg, waypoint and camera.
///
/// # Errors
/// [`SenseError`] for settings out of range, or more shots than [`super::MAX_READINGS`].
pub fn shots_of(legs: &[Vec<Waypoint>], rig: &Rig) -> Result<Vec<Shot>, SenseError> {
    let lens = pinhole(rig.width, rig.height, rig.field_degrees)?;
    check_range("rolling_shutter_seconds", rig.rolling_shutter_seconds, 0.0, 1.0)?;
    check_range("shutter_seconds", rig.shutter_seconds, 0.0, 1.0)?;
    let offsets = rig.cameras.iter().all(|m| m.offset.abs().max_element() < 100.0 && m.yaw_degrees.abs() <= 360.0);
    if !offsets {
        return Err(SenseError::Setting("a camera's mount"));
    }
    check_count(legs.iter().map(|leg| leg.len() as f64).sum::<f64>() * rig.cameras.len() as f64)?;
    let mut shots = Vec::new();
    for (street, leg) in legs.iter().enumerate() {
        for (i, here) in leg.iter().enumerate() {
            let (a, b) = (&leg[i.saturating_sub(1)], &leg[(i + 1).min(leg.len() - 1)]);
            let motion = Motion::between(&a.world_from_asset, &b.world_from_asset, b.seconds - a.seconds);
            for mount in &rig.cameras {
                let pose = &here.world_from_asset;
                let arm = pose.rotation * mount.offset;
                let forward = pose.rotation * (DQuat::from_rotation_z(mount.yaw_degrees.to_radians()) * DVec3::X);
                let camera = camera_towards(lens, pose.translation + arm, forward, DVec3::Z);
                let name = format!("{}-{street:04}-{i:05}", mount.name);
                let mut shot = Shot::new(name, &mount.name, here.seconds, camera);
                // lever arm: the camera also moves with the car's rotation
                shot.motion = Motion { velocity: motion.velocity + motion.spin.cross(arm), ..motion };
                shot.rolling_shutter_seconds = rig.rolling_shutter_seconds;
                shot.shutter_seconds = rig.shutter_seconds;
                shots.push(shot);
            }
        }
    }
    Ok(shots)
}

/// The car's poses (x forward, y left, z up; the origin on the road) per street, one waypoint per spacing.
///
/// # Errors
/// [`SenseError`] for settings out of range, or more waypoints than [`super::MAX_READINGS`].
pub fn legs(city: &City, rig: &Rig) -> Result<Vec<Vec<Waypoint>>, SenseError> {
    let spacing = check_range("spacing_metres", rig.spacing_metres, 0.01, 1e4)?;
    let speed = check_range("speed", rig.speed, 0.01, 100.0)?;
    let lane = check_range("lane_metres", rig.lane_metres, -50.0, 50.0)?;
    let mut seconds = check_range("start_seconds", rig.start_seconds, -1e9, 1e9)?;
    let streets: Vec<Polyline> = city.streets.iter().filter_map(|street| Polyline::new(street)).collect();
    check_count(streets.iter().map(|line| line.length() / spacing + 1.0).sum())?;
    let mut legs = Vec::new();
    for line in &streets {
        let rounds = (line.length() / spacing) as usize + 1;
        let start = if rig.fleet { rig.start_seconds } else { seconds };
        let waypoint = |i: usize| {
            let way = i as f64 * spacing;
            Waypoint { seconds: start + way / speed, world_from_asset: line.pose(way, lane) }
        };
        legs.push((0..rounds).map(waypoint).collect::<Vec<_>>());
        seconds = start + line.length() / speed + 1.0;
    }
    Ok(legs)
}

/// The pose of a car's sensor at a time of a leg (`world_from_sensor`, x forward, y left, z up) and its motion. `None`
/// for an empty leg.
pub fn sensor_pose_at(leg: &[Waypoint], mount: &Mount, seconds: f64) -> Option<(Rigid, Motion)> {
    const STEP: f64 = 0.01;
    let at = |seconds| {
        let car = motion::between(leg, seconds)?;
        let turn = DQuat::from_rotation_z(mount.yaw_degrees.to_radians());
        Some(Rigid { rotation: car.rotation * turn, translation: car.apply(mount.offset) })
    };
    // one-sided differences at the ends of a leg
    let (first, last) = (leg.first()?.seconds, leg.last()?.seconds);
    let (from, to) = ((seconds - STEP).max(first), (seconds + STEP).min(last));
    Some((at(seconds)?, Motion::between(&at(from)?, &at(to)?, to - from)))
}

/// A polyline parametrised by arc length.
pub(crate) struct Polyline<'a> {
    points: &'a [DVec3],
    /// Arc length at each point, metres.
    ways: Vec<f64>,
}

impl<'a> Polyline<'a> {
    /// `None` for lines without length or with invalid points.
    pub(crate) fn new(points: &'a [DVec3]) -> Option<Self> {
        let mut ways = vec![0.0];
        for pair in points.windows(2) {
            ways.push(ways[ways.len() - 1] + pair[0].distance(pair[1]));
        }
        let sane = points.len() > 1 && points.iter().all(|p| p.is_finite() && p.abs().max_element() < 1e7);
        (sane && ways[ways.len() - 1] > 0.1).then_some(Self { points, ways })
    }

    pub(crate) fn length(&self) -> f64 {
        self.ways[self.ways.len() - 1]
    }

    /// The point at an arc length.
    pub(crate) fn at(&self, way: f64) -> DVec3 {
        let next = self.ways.partition_point(|w| *w < way).clamp(1, self.points.len() - 1);
        let (from, to) = (self.ways[next - 1], self.ways[next]);
        let share = if to > from { ((way - from) / (to - from)).clamp(0.0, 1.0) } else { 0.0 };
        self.points[next - 1].lerp(self.points[next], share)
    }

    /// A car's pose at an arc length and an offset to the right. The heading is the direction of the road over the
    /// car's length.
    pub(crate) fn pose(&self, way: f64, right: f64) -> Rigid {
        const AXLE: f64 = 2.0;
        let ahead = self.at((way + AXLE).min(self.length())) - self.at((way - AXLE).max(0.0));
        let x = ahead.try_normalize().unwrap_or(DVec3::X);
        let y = DVec3::Z.cross(x).try_normalize().unwrap_or(DVec3::Y);
        let rotation = DQuat::from_mat3(&DMat3::from_cols(x, y, x.cross(y))).normalize();
        Rigid { rotation, translation: self.at(way) - right * y }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_scene;

    #[test]
    fn six_cameras_are_mounted_as_specified() {
        let city = test_scene::city();
        let shots = drive(&city, &Rig::default()).unwrap();
        assert_eq!(shots.len(), 6 * 61);
        let round = &shots[60..66];
        let ahead: Vec<DVec3> = round.iter().map(|s| s.camera.forward()).collect();
        for (seen, expected) in ahead.iter().zip([DVec3::X, DVec3::X, DVec3::Y, -DVec3::Y, -DVec3::X, -DVec3::X]) {
            assert!((*seen - expected).length() < 1e-9, "{seen}");
        }
        let centre = round[0].camera.centre();
        assert!((centre - DVec3::new(-60.0 + 20.0 + 0.8, 0.3, 1.65)).length() < 1e-9, "{centre}");
        assert!((round[3].motion.velocity - DVec3::X * 10.0).length() < 1e-9);
        assert!((shots[60].seconds - 2.0).abs() < 1e-9);
        let field = 2.0 * (704.0 / round[0].camera.pinhole.fx).atan().to_degrees();
        assert!((field - 103.7).abs() < 1e-9);
    }

    #[test]
    fn settings_out_of_range_are_refused() {
        let city = test_scene::city();
        for rig in [
            Rig { spacing_metres: 0.0, ..Rig::default() },
            Rig { spacing_metres: f64::NAN, ..Rig::default() },
            Rig { field_degrees: 180.0, ..Rig::default() },
            Rig { width: 0, ..Rig::default() },
        ] {
            assert!(drive(&city, &rig).is_err(), "{rig:?}");
        }
        let endless = City { streets: vec![vec![DVec3::ZERO, DVec3::X * 9e6]], ..City::default() };
        assert!(matches!(
            drive(&endless, &Rig { spacing_metres: 0.01, ..Rig::default() }),
            Err(SenseError::TooMany(_))
        ));
        let broken = City { streets: vec![vec![], vec![DVec3::NAN, DVec3::X]], ..City::default() };
        assert_eq!(drive(&broken, &Rig::default()), Ok(Vec::new()));
    }
}
