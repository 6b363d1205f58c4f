//! How far found paths are the true ones: CLEAR MOT (Bernardin and Stiefelhagen 2008), and the errors of their poses (the absolute
//! trajectory error of Sturm et al. 2012, without an alignment, as both are in the world's axes).
//!
//! At each time, true objects keep the track that they had if it is still near enough; the others are assigned the nearest ones. A true
//! object without a track is missed, a track without a true object is extra, and one whose track is another than before has switched.
//! MOTA is 1 less the share of the three in the true objects.

use std::collections::BTreeMap;

use glam::DVec2;
use serde::Serialize;

use super::assignment::assigned;

/// Where an object is at a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placed {
    /// Ground metres.
    pub place: DVec2,
    /// Where its front is, as a direction on the ground.
    pub ahead: DVec2,
}

/// A true object at a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrueObject {
    /// Its number.
    pub id: usize,
    /// Where it is.
    pub at: Placed,
    /// Whether it is to be found. A track of another one is neither right nor wrong.
    pub counts: bool,
}

/// What is there and what was found at a time.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Frame {
    /// What is there.
    pub truth: Vec<TrueObject>,
    /// Numbers of tracks, and where they are.
    pub found: Vec<(usize, Placed)>,
}

/// Figures of all times; the field names are keys of `plat objects track --json`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Score {
    /// True objects that count, over all times.
    pub objects: usize,
    /// True objects without a track.
    pub misses: usize,
    /// Tracks without a true object.
    pub extra: usize,
    /// True objects whose track is another than the one before.
    pub switches: usize,
    /// 1 − (misses + extra + switches) / objects; null without objects.
    pub mota: Option<f64>,
    /// Distance of tracks from their true objects, metres: median and 95th percentile.
    pub median_metres: Option<f64>,
    /// As `median_metres`.
    pub p95_metres: Option<f64>,
    /// Absolute trajectory error: the root mean square of these distances, metres.
    pub ate_metres: Option<f64>,
    /// Angle on the ground between the fronts of tracks and of their true objects, degrees: median and 95th percentile.
    pub median_degrees: Option<f64>,
    /// As `median_degrees`.
    pub p95_degrees: Option<f64>,
}

/// The figures of these times, in their order. Tracks farther than `within` metres from a true object are not its own.
pub fn score(frames: &[Frame], within: f64) -> Score {
    let (mut score, mut partner, mut off) = (Score::default(), BTreeMap::<usize, usize>::new(), Vec::new());
    let mut turned = Vec::new();
    for Frame { truth, found } in frames {
        let distance = |i: usize, j: usize| truth[i].at.place.distance(found[j].1.place);
        let mut of_truth: Vec<Option<usize>> = vec![None; truth.len()];
        let mut is_taken = vec![false; found.len()];
        for (i, object) in truth.iter().enumerate() {
            let kept = partner.get(&object.id).and_then(|id| found.iter().position(|(track, _)| track == id));
            if let Some(j) = kept.filter(|&j| !is_taken[j] && distance(i, j) <= within) {
                (of_truth[i], is_taken[j]) = (Some(j), true);
            }
        }
        // Those that count choose first.
        for counts in [true, false] {
            let rows: Vec<usize> =
                (0..truth.len()).filter(|&i| of_truth[i].is_none() && truth[i].counts == counts).collect();
            let columns: Vec<usize> = (0..found.len()).filter(|&j| !is_taken[j]).collect();
            let pairs = assigned(rows.len(), columns.len(), within, |i, j| distance(rows[i], columns[j]));
            for (&i, pair) in rows.iter().zip(&pairs) {
                if let Some(j) = pair.map(|j| columns[j]) {
                    (of_truth[i], is_taken[j]) = (Some(j), true);
                }
            }
        }
        for (i, object) in truth.iter().enumerate() {
            if let Some(j) = of_truth[i] {
                let before = partner.insert(object.id, found[j].0);
                if object.counts {
                    off.push(distance(i, j));
                    turned.push(object.at.ahead.angle_to(found[j].1.ahead).abs().to_degrees());
                    score.switches += usize::from(before.is_some_and(|before| before != found[j].0));
                }
            }
            score.objects += usize::from(object.counts);
            score.misses += usize::from(object.counts && of_truth[i].is_none());
        }
        score.extra += is_taken.iter().filter(|taken| !**taken).count();
    }
    off.sort_by(f64::total_cmp);
    let wrong = (score.misses + score.extra + score.switches) as f64;
    score.mota = (score.objects > 0).then(|| 1.0 - wrong / score.objects as f64);
    [score.median_metres, score.p95_metres] = quantiles(&off);
    let square = off.iter().map(|metres| metres * metres).sum::<f64>() / off.len() as f64;
    score.ate_metres = (!off.is_empty()).then(|| square.sqrt());
    turned.sort_by(f64::total_cmp);
    [score.median_degrees, score.p95_degrees] = quantiles(&turned);
    score
}

/// The median and the 95th percentile of sorted numbers.
fn quantiles(sorted: &[f64]) -> [Option<f64>; 2] {
    [sorted.len() / 2, sorted.len() * 95 / 100].map(|i| sorted.get(i).copied())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64) -> Placed {
        Placed { place: DVec2::new(x, 0.0), ahead: DVec2::X }
    }

    fn truth(id: usize, x: f64) -> TrueObject {
        TrueObject { id, at: at(x), counts: true }
    }

    #[test]
    fn misses_extras_and_switches_count() {
        let frames = [
            Frame { truth: vec![truth(0, 0.0), truth(1, 10.0)], found: vec![(7, at(0.5)), (8, at(10.0))] },
            // Track 7 stays with object 0 though 9 is nearer; object 1 is missed, 9 is extra.
            Frame { truth: vec![truth(0, 1.0), truth(1, 11.0)], found: vec![(9, at(1.1)), (7, at(2.0))] },
            // 9 takes over.
            Frame { truth: vec![truth(0, 2.0), truth(1, 12.0)], found: vec![(9, at(2.0)), (8, at(12.4))] },
        ];
        let found = score(&frames, 2.0);
        assert_eq!([found.objects, found.misses, found.extra, found.switches], [6, 1, 1, 1]);
        assert_eq!((found.mota, found.p95_metres), (Some(0.5), Some(1.0)));
        assert!((found.median_metres.unwrap() - 0.4).abs() < 1e-9);
        // 0.5, 0, 1, 0 and 0.4 m.
        assert!((found.ate_metres.unwrap() - (1.41f64 / 5.0).sqrt()).abs() < 1e-9);
        assert_eq!((found.median_degrees, found.p95_degrees), (Some(0.0), Some(0.0)));
    }

    #[test]
    fn fronts_are_compared_on_the_ground() {
        let towards = |ahead: DVec2| Placed { ahead, ..at(0.0) };
        let frame = |ahead| Frame { truth: vec![truth(0, 0.0)], found: vec![(1, towards(ahead))] };
        let found = score(&[DVec2::X, DVec2::new(1.0, -1.0), DVec2::NEG_X].map(frame), 2.0);
        assert!((found.median_degrees.unwrap() - 45.0).abs() < 1e-9);
        assert!((found.p95_degrees.unwrap() - 180.0).abs() < 1e-9);
    }

    #[test]
    fn what_does_not_count_is_neither_right_nor_wrong() {
        let hidden = TrueObject { counts: false, ..truth(3, 5.0) };
        let found = score(&[Frame { truth: vec![hidden], found: vec![(1, at(5.0)), (2, at(50.0))] }], 2.0);
        assert_eq!((found.objects, found.misses, found.extra, found.mota), (0, 0, 1, None));
        assert_eq!(score(&[], 2.0), Score::default());
    }
}
