//! Boxes of a scene of nuScenes: their classes, and the tracks of those that move.

use std::collections::{BTreeMap, BTreeSet};

use scene::BadInput;
use scene::nuscenes;

use super::super::moving_boxes::{Placed, Tracks, moving};
use super::tables::Tables;

/// An object whose boxes have an attribute with this ending moves.
const MOVING: &str = ".moving";
/// The boxes of a scene.
pub(super) struct Boxes {
    /// Number of boxes by class.
    pub(super) labels: BTreeMap<String, usize>,
    /// Those of objects that move.
    pub(super) moving: Tracks,
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
        let placed = boxes.iter().filter(|found| moving.contains(found.instance.as_str())).map(|found| {
            let &nuscenes::Annotation { microseconds, world_from_box, size, .. } = found;
            (found.instance.as_str(), Placed { microseconds, world_from_box, size })
        });
        Ok(Self { moving: Tracks::new(placed), labels })
    }
}
