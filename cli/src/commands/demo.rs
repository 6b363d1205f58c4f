//! `plat demo`: a small synthetic city from nothing to pictures.

use std::path::{Path, PathBuf};

use ::bench::{CurvePoint, birdseye_camera, oblique_camera, write_png};
use ::render::cpu::Renderer;
use city::{CitySettings, Traffic};
use dataset::synth::{self, Settings, Summary};
use glam::DVec3;
use serde::Serialize;
use store::Store;

use crate::args::{Auto, Backend, Blocks, DemoArgs, PlanOptions, TrainArgs};
use crate::commands::eval::evaluate;
use crate::commands::render::to_image;
use crate::commands::train::{Report, train};
use crate::failure::Failure;
use crate::model::{self, save_json};
use crate::output::Output;

/// Width of the pictures from above, pixels.
const PICTURE_WIDTH: u32 = 1200;

/// The demo as it was built.
pub(crate) struct Built {
    pub(crate) shown: Shown,
    pub(crate) text: String,
    pub(crate) curve: Vec<CurvePoint>,
}

#[derive(Serialize)]
pub(crate) struct Shown {
    #[serde(flatten)]
    pub(crate) report: Report,
    sheet: PathBuf,
    birdseye: PathBuf,
    oblique: PathBuf,
    merged: PathBuf,
}

pub(crate) fn run(args: &DemoArgs, output: &Output) -> Result<(), Failure> {
    let built = build(args, output)?;
    output.result(&built.shown, &built.text)
}

/// Builds the city, trains it, measures it and draws it.
pub(crate) fn build(args: &DemoArgs, output: &Output) -> Result<Built, Failure> {
    let city_folder = args.out.join("capture");
    let (city, train_args) = settings(args);
    let metres = city.city.extent_metres();
    output.note(format!("building a city of {metres:.0} m and taking {} photos of it", city.views));
    let built = rehearsed(&city_folder, &city, output)?;
    output.note(format!(
        "{} things in {} triangles, {} photos, {} sparse points",
        built.actors, built.triangles, built.views, built.points
    ));

    let trained = train(&train_args, output)?;
    let model = model::read(&train_args.out)?;
    let store = Store::open(&args.out.join("store").display().to_string())?.blocking();
    let eval_folder = args.out.join("eval");
    let [birdseye, oblique] = ["birdseye.png", "oblique.png"].map(|name| args.out.join(name));
    let (up, mut renderer) = (DVec3::Z, Renderer::default());
    for (path, camera) in [
        (&birdseye, birdseye_camera(&trained.capture, up, PICTURE_WIDTH)),
        (&oblique, oblique_camera(&trained.capture, up, PICTURE_WIDTH)),
    ] {
        let frame = renderer.forward(&model.splats, None, &camera, &model.options());
        write_png(path, &to_image(frame))?;
    }
    let every = train_args.plan.test_every;
    let evaluated = evaluate(&model, trained.capture, store, every, None, &eval_folder, output)?;
    save_json(&eval_folder.join("report.json"), &evaluated)?;

    let mut report = trained.report;
    report.record.measured(&evaluated.record);
    report.record.command = "demo";
    let text = format!(
        "a city of {metres:.0} m in {} splats and {} blocks, {:.1} dB PSNR and {:.3} SSIM on {} held-out photos,\n\
         trained in {:.0} CPU seconds ({:.0} seconds)\n\n\
         from above          {}\n\
         from the south      {}\n\
         photo|render|error  {}\n\
         the plan            {}\n\
         the model           {} (any splat viewer opens it)",
        report.record.splats,
        report.tasks,
        report.record.psnr.unwrap_or_default(),
        report.record.ssim.unwrap_or_default(),
        evaluated.views.len(),
        report.record.cpu_seconds.unwrap_or_default(),
        report.record.wall_seconds.unwrap_or_default(),
        birdseye.display(),
        oblique.display(),
        evaluated.sheet.display(),
        args.out.join("plan.svg").display(),
        args.out.join("merged.ply").display(),
    );
    let merged = args.out.join("merged.ply");
    let shown = Shown { report, sheet: evaluated.sheet, birdseye, oblique, merged };
    Ok(Built { shown, text, curve: trained.curve })
}

/// Photographs the city, in the place of an older one.
pub(crate) fn rehearsed(folder: &Path, settings: &Settings, output: &Output) -> Result<Summary, Failure> {
    let bars = output.stages();
    Ok(synth::replace(folder, settings, &|what, done, total| bars.at(what, done, total))?)
}

/// The city and how it is trained.
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
            test_every: 8,
            downscale: 1,
        },
        backend: Backend::Auto,
        workers: 1,
        threads: Auto(None),
        eval_every: 0,
        fresh: true,
        checkpoint_every: 60.0,
        minutes: None,
    };
    (city, train)
}
