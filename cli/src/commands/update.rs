//! `plat update`: trains an area of a finished model on new photos of it.

use std::path::Path;

use eval::{Gain, PhotoOptions, Photos, UpdateOptions, Updated, WorldBox, update};
use model::{Garage, Vehicle, check_out, cut_out, replace_blocks, rewrite};
use serde::Serialize;

use crate::args::UpdateArgs;
use crate::backend;
use crate::captures;
use crate::clock::{self, Stopwatch};
use crate::commands::garage::standing_box;
use crate::failure::Failure;
use crate::observer::OutputObserver;
use crate::output::Output;
use crate::run_record::Record;

#[derive(Debug, Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    record: Record,
    /// Photos that show the area: trained on, and held out.
    photos: [usize; 2],
    /// Splats in the area and its halo, before and after.
    area_splats: [usize; 2],
    /// PSNR of the photos' parts that show the area, before and after.
    trained_on: Option<Gain>,
    held_out: Option<Gain>,
    /// Of the pixels that show --box.
    trained_on_box: Option<Gain>,
    held_out_box: Option<Gain>,
    /// Wall and CPU seconds of training; and of that of the finest level.
    training_seconds: f64,
    training_cpu_seconds: f64,
    finest_training_seconds: f64,
    finest_training_cpu_seconds: f64,
    /// Blocks with new bytes, of all.
    blocks: Option<[usize; 2]>,
    vehicle: Option<Vehicle>,
    out: &'a Path,
}

pub(crate) fn run(args: &UpdateArgs, output: &Output) -> Result<(), Failure> {
    let clock = Stopwatch::start();
    let device = backend::open(args.backend)?;
    let model = model::read(&args.model)?;
    check_out(&args.model, &args.out)?;
    let measured = match args.measured {
        Some(area) => Some(standing_box(&area, model::ground_from_world(&args.model)?)),
        None => None,
    };
    let mut garage = match (&args.garage, &args.name) {
        (Some(folder), Some(name)) => {
            let garage = Garage::open(folder)?;
            garage.check_name(name)?;
            Some(garage)
        }
        _ => None,
    };
    let photos = photos(args, &model, output)?;
    let observer = OutputObserver::new(output);
    let options = UpdateOptions {
        centre: args.area.centre,
        radius: args.area.radius,
        steps: args.steps,
        seed: args.seed,
        measured,
        backend: &device,
    };
    let updated = update(&model, &photos, &options, &observer)?;
    drop(observer);
    let Updated { splats, blocks, photos: used, area_splats, windows, in_box, training } = updated;
    let all_blocks = model.trained.as_ref().map(|(manifest, _)| manifest.blocks.len());
    let (count, antialiased, downscale) = (splats.len(), model.antialiased, photos.downscale);
    let vehicle = measured.map(|WorldBox { world_from_box, low, high }| {
        let (name, class) = (args.name.clone().unwrap_or_default(), args.class.clone());
        let splats = cut_out(&splats, &world_from_box, low, high);
        (Vehicle { name, class, low, high, antialiased, splats: splats.len() }, splats)
    });
    let vehicle = match (&mut garage, vehicle) {
        (Some(garage), Some((vehicle, splats))) => {
            garage.add(vehicle.clone(), &splats, None)?;
            Some(vehicle)
        }
        _ => None,
    };
    let bytes = match all_blocks {
        Some(_) => replace_blocks(&args.model, &args.out, &blocks)?,
        None => rewrite(&args.model, &args.out, model, splats)?,
    };
    let [all, finest] = training;
    let report = Report {
        record: Record {
            scene: captures::name_of(&args.photos),
            downscale,
            steps: Some(args.steps),
            backend: device.name(),
            threads: rayon::current_num_threads() as u32,
            wall_seconds: Some(clock.wall_seconds()),
            cpu_seconds: Some(clock.cpu_seconds()),
            psnr: windows[1].map(|gain| gain.after),
            splats: count as u64,
            bytes: Some(bytes),
            peak_memory_bytes: clock::peak_memory_bytes(),
            seed: Some(args.seed),
            ..Record::new("update")
        },
        photos: used,
        area_splats,
        trained_on: windows[0],
        held_out: windows[1],
        trained_on_box: in_box[0],
        held_out_box: in_box[1],
        training_seconds: all.wall,
        training_cpu_seconds: all.cpu,
        finest_training_seconds: finest.wall,
        finest_training_cpu_seconds: finest.cpu,
        blocks: all_blocks.map(|all| [blocks.len(), all]),
        vehicle,
        out: &args.out,
    };
    output.result(&report, &text(&report))
}

/// The new photos, in a temporary store if none is given: that of the model stays as it is.
fn photos(args: &UpdateArgs, model: &model::Model, output: &Output) -> Result<Photos, Failure> {
    let source = captures::open(&args.photos, output)?;
    let options = PhotoOptions {
        store: args.store.as_deref(),
        downscale: args.downscale,
        test_every: Some(args.test_every.unwrap_or(0)),
        test_stretches: Some(0.0),
        leaves_store_of_model: true,
    };
    captures::photos_of(model, &source, &options, output)
}

fn text(report: &Report) -> String {
    let [trained, held_out] = report.photos;
    let [before, after] = report.area_splats;
    let mut text = format!(
        "{trained} photos of the area, {before} splats there became {after} in {:.1} s of training ({:.1} CPU seconds)\n",
        report.training_seconds, report.training_cpu_seconds
    );
    for (what, photos, gain) in [
        ("photos trained on", trained, report.trained_on),
        ("held-out photos", held_out, report.held_out),
        ("box, photos trained on", trained, report.trained_on_box),
        ("box, held-out photos", held_out, report.held_out_box),
    ] {
        if let Some(Gain { before, after }) = gain {
            text += &format!("{before:.2} dB became {after:.2} dB ({what}, {photos})\n");
        }
    }
    if let Some([changed, all]) = report.blocks {
        text += &format!("{changed} of {all} blocks have new bytes\n");
    }
    if let Some(vehicle) = &report.vehicle {
        text += &format!("{}: a {} of {} splats in the garage\n", vehicle.name, vehicle.class, vehicle.splats);
    }
    text + &report.out.display().to_string()
}
