//! Curves of tasks: bounded, thinned evenly, and their percentiles over many tasks.

use proto::Report;

use crate::views::{Curve, Fleet};

/// Points that are kept of a task; with twice as many, every second one is dropped.
const POINTS: usize = 128;

#[derive(Debug, Clone, Copy)]
pub(crate) struct Point {
    pub(crate) attempt: u32,
    pub(crate) step: u64,
    pub(crate) steps: u64,
    pub(crate) loss: Option<f32>,
    pub(crate) splats: u32,
    pub(crate) cpu_seconds: f64,
    pub(crate) wall_seconds: f64,
}

/// The reports of a task.
#[derive(Debug, Clone, Default)]
pub(crate) struct CurveLog {
    points: Vec<Point>,
    /// The newest report, if it is not among the points.
    newest: Option<Point>,
    /// Reports since the last point, and how many make one.
    since: u32,
    stride: u32,
}

impl CurveLog {
    pub(crate) fn push(&mut self, attempt: u32, report: &Report) {
        let point = Point {
            attempt,
            step: report.step,
            steps: report.steps,
            loss: report.loss.map(|loss| loss as f32),
            splats: report.splats.min(u64::from(u32::MAX)) as u32,
            cpu_seconds: report.cpu_seconds,
            wall_seconds: report.wall_seconds,
        };
        self.since += 1;
        if self.since < self.stride {
            self.newest = Some(point);
            return;
        }
        (self.since, self.newest) = (0, None);
        self.points.push(point);
        if self.points.len() >= 2 * POINTS {
            let mut index = 0;
            self.points.retain(|_| {
                index += 1;
                index % 2 == 0
            });
            self.stride = 2 * self.stride.max(1);
        }
    }

    /// The newest report.
    pub(crate) fn last(&self) -> Option<&Point> {
        self.newest.as_ref().or(self.points.last())
    }

    pub(crate) fn view(&self) -> Curve {
        let mut curve = Curve::default();
        for point in self.points.iter().chain(&self.newest) {
            curve.attempt.push(point.attempt);
            curve.step.push(point.step);
            curve.steps.push(point.steps);
            curve.loss.push(point.loss.map(f64::from));
            curve.splats.push(point.splats.into());
            curve.cpu_seconds.push(point.cpu_seconds);
            curve.wall_seconds.push(point.wall_seconds);
        }
        curve
    }
}

/// Percentiles of these curves at `points` shares of their steps. A curve counts up to where it has got.
pub(crate) fn fleet(curves: &[Curve], points: usize) -> Fleet {
    let mut fleet = Fleet::default();
    for k in 1..=points {
        let share = k as f64 / points as f64;
        // The last report up to that share, of each curve that has got there.
        let at = |curve: &Curve| {
            let share_of = |i: usize| curve.step[i] as f64 / curve.steps[i].max(1) as f64;
            let reached = (0..curve.step.len()).any(|i| share_of(i) >= share - 0.5 / points as f64);
            reached.then(|| (0..curve.step.len()).rev().find(|&i| share_of(i) <= share + 1e-9)).flatten()
        };
        let rows: Vec<(&Curve, usize)> = curves.iter().filter_map(|curve| Some((curve, at(curve)?))).collect();
        let losses = percentiles(rows.iter().filter_map(|&(curve, i)| curve.loss[i]).collect());
        let splats = percentiles(rows.iter().map(|&(curve, i)| curve.splats[i] as f64).collect());
        if let (Some(losses), Some(splats)) = (losses, splats) {
            fleet.share.push(share);
            fleet.loss.push(losses);
            fleet.splats.push(splats);
        }
    }
    fleet
}

/// The tenth, median and ninetieth percentile, the nearest value each.
fn percentiles(mut values: Vec<f64>) -> Option<[f64; 3]> {
    values.sort_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    Some([0.1, 0.5, 0.9].map(|share| values[(share * last as f64).round() as usize]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(step: u64, loss: f64) -> Report {
        Report { step, steps: 1000, loss: Some(loss), splats: step, ..Report::default() }
    }

    #[test]
    fn long_curves_are_thinned_and_keep_their_ends() {
        let mut log = CurveLog::default();
        for step in 1..=10_000 {
            log.push(1, &report(step, 1.0 / step as f64));
        }
        let curve = log.view();
        assert!(curve.step.len() > POINTS && curve.step.len() <= 2 * POINTS + 1, "{}", curve.step.len());
        assert!(curve.step.is_sorted() && curve.step[0] < 200);
        assert_eq!((curve.step.last(), log.last().unwrap().step), (Some(&10_000), 10_000));
    }

    #[test]
    fn percentiles_are_over_the_curves_that_have_got_there() {
        let curves: Vec<Curve> = (1..=11)
            .map(|block| {
                let mut log = CurveLog::default();
                // The last block is half done.
                for step in (100..=if block == 11 { 500 } else { 1000 }).step_by(100) {
                    log.push(1, &report(step, f64::from(block)));
                }
                log.view()
            })
            .collect();
        let fleet = fleet(&curves, 10);
        assert_eq!((fleet.share.len(), fleet.loss[0]), (10, [2.0, 6.0, 10.0]));
        assert_eq!(fleet.loss[9], [2.0, 6.0, 9.0]);
        assert_eq!(fleet.splats[4], [500.0; 3]);
        assert!(super::fleet(&[], 10).share.is_empty());
    }
}
