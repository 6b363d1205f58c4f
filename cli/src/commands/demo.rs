//! `plat demo`: builds a small synthetic city, trains it, and renders pictures of it.

use std::path::{Path, PathBuf};

use ::bench::CurvePoint;
use ::render::cpu::Renderer;
use city::{CitySettings, Traffic};
use dataset::synth::{self, Settings, Summary};
use eval::{Photos, birdseye_camera, frame_image, oblique_camera, write_png};
use glam::DVec3;
use model::Model;
use scene::Capture;
use serde::Serialize;
use store::Store;

use crate::args::{
    AlignedOptions, Auto, BLOCK_MEMORY_MIB, Backend, Blocks, DemoArgs, DepthKind, PlanOptions, TrainArgs, ZoneOptions,
};
use crate::commands::eval::{Further, measure_trained};
use crate::commands::train::{Report, train};
use crate::dashboard::Dashboard;
use crate::failure::Failure;
use crate::output::Output;

/// Width of the overview pictures, pixels.
const PICTURE_WIDTH: u32 = 1200;

/// Results of the demo.
pub(crate) struct Built {
    pub(crate) shown: Shown,
    pub(crate) text: String,
    pub(crate) curve: Vec<CurvePoint>,
    dashboard: Option<Dashboard>,
}

#[derive(Serialize)]
pub(crate) struct Shown {
    #[serde(flatten)]
    pub(crate) report: Report,
    sheet: Option<PathBuf>,
    birdseye: PathBuf,
    oblique: PathBuf,
    merged: PathBuf,
}

pub(crate) fn run(args: &DemoArgs, output: &Output) -> Result<(), Failure> {
    let built = build(args, output)?;
    output.result(&built.shown, &built.text)?;
    built.dashboard.map_or(Ok(()), |dashboard| dashboard.stay(output))
}

/// Builds the city, trains it, renders the overviews and measures the model.
pub(crate) fn build(args: &DemoArgs, output: &Output) -> Result<Built, Failure> {
    let city_folder = args.out.join("capture");
    let (city, train_args) = settings(args);
    let metres = city.city.extent_metres();
    output.note(format!("building a city of {metres:.0} m and taking {} photos of it", city.views));
    let built = synthesise(&city_folder, &city, output)?;
    output.note(format!(
        "{} objects in {} triangles, {} photos, {} sparse points",
        built.actors, built.triangles, built.views, built.points
    ));

    let trained = train(&train_args, output)?;
    let model = model::read(&train_args.out)?;
    let store = Store::open(&args.out.join("store").display().to_string())?.blocking();
    let eval_folder = args.out.join("eval");
    let [birdseye, oblique] = ["birdseye.png", "oblique.png"].map(|name| args.out.join(name));
    render_overviews(&model, &trained.capture, &birdseye, &oblique)?;
    let split = model.split(&trained.capture, None, None);
    let photos = Photos::ingested(trained.capture, store, split, train_args.plan.downscale);
    let evaluated = measure_trained(&model, photos, &Further::default(), &eval_folder, output)?;

    let mut report = trained.report;
    report.record.set_quality(&evaluated.record);
    report.record.command = "demo";
    let text = format!(
        "a city of {metres:.0} m in {} splats and {} blocks, {:.1} dB PSNR and {:.3} SSIM on {} held-out photos,\n\
         trained in {:.0} CPU seconds ({:.0} seconds)\n\n\
         from above          {}\n\
         from the south      {}\n\
         photo|render|error  {}\n\
         the plan            {}\n\
         the model           {} (opens in any splat viewer)",
        report.record.splats,
        report.tasks,
        report.record.psnr.unwrap_or_default(),
        report.record.ssim.unwrap_or_default(),
        evaluated.views.len(),
        report.record.cpu_seconds.unwrap_or_default(),
        report.record.wall_seconds.unwrap_or_default(),
        birdseye.display(),
        oblique.display(),
        eval_folder.join("sheet.png").display(),
        args.out.join("plan.svg").display(),
        args.out.join("merged.ply").display(),
    );
    let merged = args.out.join("merged.ply");
    let shown = Shown { report, sheet: evaluated.sheet, birdseye, oblique, merged };
    Ok(Built { shown, text, curve: trained.curve, dashboard: trained.dashboard })
}

fn render_overviews(model: &Model, capture: &Capture, birdseye: &Path, oblique: &Path) -> Result<(), Failure> {
    let (up, mut renderer) = (DVec3::Z, Renderer::default());
    for (path, camera) in
        [(birdseye, birdseye_camera(capture, up, PICTURE_WIDTH)), (oblique, oblique_camera(capture, up, PICTURE_WIDTH))]
    {
        let frame = renderer.forward(&model.splats, &[], &camera, &model.options());
        write_png(path, &frame_image(frame))?;
    }
    Ok(())
}

/// Writes the synthetic capture of a city; replaces an older one.
pub(crate) fn synthesise(folder: &Path, settings: &Settings, output: &Output) -> Result<Summary, Failure> {
    let bars = output.stages();
    Ok(synth::replace(folder, settings, &|what, done, total| bars.at(what, done as u64, total as u64, ""))?)
}

/// Settings of the city and of its training.
pub(crate) fn settings(args: &DemoArgs) -> (Settings, TrainArgs) {
    let city = CitySettings { traffic: Traffic::Light, ..CitySettings::default() };
    let whole = Settings { city, views: 320, width: 240, height: 160, aerial: 0.4, ..Settings::default() };
    let (city, steps, budget) = if args.quick {
        (Settings { views: 96, width: 160, height: 112, ..whole }, 2500, 20_000)
    } else {
        (whole, 8000, 60_000)
    };
    let train = TrainArgs {
        capture: args.out.join("capture"),
        out: args.out.clone(),
        store: None,
        plan: PlanOptions {
            blocks: Blocks::Tree,
            levels: Auto(Some(1)),
            steps: Auto(Some(steps)),
            views_per_step: 1,
            budget: Auto(Some(budget)),
            tolerance_db: 0.1,
            residual: 0.4,
            seed: 0,
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
            test_stretches: 0.0,
            evaluate: false,
            test_every: 8,
            downscale: 1,
        },
        zones: ZoneOptions::default(),
        aligned: AlignedOptions::default(),
        backend: Backend::Auto,
        workers: 1,
        threads: Auto(None),
        eval_every: 0,
        fresh: true,
        checkpoint_every: 60.0,
        minutes: None,
        serve: args.serve,
    };
    (city, train)
}
