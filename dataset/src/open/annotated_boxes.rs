//! Boxes of annotated objects: which of them move, and where they are at a photo's time.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Display;

use glam::DVec3;
use scene::{CameraModel, MovingObject, PathPose, Rigid};

use super::parsed::LabelledBox;

/// An object moves if its places in the world differ by more, metres.
const MOVED_METRES: f64 = 0.5;
/// An object keeps its first and last place for this long before and after. nuScenes annotates every half second.
const ALONE_MICROSECONDS: u64 = 300_000;
/// Between boxes that are farther apart in time the object's place is unknown.
const GAP_MICROSECONDS: u64 = 1_600_000;
/// Boxes in a photo are nearer, metres.
const MAX_DEPTH_METRES: f64 = 200.0;

/// The objects that move, of all places of each.
pub(super) fn moving<K: Ord>(places: impl Iterator<Item = (K, DVec3)>) -> BTreeSet<K> {
    let mut bounds: BTreeMap<K, (DVec3, DVec3)> = BTreeMap::new();
    for (object, place) in places {
        let (low, high) = bounds.entry(object).or_insert((place, place));
        (*low, *high) = (low.min(place), high.max(place));
    }
    let moved = bounds.into_iter().filter(|(_, (low, high))| low.distance(*high) > MOVED_METRES);
    moved.map(|(object, _)| object).collect()
}

/// The corners of a box of this size around its origin, numbered by the bits of their signs along the three sides.
pub(super) fn corners(pose: &Rigid, size: DVec3) -> [DVec3; 8] {
    let sign = |i: usize, bit: usize| if i & bit == 0 { -0.5 } else { 0.5 };
    std::array::from_fn(|i| pose.apply(size * DVec3::new(sign(i, 1), sign(i, 2), sign(i, 4))))
}

/// A box of an object.
#[derive(Debug, Clone, Copy)]
pub(super) struct Placed {
    pub(super) microseconds: i64,
    pub(super) world_from_box: Rigid,
    /// Metres along its axes.
    pub(super) size: DVec3,
}

/// For each object its boxes, by time.
pub(super) struct Tracks {
    tracks: Vec<Track>,
    /// When the clock of the objects starts: with the first box.
    start_microseconds: i64,
}

struct Track {
    name: String,
    class: String,
    moves: bool,
    boxes: Vec<Placed>,
}

impl Tracks {
    /// Of boxes with their objects and classes, each object's in the order of time; `moves` says which objects move.
    pub(super) fn new<'a, K: Ord + Display>(
        boxes: impl Iterator<Item = (K, &'a str, Placed)>,
        moves: impl Fn(&K) -> bool,
    ) -> Self {
        let mut by_object: BTreeMap<K, (&str, Vec<Placed>)> = BTreeMap::new();
        boxes.for_each(|(object, class, found)| by_object.entry(object).or_insert((class, Vec::new())).1.push(found));
        let track = |(object, (class, boxes)): (K, (&str, Vec<Placed>))| {
            let is_allowed = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
            let name = object.to_string().chars().map(|c| if is_allowed(c) { c } else { '_' }).collect();
            Track { name, class: String::from(class), moves: moves(&object), boxes }
        };
        let tracks: Vec<Track> = by_object.into_iter().map(track).collect();
        let start_microseconds = tracks.iter().flat_map(|track| &track.boxes).map(|found| found.microseconds).min();
        Self { tracks, start_microseconds: start_microseconds.unwrap_or(0) }
    }

    /// A time on the clock of the objects, if there are any.
    pub(super) fn seconds(&self, microseconds: i64) -> Option<f64> {
        let since = microseconds.checked_sub(self.start_microseconds)?;
        (!self.tracks.is_empty()).then_some(since as f64 * 1e-6)
    }

    /// The objects that move, by name, each as large as its largest box. One whose place is unknown for a while is another one
    /// afterwards.
    pub(super) fn objects(&self) -> Vec<MovingObject> {
        let part = |track: &Track, number: usize, boxes: &[Placed]| {
            let half = 0.5 * track.boxes.iter().fold(DVec3::ZERO, |size, found| size.max(found.size));
            let mut path: Vec<PathPose> = Vec::new();
            for found in boxes {
                let seconds = self.seconds(found.microseconds).unwrap_or(0.0);
                if path.last().is_none_or(|last| seconds > last.seconds) {
                    path.push(PathPose { seconds, world_from_object: found.world_from_box });
                }
            }
            let id = if number == 0 { track.name.clone() } else { format!("{}-{}", track.name, number + 1) };
            MovingObject { id, class: track.class.clone(), low: -half, high: half, path }
        };
        let object = |track: &Track| {
            let known = |a: &Placed, b: &Placed| b.microseconds.abs_diff(a.microseconds) <= GAP_MICROSECONDS;
            let parts = track.boxes.chunk_by(known).enumerate();
            parts.map(|(number, boxes)| part(track, number, boxes)).collect::<Vec<_>>()
        };
        // Annotations of one that jumps are wrong; its pixels are left out all the same.
        let sane = |of: &MovingObject| of.check().is_ok();
        let mut objects: Vec<MovingObject> =
            self.tracks.iter().filter(|of| of.moves).flat_map(object).filter(sane).collect();
        objects.sort_by(|a, b| a.id.cmp(&b.id));
        objects
    }

    /// The objects that may be in a photo.
    pub(super) fn seen(
        &self,
        microseconds: i64,
        camera_from_world: &Rigid,
        lens: &CameraModel,
        size: Option<(u32, u32)>,
    ) -> Vec<LabelledBox> {
        let seen = |track: &Track| {
            let (world_from_box, side) = at(&track.boxes, microseconds)?;
            let corners = corners(&camera_from_world.compose(&world_from_box), side);
            let labelled = || LabelledBox { class: track.class.clone(), moves: track.moves, corners };
            is_in_view(&corners, lens, size).then(labelled)
        };
        self.tracks.iter().filter_map(seen).collect()
    }
}

/// An object's pose and size at a time, between its boxes; `None` if they are too far away in time.
fn at(boxes: &[Placed], microseconds: i64) -> Option<(Rigid, DVec3)> {
    let after = boxes.partition_point(|found| found.microseconds < microseconds);
    let near = |found: &Placed| {
        let pose = (found.world_from_box, found.size);
        (found.microseconds.abs_diff(microseconds) <= ALONE_MICROSECONDS).then_some(pose)
    };
    match (after.checked_sub(1).and_then(|i| boxes.get(i)), boxes.get(after)) {
        (Some(a), Some(b)) if b.microseconds.abs_diff(a.microseconds) <= GAP_MICROSECONDS => {
            let span = b.microseconds.abs_diff(a.microseconds).max(1);
            let share = microseconds.abs_diff(a.microseconds) as f64 / span as f64;
            let (from, to) = (a.world_from_box, b.world_from_box);
            let rotation = from.rotation.slerp(to.rotation, share).normalize();
            let translation = from.translation.lerp(to.translation, share);
            Some((Rigid { rotation, translation }, a.size.max(b.size)))
        }
        (a, b) => a.and_then(near).or_else(|| b.and_then(near)),
    }
}

/// Whether the box may be in the photo: not if all corners are behind the camera, far away, or beyond one edge.
fn is_in_view(corners: &[DVec3; 8], lens: &CameraModel, size: Option<(u32, u32)>) -> bool {
    if corners.iter().all(|p| p.z <= 0.0) || corners.iter().any(|p| p.length() > MAX_DEPTH_METRES) {
        return false;
    }
    let Some((width, height)) = size else { return true };
    let [fx, fy, cx, cy] = lens.focal_and_centre();
    // An edge and the camera span a plane; half spaces stay right for corners behind the camera.
    let beyond = [
        corners.iter().all(|p| fx * p.x + cx * p.z < 0.0),
        corners.iter().all(|p| fx * p.x + (cx - f64::from(width)) * p.z > 0.0),
        corners.iter().all(|p| fy * p.y + cy * p.z < 0.0),
        corners.iter().all(|p| fy * p.y + (cy - f64::from(height)) * p.z > 0.0),
    ];
    !beyond.contains(&true)
}
