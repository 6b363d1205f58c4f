//! `plat bench ablate`: trains the same block by each variant of the recipe and reports the time to reach target PSNRs.
//!
//! Within a seed the variants are trained in turn, so that other load on the machine affects all of them alike.

use std::sync::Arc;

use ::bench::parts::{Ablation, Reached};
use ::bench::{CurvePoint, PartLine, append_part, cpu_seconds_to};
use serde::Serialize;
use store::Store;
use worker::one_block::{Evaluation, OneBlockTraining};

use crate::ablation_variants::{DEFAULT, Variant};
use crate::args::{AblateArgs, Auto, BLOCK_MEMORY_MIB, Blocks, DepthKind, PlanOptions, RESIDUAL};
use crate::backend;
use crate::captures::{self, ingest_photos};
use crate::commands::train::CACHE_BYTES;
use crate::failure::{Failure, make_folder, temporary_folder};
use crate::output::Output;
use crate::planning::{check_plan, plan_of};
use crate::run_record::{commit, invocation};

/// The file of ablations.
const LINES: &str = "ablation.jsonl";

/// Means of a variant over its seeds.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Mean {
    variant: &'static str,
    about: &'static str,
    seeds: usize,
    /// CPU seconds to each target; null if a seed never reached it.
    reached: Vec<Reached>,
    psnr: f64,
    splats: f64,
    cpu_seconds: f64,
}

#[derive(Serialize)]
struct Ablated<'a> {
    command: &'static str,
    scene: &'a str,
    targets: &'a [f64],
    means: &'a [Mean],
    lines: &'a [Ablation],
}

pub(crate) fn run(args: &AblateArgs, output: &Output) -> Result<(), Failure> {
    let variants = &args.variants;
    if args.to_gain.is_some() && !variants.iter().any(|variant| variant.name == DEFAULT) {
        let problem = format!("is a share of the gain of {DEFAULT}, which --variants leaves out");
        return Err(scene::BadInput::new("--to-gain", problem, "add it, or give --to").into());
    }
    let backend = backend::open(args.backend)?;
    let source = captures::open(&args.capture, output)?;
    let folder = temporary_folder()?;
    let store = Store::open(&folder.path().display().to_string())?.blocking();
    let (planned_for, plan) = plan_of(&source, &plan_options(args, 0))?;
    check_plan(&plan, &planned_for, output)?;
    let capture = Arc::new(ingest_photos(&source, &store, args.downscale, output)?.capture);
    let mut lines: Vec<Ablation> = Vec::new();
    let runs = args.seeds.len() * variants.len();
    make_folder(&args.results)?;
    let file = args.results.join(LINES);
    let append = |line: &mut Ablation, targets: &[f64]| {
        line.reached = reached(&line.curve, targets);
        append_part(&file, &PartLine::Ablation(line.clone()))
    };
    // With --to-gain the targets depend on the last run.
    let targets_are_known = !args.to.is_empty() && args.to_gain.is_none();
    for &seed in &args.seeds {
        let (_, plan) = plan_of(&source, &plan_options(args, seed))?;
        let training = OneBlockTraining {
            plan: &plan,
            capture: capture.clone(),
            store: store.clone(),
            backend: backend.clone(),
            threads: args.threads as usize,
            cache_bytes: CACHE_BYTES,
            evaluations: args.looks,
        };
        for variant in variants {
            let samples = training.train(variant.recipe).map_err(|error| match error.kind {
                worker::FailureKind::Input => Failure::Input(error.message),
                _ => Failure::Work(error.message),
            })?;
            let [.., last] = samples[..] else { return Err(Failure::Work("nothing was measured".into())) };
            output.note(format!(
                "{} of {runs}: {}, seed {seed}: {:.2} dB, {:.1} CPU s",
                lines.len() + 1,
                variant.name,
                last.psnr,
                last.cpu_seconds
            ));
            let mut line = Ablation {
                backend: backend.name(),
                variant: variant.name.to_owned(),
                seed,
                steps: plan.settings.steps,
                budget: plan.settings.budget,
                psnr: last.psnr,
                splats: last.splats,
                cpu_seconds: last.cpu_seconds,
                wall_seconds: last.wall_seconds,
                curve: samples.iter().map(point).collect(),
                ..blank_line(args)
            };
            if targets_are_known {
                append(&mut line, &args.to)?;
            }
            lines.push(line);
        }
    }
    let targets = targets(args, &lines);
    if !targets_are_known {
        lines.iter_mut().try_for_each(|line| append(line, &targets))?;
    }
    let means: Vec<Mean> = variants.iter().map(|variant| mean(variant, &lines)).collect();
    let scene = lines.first().map_or("", |line| &line.scene);
    let ablated = Ablated { command: "bench ablate", scene, targets: &targets, means: &means, lines: &lines };
    output.result(&ablated, &format!("{}appended to {}", table(&targets, &means), file.display()))
}

/// A plan of one block, without pruning.
fn plan_options(args: &AblateArgs, seed: u64) -> PlanOptions {
    PlanOptions {
        blocks: Blocks::Tree,
        levels: Auto(Some(0)),
        steps: args.steps,
        views_per_step: 1,
        budget: args.budget,
        tolerance_db: 0.0,
        residual: RESIDUAL,
        seed,
        test_every: args.test_every,
        antialiased: false,
        exposure: false,
        refine_poses: false,
        refine_sensors: false,
        objects: false,
        label_blocks: false,
        depth_weight: 0.0,
        no_lidar: true,
        no_radar: true,
        no_masks: false,
        no_backdrop: false,
        block_memory: BLOCK_MEMORY_MIB,
        depths: None,
        depth_kind: DepthKind::Metric,
        depth_unit: None,
        no_depths: true,
        evaluate: false,
        test_stretches: 0.0,
        downscale: args.downscale,
    }
}

/// A line with what all runs have in common.
fn blank_line(args: &AblateArgs) -> Ablation {
    Ablation {
        commit: commit().to_owned(),
        machine: ::bench::machine(),
        scene: args.scene.clone().unwrap_or_else(|| captures::name_of(&args.capture)),
        downscale: args.downscale,
        threads: args.threads,
        command: invocation(),
        ..Ablation::default()
    }
}

fn point(evaluation: &Evaluation) -> CurvePoint {
    CurvePoint { cpu_seconds: evaluation.cpu_seconds, psnr: evaluation.psnr, splats: Some(evaluation.splats) }
}

fn reached(curve: &[CurvePoint], targets: &[f64]) -> Vec<Reached> {
    targets.iter().map(|&psnr| Reached { psnr, cpu_seconds: cpu_seconds_to(curve, psnr) }).collect()
}

/// The target PSNRs: those given, and the given share of the default's gain from its initial to its final splats, as means over seeds.
fn targets(args: &AblateArgs, lines: &[Ablation]) -> Vec<f64> {
    let mut targets = args.to.clone();
    let gain = if targets.is_empty() { args.to_gain.or(Some(DEFAULT_GAIN)) } else { args.to_gain };
    let of_default = || lines.iter().filter(|line| line.variant == DEFAULT);
    let first = average(of_default().filter_map(|line| Some(line.curve.first()?.psnr)));
    let last = average(of_default().map(|line| line.psnr));
    if let (Some(gain), Some(first), Some(last)) = (gain, first, last) {
        targets.push(first + gain * (last - first));
    }
    targets
}

/// Target share of the gain if no target is given.
const DEFAULT_GAIN: f64 = 0.9;

fn average(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0u32), |(sum, count), value| (sum + value, count + 1));
    (count > 0).then(|| sum / f64::from(count))
}

fn mean(variant: &Variant, lines: &[Ablation]) -> Mean {
    let of_variant: Vec<&Ablation> = lines.iter().filter(|line| line.variant == variant.name).collect();
    let of = |get: fn(&Ablation) -> f64| average(of_variant.iter().map(|line| get(line))).unwrap_or(f64::NAN);
    let targets = of_variant.first().map_or(&[][..], |line| &line.reached);
    let reached = targets.iter().enumerate().map(|(k, target)| {
        let all: Option<Vec<f64>> = of_variant.iter().map(|line| line.reached[k].cpu_seconds).collect();
        Reached { psnr: target.psnr, cpu_seconds: all.and_then(|all| average(all.into_iter())) }
    });
    Mean {
        variant: variant.name,
        about: variant.about,
        seeds: of_variant.len(),
        reached: reached.collect(),
        psnr: of(|line| line.psnr),
        splats: of(|line| line.splats as f64),
        cpu_seconds: of(|line| line.cpu_seconds),
    }
}

/// The means as text, a row per variant; each time with its ratio to the default's.
fn table(targets: &[f64], means: &[Mean]) -> String {
    let heads: String = targets.iter().map(|target| format!(" {:>18}", format!("s to {target:.2} dB"))).collect();
    let mut text = format!("{:<14}{heads} {:>9} {:>9} {:>18}\n", "variant", "PSNR, dB", "splats", "CPU s in total");
    let default = means.iter().find(|mean| mean.variant == DEFAULT);
    let beside = |value: Option<f64>, usual: Option<f64>| match (value, usual) {
        (Some(value), Some(usual)) if usual > 0.0 => format!("{value:.2} ({:.2}×)", value / usual),
        (Some(value), _) => format!("{value:.2}"),
        (None, _) => "never".into(),
    };
    for mean in means {
        let times = mean.reached.iter().enumerate().map(|(k, reached)| {
            let usual = default.and_then(|default| default.reached[k].cpu_seconds);
            format!(" {:>18}", beside(reached.cpu_seconds, usual))
        });
        let all = beside(Some(mean.cpu_seconds), default.map(|default| default.cpu_seconds));
        let times: String = times.collect();
        text += &format!("{:<14}{times} {:>9.2} {:>9.0} {all:>18}\n", mean.variant, mean.psnr, mean.splats);
    }
    text
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::ablation_variants::named;
    use crate::args::{BenchCommand, Cli, Command};

    fn args(words: &[&str]) -> Box<AblateArgs> {
        let cli = Cli::try_parse_from(["plat", "bench", "ablate", "c"].iter().chain(words)).unwrap();
        match cli.command {
            Command::Bench(BenchCommand::Ablate(args)) => Box::new(args),
            other => panic!("{other:?}"),
        }
    }

    fn line(variant: &str, seed: u64, curve: &[(f64, f64)]) -> Ablation {
        let curve: Vec<CurvePoint> =
            curve.iter().map(|&(cpu_seconds, psnr)| CurvePoint { cpu_seconds, psnr, splats: Some(9) }).collect();
        let last = curve[curve.len() - 1];
        Ablation {
            commit: "unknown".into(),
            machine: "none".into(),
            scene: "c".into(),
            downscale: 1,
            backend: "cpu".into(),
            threads: 1,
            variant: variant.into(),
            seed,
            steps: 10,
            budget: 9,
            reached: Vec::new(),
            psnr: last.psnr,
            splats: 9,
            cpu_seconds: last.cpu_seconds,
            wall_seconds: last.cpu_seconds,
            curve,
            command: "plat bench ablate".into(),
        }
    }

    #[test]
    fn the_target_gain_is_the_defaults_mean_over_seeds() {
        let lines = [
            line(DEFAULT, 0, &[(0.0, 10.0), (4.0, 20.0)]),
            line("fine", 0, &[(0.0, 1.0), (4.0, 90.0)]),
            line(DEFAULT, 1, &[(0.0, 12.0), (4.0, 26.0)]),
        ];
        // From 11 to 23.
        assert_eq!(targets(&args(&["--to-gain", "0.5"]), &lines), [17.0]);
        assert_eq!(targets(&args(&["--to", "24.44,26.84"]), &lines), [24.44, 26.84]);
        assert_eq!(targets(&args(&["--to", "24.44", "--to-gain", "0.5"]), &lines), [24.44, 17.0]);
        let usual = targets(&args(&[]), &lines);
        assert!((usual[0] - 21.8).abs() < 1e-9, "{usual:?}");
        assert!(targets(&args(&[]), &lines[1..2]).is_empty());
    }

    #[test]
    fn a_seed_that_never_reaches_the_target_leaves_no_mean() {
        let mut lines = [
            line("fine", 0, &[(0.0, 12.0), (4.0, 20.0)]),
            line("fine", 1, &[(0.0, 12.0), (8.0, 20.0)]),
            line(DEFAULT, 0, &[(0.0, 12.0), (2.0, 16.0)]),
        ];
        for line in &mut lines {
            line.reached = reached(&line.curve, &[14.0, 18.0]);
        }
        let means = [DEFAULT, "fine"].map(|name| mean(&named(name).unwrap(), &lines));
        let times = |mean: &Mean| mean.reached.iter().map(|r| r.cpu_seconds).collect::<Vec<_>>();
        assert_eq!(times(&means[1]), [Some(1.5), Some(4.5)]);
        assert_eq!(times(&means[0]), [Some(1.0), None]);
        let text = table(&[14.0, 18.0], &means);
        let rows: Vec<&str> = text.lines().skip(1).collect();
        assert!(rows[0].contains("1.00 (1.00×)") && rows[0].contains("never"), "{text}");
        assert!(rows[1].contains("1.50 (1.50×)") && rows[1].contains("4.50"), "{text}");
    }
}
