//! `plat bench pareto`: trains every combination of captures and option values, measures the models, and appends a line for each.
//!
//! Seeds come one after the other; within a seed the runs are shuffled, so that other load on the machine affects all values alike.
//! Runs whose line exists are skipped, so an interrupted sweep can be resumed.

use std::fs;
use std::path::PathBuf;

use ::bench::{KindFigures, ResultLine, read};
use dataset::ingest::TrueDepth;
use eval::{DepthSummary, Lpips, Photos, Summary, load_detector};
use scene::BadInput;
use serde::Serialize;
use store::Store;
use train::random;

use crate::args::{Auto, Backend, Named, ParetoArgs, PlanOptions, TrainArgs};
use crate::captures;
use crate::clock;
use crate::commands::eval::{Further, measure_trained, true_boxes};
use crate::commands::prune_orders::judged;
use crate::commands::train::{Trained, resolved, store_url, train};
use crate::eval_report::{Evaluated, text};
use crate::failure::{Failure, cannot};
use crate::output::Output;
use crate::planning::plan_of;
use crate::result_lines::{RUNS, append_run, line_of};
use crate::run_record::commit;

/// One combination of a sweep.
#[derive(Debug, Clone)]
struct Run {
    label: String,
    scene: String,
    train: TrainArgs,
}

#[derive(Serialize)]
struct Swept<'a> {
    command: &'static str,
    /// Of all combinations, in the order of the runs.
    lines: &'a [ResultLine],
    /// Number of lines that existed before.
    skipped: usize,
}

pub(crate) fn run(args: &ParetoArgs, output: &Output) -> Result<(), Failure> {
    let lpips = args.lpips.as_deref().map(Lpips::load).transpose()?;
    let detectors = args.detector.iter().map(|file| load_detector(file)).collect::<Result<Vec<_>, _>>()?;
    if args.sweep.train.plan.evaluate {
        return Err(BadInput::new("--evaluate", "measures what each run is measured on anyway", "leave it").into());
    }
    let further = Further { lpips: lpips.as_ref(), detectors: &detectors, ..Further::default() };
    let runs = runs(args)?;
    let file = args.results.join(RUNS);
    let mut existing = if file.exists() { read(&file)? } else { Vec::new() };
    let (mut lines, mut text, mut skipped) = (Vec::new(), String::new(), 0);
    for (n, run) in runs.iter().enumerate() {
        let known = if args.sweep.train.fresh { None } else { known(run, &existing, args, output)? };
        let line = match known {
            Some(line) => {
                skipped += 1;
                output.note(format!("{}: skipped, its line exists", described(&line)));
                line
            }
            None => {
                if runs.len() > 1 {
                    output.note(format!("run {} of {}", n + 1, runs.len()));
                }
                let (line, figures) = train_and_measure(run, &further, args.depth, output)?;
                append_run(&args.results, &line)?;
                if runs.len() > 1 {
                    // Photos and checkpoints would fill the disk once per run.
                    let store = run.train.out.join("store");
                    fs::remove_dir_all(&store).map_err(cannot("removed", &store))?;
                }
                text = figures;
                existing.push(line.clone());
                line
            }
        };
        lines.push(line);
    }
    let appended = format!("appended to {}", file.display());
    if let [line] = &lines[..] {
        let shown = if skipped > 0 { described(line) } else { format!("{text}\n{appended}") };
        return output.result(line, &shown);
    }
    let swept = Swept { command: "bench pareto", lines: &lines, skipped };
    let each: Vec<String> = lines.iter().map(described).collect();
    let added = format!("{} of {} lines {appended}", lines.len() - skipped, lines.len());
    output.result(&swept, &format!("{}\n{added}", each.join("\n")))
}

/// All combinations, shuffled within each seed.
fn runs(args: &ParetoArgs) -> Result<Vec<Run>, BadInput> {
    let sweep = &args.sweep;
    if args.scene.is_some() && sweep.captures.len() > 1 {
        return Err(BadInput::new("--scene", "names one capture, but there are several", "give each as NAME=PATH"));
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
        let advice = "leave --store: a line counts all work, ingest included";
        return Err(BadInput::new("--store", "is for one run, but there are several", advice));
    }
    Ok(all)
}

/// A run with a folder of its own. Its line counts all work, so it reuses nothing of earlier runs.
fn combination(args: &ParetoArgs, capture: &Named, train: TrainArgs) -> Run {
    let scene = args.scene.clone().or_else(|| capture.name.clone()).unwrap_or_else(|| captures::name_of(&capture.path));
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

/// The existing line of this run, if it is of this commit and machine and has the figures that are asked for.
fn known(
    run: &Run,
    existing: &[ResultLine],
    args: &ParetoArgs,
    output: &Output,
) -> Result<Option<ResultLine>, Failure> {
    let machine = ::bench::machine();
    let alike = |line: &&ResultLine| {
        line.label == run.label
            && line.scene == run.scene
            && line.commit == commit()
            && line.machine == machine
            && has_figures(line, args.depth, args.detector.len())
    };
    if !existing.iter().any(|line| alike(&line)) {
        return Ok(None);
    }
    let source = captures::open_to_plan(&run.train.capture, &run.train.plan, output)?;
    let (_, plan) = plan_of(&source, &run.train.plan)?;
    let hash = Some(resolved(&run.train, &plan).1.to_string());
    Ok(existing.iter().rfind(|line| alike(line) && line.config_hash == hash).cloned())
}

/// Whether a line has the figures of `--depth` and `--detector` where they are asked for.
fn has_figures(line: &ResultLine, depth: bool, detectors: usize) -> bool {
    (!depth || line.depth_delta1.is_some()) && line.judged.len() >= detectors
}

/// Trains and measures a run, with its depth if asked; returns its line and the figures as text.
fn train_and_measure(
    run: &Run,
    further: &Further,
    depth: bool,
    output: &Output,
) -> Result<(ResultLine, String), Failure> {
    let depth = depth.then(|| TrueDepth::open(&run.train.capture)).transpose()?;
    let true_boxes = true_boxes(further.detectors, &run.train.capture)?;
    clock::reset_peak_memory();
    let Trained { capture, report, curve, .. } = train(&run.train, output)?;
    let model = model::read(&run.train.out)?;
    let store = Store::open(&store_url(&run.train))?.blocking();
    let out = run.train.out.join("eval");
    let mut record = report.record;
    let plan = &run.train.plan;
    let split = model.split(&capture, None, None);
    let photos = Photos::ingested(capture, store, split, plan.downscale);
    let further = Further { depth: depth.as_ref(), true_boxes: true_boxes.as_ref(), ..*further };
    let evaluated = measure_trained(&model, photos, &further, &out, output)?;
    record.scene.clone_from(&run.scene);
    record.set_quality(&evaluated.record);
    let depth = evaluated.depth.as_ref().map(|report| report.groups.held_out.all);
    let [aerial, street] = by_kind(&evaluated);
    let line = ResultLine {
        depth_absrel: depth.and_then(|of| of.absrel),
        depth_delta1: depth.and_then(|of| of.delta1),
        moving_psnr: evaluated.moving.as_ref().and_then(|of| of.psnr),
        judged: evaluated.detections.iter().map(|of| judged(of.detector.clone(), &of.groups.held_out.all)).collect(),
        aerial,
        street,
        ..line_of(&run.label, &record, curve)
    };
    Ok((line, text(&evaluated)))
}

/// Figures of the held-out aerial and street views, where both kinds are there.
fn by_kind(evaluated: &Evaluated) -> [Option<KindFigures>; 2] {
    let held_out = &evaluated.by_kind;
    let depth = evaluated.depth.as_ref().map(|report| &report.groups.held_out);
    let found = evaluated.detections.first().map(|found| &found.groups.held_out);
    let of = |figures: Option<Summary>, depth: Option<DepthSummary>, kept: Option<f64>| {
        let figures = figures?;
        Some(KindFigures {
            psnr: figures.psnr?,
            ssim: figures.ssim,
            perceptual: figures.ssimulacra2,
            worst_cc_gap: figures.worst_cc_gap,
            depth_absrel: depth.and_then(|of| of.absrel),
            depth_delta1: depth.and_then(|of| of.delta1),
            detections_kept: kept,
        })
    };
    [
        of(held_out.aerial, depth.and_then(|of| of.aerial), found.and_then(|of| of.aerial?.share_kept)),
        of(held_out.street, depth.and_then(|of| of.street), found.and_then(|of| of.street?.share_kept)),
    ]
}

/// A result line as text.
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
    use std::path::Path;

    use clap::Parser;

    use super::*;
    use crate::args::{BenchCommand, Cli, Command};
    use crate::run_record::Record;

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
        // Shuffled: neither captures nor steps come in runs.
        let changes = |key: fn(&Run) -> String| all[..12].windows(2).filter(|w| key(&w[0]) != key(&w[1])).count();
        assert!(changes(|run| run.scene.clone()) > 2 && changes(|run| run.train.plan.steps.to_string()) > 4);
        folders.sort();
        folders.dedup();
        assert_eq!(folders.len(), all.len(), "two runs share a folder");
        assert!(all.iter().all(|run| (run.scene == "a") == (run.train.capture == Path::new("x"))));
        assert!(all.iter().all(|run| run.label == "l" && run.train.fresh));
        let again = runs_of(&["a=x", "y", "--steps", "10,20,auto", "--budget", "5,6", "--seed", "0,3"]).unwrap();
        assert!(all.iter().zip(&again).all(|(a, b)| a.train.out == b.train.out), "the order is not deterministic");
    }

    #[test]
    fn a_single_run_uses_the_options_of_train() {
        let [run] = &runs_of(&["--scene", "s", "x", "--steps", "3", "--steps", "10", "--store", "st"]).unwrap()[..]
        else {
            panic!()
        };
        assert_eq!((run.scene.as_str(), run.train.out.as_path()), ("s", Path::new("o")));
        assert_eq!((run.train.plan.steps.0, run.train.store.as_deref()), (Some(10), Some("st")));
    }

    #[test]
    fn a_line_without_the_figures_asked_for_does_not_stand_for_the_run() {
        let line = |depth, judges: usize| ResultLine {
            depth_delta1: depth,
            judged: vec![judged("d.onnx".into(), &eval::DetectionSummary::default()); judges],
            ..line_of("l", &Record::new("train"), Vec::new())
        };
        let answers = |of: &ResultLine| {
            [(false, 0), (true, 0), (false, 1), (true, 2)].map(|(depth, judges)| has_figures(of, depth, judges))
        };
        assert_eq!(answers(&line(None, 0)), [true, false, false, false]);
        assert_eq!(answers(&line(Some(0.5), 1)), [true, true, true, false]);
        assert_eq!(answers(&line(None, 2)), [true, false, true, false]);
        assert_eq!(answers(&line(Some(0.5), 2)), [true; 4]);
    }

    #[test]
    fn options_of_a_single_run_are_refused_in_a_sweep() {
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
