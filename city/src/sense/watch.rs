//! Fixed cameras around a place of a street: a key area (EDeRF, section 3.1).

use glam::{DVec2, DVec3};
use scene::{Camera, Rigid};

use super::rig::Polyline;
use super::{SenseError, Shot, camera_towards, check_count, check_range, pinhole};
use crate::City;
use crate::trace::{Moment, Ray};

/// Height over the street of what the cameras look at, metres.
const TARGET_METRES: f64 = 0.8;
/// Height of what they must see, metres: above a vehicle that stands there, so that the same posts stand around it as without.
const CLEAR_METRES: f64 = 3.0;
/// A camera whose line of sight is blocked comes nearer, to these shares of the radius.
const SHARES: [f64; 4] = [1.0, 0.8, 0.65, 0.5];
/// Distance between the places on a street that are compared, metres.
const STEP_METRES: f64 = 0.5;

/// Cameras on posts in a ring, which look at its middle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Watch {
    /// The middle is the place of a street that is nearest to this one, world metres.
    pub at: DVec2,
    /// Radius of the ring, metres.
    pub radius_metres: f64,
    /// Number of cameras.
    pub cameras: u32,
    /// Height over the street, metres.
    pub height_metres: f64,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Horizontal field of view, degrees.
    pub field_degrees: f64,
    /// City time of the first photos, seconds.
    pub seconds: f64,
    /// Photos of each camera.
    pub frames: u32,
    /// Photos a second of each camera.
    pub frame_rate_hz: f64,
}

/// The pose on a street that is nearest to a place: on the road, x along it. `None` in a city without streets.
pub fn nearest_on_street(city: &City, at: DVec2) -> Option<Rigid> {
    let streets: Vec<Polyline> = city.streets.iter().filter_map(|street| Polyline::new(street)).collect();
    let places = streets
        .iter()
        .flat_map(|line| (0..=(line.length() / STEP_METRES) as usize).map(move |i| (line, i as f64 * STEP_METRES)));
    let distance = |(line, way): &(&Polyline, f64)| line.at(*way).truncate().distance_squared(at);
    let (line, way) = places.min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
    Some(line.pose(way, 0.0))
}

/// The shots of each camera. There are fewer cameras where no post in a direction sees the middle.
///
/// # Errors
/// [`SenseError`] for settings out of range, more shots than [`super::MAX_READINGS`], or a city without streets.
pub fn watch(moment: &Moment, settings: &Watch) -> Result<Vec<Shot>, SenseError> {
    let lens = pinhole(settings.width, settings.height, settings.field_degrees)?;
    let radius = check_range("the radius around the watched place", settings.radius_metres, 2.0, 200.0)?;
    let height = check_range("height_metres", settings.height_metres, 0.1, 200.0)?;
    let rate = check_range("frame_rate_hz", settings.frame_rate_hz, 0.01, 1000.0)?;
    let (cameras, frames) = (settings.cameras, settings.frames);
    check_count(f64::from(cameras) * f64::from(frames))?;
    if !settings.at.is_finite() {
        return Err(SenseError::Setting("the watched place"));
    }
    let middle = nearest_on_street(moment.city(), settings.at).ok_or(SenseError::Setting("a city without streets"))?;
    let target = middle.translation + TARGET_METRES * DVec3::Z;
    let above = middle.translation + CLEAR_METRES * DVec3::Z;
    let is_free = |place: DVec3| {
        let direction = (place - above).as_vec3().normalize_or_zero();
        !moment.is_occluded(&Ray { t_max: place.distance(above) as f32, ..Ray::new(above.as_vec3(), direction) })
    };
    let post = |i: u32| {
        let angle = std::f64::consts::TAU * (f64::from(i) + 0.5) / f64::from(cameras);
        let out = middle.rotation * DVec3::new(angle.cos(), angle.sin(), 0.0);
        let place = |share: f64| middle.translation + share * radius * out + height * DVec3::Z;
        let place = SHARES.into_iter().map(place).find(|&place| is_free(place))?;
        let camera = camera_towards(lens, place, target - place, out);
        Some((format!("watch-{i:03}"), camera))
    };
    let shot = |(sensor, camera): &(String, Camera), frame: u32| {
        let seconds = settings.seconds + f64::from(frame) / rate;
        Shot::new(format!("{sensor}-{frame:05}"), sensor, seconds, *camera)
    };
    let posts: Vec<(String, Camera)> = (0..cameras).filter_map(post).collect();
    Ok((0..frames).flat_map(|frame| posts.iter().map(move |post| shot(post, frame))).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{test_scene, trace::World};

    #[test]
    fn cameras_stand_around_a_place_of_the_street_and_see_it() {
        let city = test_scene::city();
        let world = World::new(&city).unwrap();
        let settings = Watch {
            at: DVec2::new(-20.2, 5.0),
            radius_metres: 8.0,
            cameras: 6,
            height_metres: 4.0,
            width: 320,
            height: 240,
            field_degrees: 60.0,
            seconds: 0.0,
            frames: 1,
            frame_rate_hz: 10.0,
        };
        let shots = watch(&world.at(0.0), &settings).unwrap();
        assert_eq!(shots.len(), 6);
        let middle = DVec3::new(-20.0, 0.0, 0.0);
        for shot in &shots {
            let centre = shot.camera.centre();
            assert!((centre.z - 4.0).abs() < 1e-9, "{centre}");
            assert!(((centre - middle).truncate().length() - 8.0).abs() < 1e-9, "{centre}");
            let (pixel, depth) = shot.camera.project(middle + TARGET_METRES * DVec3::Z);
            assert!(depth > 0.0 && (pixel - DVec2::new(160.0, 120.0)).length() < 1e-6, "{pixel}");
        }
        // The house hides the street from posts in and behind it: those come nearer, or are left out.
        let near_house = watch(&world.at(0.0), &Watch { at: DVec2::new(19.0, 0.0), radius_metres: 12.0, ..settings });
        let places: Vec<DVec3> = near_house.unwrap().iter().map(|shot| shot.camera.centre()).collect();
        let is_far = |place: &&DVec3| ((place.truncate() - DVec2::new(19.0, 0.0)).length() - 12.0).abs() < 1e-6;
        assert!(places.len() >= 3 && places.iter().filter(is_far).count() < 6, "{places:?}");
        let is_in_house = |place: &DVec3| (14.01..23.99).contains(&place.x) && (6.01..17.99).contains(&place.y);
        assert!(!places.iter().any(is_in_house), "{places:?}");
        for wrong in [
            Watch { radius_metres: f64::NAN, ..settings },
            Watch { at: DVec2::NAN, ..settings },
            Watch { width: 0, ..settings },
        ] {
            assert!(watch(&world.at(0.0), &wrong).is_err());
        }
    }
}
