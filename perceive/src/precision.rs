//! Mean average precision, as COCO computes it (Lin et al. 2014; pycocotools' `COCOeval` with one range of areas).
//!
//! Of each class and each least overlap t = 0.5, 0.55 … 0.95: in order of their scores, found boxes take the free true
//! box of their view and class that they overlap most, by at least t. Precision is made monotone from the end and read
//! at the recalls 0, 0.01 … 1. The mean is over the classes that have true boxes, and over t. At most the best 100
//! found boxes of a view and class count.

use std::cmp::Reverse;
use std::ops::Range;

use serde::Serialize;

use crate::boxes::{Detection, overlap};

/// Least overlaps, in hundredths.
const OVERLAPS: [u32; 10] = [50, 55, 60, 65, 70, 75, 80, 85, 90, 95];
/// Steps between the recalls 0 and 1.
const RECALL_STEPS: usize = 100;
/// Most found boxes of a view and class.
const MAX_FOUND: usize = 100;

/// A box that is there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrueBox {
    /// Number of the class.
    pub class: usize,
    /// Left, top, right, bottom in pixels of the picture.
    pub corners: [f32; 4],
    /// Whether it is to be found. Of others a found box counts neither as right nor as wrong.
    pub counts: bool,
}

/// True and found boxes of a view.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Boxes {
    /// What is there.
    pub truth: Vec<TrueBox>,
    /// What was found.
    pub found: Vec<Detection>,
    /// Least height of a found box that counts as wrong where no true box is, pixels.
    pub least_height: f32,
}

/// Mean average precision; null without true boxes that count. The field names are keys of `eval/report.json`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Precision {
    /// Mean over the least overlaps 0.5 to 0.95.
    pub map: Option<f64>,
    /// At a least overlap of 0.5.
    pub map50: Option<f64>,
}

/// What became of a found box.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Outcome {
    Right,
    Wrong,
    Ignored,
}

/// The mean average precision over these views.
pub fn precision(views: &[&Boxes]) -> Precision {
    let classes = views.iter().flat_map(|view| &view.truth).filter(|of| of.counts).map(|of| of.class + 1).max();
    let by_class: Vec<[f64; 10]> = (0..classes.unwrap_or(0)).filter_map(|class| of_class(views, class)).collect();
    let mean = |overlaps: Range<usize>| {
        let (count, values) = (by_class.len() * overlaps.len(), by_class.iter().flat_map(|of| &of[overlaps.clone()]));
        (count > 0).then(|| values.sum::<f64>() / count as f64)
    };
    Precision { map: mean(0..OVERLAPS.len()), map50: mean(0..1) }
}

/// A class's average precision for each least overlap; `None` without true boxes that count.
fn of_class(views: &[&Boxes], class: usize) -> Option<[f64; 10]> {
    let is_true = |of: &&TrueBox| of.class == class && of.counts;
    let total = views.iter().flat_map(|view| &view.truth).filter(is_true).count();
    let views: Vec<Overlaps> = views.iter().map(|view| Overlaps::of(view, class)).collect();
    (total > 0).then(|| {
        OVERLAPS.map(|least| {
            let outcomes = views.iter().flat_map(|view| view.outcomes(f64::from(least) / 100.0));
            average(outcomes.collect(), total)
        })
    })
}

/// Boxes of a class in a view and how they overlap: true boxes, those that count first; found boxes, best first.
struct Overlaps<'a> {
    truth: Vec<&'a TrueBox>,
    found: Vec<&'a Detection>,
    least_height: f32,
}

impl<'a> Overlaps<'a> {
    fn of(view: &'a Boxes, class: usize) -> Self {
        let mut truth: Vec<_> = view.truth.iter().filter(|of| of.class == class).collect();
        truth.sort_by_key(|of| Reverse(of.counts));
        let mut found: Vec<_> = view.found.iter().filter(|of| of.class == class).collect();
        found.sort_by(|a, b| b.score.total_cmp(&a.score));
        found.truncate(MAX_FOUND);
        Self { truth, found, least_height: view.least_height }
    }

    /// Scores of the found boxes with what became of them. A box that does not count is taken only if none that counts
    /// can be. Of equal overlaps the last one is taken, as in pycocotools.
    fn outcomes(&self, least: f64) -> Vec<(f32, Outcome)> {
        let mut taken = vec![false; self.truth.len()];
        let mut outcome = |of: &&Detection| {
            let mut best: Option<(usize, f64)> = None;
            for (i, truth) in self.truth.iter().enumerate().filter(|(i, _)| !taken[*i]) {
                if best.is_some_and(|(best, _)| self.truth[best].counts && !truth.counts) {
                    break;
                }
                let common = overlap(truth.corners, of.corners);
                if common >= best.map_or(least, |(_, most)| most) {
                    best = Some((i, common));
                }
            }
            let Some((i, _)) = best else {
                let is_small = of.corners[3] - of.corners[1] < self.least_height;
                return (of.score, if is_small { Outcome::Ignored } else { Outcome::Wrong });
            };
            taken[i] = true;
            (of.score, if self.truth[i].counts { Outcome::Right } else { Outcome::Ignored })
        };
        self.found.iter().map(&mut outcome).collect()
    }
}

/// Mean of the precision at the recalls; `total` true boxes are to be found.
fn average(mut outcomes: Vec<(f32, Outcome)>, total: usize) -> f64 {
    outcomes.sort_by(|a, b| b.0.total_cmp(&a.0));
    let (mut right, mut wrong) = (0usize, 0usize);
    let mut curve: Vec<(usize, f64)> = Vec::new();
    for (_, outcome) in outcomes {
        match outcome {
            Outcome::Right => right += 1,
            Outcome::Wrong => wrong += 1,
            Outcome::Ignored => continue,
        }
        curve.push((right, right as f64 / (right + wrong) as f64));
    }
    let mut best = 0.0f64;
    for (_, precision) in curve.iter_mut().rev() {
        best = best.max(*precision);
        *precision = best;
    }
    let at = |step: usize| {
        // The first point whose recall reaches step / 100, in integers.
        let reached = curve.partition_point(|(right, _)| right * RECALL_STEPS < step * total);
        curve.get(reached).map_or(0.0, |(_, precision)| *precision)
    };
    (0..=RECALL_STEPS).map(at).sum::<f64>() / (RECALL_STEPS + 1) as f64
}

#[cfg(test)]
mod expected;

#[cfg(test)]
mod tests {
    use super::expected::EXPECTED;
    use super::*;

    /// The generator of `tests/expected.py`; 0..1.
    struct Numbers(u64);

    impl Numbers {
        fn next(&mut self) -> f32 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 40) as f32 / (1 << 24) as f32
        }
    }

    /// Boxes as in `tests/expected.py`.
    fn boxes(seed: u64, views: usize, classes: usize) -> Vec<Boxes> {
        let mut n = Numbers(seed);
        let mut view = |_| {
            let mut made = Boxes { least_height: 8.0, ..Boxes::default() };
            for _ in 0..(n.next() * 12.0) as usize {
                let [left, top] = [n.next() * 200.0, n.next() * 100.0];
                let [width, height] = [n.next() * 60.0 + 5.0, n.next() * 60.0 + 5.0];
                let corners = [left, top, left + width, top + height];
                let (class, counts) = ((n.next() * classes as f32) as usize, n.next() > 0.2);
                made.truth.push(TrueBox { class, corners, counts });
                for _ in 0..(n.next() * 3.0) as usize {
                    let jitter = [(); 4].map(|()| (n.next() - 0.5) * 12.0);
                    let class = if n.next() > 0.15 { class } else { 0 };
                    let score = (n.next() * 16.0).floor() / 16.0;
                    let corners = [0, 1, 2, 3].map(|i| corners[i] + jitter[i]);
                    made.found.push(Detection { class, score, corners });
                }
            }
            made
        };
        (0..views).map(&mut view).collect()
    }

    #[test]
    fn figures_are_those_of_pycocotools() {
        for &(seed, views, classes, map, map50) in EXPECTED {
            let made = boxes(seed, views, classes);
            let found = precision(&made.iter().collect::<Vec<_>>());
            let [off, off50] = [(found.map, map), (found.map50, map50)].map(|(found, wanted)| found.unwrap() - wanted);
            println!("{views} views, {classes} classes: {found:?}, off by {off:.1e} and {off50:.1e}");
            assert!(off.abs() < 1e-12 && off50.abs() < 1e-12);
        }
    }

    #[test]
    fn what_is_found_exactly_is_found_wholly_and_nothing_is_no_figure() {
        assert_eq!(precision(&[]), Precision::default());
        let corners = [0.0, 0.0, 10.0, 20.0];
        let found = vec![Detection { class: 3, score: 0.5, corners }];
        let only_found = Boxes { found: found.clone(), ..Boxes::default() };
        assert_eq!(precision(&[&only_found]), Precision::default());
        let truth = |counts| vec![TrueBox { class: 3, corners, counts }];
        let view =
            |counts, found: &[Detection]| Boxes { truth: truth(counts), found: found.to_vec(), ..Boxes::default() };
        assert_eq!(precision(&[&view(true, &found)]), Precision { map: Some(1.0), map50: Some(1.0) });
        assert_eq!(precision(&[&view(true, &[])]), Precision { map: Some(0.0), map50: Some(0.0) });
        assert_eq!(precision(&[&view(false, &found)]), Precision::default());
        // Half as high: an overlap of exactly 0.5 is a match at one of ten thresholds.
        let half = Detection { corners: [0.0, 0.0, 10.0, 10.0], ..found[0] };
        assert_eq!(precision(&[&view(true, &[half])]), Precision { map: Some(0.1), map50: Some(1.0) });
    }
}
