//! Boxes of annotated objects: which of them move, and their corners.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use scene::Rigid;

/// An object moves if its places in the world differ by more, metres.
const MOVED_METRES: f64 = 0.5;

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
