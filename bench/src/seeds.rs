//! One run of several seeds: what chart and table show, as a seed alone moves PSNR by tenths of a decibel.

use std::collections::BTreeMap;

use crate::{CurvePoint, ResultLine};

/// The mean over the seeds of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Averaged {
    /// The last line of the run with its figures averaged; those that a seed lacks are null.
    pub line: ResultLine,
    /// Number of seeds.
    pub seeds: usize,
    /// Largest PSNR less the smallest, dB.
    pub spread: f64,
}

/// For each scene and label, in the order of their first appearance: the mean over seeds of the lines that the last
/// line's commit wrote, each seed's last one. Lines without a seed (references) stand alone.
pub fn averaged(lines: &[ResultLine]) -> Vec<Averaged> {
    let same = |a: &ResultLine, b: &ResultLine| a.scene == b.scene && a.label == b.label;
    let firsts = lines.iter().enumerate().filter(|(i, line)| !lines[..*i].iter().any(|before| same(before, line)));
    let run = |(_, first): (usize, &ResultLine)| {
        let last = lines.iter().rfind(|line| same(line, first)).expect("the first is one");
        let of_run = |line: &&ResultLine| same(line, last) && line.commit == last.commit && line.seed.is_some();
        let by_seed: BTreeMap<Option<u64>, &ResultLine> =
            lines.iter().filter(of_run).map(|line| (line.seed, line)).collect();
        match last.seed {
            Some(_) => mean(last, &by_seed.into_values().collect::<Vec<_>>()),
            None => mean(last, &[last]),
        }
    };
    firsts.map(run).collect()
}

fn mean(last: &ResultLine, runs: &[&ResultLine]) -> Averaged {
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
        psnr: of(&|run| run.psnr),
        cc_psnr: maybe(&|run| run.cc_psnr),
        ssim: maybe(&|run| run.ssim),
        lpips: maybe(&|run| run.lpips),
        perceptual: maybe(&|run| run.perceptual),
        splats: whole(&|run| run.splats),
        peak_memory_bytes: whole(&|run| run.peak_memory_bytes),
        curve: mean_curve(last, runs),
        ..last.clone()
    };
    let spread = runs.iter().map(psnr).fold(f64::MIN, f64::max) - runs.iter().map(psnr).fold(f64::MAX, f64::min);
    Averaged { line, seeds: runs.len(), spread }
}

/// Point by point where all curves have as many; else the last one's.
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
    fn what_a_seed_lacks_the_mean_lacks() {
        let mut lines = [of_seed("new", 0, 20.0), of_seed("new", 1, 24.0)];
        lines[0].ssim = Some(0.5);
        lines[0].curve.pop();
        let [plat] = &averaged(&lines)[..] else { panic!("one run") };
        assert_eq!((plat.line.ssim, &plat.line.curve), (None, &lines[1].curve));
    }
}
