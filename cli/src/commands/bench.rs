//! `plat bench demo`, `adaptive`, `ingest`, `tree` and `chart`: appends result lines, and draws the chart and table from them.

use std::fs;
use std::path::Path;

use ::bench::parts::{Ingest, Tree, TreeBudget, TreeFaces, TreeLevel};
use ::bench::reference::read_references;
use ::bench::{CurvePoint, PartLine, append_part, read_folder, read_parts, replace_table, short_table, table};
use city::CitySettings;
use dataset::synth::Settings;
use eval::cuts::CutFigures;
use eval::{BudgetFigures, Levels, Photos, mean};
use model::read_tree;
use scene::BadInput;
use serde::Serialize;
use store::Store;
use store::file::save;

use crate::args::{
    AdaptiveArgs, Auto, BenchDemoArgs, BenchTreeArgs, ChartArgs, DemoArgs, EvalArgs, IngestArgs, PlanOptions, TrainArgs,
};
use crate::captures::{self, ingest_photos};
use crate::clock::{self, Stopwatch};
use crate::commands::demo;
use crate::commands::eval::{Further, measure, measure_trained};
use crate::commands::train::{store_url, train};
use crate::eval_report::text;
use crate::failure::{Failure, make_folder, temporary_folder};
use crate::output::Output;
use crate::result_lines::{append_run, line_of};
use crate::run_record::{Record, commit, invocation};

/// The file of tree measurements.
const TREES: &str = "tree.jsonl";
/// The file of ingest measurements.
const INGESTS: &str = "ingest.jsonl";

/// Builds the demo and appends a line.
pub(crate) fn demo(args: &BenchDemoArgs, output: &Output) -> Result<(), Failure> {
    let built = demo::build(&args.demo, output)?;
    let mut record = built.shown.report.record;
    record.scene = if args.demo.quick { "demo quick" } else { "demo" }.to_owned();
    append_and_print(&args.results, &args.label, &record, built.curve, built.text, output)
}

/// Trains a city of which one half is a bare plain, as a tree of fixed depth and as a tree that refines by residual error; appends a
/// line for each.
pub(crate) fn adaptive(args: &AdaptiveArgs, output: &Output) -> Result<(), Failure> {
    let demo = DemoArgs { out: args.out.clone(), quick: false, serve: None };
    let (city, settings) = demo::settings(&demo);
    let city = Settings { city: CitySettings { plain: 0.5, ..city.city }, ..city };
    demo::synthesise(&settings.capture, &city, output)?;
    for (label, residual) in [("fixed depth", 0.0), ("adaptive", settings.plan.residual)] {
        let levels = Auto(Some(2));
        let plan =
            PlanOptions { residual, levels, seed: args.seed, tolerance_db: args.tolerance_db, ..settings.plan.clone() };
        let train = TrainArgs { plan, threads: Auto(Some(args.threads)), ..settings.clone() };
        let trained = self::train(&train, output)?;
        let store = Store::open(&store_url(&train))?.blocking();
        let out = args.out.join("eval").join(label.replace(' ', "_"));
        let mut record = trained.report.record.clone();
        let model = model::read(&train.out)?;
        let split = model.split(&trained.capture, None, None);
        let photos = Photos::ingested(trained.capture, store, split, train.plan.downscale);
        let evaluated = measure_trained(&model, photos, &Further::default(), &out, output)?;
        record.scene = "half a bare plain".into();
        record.set_quality(&evaluated.record);
        let settled = format!(
            "{} of {} blocks stayed at their parent's resolution",
            trained.report.settled, trained.report.tasks
        );
        let text = format!("{label}: {settled}\n{}", text(&evaluated));
        append_and_print(&args.results, label, &record, trained.curve, text, output)?;
    }
    Ok(())
}

/// Appends a run and prints it.
fn append_and_print(
    results: &Path,
    label: &str,
    record: &Record,
    curve: Vec<CurvePoint>,
    text: String,
    output: &Output,
) -> Result<(), Failure> {
    let line = line_of(label, record, curve);
    let file = append_run(results, &line)?;
    output.result(&line, &format!("{text}\nappended to {}", file.display()))
}

/// Ingests a capture into an empty store and appends a line. The process does nothing else, so its peak memory is the ingest's.
pub(crate) fn ingest(args: &IngestArgs, output: &Output) -> Result<(), Failure> {
    let folder = temporary_folder()?;
    let store = Store::open(&folder.path().display().to_string())?;
    let clock = Stopwatch::start();
    let source = captures::open(&args.capture, output)?;
    ingest_photos(&source, &store.blocking(), args.downscale, output)?;
    let line = Ingest {
        commit: commit().to_owned(),
        machine: ::bench::machine(),
        scene: args.scene.clone().unwrap_or_else(|| captures::name_of(&args.capture)),
        downscale: args.downscale,
        threads: std::thread::available_parallelism().map_or(1, |n| n.get() as u32),
        photos: source.photos.len() as u64,
        pixels: source.photos.iter().map(|photo| u64::from(photo.width) * u64::from(photo.height)).sum(),
        wall_seconds: clock.wall_seconds(),
        cpu_seconds: clock.cpu_seconds(),
        peak_memory_bytes: clock::peak_memory_bytes(),
        bytes_written: store.traffic().written,
        command: invocation(),
    };
    let file = args.results.join(INGESTS);
    make_folder(&args.results)?;
    let text = format!(
        "{} photos, {:.1} megapixels in total: {:.1} CPU seconds, {:.1} seconds, peak memory {} MB, {} MB stored\nappended to {}",
        line.photos,
        line.pixels as f64 / 1e6,
        line.cpu_seconds,
        line.wall_seconds,
        line.peak_memory_bytes.unwrap_or_default() / 1_000_000,
        line.bytes_written / 1_000_000,
        file.display(),
    );
    let line = PartLine::Ingest(line);
    append_part(&file, &line)?;
    output.result(&line, &text)
}

/// Measures a tree's levels and seams and appends a line.
pub(crate) fn tree(args: &BenchTreeArgs, output: &Output) -> Result<(), Failure> {
    let options = |model: &Path| EvalArgs {
        model: model.to_path_buf(),
        capture: args.capture.clone(),
        seam_metres: args.seam_metres,
        ..EvalArgs::default()
    };
    let has_faces = read_tree(&args.model)?.plan.leaves().blocks().len() > 1;
    let own =
        EvalArgs { level: Some(Levels::All), seams: has_faces, budget: args.budget.clone(), ..options(&args.model) };
    let of_tree = measure(&own, output)?;
    let of_whole = match &args.whole {
        Some(whole) if has_faces => {
            Some(measure(&EvalArgs { seams_of: Some(args.model.clone()), ..options(whole) }, output)?)
        }
        _ => None,
    };
    let control = of_whole.as_ref().and_then(|whole| whole.seams.as_ref()).map(|seams| seams.figures);
    let faces = of_tree.seams.as_ref().map(|report| {
        let figures = report.figures;
        TreeFaces {
            seam_metres: report.seam_metres,
            seam_share: report.seam_share,
            psnr: [figures.seam_psnr, figures.interior_psnr],
            ssim: [figures.seam_ssim, figures.interior_ssim],
            flip: [figures.seam_flip, figures.interior_flip],
            step: mean(report.faces.iter().map(|face| face.step)),
            without_psnr: control.map(|figures| [figures.seam_psnr, figures.interior_psnr]),
        }
    });
    let level = |cut: &CutFigures| {
        let away = [&cut.away, &cut.away_finest, &cut.away_pruned].map(|figures| figures.best().1.psnr);
        let (level, splats) = (cut.level, cut.splats);
        TreeLevel { level, splats, psnr: cut.full.psnr, away_mip: cut.away_mip, away_psnr: away }
    };
    let budget = |of: &BudgetFigures| {
        let whole = of.figures.psnr.zip(of.loss_db).map(|(drawn, loss)| drawn + loss);
        TreeBudget { budget: of.budget, drawn: of.drawn, psnr: [of.figures.psnr, of.pruned.psnr, whole] }
    };
    let line = PartLine::Tree(Tree {
        commit: commit().to_owned(),
        machine: ::bench::machine(),
        scene: args.scene.clone().unwrap_or_else(|| of_tree.record.scene.clone()),
        downscale: of_tree.record.downscale,
        splats: of_tree.record.splats,
        levels: of_tree.cuts.iter().map(level).collect(),
        faces,
        budgets: of_tree.budgets.iter().map(budget).collect(),
        command: invocation(),
    });
    make_folder(&args.results)?;
    let file = args.results.join(TREES);
    append_part(&file, &line)?;
    let of_whole = of_whole.as_ref().map_or(String::new(), |whole| format!("{}\n", text(whole)));
    output.result(&line, &format!("{}\n{of_whole}appended to {}", text(&of_tree), file.display()))
}

#[derive(Serialize)]
struct Drawn<'a> {
    command: &'static str,
    /// Result lines of plat.
    lines: usize,
    /// Result lines of other trainers.
    references: usize,
    chart: &'a Path,
    readme: &'a Path,
}

/// The document beside the README that has the table of all runs.
const CHAPTER: &str = "docs/src/performance.md";

/// A document with its table replaced.
fn with_table(path: &Path, table: &str) -> Result<String, BadInput> {
    let name = path.display().to_string();
    let document = fs::read_to_string(path)
        .map_err(|error| BadInput::new(name.clone(), format!("cannot be read ({error})"), "name it with --readme"))?;
    replace_table(&document, table).ok_or_else(|| {
        let advice = "put <!-- bench:begin --> and <!-- bench:end --> where the table goes";
        BadInput::new(name, "has no markers for the table", advice)
    })
}

/// Redraws the chart and the tables from the result lines and the references.
pub(crate) fn chart(args: &ChartArgs, output: &Output) -> Result<(), Failure> {
    let runs = read_folder(&args.results)?;
    let default_folder = Path::new("bench/reference");
    let references = match &args.reference {
        Some(folder) => read_references(folder)?,
        None if default_folder.is_dir() => read_references(default_folder)?,
        None => Vec::new(),
    };
    let lines = [&references[..], &runs[..]].concat();
    let readme = with_table(&args.readme, &short_table(&lines))?;
    let chapter = args.readme.with_file_name(CHAPTER);
    let full = chapter.exists().then(|| with_table(&chapter, &table(&lines))).transpose()?;
    let path = args.results.join("chart.svg");
    save(&path, ::bench::chart(&runs, &references).as_bytes())?;
    let pruned = args.results.join("prune.jsonl");
    let lines_of_parts = if pruned.exists() { read_parts(&pruned)? } else { Vec::new() };
    if let Some(drawn) = ::bench::pruning_chart(&lines_of_parts) {
        save(&args.results.join("prune.svg"), drawn.as_bytes())?;
    }
    save(&args.readme, readme.as_bytes())?;
    full.map_or(Ok(()), |document| save(&chapter, document.as_bytes()))?;
    let (count, others) = (runs.len(), references.len());
    let drawn = Drawn { command: "bench chart", lines: count, references: others, chart: &path, readme: &args.readme };
    let text = format!("{count} lines, {others} of other trainers\n{}\n{}", path.display(), args.readme.display());
    output.result(&drawn, &text)
}
