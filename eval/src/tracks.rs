//! How far the found paths of objects that move are the true ones.

use std::collections::BTreeSet;

use dataset::true_boxes::TrueBoxes;
use glam::{DQuat, DVec3};
use perceive::tracking::{Frame, Placed, Score, TrueObject, score};
use scene::{Camera, MovingObject, View};
use serde::Serialize;

/// Photos of one time, seconds.
const SAME_SECONDS: f64 = 0.02;
/// A true object counts if its box is at least this high in a photo, pixels, and this share of it is visible, where that is known.
const LEAST_PIXELS: f64 = 20.0;
const LEAST_VISIBLE: f32 = 0.5;
/// A track that is less high than this share of that in all photos is not looked at.
const NEAR_SHARE: f64 = 0.8;
/// A track is that of a true object up to this distance between the middles of their boxes, metres (nuScenes' tracking benchmark).
const WITHIN_METRES: f64 = 2.0;
/// Nothing nearer can be projected, metres.
const NEAR_METRES: f64 = 0.3;

/// Figures of tracks.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrackFigures {
    /// Times of photos.
    pub times: usize,
    /// Of all objects.
    pub all: Score,
    /// Of vehicles: all but people.
    pub vehicles: Score,
}

/// Compares found paths with true ones at the times of a capture's photos. `visible` are the objects that photos of a generated city
/// show; their numbers are the names of the true objects.
pub fn track_figures(
    views: &[View],
    (found, truth): (&[MovingObject], &[MovingObject]),
    visible: Option<&TrueBoxes>,
    ground_from_world: DQuat,
) -> TrackFigures {
    let mut timed: Vec<(f64, &View)> = views.iter().filter_map(|view| Some((view.seconds?, view))).collect();
    timed.sort_by(|a, b| a.0.total_cmp(&b.0));
    let groups: Vec<&[(f64, &View)]> = timed.chunk_by(|a, b| b.0 - a.0 <= SAME_SECONDS).collect();
    let of = |counted: &dyn Fn(&MovingObject) -> bool| {
        let compared = Compared { found, truth, visible, ground_from_world };
        let frames: Vec<Frame> = groups.iter().map(|group| compared.frame(group, counted)).collect();
        score(&frames, WITHIN_METRES)
    };
    let is_person = |object: &MovingObject| matches!(object.class.as_str(), "person" | "pedestrian");
    TrackFigures { times: groups.len(), all: of(&|_| true), vehicles: of(&|object| !is_person(object)) }
}

/// What is compared.
struct Compared<'a> {
    found: &'a [MovingObject],
    truth: &'a [MovingObject],
    visible: Option<&'a TrueBoxes>,
    ground_from_world: DQuat,
}

impl Compared<'_> {
    /// The objects at the time of these photos. Others than the counted ones are neither right nor wrong.
    fn frame(&self, photos: &[(f64, &View)], counted: &dyn Fn(&MovingObject) -> bool) -> Frame {
        let seconds = photos[0].0;
        let pixels = |object: &MovingObject| {
            photos.iter().map(|(_, view)| height_in(&view.camera, object, seconds)).fold(0.0, f64::max)
        };
        let seen: Option<BTreeSet<String>> = self.visible.map(|visible| {
            let shown = photos.iter().filter_map(|(_, view)| visible.of_view(view)).flatten();
            let whole = shown.filter(|of| of.visible >= LEAST_VISIBLE);
            let high = whole.filter(|of| f64::from(of.corners[3] - of.corners[1]) >= LEAST_PIXELS);
            high.map(|of| of.instance.to_string()).collect()
        });
        let at = |object: &MovingObject| -> Option<Placed> {
            let pose = object.pose(seconds)?;
            let middle = pose.apply(0.5 * (object.low + object.high));
            let [place, ahead] = [middle, pose.rotation * DVec3::X].map(|of| (self.ground_from_world * of).truncate());
            Some(Placed { place, ahead })
        };
        let truth = self.truth.iter().enumerate().filter_map(|(id, object)| {
            let is_seen =
                seen.as_ref().map_or_else(|| pixels(object) >= LEAST_PIXELS, |seen| seen.contains(&object.id));
            Some(TrueObject { id, at: at(object)?, counts: is_seen && counted(object) })
        });
        let found = self.found.iter().enumerate().filter(|(_, object)| pixels(object) >= NEAR_SHARE * LEAST_PIXELS);
        let found = found.filter(|(_, object)| counted(object));
        Frame { truth: truth.collect(), found: found.filter_map(|(id, object)| Some((id, at(object)?))).collect() }
    }
}

/// How high an object's box is in a photo whose middle it is in, pixels; 0 elsewhere.
fn height_in(camera: &Camera, object: &MovingObject, seconds: f64) -> f64 {
    let Some(pose) = object.pose(seconds) else { return 0.0 };
    let (middle, depth) = camera.project(pose.apply(0.5 * (object.low + object.high)));
    let (width, height) = (f64::from(camera.pinhole.width), f64::from(camera.pinhole.height));
    if depth < NEAR_METRES || !(0.0..width).contains(&middle.x) || !(0.0..height).contains(&middle.y) {
        return 0.0;
    }
    let across = 0.5 * (object.low + object.high).truncate();
    let rows = [object.low.z, object.high.z].map(|z| camera.project(pose.apply(across.extend(z))).0.y);
    (rows[0] - rows[1]).abs()
}

#[cfg(test)]
mod tests {
    use glam::DMat3;
    use scene::{PathPose, Pinhole, Rigid};

    use super::*;

    /// Looks along x from 1.5 m above the ground.
    fn view(name: &str, seconds: f64) -> View {
        let axes = DMat3::from_cols(-DVec3::Y, -DVec3::Z, DVec3::X);
        let world_from_camera = Rigid { rotation: DQuat::from_mat3(&axes), translation: DVec3::new(0.0, 0.0, 1.5) };
        let pinhole = Pinhole { width: 400, height: 300, fx: 200.0, fy: 200.0, cx: 200.0, cy: 150.0 };
        let camera = Camera { pinhole, camera_from_world: world_from_camera.inverse() };
        View { name: name.into(), camera, mips: Vec::new(), masked: false, depth: None, seconds: Some(seconds) }
    }

    /// Stands ahead of the camera.
    fn object(id: &str, class: &str, ahead: f64, left: f64) -> MovingObject {
        let world_from_object = Rigid { translation: DVec3::new(ahead, left, 0.0), ..Rigid::IDENTITY };
        let path = [0.0, 5.0].map(|seconds| PathPose { seconds, world_from_object }).to_vec();
        let (low, high) = (DVec3::new(-1.0, -1.0, 0.0), DVec3::new(1.0, 1.0, 1.5));
        MovingObject { id: id.into(), class: class.into(), low, high, path }
    }

    #[test]
    fn objects_count_where_photos_show_them_high_enough() {
        let views = [view("a", 1.0), view("b", 1.01), view("c", 2.0)];
        // 30 pixels high, 10 pixels high, behind the camera, and a person.
        let truth = [
            object("1", "car", 10.0, 1.0),
            object("2", "car", 30.0, 0.0),
            object("3", "car", -10.0, 0.0),
            object("4", "person", 8.0, -3.0),
        ];
        let found = [object("a", "car", 10.5, 1.0), object("b", "car", 9.0, 6.0), object("c", "car", 40.0, 9.0)];
        let figures = track_figures(&views, (&found, &truth), None, DQuat::IDENTITY);
        assert_eq!(figures.times, 2);
        let of = |score: &Score| [score.objects, score.misses, score.extra, score.switches];
        assert_eq!([of(&figures.all), of(&figures.vehicles)], [[4, 2, 2, 0], [2, 0, 2, 0]]);
        assert!((figures.vehicles.median_metres.unwrap() - 0.5).abs() < 1e-9);
    }
}
