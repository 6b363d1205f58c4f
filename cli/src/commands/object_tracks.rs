//! `plat objects track`: the objects that move in a capture, and their paths.

use std::collections::BTreeMap;
use std::path::Path;

use blocks::Ground;
use dataset::moving::Looking;
use dataset::open::OpenOptions;
use dataset::true_boxes::TrueBoxes;
use eval::{TrackFigures, track_figures};
use scene::objects::{self, Tracks};
use scene::{BadInput, MovingObject};
use serde::Serialize;
use store::Store;
use store::file::save;

use crate::args::TrackArgs;
use crate::captures::{find_zones, ingest_photos, open_with, zone_source};
use crate::commands::export::make_parent;
use crate::commands::object_poses::read;
use crate::failure::{Failure, temporary_folder};
use crate::output::Output;
use crate::track_map;

#[derive(Serialize)]
struct Tracked<'a> {
    command: &'static str,
    out: &'a Path,
    objects: usize,
    classes: BTreeMap<&'a str, usize>,
    /// Poses of all objects.
    poses: usize,
    sweeps: usize,
    radar_sweeps: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    against: Option<TrackFigures>,
}

pub(crate) fn run(args: &TrackArgs, output: &Output) -> Result<(), Failure> {
    let truth = args.against.as_deref().map(|path| read(path, objects::read)).transpose()?;
    let options = OpenOptions { lidar: !args.no_lidar, radar: !args.no_radar, ..OpenOptions::default() };
    let mut source = open_with(&args.capture, &options, output)?;
    // Masks hide what is looked for.
    source.unmask();
    let ground_from_world = Ground::of(&source.capture).ground_from_world;
    let from = zone_source(&args.finder, &args.capture, &source)?;
    let (mut views, mut zones) = (source.capture.views.clone(), None);
    if let Some(from) = from {
        let folder = temporary_folder()?;
        let url = args.store.clone().unwrap_or_else(|| folder.path().display().to_string());
        let store = Store::open(&url)?.blocking();
        let capture = ingest_photos(&source, &store, 1, output)?.capture;
        zones = Some(find_zones(&capture, &from, &store, output)?.0);
        views = capture.views;
    }
    let name = args.capture.display().to_string();
    let zones = zones.as_ref();
    let looking = Looking { capture: &name, source: &source, views: &views, zones, ground_from_world };
    let progress = output.progress("tracks", looking.steps() as u64);
    let found = looking.objects(&|done, _| progress.at(done as u64, ""))?;
    drop(progress);
    objects::check_all(&found)
        .map_err(|error| BadInput::new(name, error.to_string(), "check the times of its photos"))?;
    let visible = truth.as_ref().map(|_| TrueBoxes::open(&args.capture)).transpose()?.flatten();
    let true_objects = truth.as_ref().map(|truth| &truth.objects[..]);
    let against = true_objects.map(|truth| track_figures(&views, (&found, truth), visible.as_ref(), ground_from_world));
    let mut classes = BTreeMap::new();
    found.iter().for_each(|object| *classes.entry(object.class.as_str()).or_insert(0) += 1);
    let said = Tracked {
        command: "objects track",
        out: &args.out,
        objects: found.len(),
        classes,
        poses: found.iter().map(|object| object.path.len()).sum(),
        sweeps: source.sweeps.len(),
        radar_sweeps: source.road.len(),
        against,
    };
    let text = summary(&said, &found);
    if let Some(svg) = &args.svg {
        make_parent(svg)?;
        save(svg, track_map::draw(&views, (&found, true_objects), ground_from_world).as_bytes())?;
    }
    let seconds = views.iter().filter_map(|view| Some((view.name.clone(), view.seconds?))).collect();
    let bytes = objects::write(&Tracks { objects: found.clone(), seconds });
    make_parent(&args.out)?;
    save(&args.out, &bytes)?;
    output.result(&said, &text)
}

fn swept(said: &Tracked) -> String {
    match (said.sweeps, said.radar_sweeps) {
        (0, 0) => "photos alone".to_owned(),
        (0, radar) => format!("{radar} sweeps of a radar"),
        (lidar, 0) => format!("{lidar} sweeps of a lidar"),
        (lidar, radar) => format!("{lidar} sweeps of a lidar and {radar} of a radar"),
    }
}

fn summary(said: &Tracked, found: &[MovingObject]) -> String {
    let classes: Vec<String> = said.classes.iter().map(|(class, count)| format!("{count} {class}")).collect();
    let classes = if found.is_empty() { String::new() } else { format!(" ({})", classes.join(", ")) };
    let mut text = format!("{} objects that move{classes} in {}, {} poses", said.objects, swept(said), said.poses);
    if let Some(TrackFigures { times, all, vehicles }) = &said.against {
        for (what, of) in [("all", all), ("vehicles", vehicles)] {
            let number = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.2}"));
            text += &format!(
                "\n{what}: MOTA {} over {times} times: of {} objects {} missed, {} extra, {} switches; off by {} m and {}° in the median, {} m and {}° at 95 %, ATE {} m",
                number(of.mota),
                of.objects,
                of.misses,
                of.extra,
                of.switches,
                number(of.median_metres),
                number(of.median_degrees),
                number(of.p95_metres),
                number(of.p95_degrees),
                number(of.ate_metres)
            );
        }
    }
    format!("{text}\n{}", said.out.display())
}
