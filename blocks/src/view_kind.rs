//! The kind of each view, aerial or street, from geometry alone: real captures have no names that tell.
//!
//! Lengths are compared with each other only, as a capture may have any unit. A view is *steep* if it looks down on half of the
//! sparse points that it observes by more than [`STEEP_DEGREES`]; its height is that over the low points among them. If the
//! steep views stand [`MANY_TIMES`] as high as the others, the capture has both kinds and the height decides, so that an aerial
//! photo of the horizon is aerial. Otherwise all views are of one kind, that of the majority.

use glam::{DVec2, DVec3};
use scene::Capture;
use serde::{Deserialize, Serialize};

use crate::ground::{Ground, quantile};
use crate::visibility::Observations;

/// Median depression of the points from which a view looks down. A car's camera sees the road and walls at 0° to 10°, an oblique
/// aerial camera looks down by 30° to 60°.
const STEEP_DEGREES: f64 = 20.0;
/// Ratio of heights from which a capture has both kinds. A camera on a roof rack is 2 m high, a drone at least 15 m.
const MANY_TIMES: f64 = 6.0;
/// The ground under a view is at this quantile of the heights of its points: some of a street's points lie in cellars.
const LOW_QUANTILE: f64 = 0.1;
/// Views with fewer observations take the kind of the nearest view with more.
const MIN_OBSERVATIONS: usize = 8;

/// How a view looks at the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ViewKind {
    /// From above.
    Aerial,
    /// From eye level: from cars, from pedestrians, from posts.
    Street,
}

impl ViewKind {
    /// Both kinds.
    pub const ALL: [Self; 2] = [Self::Aerial, Self::Street];

    /// `aerial` or `street`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Aerial => "aerial",
            Self::Street => "street",
        }
    }
}

/// The kind of every view of a capture, by view.
pub fn view_kinds(capture: &Capture) -> Vec<ViewKind> {
    kinds_of(capture, &Observations::of(capture), &Ground::of(capture))
}

/// As [`view_kinds`], with the capture's observations and ground.
pub(crate) fn kinds_of(capture: &Capture, observations: &Observations, ground: &Ground) -> Vec<ViewKind> {
    let mut outlooks: Vec<Option<Outlook>> = vec![None; capture.views.len()];
    for (view, points) in observations.points_by_view().into_iter().enumerate() {
        let centre = capture.views[view].camera.centre();
        let places = points.iter().map(|&point| capture.points.positions[point as usize] - centre);
        outlooks[view] = Outlook::of(places.map(|ray| ground.from_world(ray)));
    }
    let heights = |steep: bool| -> Vec<f64> {
        outlooks.iter().flatten().filter(|o| o.is_steep == steep).map(|o| o.height).collect()
    };
    let [mut steep, mut level] = [heights(true), heights(false)];
    let most = if steep.len() > level.len() { ViewKind::Aerial } else { ViewKind::Street };
    let [above, below] = [quantile(&mut steep, 0.5), quantile(&mut level, 0.5).max(0.0)];
    if steep.is_empty() || level.is_empty() || above <= MANY_TIMES * below {
        return vec![most; outlooks.len()];
    }
    let limit = (above * below).sqrt();
    let kind = |outlook: &Outlook| if outlook.height > limit { ViewKind::Aerial } else { ViewKind::Street };
    let known: Vec<(DVec3, ViewKind)> = (outlooks.iter().enumerate())
        .filter_map(|(view, outlook)| Some((capture.views[view].camera.centre(), kind(outlook.as_ref()?))))
        .collect();
    let nearest = |view: usize| {
        let centre = capture.views[view].camera.centre();
        let found = known.iter().min_by(|a, b| a.0.distance(centre).total_cmp(&b.0.distance(centre)));
        found.map_or(most, |(_, kind)| *kind)
    };
    outlooks.iter().enumerate().map(|(view, outlook)| outlook.as_ref().map_or_else(|| nearest(view), kind)).collect()
}

/// What a view sees of the sparse points.
#[derive(Debug, Clone, Copy)]
struct Outlook {
    /// Height over the low points, in the capture's unit.
    height: f64,
    is_steep: bool,
}

impl Outlook {
    /// From the rays to the observed points, ground axes. `None` for too few of them.
    fn of(rays: impl Iterator<Item = DVec3>) -> Option<Self> {
        let (mut drops, mut slopes): (Vec<f64>, Vec<f64>) =
            rays.map(|ray| (-ray.z, (-ray.z).atan2(DVec2::new(ray.x, ray.y).length()))).unzip();
        (drops.len() >= MIN_OBSERVATIONS).then(|| Self {
            height: quantile(&mut drops, 1.0 - LOW_QUANTILE),
            is_steep: quantile(&mut slopes, 0.5) > STEEP_DEGREES.to_radians(),
        })
    }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use scene::Camera;

    use super::*;
    use crate::testing::{aerial, capture, look_at, noise, rotated, street};

    /// A street of walls 9 m high on a plain, seen by 20 views from a car, then by 9 nadir and 6 oblique views from 80 m and one
    /// from there towards the horizon.
    fn both() -> Capture {
        let car = (0..20).map(|i| {
            let eye = DVec3::new(10.0 * f64::from(i), 0.0, 1.7);
            look_at(eye, eye + DVec3::X, DVec3::Z)
        });
        let nadir = (0..9).map(|i| {
            let eye = DVec3::new(20.0 * f64::from(i), 5.0, 80.0);
            look_at(eye, eye - DVec3::Z, DVec3::Y)
        });
        let oblique = (0..6).map(|i| {
            let eye = DVec3::new(30.0 * f64::from(i), -80.0, 80.0);
            look_at(eye, eye + DVec3::new(0.0, 1.0, -1.0), DVec3::Z)
        });
        let eye = DVec3::new(-200.0, 0.0, 80.0);
        let horizon = look_at(eye, eye + DVec3::new(1.0, 0.0, -0.2), DVec3::Z);
        let cameras: Vec<Camera> = car.chain(nadir).chain(oblique).chain([horizon]).collect();
        let place = |i: u64| {
            let at = |k: u64| noise(3 * i + k);
            match i % 3 {
                0 => DVec3::new(300.0 * at(0) - 50.0, 100.0 * at(1) - 50.0, 0.0),
                side => DVec3::new(300.0 * at(0) - 50.0, 14.0 * side as f64 - 21.0, 9.0 * at(2)),
            }
        };
        capture(&cameras, (0..3000).map(place).collect(), true)
    }

    fn aerial_views(capture: &Capture) -> Vec<usize> {
        let kinds = view_kinds(capture);
        assert_eq!(kinds.len(), capture.views.len());
        (0..kinds.len()).filter(|&view| kinds[view] == ViewKind::Aerial).collect()
    }

    #[test]
    fn a_capture_of_one_kind_is_not_divided() {
        assert_eq!(aerial_views(&aerial(5, 200.0, 3000)).len(), 25);
        assert!(aerial_views(&street(30, 600)).is_empty());
        assert!(aerial_views(&capture(&[], Vec::new(), false)).is_empty());
    }

    #[test]
    fn height_tells_aerial_from_street_views_in_any_unit_and_frame() {
        let expected: Vec<usize> = (20..36).collect();
        assert_eq!(aerial_views(&both()), expected);
        let mut small = both();
        small.points.positions.iter_mut().for_each(|p| *p *= 0.01);
        small.views.iter_mut().for_each(|view| view.camera.camera_from_world.translation *= 0.01);
        assert_eq!(aerial_views(&small), expected);
        assert_eq!(aerial_views(&rotated(both(), DQuat::from_rotation_x(0.2))), expected);
        let mut untracked = both();
        (untracked.points.track_start, untracked.points.seen_by) = (Vec::new(), Vec::new());
        assert_eq!(aerial_views(&untracked), expected);
    }

    #[test]
    fn views_without_points_follow_their_neighbours() {
        let mut blind = both();
        let at = |eye: DVec3| look_at(eye, eye + DVec3::Z, DVec3::X);
        for eye in [DVec3::new(15.0, 0.0, 2.0), DVec3::new(30.0, 0.0, 90.0), DVec3::NAN] {
            let view = blind.views[0].clone();
            blind.views.push(scene::View { camera: at(eye), ..view });
        }
        let found = aerial_views(&blind);
        assert!(found.contains(&37) && !found.contains(&36), "{found:?}");
    }
}
