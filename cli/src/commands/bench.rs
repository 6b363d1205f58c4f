//! `plat bench demo`, `adaptive`, `ingest`, `tree` and `chart`: figures that are kept, and pictures of them.

use std::fs;
use std::path::Path;

use ::bench::parts::{Ingest, Tree, TreeFaces, TreeLevel};
use ::bench::reference::read_references;
use ::bench::{CurvePoint, PartLine, append_part, read_folder, replace_table, short_table, table};
use city::CitySettings;
use dataset::synth::Settings;
use serde::Serialize;
use store::Store;
use store::file::save;

use crate::args::{
    AdaptiveArgs, Auto, BenchDemoArgs, BenchTreeArgs, ChartArgs, DemoArgs, EvalArgs, IngestArgs, Level, PlanOptions,
    TrainArgs,
};
use crate::cameras;
use crate::clock::{self, Stopwatch};
use crate::commands::eval::{self, evaluate};
use crate::commands::train::{ingest_photos, make_folder, train};
use crate::commands::{demo, pareto};
use crate::cuts::CutFigures;
use crate::failure::Failure;
use crate::model::{self, save_json};
use crate::output::Output;
use crate::record::{Record, commit};

/// The file of what trees lose.
const TREES: &str = "tree.jsonl";
/// The file of ingests alone.
const INGESTS: &str = "ingest.jsonl";

/// Builds the demo, and appends a line.
pub(crate) fn demo(args: &BenchDemoArgs, output: &Output) -> Result<(), Failure> {
    let built = demo::build(&args.demo, output)?;
    let mut record = built.shown.report.record;
    record.scene = if args.demo.quick { "demo quick" } else { "demo" }.to_owned();
    keep_run(&args.results, &args.label, &record, built.curve, built.text, output)
}

/// Trains a city whose one half is a bare plain as a tree of one depth, and as one that follows the need; appends a line
/// for each.
pub(crate) fn adaptive(args: &AdaptiveArgs, output: &Output) -> Result<(), Failure> {
    let demo = DemoArgs { out: args.out.clone(), quick: false };
    let (city, settings) = demo::settings(&demo);
    let city = Settings { city: CitySettings { plain: 0.5, ..city.city }, ..city };
    demo::rehearsed(&settings.capture, &city, output)?;
    for (label, residual) in [("fixed depth", 0.0), ("adaptive", settings.plan.residual)] {
        let levels = Auto(Some(2));
        let plan =
            PlanOptions { residual, levels, seed: args.seed, tolerance_db: args.tolerance_db, ..settings.plan.clone() };
        let train = TrainArgs { plan, threads: Auto(Some(args.threads)), ..settings.clone() };
        let trained = self::train(&train, output)?;
        let store = Store::open(&args.out.join("store").display().to_string())?.blocking();
        let every = train.plan.test_every;
        let out = args.out.join("eval").join(label.replace(' ', "_"));
        let mut record = trained.report.record.clone();
        let model = model::read(&train.out)?;
        let evaluated = evaluate(&model, trained.capture, store, every, None, &out, output)?;
        save_json(&out.join("report.json"), &evaluated)?;
        record.scene = "half a bare plain".into();
        record.measured(&evaluated.record);
        let settled = format!(
            "{} of {} blocks stayed at their parent's resolution",
            trained.report.settled, trained.report.tasks
        );
        let text = format!("{label}: {settled}\n{}", eval::text(&evaluated));
        keep_run(&args.results, label, &record, trained.curve, text, output)?;
    }
    Ok(())
}

/// Appends a run.
fn keep_run(
    results: &Path,
    label: &str,
    record: &Record,
    curve: Vec<CurvePoint>,
    text: String,
    output: &Output,
) -> Result<(), Failure> {
    let line = pareto::line_of(label, record, curve);
    let file = pareto::keep(results, &line)?;
    output.result(&line, &format!("{text}\nappended to {}", file.display()))
}

/// Ingests a capture into an empty store, and appends a line. This process does nothing else, so its peak is the ingest's.
pub(crate) fn ingest(args: &IngestArgs, output: &Output) -> Result<(), Failure> {
    let folder = tempfile::tempdir().map_err(|e| Failure::Work(format!("no temporary folder: {e}")))?;
    let store = Store::open(&folder.path().display().to_string())?;
    let clock = Stopwatch::start();
    let source = cameras::open(&args.capture, output)?;
    ingest_photos(&source, &store.blocking(), args.downscale, output)?;
    let line = Ingest {
        commit: commit().to_owned(),
        machine: ::bench::machine(),
        scene: args.scene.clone().unwrap_or_else(|| cameras::name_of(&args.capture)),
        downscale: args.downscale,
        threads: std::thread::available_parallelism().map_or(1, |n| n.get() as u32),
        photos: source.photos.len() as u64,
        pixels: source.photos.iter().map(|photo| u64::from(photo.width) * u64::from(photo.height)).sum(),
        wall_seconds: clock.wall_seconds(),
        cpu_seconds: clock.cpu_seconds(),
        peak_memory_bytes: clock::peak_memory_bytes(),
        bytes_written: store.traffic().written,
        command: invoked(),
    };
    let file = args.results.join(INGESTS);
    make_folder(&args.results)?;
    let text = format!(
        "{} photos of {:.1} megapixels in all: {:.1} CPU seconds, {:.1} seconds, {} MB at most, {} MB stored\nappended to {}",
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

/// Measures a tree's levels and faces, and appends a line.
pub(crate) fn tree(args: &BenchTreeArgs, output: &Output) -> Result<(), Failure> {
    let ask = |model: &Path| EvalArgs {
        model: model.to_path_buf(),
        capture: args.capture.clone(),
        seam_metres: args.seam_metres,
        ..EvalArgs::default()
    };
    let has_faces = model::read_tree(&args.model)?.plan.leaves().blocks().len() > 1;
    let of_tree = eval::look(&EvalArgs { level: Some(Level::All), seams: has_faces, ..ask(&args.model) }, output)?;
    let of_whole = match &args.whole {
        Some(whole) if has_faces => {
            Some(eval::look(&EvalArgs { seams_of: Some(args.model.clone()), ..ask(whole) }, output)?)
        }
        _ => None,
    };
    let without = of_whole.as_ref().and_then(|whole| whole.seams.as_ref()).map(|seams| seams.figures);
    let faces = of_tree.seams.as_ref().map(|report| {
        let figures = report.figures;
        TreeFaces {
            seam_metres: report.seam_metres,
            seam_share: report.seam_share,
            psnr: [figures.seam_psnr, figures.interior_psnr],
            ssim: [figures.seam_ssim, figures.interior_ssim],
            flip: [figures.seam_flip, figures.interior_flip],
            step: eval::mean(report.faces.iter().map(|face| face.step)),
            without_psnr: without.map(|figures| [figures.seam_psnr, figures.interior_psnr]),
        }
    });
    let level = |cut: &CutFigures| {
        let away = [&cut.away, &cut.away_finest, &cut.away_pruned].map(|drawn| drawn.best().1.psnr);
        let level = cut.level?;
        Some(TreeLevel { level, splats: cut.splats, psnr: cut.full.psnr, away_mip: cut.away_mip, away_psnr: away })
    };
    let line = PartLine::Tree(Tree {
        commit: commit().to_owned(),
        machine: ::bench::machine(),
        scene: args.scene.clone().unwrap_or_else(|| of_tree.record.scene.clone()),
        downscale: of_tree.record.downscale,
        splats: of_tree.record.splats,
        levels: of_tree.cuts.iter().filter_map(level).collect(),
        faces,
        command: invoked(),
    });
    make_folder(&args.results)?;
    let file = args.results.join(TREES);
    append_part(&file, &line)?;
    let of_whole = of_whole.as_ref().map_or(String::new(), |whole| format!("{}\n", eval::text(whole)));
    output.result(&line, &format!("{}\n{of_whole}appended to {}", eval::text(&of_tree), file.display()))
}

/// The command line, with the program by its plain name.
pub(crate) fn invoked() -> String {
    let words = std::env::args().skip(1);
    std::iter::once("plat".to_owned()).chain(words).collect::<Vec<_>>().join(" ")
}

#[derive(Serialize)]
struct Drawn<'a> {
    command: &'static str,
    /// Of runs of plat.
    lines: usize,
    /// Of runs of other trainers.
    references: usize,
    chart: &'a Path,
    readme: &'a Path,
}

/// The document beside the README that has the full table.
const CHAPTER: &str = "docs/src/performance.md";

/// A document with its table replaced.
fn with_table(path: &Path, table: &str) -> Result<String, scene::BadInput> {
    let name = path.display().to_string();
    let document = fs::read_to_string(path).map_err(|error| {
        scene::BadInput::new(name.clone(), format!("cannot be read ({error})"), "name it with --readme")
    })?;
    replace_table(&document, table).ok_or_else(|| {
        let advice = "put <!-- bench:begin --> and <!-- bench:end --> where the table goes";
        scene::BadInput::new(name, "has no place for the table", advice)
    })
}

/// Redraws the chart and the tables from the results and the references.
pub(crate) fn chart(args: &ChartArgs, output: &Output) -> Result<(), Failure> {
    let runs = read_folder(&args.results)?;
    let usual = Path::new("bench/reference");
    let references = match &args.reference {
        Some(folder) => read_references(folder)?,
        None if usual.is_dir() => read_references(usual)?,
        None => Vec::new(),
    };
    let lines = [&references[..], &runs[..]].concat();
    let readme = with_table(&args.readme, &short_table(&lines))?;
    let chapter = args.readme.with_file_name(CHAPTER);
    let full = chapter.exists().then(|| with_table(&chapter, &table(&lines))).transpose()?;
    let path = args.results.join("chart.svg");
    save(&path, ::bench::chart(&runs, &references).as_bytes())?;
    save(&args.readme, readme.as_bytes())?;
    full.map_or(Ok(()), |document| save(&chapter, document.as_bytes()))?;
    let (count, others) = (runs.len(), references.len());
    let drawn = Drawn { command: "bench chart", lines: count, references: others, chart: &path, readme: &args.readme };
    let text = format!("{count} lines, {others} of other trainers\n{}\n{}", path.display(), args.readme.display());
    output.result(&drawn, &text)
}
