//! `plat synth`: writes a synthetic capture of a generated city.

use std::path::{Path, PathBuf};

use city::CitySettings;
use city::faults::Fault;
use dataset::synth::{self, CarRig, Driven, Settings, Summary, Watched, WatchedPlace};
use eval::write_png;
use serde::Serialize;

use crate::args::{Rig, SynthArgs};
use crate::failure::Failure;
use crate::output::Output;

#[derive(Serialize)]
struct Shown {
    out: PathBuf,
    #[serde(flatten)]
    summary: Summary,
}

#[derive(Serialize)]
struct Drawn {
    gallery: PathBuf,
}

pub(crate) fn run(args: &SynthArgs, output: &Output) -> Result<(), Failure> {
    let settings = settings(args);
    settings.check()?;
    let stages = output.stages();
    let progress = |what, done, total| stages.at(what, done as u64, total as u64, "");
    if let Some(file) = &args.gallery {
        write_png(file, &synth::gallery(&settings, &progress)?)?;
        drop(stages);
        return output.result(&Drawn { gallery: file.clone() }, &file.display().to_string());
    }
    drop(stages);
    let out =
        args.out.clone().ok_or_else(|| Failure::Input("--out: is missing; give a folder for the capture".into()))?;
    let summary = write(args, &out, output)?;
    let text = format!(
        "{} photos of {} objects, {} of them moving, in {} triangles; {} sparse points, each in {:.1} views\n{}\n\
         the capture         {} (plat train reads it)\n\
         its contents        {}",
        summary.views,
        summary.actors,
        summary.moving,
        summary.triangles,
        summary.points,
        summary.mean_track,
        summary.driven.as_ref().map_or(String::new(), drives) + &summary.watched.map_or(String::new(), watched),
        out.display(),
        out.join("manifest.json").display(),
    );
    output.result(&Shown { out, summary }, &text)
}

/// Writes a capture into a folder, with progress.
pub(super) fn write(args: &SynthArgs, out: &Path, output: &Output) -> Result<Summary, Failure> {
    output.note(format!("building a city of {} km² and taking {} photos of it", args.area_km2, args.views));
    let stages = output.stages();
    let progress = |what, done, total| stages.at(what, done as u64, total as u64, "");
    Ok(synth::write(out, &settings(args), &progress)?)
}

/// What the cars drove, in a line.
fn drives(driven: &Driven) -> String {
    format!(
        "cars drove {:.0} m, {:.0} % of all streets in both directions, and stopped {} times, every {} m\n",
        driven.metres,
        100.0 * driven.share,
        driven.stops,
        driven.spacing_metres
    )
}

/// Where the watched place is, in a line or two.
fn watched(place: WatchedPlace) -> String {
    let listed = |numbers: &[f64]| numbers.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
    let parked = place.parked.map_or(String::new(), |car| format!("the parked car, as a --box {}\n", listed(&car)));
    format!("the watched place   {}, the street's direction {} degrees\n{parked}", listed(&place.place), place.degrees)
}

fn settings(args: &SynthArgs) -> Settings {
    Settings {
        city: CitySettings {
            seed: args.seed,
            area_km2: args.area_km2,
            layout: args.layout,
            traffic: args.traffic,
            plain: args.plain,
        },
        views: args.views,
        width: args.size.width,
        height: args.size.height,
        aerial: args.aerial,
        fixed: args.fixed,
        faults: args.fault.iter().map(|fault| Fault { seed: args.seed, ..*fault }).collect(),
        truth: args.truth,
        lidar: args.lidar,
        radar: args.radar,
        mesh: args.mesh,
        nuscenes: args.nuscenes,
        kitti_raw: args.kitti_raw,
        waymo: args.waymo,
        occupancy: args.occupancy,
        around: args.occupancy_around.clone(),
        spacing: args.spacing,
        rig: match args.rig {
            Rig::Six => CarRig::Six,
            Rig::Front => CarRig::Front,
        },
        watched: args.watch.map(|[x, y, radius]| Watched {
            x,
            y,
            radius,
            parked: args.parked,
            film_seconds: args.film,
        }),
    }
}
