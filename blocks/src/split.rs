//! Which views are held out of training: every n-th one, and whole stretches of streets.
//!
//! A held-out view of every eighth lies between two training views a few metres away; a trainer that only interpolates passes.
//! A held-out stretch has no training view from its own places, in any direction.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use scene::{Capture, random};

use crate::ground::Ground;
use crate::plan::Plan;
use crate::view_kind::{ViewKind, view_kinds};

/// One stretch in this many is held out, but at least one.
const STRETCHES: usize = 10;

/// What a view is used for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Part {
    /// Training.
    Trained,
    /// Testing: one of every n views.
    Test,
    /// Testing: it lies in a held-out stretch.
    Stretch,
}

/// The part that each view of a capture belongs to. Planning, training and evaluation all ask it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Split(Vec<Part>);

impl Split {
    /// Holds out every `test_every`-th view in name order, starting with the first (0: none), and about one in ten stretches of
    /// the street views' positions (`stretch_metres` 0: none). A stretch is a square of the ground, `stretch_metres` wide, with
    /// street views; which are held out follows from their places alone. Aerial views are in no stretch.
    pub fn new(capture: &Capture, ground: &Ground, test_every: u32, stretch_metres: f64) -> Self {
        let mut parts = vec![Part::Trained; capture.views.len()];
        if test_every > 0 {
            parts.iter_mut().step_by(test_every as usize).for_each(|part| *part = Part::Test);
        }
        if stretch_metres > 0.0 {
            held_out_stretches(capture, ground, stretch_metres).for_each(|view| parts[view] = Part::Stretch);
        }
        Self(parts)
    }

    /// The split of a plan's capture.
    pub fn of(plan: &Plan, capture: &Capture) -> Self {
        Self::new(capture, &plan.ground, plan.settings.test_every, plan.settings.test_stretches)
    }

    /// The part of a view; a view that the capture does not have counts as trained.
    pub fn part(&self, view: u32) -> Part {
        self.0.get(view as usize).copied().unwrap_or(Part::Trained)
    }

    /// Whether a view is never trained on.
    pub fn is_held_out(&self, view: u32) -> bool {
        self.part(view) != Part::Trained
    }

    /// The views of a part, ascending.
    pub fn views(&self, part: Part) -> Vec<u32> {
        (0..self.0.len() as u32).filter(|&view| self.part(view) == part).collect()
    }

    /// All held-out views, ascending.
    pub fn held_out(&self) -> Vec<u32> {
        (0..self.0.len() as u32).filter(|&view| self.is_held_out(view)).collect()
    }
}

/// The views in held-out stretches. None if all street views lie in one stretch.
fn held_out_stretches(capture: &Capture, ground: &Ground, metres: f64) -> impl Iterator<Item = usize> {
    let kinds = view_kinds(capture);
    let mut stretches: BTreeMap<[i64; 2], Vec<usize>> = BTreeMap::new();
    for (view, place) in capture.views.iter().map(|view| view.camera.centre()).enumerate() {
        if kinds[view] == ViewKind::Street && place.is_finite() {
            stretches.entry(stretch_at(ground, place, metres)).or_default().push(view);
        }
    }
    let mut order: Vec<(u64, [i64; 2])> =
        stretches.keys().map(|&[x, y]| (random::bits(x as u64, y as u64), [x, y])).collect();
    order.sort_unstable();
    let count = if order.len() < 2 { 0 } else { order.len().div_ceil(STRETCHES) };
    let held_out: BTreeSet<[i64; 2]> = order.into_iter().take(count).map(|(_, stretch)| stretch).collect();
    stretches.into_iter().filter(move |(stretch, _)| held_out.contains(stretch)).flat_map(|(_, views)| views)
}

/// The stretch of a place: its column and row. Not relative to the root square, whose corner moves with every photo.
fn stretch_at(ground: &Ground, place: DVec3, metres: f64) -> [i64; 2] {
    let at = ground.from_world(place).truncate() / metres;
    [at.x.floor() as i64, at.y.floor() as i64]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{aerial, capture, street};

    fn split(capture: &Capture, test_every: u32, metres: f64) -> Split {
        Split::new(capture, &Ground::of(capture), test_every, metres)
    }

    #[test]
    fn every_nth_view_is_held_out() {
        let drive = street(20, 400);
        assert_eq!(split(&drive, 8, 0.0).held_out(), [0, 8, 16]);
        assert_eq!(split(&drive, 1, 0.0).held_out().len(), 20);
        assert_eq!(split(&drive, 0, 0.0).views(Part::Trained).len(), 20);
        assert!(!split(&drive, 1, 0.0).is_held_out(20));
        assert_eq!(split(&capture(&[], Vec::new(), false), 8, 10.0), Split::default());
    }

    #[test]
    fn stretches_are_held_out_whole() {
        // 200 views, 2 m apart: 20 stretches of 20 m.
        let drive = street(200, 3000);
        let parts = split(&drive, 8, 20.0);
        let stretches = parts.views(Part::Stretch);
        assert_eq!(stretches.len(), 20);
        let places: BTreeSet<u32> = stretches.iter().map(|view| view / 10).collect();
        assert_eq!(places.len(), 2);
        // Every eighth of the others remains a test view.
        assert!(parts.views(Part::Test).iter().all(|view| view % 8 == 0 && !places.contains(&(view / 10))));
        assert_eq!(parts.views(Part::Test).len() + parts.views(Part::Trained).len(), 180);
        // Other points do not change it.
        assert_eq!(split(&street(200, 3300), 8, 20.0), parts);
    }

    #[test]
    fn aerial_views_and_a_single_stretch_are_trained() {
        assert!(split(&aerial(6, 200.0, 2000), 0, 20.0).held_out().is_empty());
        assert!(split(&street(20, 400), 0, 1e9).held_out().is_empty());
    }
}
