//! Detections against the true boxes of a generated city.

use dataset::true_boxes::SeenObject;
use perceive::{Boxes, Card, Detection, Precision, TrueBox, precision};
use serde::Serialize;

/// Least height of a box that counts, pixels.
const LEAST_HEIGHT: f32 = 20.0;
/// Least share of an object's bounds that has to be visible for it to count.
const LEAST_VISIBLE: f32 = 0.5;

/// The objects of a view.
pub(crate) type Objects = Vec<SeenObject>;

/// True boxes of a view with what was found on its photo and on its render.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TruthBoxes([Boxes; 2]);

/// Detections on photos and renders against true boxes. The field names are keys of `eval/report.json`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AgainstTruth {
    /// True boxes that count.
    pub boxes: u64,
    /// True boxes that are small, hidden or masked by more than half: whether they are found changes nothing.
    pub left_out: u64,
    /// Of the detections on photos.
    pub photos: Precision,
    /// Of the detections on renders.
    pub renders: Precision,
}

impl TruthBoxes {
    /// The objects of classes that the detector knows; `is_hidden` tells whether a box is masked. `found` is that on
    /// the photo and on the render.
    pub(crate) fn new(
        objects: &Objects,
        card: &Card,
        is_hidden: impl Fn([f32; 4]) -> bool,
        found: [Vec<Detection>; 2],
    ) -> Self {
        let truth = |of: &SeenObject| {
            let corners = of.corners;
            let is_large = corners[3] - corners[1] >= LEAST_HEIGHT;
            let counts = is_large && of.visible >= LEAST_VISIBLE && !is_hidden(corners);
            Some(TrueBox { class: card.class_named(coco_name(&of.class)?)?, corners, counts })
        };
        let truth: Vec<TrueBox> = objects.iter().filter_map(truth).collect();
        Self(found.map(|found| Boxes { truth: truth.clone(), found, least_height: LEAST_HEIGHT }))
    }
}

/// What COCO calls a class of `plat synth`; it has no signs but those for stopping.
fn coco_name(class: &str) -> Option<&str> {
    match class {
        "person" | "rider" => Some("person"),
        "traffic-light" => Some("traffic light"),
        "car" | "truck" | "bus" | "motorcycle" | "bicycle" => Some(class),
        _ => None,
    }
}

impl AgainstTruth {
    pub(crate) fn of(views: &[&TruthBoxes]) -> Self {
        let all = || views.iter().flat_map(|TruthBoxes([photo, _])| &photo.truth);
        let boxes = all().filter(|of| of.counts).count();
        let of = |i: usize| precision(&views.iter().map(|view| &view.0[i]).collect::<Vec<_>>());
        Self { boxes: boxes as u64, left_out: (all().count() - boxes) as u64, photos: of(0), renders: of(1) }
    }
}

#[cfg(test)]
mod tests {
    use perceive::card::Card;
    use perceive::network::Shapes;

    use super::*;

    #[test]
    fn small_hidden_and_masked_objects_change_nothing() {
        let shapes =
            Shapes { inputs: vec![[1, 3, 64, 96].map(Some).to_vec()], outputs: vec![[1, 126, 85].map(Some).to_vec()] };
        let card = Card::of(&shapes, Some("[map]\ncar = 'vehicle'\ntruck = 'vehicle'")).unwrap();
        let object = |class: &str, left: f32, height: f32, visible: f32| SeenObject {
            instance: 1,
            class: class.into(),
            corners: [left, 0.0, left + 30.0, height],
            visible,
        };
        let objects = vec![
            object("car", 0.0, 40.0, 1.0),
            object("truck", 100.0, 40.0, 0.4),
            object("rider", 200.0, 40.0, 0.9),
            object("person", 300.0, 12.0, 1.0),
            object("car", 400.0, 40.0, 1.0),
            object("traffic-sign", 500.0, 40.0, 1.0),
        ];
        let vehicle = card.class_named("truck").unwrap();
        let person = card.class_named("person").unwrap();
        let found =
            |class, left: f32, height| Detection { class, score: 0.5, corners: [left, 0.0, left + 30.0, height] };
        // On the photo everything, and a small box where nothing is; on the render a vehicle where nothing is.
        let photo = vec![
            found(vehicle, 0.0, 40.0),
            found(vehicle, 100.0, 40.0),
            found(person, 200.0, 40.0),
            found(person, 300.0, 12.0),
            found(vehicle, 400.0, 40.0),
            found(vehicle, 600.0, 15.0),
        ];
        let render = vec![found(vehicle, 700.0, 40.0), found(person, 200.0, 40.0)];
        let boxes = TruthBoxes::new(&objects, &card, |corners| corners[0] == 400.0, [photo, render]);
        let all = AgainstTruth::of(&[&boxes]);
        assert_eq!((all.boxes, all.left_out), (2, 3));
        assert_eq!((all.photos.map, all.renders.map), (Some(1.0), Some(0.5)));
    }
}
