//! Averages runs over their seeds. The seed alone changes PSNR by tenths of a decibel, so chart and table show means.

use std::collections::BTreeMap;

use crate::{CurvePoint, KindFigures, ResultLine};

/// The mean over the seeds of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Averaged {
    /// The last line of the run with averaged figures; a figure that any seed lacks is null.
    pub line: ResultLine,
    /// The settings in which it differs from the other configurations of its scene and label: `400 steps, 12000 splats`; empty if it is
    /// the only one.
    pub variant: String,
    /// Number of seeds.
    pub seeds: usize,
    /// Largest minus smallest PSNR, dB.
    pub spread: f64,
}

/// The mean over seeds for each scene and label, in order of first appearance, and each configuration that the last line's commit ran, or that
/// differs from the last line in its steps alone. A configuration's lines are those of the last commit that ran it: a longer run added
/// later extends a curve, and does not replace it. Of several lines with the same seed the last one counts. Lines without a seed
/// (references) are not averaged.
pub fn averaged(lines: &[ResultLine]) -> Vec<Averaged> {
    let same = |a: &ResultLine, b: &ResultLine| a.scene == b.scene && a.label == b.label;
    let firsts = lines.iter().enumerate().filter(|(i, line)| !lines[..*i].iter().any(|before| same(before, line)));
    let runs = |(_, first): (usize, &ResultLine)| -> Vec<Averaged> {
        let all: Vec<&ResultLine> = lines.iter().filter(|line| same(line, first)).collect();
        let last = *all.last().expect("the first line matches");
        if last.seed.is_none() {
            return vec![mean(last, &[last], String::new())];
        }
        let newest = |line: &ResultLine| {
            let commit = all.iter().rfind(|other| settings(other) == settings(line)).map(|other| &other.commit);
            commit == Some(&line.commit)
        };
        let by_steps = |line: &ResultLine| line.steps.is_some() && settings(line)[1..] == settings(last)[1..];
        let of_run =
            |line: &&&ResultLine| line.seed.is_some() && newest(line) && (line.commit == last.commit || by_steps(line));
        let all: Vec<&ResultLine> = all.iter().filter(of_run).copied().collect();
        let new = |(i, line): (usize, &&ResultLine)| !all[..i].iter().any(|before| settings(before) == settings(line));
        let distinct: Vec<&ResultLine> =
            all.iter().enumerate().filter(|&(i, line)| new((i, line))).map(|(_, line)| *line).collect();
        let of_settings = |of: &&ResultLine| {
            let mut alike = all.iter().copied().filter(|line| settings(line) == settings(of));
            let by_seed: BTreeMap<Option<u64>, &ResultLine> = alike.clone().map(|line| (line.seed, line)).collect();
            let last = alike.next_back().expect("at least one line matches");
            mean(last, &by_seed.into_values().collect::<Vec<_>>(), variant(of, &distinct))
        };
        distinct.iter().map(of_settings).collect()
    };
    firsts.flat_map(runs).collect()
}

/// The settings that a sweep varies.
fn settings(line: &ResultLine) -> [Option<f64>; 3] {
    [line.steps.map(f64::from), line.budget.map(f64::from), line.tolerance_db]
}

/// The settings of a run that differ among all runs.
fn variant(line: &ResultLine, all: &[&ResultLine]) -> String {
    let names = [" steps", " splats", " dB pruned"];
    let differs = |k: usize| all.iter().any(|other| settings(other)[k] != settings(line)[k]);
    let name = |(k, name): (usize, &str)| Some(format!("{}{name}", settings(line)[k].filter(|_| differs(k))?));
    names.into_iter().enumerate().filter_map(name).collect::<Vec<_>>().join(", ")
}

fn mean(last: &ResultLine, runs: &[&ResultLine], variant: String) -> Averaged {
    let count = runs.len() as f64;
    let of = |get: &dyn Fn(&ResultLine) -> f64| runs.iter().map(|run| get(run)).sum::<f64>() / count;
    let maybe = |get: &dyn Fn(&ResultLine) -> Option<f64>| {
        runs.iter().map(|run| get(run)).sum::<Option<f64>>().map(|sum| sum / count)
    };
    let whole = |get: &dyn Fn(&ResultLine) -> Option<u64>| {
        maybe(&|run| get(run).map(|value| value as f64)).map(|value| value.round() as u64)
    };
    let psnr = |run: &&ResultLine| run.psnr;
    let line = ResultLine {
        cpu_seconds: of(&|run| run.cpu_seconds),
        predicted_cpu_seconds: maybe(&|run| run.predicted_cpu_seconds),
        psnr: of(&|run| run.psnr),
        cc_psnr: maybe(&|run| run.cc_psnr),
        ssim: maybe(&|run| run.ssim),
        lpips: maybe(&|run| run.lpips),
        perceptual: maybe(&|run| run.perceptual),
        detections_kept: maybe(&|run| run.detections_kept),
        // Counts of one training say nothing of the others.
        judged: if runs.len() == 1 { last.judged.clone() } else { Vec::new() },
        depth_absrel: maybe(&|run| run.depth_absrel),
        depth_delta1: maybe(&|run| run.depth_delta1),
        moving_psnr: maybe(&|run| run.moving_psnr),
        aerial: mean_kind(runs, |run| run.aerial),
        street: mean_kind(runs, |run| run.street),
        splats: whole(&|run| run.splats),
        peak_memory_bytes: whole(&|run| run.peak_memory_bytes),
        curve: mean_curve(last, runs),
        ..last.clone()
    };
    let spread = runs.iter().map(psnr).fold(f64::MIN, f64::max) - runs.iter().map(psnr).fold(f64::MAX, f64::min);
    Averaged { line, variant, seeds: runs.len(), spread }
}

/// The mean of the figures of one kind of views; `None` if a run lacks them.
fn mean_kind(runs: &[&ResultLine], kind: fn(&ResultLine) -> Option<KindFigures>) -> Option<KindFigures> {
    let figures: Vec<KindFigures> = runs.iter().map(|run| kind(run)).collect::<Option<_>>()?;
    let count = figures.len() as f64;
    let maybe =
        |get: fn(&KindFigures) -> Option<f64>| figures.iter().map(get).sum::<Option<f64>>().map(|sum| sum / count);
    Some(KindFigures {
        psnr: figures.iter().map(|of| of.psnr).sum::<f64>() / count,
        ssim: maybe(|of| of.ssim),
        perceptual: maybe(|of| of.perceptual),
        worst_cc_gap: maybe(|of| of.worst_cc_gap),
        depth_absrel: maybe(|of| of.depth_absrel),
        depth_delta1: maybe(|of| of.depth_delta1),
        detections_kept: maybe(|of| of.detections_kept),
    })
}

/// The mean of curves of equal length, point by point; else the last run's curve.
fn mean_curve(last: &ResultLine, runs: &[&ResultLine]) -> Vec<CurvePoint> {
    if runs.iter().any(|run| run.curve.len() != last.curve.len()) {
        return last.curve.clone();
    }
    let count = runs.len() as f64;
    let point = |i: usize| {
        let of = |get: &dyn Fn(&CurvePoint) -> f64| runs.iter().map(|run| get(&run.curve[i])).sum::<f64>() / count;
        CurvePoint {
            cpu_seconds: of(&|p| p.cpu_seconds),
            psnr: of(&|p| p.psnr),
            splats: runs.iter().map(|run| run.curve[i].splats).sum::<Option<u64>>().map(|s| s / runs.len() as u64),
        }
    };
    (0..last.curve.len()).map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::line;

    fn of_seed(commit: &str, seed: u64, psnr: f64) -> ResultLine {
        ResultLine {
            commit: commit.into(),
            seed: Some(seed),
            ..line("plat", "fox", &[(1.0, psnr - 1.0), (2.0 * psnr, psnr)])
        }
    }

    #[test]
    fn seeds_of_the_last_commit_are_averaged() {
        let lines = [
            of_seed("old", 0, 50.0),
            of_seed("new", 0, 1.0),
            line("OpenSplat", "fox", &[(9.0, 9.0)]),
            of_seed("new", 1, 24.0),
            of_seed("new", 0, 20.0),
        ];
        let [plat, reference] = &averaged(&lines)[..] else { panic!("two runs") };
        assert_eq!((plat.seeds, plat.spread, plat.line.psnr), (2, 4.0, 22.0));
        assert_eq!(plat.line.curve[1].cpu_seconds, 44.0);
        assert_eq!((reference.seeds, reference.spread, &reference.line), (1, 0.0, &lines[2]));
    }

    #[test]
    fn configurations_are_kept_apart() {
        let with = |commit: &str, steps: u32, budget: u32, seed: u64, psnr: f64| ResultLine {
            steps: Some(steps),
            budget: Some(budget),
            ..of_seed(commit, seed, psnr)
        };
        let lines = [
            with("old", 900, 13, 0, 60.0),
            with("old", 400, 12, 0, 60.0),
            with("new", 400, 12, 0, 20.0),
            with("new", 800, 12, 0, 30.0),
            with("new", 400, 12, 1, 22.0),
            with("new", 800, 12, 0, 31.0),
        ];
        let found = averaged(&lines);
        let found: Vec<_> = found.iter().map(|run| (&*run.variant, run.seeds, run.line.psnr)).collect();
        assert_eq!(found, [("400 steps", 2, 21.0), ("800 steps", 1, 31.0)]);
        let one = averaged(&lines[..1]);
        assert_eq!((one.len(), &*one[0].variant), (1, ""));
        let longer = [&lines[..], &[with("newer", 1600, 12, 0, 33.0)]].concat();
        let found = averaged(&longer);
        let found: Vec<_> = found.iter().map(|run| (&*run.variant, run.seeds, run.line.psnr)).collect();
        assert_eq!(found, [("400 steps", 2, 21.0), ("800 steps", 1, 31.0), ("1600 steps", 1, 33.0)]);
    }

    #[test]
    fn the_mean_lacks_figures_that_a_seed_lacks() {
        let street = |psnr: f64, kept: Option<f64>| {
            let [ssim, perceptual, worst_cc_gap, depth_absrel, depth_delta1] = [Some(psnr / 40.0); 5];
            let detections_kept = kept;
            Some(KindFigures { psnr, ssim, perceptual, worst_cc_gap, depth_absrel, depth_delta1, detections_kept })
        };
        let mut lines = [of_seed("new", 0, 20.0), of_seed("new", 1, 24.0)];
        (lines[0].street, lines[1].street) = (street(20.0, Some(1.0)), street(24.0, None));
        lines[0].aerial = street(20.0, None);
        lines[0].ssim = Some(0.5);
        lines[0].curve.pop();
        let [plat] = &averaged(&lines)[..] else { panic!("one run") };
        assert_eq!((plat.line.ssim, &plat.line.curve), (None, &lines[1].curve));
        assert_eq!((plat.line.aerial, plat.line.street), (None, street(22.0, None)));
    }
}
