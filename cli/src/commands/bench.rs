//! `plat bench pareto` and `plat bench chart`: figures that are kept, and pictures of them.

use std::fs;
use std::path::Path;

use ::bench::{CurvePoint, append, read_folder, replace_table, table};
use serde::Serialize;
use store::Store;

use crate::args::{ChartArgs, ParetoArgs};
use crate::commands::eval::{self, evaluate};
use crate::commands::train::{make_folder, train};
use crate::failure::Failure;
use crate::model::{save, save_json};
use crate::output::Output;

/// The file of our own runs.
const RUNS: &str = "plat.jsonl";

/// Trains, measures the merged model, and appends a line.
pub(crate) fn pareto(args: &ParetoArgs, output: &Output) -> Result<(), Failure> {
    let trained = train(&args.train, output)?;
    let store_url = args.train.store.clone().unwrap_or_else(|| args.train.out.join("store").display().to_string());
    let store = Store::open(&store_url)?.blocking();
    let out = args.train.out.join("eval");
    let mut record = trained.report.record.clone();
    let evaluated = evaluate(&trained.model, trained.capture, store, args.train.plan.test_every, &out, output)?;
    save_json(&out.join("report.json"), &evaluated)?;
    record.scene.clone_from(&args.scene);
    (record.psnr, record.ssim, record.perceptual, record.fps) =
        (evaluated.record.psnr, evaluated.record.ssim, evaluated.record.perceptual, evaluated.record.fps);
    // The last point is the merged model at the end of all work.
    let mut curve = trained.curve;
    if let (Some(cpu_seconds), Some(psnr)) = (record.cpu_seconds, record.psnr) {
        curve.pop();
        curve.push(CurvePoint { cpu_seconds, psnr, splats: Some(record.splats) });
    }
    let line = record.line(&args.label, invoked(), curve);
    make_folder(&args.results)?;
    append(&args.results.join(RUNS), &line)?;
    let text = format!("{}\nappended to {}", eval::text(&evaluated), args.results.join(RUNS).display());
    output.result(&line, &text)
}

/// The command line, with the program by its plain name.
fn invoked() -> String {
    let words = std::env::args().skip(1);
    std::iter::once("plat".to_owned()).chain(words).collect::<Vec<_>>().join(" ")
}

#[derive(Serialize)]
struct Drawn<'a> {
    command: &'static str,
    lines: usize,
    chart: &'a Path,
    readme: &'a Path,
}

/// Redraws what is a function of the results.
pub(crate) fn chart(args: &ChartArgs, output: &Output) -> Result<(), Failure> {
    let lines = read_folder(&args.results)?;
    let (references, runs): (Vec<_>, Vec<_>) = lines.iter().cloned().partition(|line| line.source.is_some());
    let readme = args.readme.display().to_string();
    let document = fs::read_to_string(&args.readme).map_err(|error| {
        scene::BadInput::new(readme.clone(), format!("cannot be read ({error})"), "name it with --readme")
    })?;
    let document = replace_table(&document, &table(&lines)).ok_or_else(|| {
        let advice = "put <!-- bench:begin --> and <!-- bench:end --> where the table goes";
        scene::BadInput::new(readme, "has no place for the table", advice)
    })?;
    let path = args.results.join("chart.svg");
    save(&path, ::bench::chart(&runs, &references).as_bytes())?;
    save(&args.readme, document.as_bytes())?;
    let drawn = Drawn { command: "bench chart", lines: lines.len(), chart: &path, readme: &args.readme };
    output.result(&drawn, &format!("{} lines\n{}\n{}", lines.len(), path.display(), args.readme.display()))
}
