//! How far the detections on a photo and on a render of the same view agree.
//!
//! A detection on the photo is *kept* if the render has one of the same group of classes that overlaps it by at least
//! 0.5. Cars, buses and trucks are one group: which of them a van is may change with a few pixels. Every other class is
//! a group of its own.

use std::ops::AddAssign;

use serde::Serialize;

use crate::boxes::{Detection, iou};

/// Least overlap of a box on the render with that on the photo.
const MATCHES: f32 = 0.5;
const VEHICLES: [&str; 4] = ["car", "bus", "truck", "vehicle"];
const PEOPLE: [&str; 1] = ["person"];

/// Numbers of detections. The field names are keys of `eval/report.json`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// On photos.
    pub photos: u64,
    /// On renders.
    pub renders: u64,
    /// On photos, and also on the render.
    pub kept: u64,
    /// On renders without one on the photo.
    pub extra: u64,
}

/// Detections on photos and renders by groups of classes. The field names are keys of `eval/report.json`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Agreement {
    /// Cars, buses, trucks, and what a card maps to `vehicle`.
    pub vehicles: Counts,
    /// People.
    pub people: Counts,
    /// All classes.
    pub all: Counts,
    /// Sum of the overlaps (intersection over union) of all that are kept with what keeps them.
    #[serde(skip)]
    pub overlaps: f64,
}

impl Agreement {
    /// The groups with their names.
    pub fn named(&self) -> [(&'static str, Counts); 3] {
        [("vehicles", self.vehicles), ("people", self.people), ("all classes", self.all)]
    }

    /// Mean over the detections on photos of the overlap with what keeps them; 0 for those that are not kept. `None`
    /// without detections.
    pub fn mean_overlap(&self) -> Option<f64> {
        (self.all.photos > 0).then(|| self.overlaps / self.all.photos as f64)
    }
}

impl AddAssign for Counts {
    fn add_assign(&mut self, more: Self) {
        self.photos += more.photos;
        self.renders += more.renders;
        self.kept += more.kept;
        self.extra += more.extra;
    }
}

impl AddAssign for Agreement {
    fn add_assign(&mut self, more: Self) {
        self.vehicles += more.vehicles;
        self.people += more.people;
        self.all += more.all;
        self.overlaps += more.overlaps;
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Group {
    Vehicles,
    People,
    Class(usize),
}

fn group(of: &Detection, classes: &[String]) -> Group {
    let name = classes.get(of.class).map_or("", String::as_str);
    match of.class {
        _ if VEHICLES.contains(&name) => Group::Vehicles,
        _ if PEOPLE.contains(&name) => Group::People,
        class => Group::Class(class),
    }
}

/// Compares detections on a photo and on its render; `classes` are the names of the detector's classes. In order of
/// their scores, detections on the render take that on the photo which they overlap most and no other has taken.
pub fn agreement(photo: &[Detection], render: &[Detection], classes: &[String]) -> Agreement {
    let (mut agreement, mut overlaps) = (Agreement::default(), 0.0);
    let mut add = |of: &Detection, counts: Counts| {
        agreement.all += counts;
        match group(of, classes) {
            Group::Vehicles => agreement.vehicles += counts,
            Group::People => agreement.people += counts,
            Group::Class(_) => {}
        }
    };
    photo.iter().for_each(|of| add(of, Counts { photos: 1, ..Counts::default() }));
    for (of, takes) in matched(photo, render, classes) {
        let (kept, extra) = if takes.is_some() { (1, 0) } else { (0, 1) };
        overlaps += takes.map_or(0.0, |(_, overlap)| f64::from(overlap));
        add(of, Counts { photos: 0, renders: 1, kept, extra });
    }
    Agreement { overlaps, ..agreement }
}

/// Which detections on the photo are kept on its render, matched as [`agreement`] does.
pub fn kept(photo: &[Detection], render: &[Detection], classes: &[String]) -> Vec<bool> {
    let mut kept = vec![false; photo.len()];
    matched(photo, render, classes).into_iter().filter_map(|(_, takes)| takes).for_each(|(i, _)| kept[i] = true);
    kept
}

/// Detections on the render in order of their scores, each with the one on the photo that it takes, and their overlap.
fn matched<'a>(
    photo: &[Detection],
    render: &'a [Detection],
    classes: &[String],
) -> Vec<(&'a Detection, Option<(usize, f32)>)> {
    let mut taken = vec![false; photo.len()];
    let mut by_score: Vec<&Detection> = render.iter().collect();
    by_score.sort_by(|a, b| b.score.total_cmp(&a.score));
    let take = |of: &'a Detection| {
        let free = (0..photo.len()).filter(|&i| !taken[i] && group(&photo[i], classes) == group(of, classes));
        let matches = free.map(|i| (i, iou(photo[i].corners, of.corners))).filter(|(_, overlap)| *overlap >= MATCHES);
        let best = matches.reduce(|best, next| if next.1 > best.1 { next } else { best });
        best.iter().for_each(|(i, _)| taken[*i] = true);
        (of, best)
    };
    by_score.into_iter().map(take).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coco;

    const PERSON: usize = 0;
    const CAR: usize = 2;
    const TRUCK: usize = 7;
    const BENCH: usize = 13;

    fn at(class: usize, score: f32, left: f32) -> Detection {
        Detection { class, score, corners: [left, 0.0, left + 10.0, 10.0] }
    }

    fn compared(photo: &[Detection], render: &[Detection]) -> Agreement {
        let classes = coco::NAMES.map(str::to_owned);
        let agreement = agreement(photo, render, &classes);
        let kept = kept(photo, render, &classes);
        assert_eq!((kept.len(), kept.iter().filter(|kept| **kept).count()), (photo.len(), agreement.all.kept as usize));
        agreement
    }

    fn counts(photos: u64, renders: u64, kept: u64) -> Counts {
        Counts { photos, renders, kept, extra: renders - kept }
    }

    #[test]
    fn kept_and_extra_are_counted_by_group() {
        // A car that became a truck, a person moved too far, a bench kept, a bench that is none.
        let photo = [at(CAR, 0.9, 0.0), at(PERSON, 0.8, 100.0), at(BENCH, 0.5, 200.0)];
        let render = [at(TRUCK, 0.4, 2.0), at(PERSON, 0.9, 106.0), at(BENCH, 0.5, 200.0), at(BENCH, 0.9, 300.0)];
        let found = compared(&photo, &render);
        assert_eq!((found.vehicles, found.people, found.all), (counts(1, 1, 1), counts(1, 1, 0), counts(3, 4, 2)));
        // A person is no bench.
        assert_eq!(compared(&[at(PERSON, 0.9, 0.0)], &[at(BENCH, 0.9, 0.0)]).all, counts(1, 1, 0));
        assert_eq!(compared(&photo, &photo).all, counts(3, 3, 3));
        assert_eq!(compared(&[], &[]), Agreement::default());
        let of_a_card = ["car", "vehicle"].map(str::to_owned);
        assert_eq!(agreement(&[at(0, 0.9, 0.0)], &[at(1, 0.9, 0.0)], &of_a_card).vehicles, counts(1, 1, 1));
        // The truck overlaps the car by 8 of 12, the bench is where it was, the person is lost.
        assert!((found.mean_overlap().unwrap() - (2.0 / 3.0 + 1.0) / 3.0).abs() < 1e-6);
        assert_eq!(compared(&[], &render).mean_overlap(), None);
        let mut sum = found;
        sum += found;
        assert_eq!(sum.all, counts(6, 8, 4));
    }

    #[test]
    fn matches_are_one_to_one_and_the_best_score_chooses_first() {
        // Two boxes on the render over one on the photo: one is extra.
        assert_eq!(compared(&[at(CAR, 0.9, 0.0)], &[at(CAR, 0.9, 0.0), at(CAR, 0.8, 1.0)]).all, counts(1, 2, 1));
        // The better one takes the photo's nearest box; the other still has its own.
        let photo = [at(CAR, 0.9, 0.0), at(CAR, 0.9, 3.0)];
        assert_eq!(compared(&photo, &[at(CAR, 0.5, 3.0), at(CAR, 0.6, 1.0)]).all, counts(2, 2, 2));
        // The better one takes the only box that the other could have had.
        assert_eq!(compared(&photo[..1], &[at(CAR, 0.5, 0.0), at(CAR, 0.6, 3.0)]).all, counts(1, 2, 1));
    }
}
