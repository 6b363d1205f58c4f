//! Boxes of a scene of nuScenes: their classes, their tracks, and which of them move.

use std::collections::{BTreeMap, BTreeSet};

use scene::BadInput;
use scene::nuscenes;

use super::super::annotated_boxes::{Placed, Tracks, moving};
use super::tables::Tables;

/// An object whose boxes have an attribute with this ending moves.
const MOVING: &str = ".moving";
/// The boxes of a scene.
pub(super) struct Boxes {
    /// Number of boxes by class.
    pub(super) labels: BTreeMap<String, usize>,
    /// Those of each object.
    pub(super) tracks: Tracks,
}

impl Boxes {
    pub(super) fn read(tables: &Tables, samples: &BTreeMap<String, i64>) -> Result<Self, BadInput> {
        let boxes = tables.read("sample_annotation", |bytes| nuscenes::read_annotations(bytes, samples))?;
        let instances = tables.read("instance", nuscenes::read_instances)?;
        let categories = tables.read("category", nuscenes::read_names)?;
        let attributes = tables.read("attribute", nuscenes::read_names)?;
        let (mut labels, mut placed) = (BTreeMap::new(), Vec::new());
        let mut said: BTreeSet<&str> = BTreeSet::new();
        for found in &boxes {
            let category = tables.row(&instances, "sample_annotation", "instance", &found.instance)?;
            let name = tables.row(&categories, "instance", "category", category)?;
            *labels.entry(name.clone()).or_default() += 1;
            let &nuscenes::Annotation { microseconds, world_from_box, size, .. } = found;
            placed.push((found.instance.as_str(), name.as_str(), Placed { microseconds, world_from_box, size }));
            for token in &found.attributes {
                let name = tables.row(&attributes, "sample_annotation", "attribute", token)?;
                if name.ends_with(MOVING) {
                    said.insert(&found.instance);
                }
            }
        }
        let places = boxes.iter().map(|found| (found.instance.as_str(), found.world_from_box.translation));
        let moving: BTreeSet<&str> = moving(places).into_iter().chain(said).collect();
        Ok(Self { tracks: Tracks::new(placed.into_iter(), |object| moving.contains(object)), labels })
    }
}
