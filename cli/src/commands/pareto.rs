//! `plat bench pareto`: trains every combination of captures and values, measures the merged models, and appends a line for each.
//!
//! Runs come one after the other in an order that mixes all values, seed by seed, so that what else the machine does hits all alike.
//! A run whose line is there already is left out: a sweep that was stopped goes on.

use std::fs;
use std::path::{Path, PathBuf};

use ::bench::{CurvePoint, ResultLine, append, read};
use scene::BadInput;
use serde::Serialize;
use store::Store;
use train::random;

use crate::args::{Auto, Backend, Named, ParetoArgs, PlanOptions, TrainArgs};
use crate::cameras;
use crate::clock;
use crate::commands::bench::invoked;
use crate::commands::eval::{self, evaluate};
use crate::commands::plan::plan_of;
use crate::commands::train::{Trained, make_folder, resolved, train};
use crate::failure::{Failure, cannot};
use crate::lpips::Lpips;
use crate::model::{self, save_json};
use crate::output::Output;
use crate::record::{Record, commit};

/// The file of our own runs.
const RUNS: &str = "plat.jsonl";

/// A combination.
#[derive(Debug, Clone)]
struct Run {
    label: String,
    scene: String,
    train: TrainArgs,
}

#[derive(Serialize)]
struct Swept<'a> {
    command: &'static str,
    /// Of all combinations, in the order in which they ran.
    lines: &'a [ResultLine],
    /// Those of them that were there already.
    skipped: usize,
}

pub(crate) fn run(args: &ParetoArgs, output: &Output) -> Result<(), Failure> {
    let lpips = args.lpips.as_deref().map(Lpips::load).transpose()?;
    let runs = runs(args)?;
    let file = args.results.join(RUNS);
    let mut there = if file.exists() { read(&file)? } else { Vec::new() };
    let (mut lines, mut text, mut skipped) = (Vec::new(), String::new(), 0);
    for (n, run) in runs.iter().enumerate() {
        let known = if args.sweep.train.fresh { None } else { known(run, &there, output)? };
        let line = match known {
            Some(line) => {
                skipped += 1;
                output.note(format!("{}: its line is there already", described(&line)));
                line
            }
            None => {
                if runs.len() > 1 {
                    output.note(format!("run {} of {}", n + 1, runs.len()));
                }
                let (line, measured) = one(run, lpips.as_ref(), output)?;
                keep(&args.results, &line)?;
                if runs.len() > 1 {
                    // A sweep's photos and checkpoints would be there once for each run.
                    let store = run.train.out.join("store");
                    fs::remove_dir_all(&store).map_err(cannot("removed", &store))?;
                }
                text = measured;
                there.push(line.clone());
                line
            }
        };
        lines.push(line);
    }
    let appended = format!("appended to {}", file.display());
    if let [line] = &lines[..] {
        let said = if skipped > 0 { described(line) } else { format!("{text}\n{appended}") };
        return output.result(line, &said);
    }
    let swept = Swept { command: "bench pareto", lines: &lines, skipped };
    let each: Vec<String> = lines.iter().map(described).collect();
    let added = format!("{} of {} lines {appended}", lines.len() - skipped, lines.len());
    output.result(&swept, &format!("{}\n{added}", each.join("\n")))
}

/// Every combination, mixed.
fn runs(args: &ParetoArgs) -> Result<Vec<Run>, BadInput> {
    let sweep = &args.sweep;
    if args.scene.is_some() && sweep.captures.len() > 1 {
        return Err(BadInput::new("--scene", "names one capture, there are several", "give each as NAME=PATH"));
    }
    let mut all = Vec::new();
    for (round, &seed) in sweep.seed.iter().enumerate() {
        let mut of_seed = Vec::new();
        for capture in &sweep.captures {
            for &backend in &sweep.backend {
                for &steps in &sweep.steps {
                    for &budget in &sweep.budget {
                        for &tolerance_db in &sweep.tolerance_db {
                            let plan = PlanOptions { steps, budget, tolerance_db, seed, ..sweep.train.plan.clone() };
                            of_seed.push(combination(
                                args,
                                capture,
                                TrainArgs { plan, backend, ..sweep.train.clone() },
                            ));
                        }
                    }
                }
            }
        }
        let order = random::shuffle(round as u64, of_seed.len());
        all.extend(order.into_iter().map(|i| of_seed[i as usize].clone()));
    }
    if all.len() == 1 {
        all[0].train.out.clone_from(&sweep.train.out);
    } else if sweep.train.store.is_some() {
        let advice = "leave --store: a line says what all of the work took, photos included";
        return Err(BadInput::new("--store", "is one run's, there are several", advice));
    }
    Ok(all)
}

/// A run with a folder of its own. A line says what all of the work took, so nothing of earlier runs is used.
fn combination(args: &ParetoArgs, capture: &Named, train: TrainArgs) -> Run {
    let scene = args.scene.clone().or_else(|| capture.name.clone()).unwrap_or_else(|| cameras::name_of(&capture.path));
    let backend = match train.backend {
        Backend::Auto => "auto",
        Backend::Cpu => "cpu",
        Backend::Gpu => "gpu",
    };
    // One line of the chart is of one backend.
    let label = if args.sweep.backend.len() > 1 { format!("{}, {backend}", args.label) } else { args.label.clone() };
    let PlanOptions { steps, budget, tolerance_db, seed, .. } = &train.plan;
    let name = format!("{scene}-{backend}-{steps}-steps-{budget}-splats-{tolerance_db}-dB-seed-{seed}");
    let plain = |c: char| if c.is_alphanumeric() || "-.".contains(c) { c } else { '_' };
    let out: PathBuf = train.out.join(name.chars().map(plain).collect::<String>().trim_start_matches('.'));
    Run { label, scene, train: TrainArgs { out, capture: capture.path.clone(), fresh: true, ..train } }
}

/// The line of this run, where there is one of this commit and this machine.
fn known(run: &Run, there: &[ResultLine], output: &Output) -> Result<Option<ResultLine>, Failure> {
    let machine = ::bench::machine();
    let alike = |line: &&ResultLine| {
        line.label == run.label && line.scene == run.scene && line.commit == commit() && line.machine == machine
    };
    if !there.iter().any(|line| alike(&line)) {
        return Ok(None);
    }
    let source = cameras::open(&run.train.capture, output)?;
    let (_, plan) = plan_of(&source.capture, &run.train.plan)?;
    let hash = Some(resolved(&run.train, &plan).1.to_string());
    Ok(there.iter().rfind(|line| alike(line) && line.config_hash == hash).cloned())
}

/// Trains and measures; the line, and the figures as text.
fn one(run: &Run, lpips: Option<&Lpips>, output: &Output) -> Result<(ResultLine, String), Failure> {
    clock::forget_peak_memory();
    let Trained { capture, report, curve } = train(&run.train, output)?;
    let model = model::read(&run.train.out)?;
    let store_url = run.train.store.clone().unwrap_or_else(|| run.train.out.join("store").display().to_string());
    let store = Store::open(&store_url)?.blocking();
    let out = run.train.out.join("eval");
    let mut record = report.record;
    let evaluated = evaluate(&model, capture, store, run.train.plan.test_every, lpips, &out, output)?;
    save_json(&out.join("report.json"), &evaluated)?;
    record.scene.clone_from(&run.scene);
    record.measured(&evaluated.record);
    Ok((line_of(&run.label, &record, curve), eval::text(&evaluated)))
}

/// A run's line, whose curve ends with the merged model at the end of all work.
pub(crate) fn line_of(label: &str, record: &Record, mut curve: Vec<CurvePoint>) -> ResultLine {
    if let (Some(cpu_seconds), Some(psnr)) = (record.cpu_seconds, record.psnr) {
        curve.pop();
        curve.push(CurvePoint { cpu_seconds, psnr, splats: Some(record.splats) });
    }
    record.line(label, invoked(), curve)
}

/// Appends a run's line to those of all.
pub(crate) fn keep(results: &Path, line: &ResultLine) -> Result<PathBuf, Failure> {
    let file = results.join(RUNS);
    make_folder(results)?;
    append(&file, line)?;
    Ok(file)
}

/// A line for a person.
fn described(line: &ResultLine) -> String {
    let auto = |value: Option<u32>| Auto(value);
    format!(
        "{}, {}, {} steps, {} splats planned, seed {}: {:.2} dB, {:.1} CPU s, {} splats",
        line.scene,
        line.label,
        auto(line.steps),
        auto(line.budget),
        line.seed.unwrap_or_default(),
        line.psnr,
        line.cpu_seconds,
        line.splats.unwrap_or_default(),
    )
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::args::{BenchCommand, Cli, Command};

    fn runs_of(words: &[&str]) -> Result<Vec<Run>, String> {
        let all = ["plat", "bench", "pareto", "--label", "l", "--out", "o"].iter().chain(words);
        match Cli::try_parse_from(all).map_err(|e| e.to_string())?.command {
            Command::Bench(BenchCommand::Pareto(args)) => runs(&args).map_err(|e| e.to_string()),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn every_combination_runs_once_and_seeds_come_in_rounds() {
        let all = runs_of(&["a=x", "y", "--steps", "10,20,auto", "--budget", "5,6", "--seed", "0,3"]).unwrap();
        assert_eq!(all.len(), 2 * 3 * 2 * 2);
        assert!(
            all[..12].iter().all(|run| run.train.plan.seed == 0)
                && all[12..].iter().all(|run| run.train.plan.seed == 3)
        );
        let mut folders: Vec<_> = all.iter().map(|run| run.train.out.clone()).collect();
        // Mixed: neither one capture after the other nor one number of steps after the other.
        let changes = |key: fn(&Run) -> String| all[..12].windows(2).filter(|w| key(&w[0]) != key(&w[1])).count();
        assert!(changes(|run| run.scene.clone()) > 2 && changes(|run| run.train.plan.steps.to_string()) > 4);
        folders.sort();
        folders.dedup();
        assert_eq!(folders.len(), all.len(), "two runs in one folder");
        assert!(all.iter().all(|run| (run.scene == "a") == (run.train.capture == Path::new("x"))));
        assert!(all.iter().all(|run| run.label == "l" && run.train.fresh));
        let again = runs_of(&["a=x", "y", "--steps", "10,20,auto", "--budget", "5,6", "--seed", "0,3"]).unwrap();
        assert!(all.iter().zip(&again).all(|(a, b)| a.train.out == b.train.out), "the order is not the same twice");
    }

    #[test]
    fn one_run_is_as_of_train() {
        let [run] = &runs_of(&["--scene", "s", "x", "--steps", "3", "--steps", "10", "--store", "st"]).unwrap()[..]
        else {
            panic!()
        };
        assert_eq!((run.scene.as_str(), run.train.out.as_path()), ("s", Path::new("o")));
        assert_eq!((run.train.plan.steps.0, run.train.store.as_deref()), (Some(10), Some("st")));
    }

    #[test]
    fn what_cannot_be_swept_is_refused() {
        let line = |words: &[&str]| runs_of(words).unwrap_err();
        assert!(line(&["a", "b", "--scene", "s"]).contains("--scene"));
        assert!(line(&["a", "--steps", "1,2", "--store", "s"]).contains("--store"));
        assert!(line(&["a", "--steps", "1,many"]).contains("many"));
        assert!(line(&[]).contains("NAME=PATH"));
        let labels: Vec<String> =
            runs_of(&["a", "--backend", "cpu,gpu"]).unwrap().into_iter().map(|run| run.label).collect();
        assert!(labels.contains(&"l, cpu".into()) && labels.contains(&"l, gpu".into()));
    }
}
