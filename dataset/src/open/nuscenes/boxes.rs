//! Boxes of a scene of nuScenes: their classes, and where those that move are at a photo's time.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use scene::nuscenes::{self, Annotation};
use scene::{BadInput, CameraModel, Rigid};

use super::super::moving_boxes::{corners, moving};
use super::tables::Tables;

/// An object whose boxes have an attribute with this ending moves.
const MOVING: &str = ".moving";
/// Boxes are annotated every half second. An object keeps its first and last place for this long before and after.
const ALONE_MICROSECONDS: u64 = 300_000;
/// Between boxes that are farther apart in time the object's place is unknown.
const GAP_MICROSECONDS: u64 = 1_600_000;
/// Boxes in a photo are nearer, metres.
const MAX_DEPTH_METRES: f64 = 200.0;

/// The boxes of a scene.
pub(super) struct Boxes {
    /// Number of boxes by class.
    pub(super) labels: BTreeMap<String, usize>,
    /// For each moving object its boxes, by time.
    moving: Vec<Vec<Annotation>>,
}

impl Boxes {
    pub(super) fn read(tables: &Tables, samples: &BTreeMap<String, i64>) -> Result<Self, BadInput> {
        let boxes = tables.read("sample_annotation", |bytes| nuscenes::read_annotations(bytes, samples))?;
        let instances = tables.read("instance", nuscenes::read_instances)?;
        let categories = tables.read("category", nuscenes::read_names)?;
        let attributes = tables.read("attribute", nuscenes::read_names)?;
        let mut labels = BTreeMap::new();
        let mut said: BTreeSet<&str> = BTreeSet::new();
        for found in &boxes {
            let category = tables.row(&instances, "sample_annotation", "instance", &found.instance)?;
            let name = tables.row(&categories, "instance", "category", category)?;
            *labels.entry(name.clone()).or_default() += 1;
            for token in &found.attributes {
                let name = tables.row(&attributes, "sample_annotation", "attribute", token)?;
                if name.ends_with(MOVING) {
                    said.insert(&found.instance);
                }
            }
        }
        let places = boxes.iter().map(|found| (found.instance.as_str(), found.world_from_box.translation));
        let moving: BTreeSet<&str> = moving(places).into_iter().chain(said).collect();
        let mut by_object: BTreeMap<&str, Vec<Annotation>> = BTreeMap::new();
        for found in boxes.iter().filter(|found| moving.contains(found.instance.as_str())) {
            by_object.entry(&found.instance).or_default().push(found.clone());
        }
        let moving = by_object.into_values().collect();
        Ok(Self { labels, moving })
    }

    /// Corners in the camera's axes of the moving objects that may be in a photo.
    pub(super) fn seen(
        &self,
        microseconds: i64,
        camera_from_world: &Rigid,
        lens: &CameraModel,
        size: Option<(u32, u32)>,
    ) -> Vec<[DVec3; 8]> {
        let at = |boxes: &Vec<Annotation>| {
            let (world_from_box, size) = at(boxes, microseconds)?;
            Some(corners(&camera_from_world.compose(&world_from_box), size))
        };
        self.moving.iter().filter_map(at).filter(|corners| is_in_view(corners, lens, size)).collect()
    }
}

/// An object's pose and size at a time, between its boxes; `None` if they are too far away in time.
fn at(boxes: &[Annotation], microseconds: i64) -> Option<(Rigid, DVec3)> {
    let after = boxes.partition_point(|found| found.microseconds < microseconds);
    let near = |found: &Annotation| {
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
