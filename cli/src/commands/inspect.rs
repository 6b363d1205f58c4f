//! `plat inspect`: what is in a capture, how it would be divided, and what training it would cost.

use std::collections::{BTreeMap, BTreeSet};

use blocks::density::ENOUGH_PLACES;
use blocks::{Density, Plan, ViewKind};
use scene::{Capture, GeoOrigin};
use serde::Serialize;
use store::file::save;
use worker::estimate::Estimate;
use worker::speed::relative_speed;

use super::inspect_objects::{Objects, objects};
use crate::args::InspectArgs;
use crate::captures;
use crate::failure::Failure;
use crate::output::Output;
use crate::planning::{check_plan, describe, plan_of};

/// Share of the ground whose photos may be too few without a warning: the rim of every capture is seen from one side.
const THIN_SHARE: f64 = 0.1;

#[derive(Serialize)]
struct Inspected {
    command: &'static str,
    scene: String,
    format: &'static str,
    views: usize,
    /// Number of views of each size, as `width`x`height`.
    sizes: BTreeMap<String, usize>,
    masked: usize,
    points: usize,
    /// Mean number of views per point; null without tracks.
    mean_track: Option<f64>,
    /// Sweeps of the capture's lidar.
    sweeps: usize,
    /// Views taken during a sweep.
    views_with_lidar: usize,
    /// How many of the points come from lidar, and from the road that a radar found.
    lidar_points: usize,
    /// Sweeps of the capture's radar.
    radar_sweeps: usize,
    /// After how many of them there is a road to the next one.
    radar_roads: usize,
    /// Photos with a depth map.
    depth_maps: usize,
    /// Number of annotated boxes by class.
    boxes: BTreeMap<String, usize>,
    /// Objects that move, of which boxes and paths are known.
    moving: usize,
    /// Views whose time is known, as --objects needs it.
    views_with_time: usize,
    /// What `--detector` or `--zones` finds; null without them.
    objects: Option<Objects>,
    left_out: Vec<(String, String)>,
    /// Along the ground's axes and up, 1st to 99th percentile of the points.
    extent_metres: [f64; 3],
    geo_origin: Option<GeoOrigin>,
    levels: Option<u8>,
    tasks: Option<usize>,
    estimate: Option<Estimate>,
    /// Why the capture cannot be trained; null if it can.
    problem: Option<String>,
    /// By kind of view: `aerial`, `street`.
    density: BTreeMap<&'static str, Shown>,
    /// Where photos are too few for what is asked of them.
    warnings: Vec<String>,
}

/// How densely views of one kind photograph the ground.
#[derive(Serialize)]
struct Shown {
    views: usize,
    /// Median distance of a photo to the next that looks the same way.
    spacing_metres: Option<f64>,
    cell_metres: f64,
    cells: usize,
    thin_cells: usize,
    thin_share: f64,
}

pub(crate) fn run(args: &InspectArgs, output: &Output) -> Result<(), Failure> {
    let source = captures::open_to_inspect(&args.capture, &args.plan)?;
    let planned = plan_of(&source, &args.plan);
    let planned = planned.and_then(|(capture, plan)| {
        check_plan(&plan, &capture, output)?;
        Ok(plan)
    });
    let capture = &source.capture;
    let densities = blocks::densities(capture);
    if let Some(path) = &args.svg {
        save(path, blocks::draw_density(&densities, capture).as_bytes())?;
    }
    let mut sizes = BTreeMap::new();
    for view in &capture.views {
        let k = &view.camera.pinhole;
        *sizes.entry(format!("{}x{}", k.width, k.height)).or_default() += 1;
    }
    let points = &capture.points;
    let mean_track = (!points.track_start.is_empty() && !points.is_empty())
        .then(|| points.seen_by.len() as f64 / points.len() as f64);
    let inspected = Inspected {
        command: "inspect",
        scene: captures::name_of(&args.capture),
        format: source.format,
        views: capture.views.len(),
        sizes,
        masked: source.photos.iter().filter(|photo| photo.mask.is_some()).count(),
        points: points.len(),
        mean_track,
        sweeps: source.sweeps.len(),
        views_with_lidar: source.sweeps.iter().flat_map(|sweep| &sweep.views).collect::<BTreeSet<_>>().len(),
        lidar_points: source.seeds.len(),
        radar_sweeps: source.road.len(),
        radar_roads: source.roads(),
        depth_maps: source.depth_maps(),
        boxes: source.labels,
        moving: capture.objects.len(),
        views_with_time: capture.views.iter().filter(|view| view.seconds.is_some()).count(),
        objects: objects(args, output)?,
        left_out: source.left_out,
        extent_metres: extent_metres(capture),
        geo_origin: capture.geo_origin,
        levels: planned.as_ref().ok().map(|plan| plan.levels),
        tasks: planned.as_ref().ok().map(|plan| plan.tasks.len()),
        estimate: planned.as_ref().ok().map(|plan| Estimate::of(plan, relative_speed())),
        problem: planned.as_ref().err().map(Failure::to_string),
        density: densities.iter().map(|density| (density.kind.name(), shown(density))).collect(),
        warnings: densities.iter().filter_map(warning).collect(),
    };
    output.result(&inspected, &text(&inspected, planned.ok().as_ref()))
}

fn text(found: &Inspected, plan: Option<&Plan>) -> String {
    let sizes: Vec<String> = found.sizes.iter().map(|(size, n)| format!("{n} of {size}")).collect();
    let [x, y, z] = found.extent_metres;
    let mut text = format!("{}: {}, {} views ({})", found.scene, found.format, found.views, sizes.join(", "));
    if found.masked > 0 {
        text += &format!(", {} with masks", found.masked);
    }
    text += &format!("\n{} points", found.points);
    if let Some(track) = found.mean_track {
        text += &format!(", each seen by {track:.1} views");
    }
    text += &format!(", over {x:.1} × {y:.1} m, {z:.1} m high\n");
    if found.sweeps > 0 {
        let (sweeps, views) = (found.sweeps, found.views_with_lidar);
        text += &format!("{sweeps} sweeps of a lidar, taken with {views} of the views\n");
    }
    if found.radar_sweeps > 0 {
        let (sweeps, roads) = (found.radar_sweeps, found.radar_roads);
        text += &format!("{sweeps} sweeps of a radar, which find the road from {roads} of them to the next\n");
    }
    if found.lidar_points > 0 {
        text += &format!("{} of the points come from these\n", found.lidar_points);
    }
    if found.depth_maps > 0 {
        text += &format!("depth maps of {} of the views, for --depth-weight\n", found.depth_maps);
    }
    if !found.boxes.is_empty() {
        let boxes: Vec<String> = found.boxes.iter().map(|(class, count)| format!("{count} {class}")).collect();
        text += &format!("boxes: {}\n", boxes.join(", "));
    }
    if found.moving > 0 {
        let (moving, views) = (found.moving, found.views_with_time);
        text +=
            &format!("{moving} objects that move, with paths, for --objects; the times of {views} views are known\n");
    }
    if let Some(objects) = &found.objects {
        text += &objects.text(found.views);
    }
    text += &match found.geo_origin {
        Some(at) => format!(
            "origin at {:.6}° north, {:.6}° east, {:.1} m\n",
            at.latitude_degrees, at.longitude_degrees, at.altitude_metres
        ),
        None => "no geographic origin: lengths are in the capture's unit\n".into(),
    };
    for (kind, shown) in &found.density {
        let spacing = shown.spacing_metres.map_or(String::new(), |metres| format!(", {metres:.1} m apart"));
        text += &format!("{} {kind} views{spacing}\n", shown.views);
    }
    found.warnings.iter().for_each(|warning| text += &format!("{warning}\n"));
    for (name, reason) in &found.left_out {
        text += &format!("left out {name}: {reason}\n");
    }
    match (plan, &found.problem) {
        (Some(plan), _) => text += &describe(plan),
        (None, Some(problem)) => text += &format!("cannot be trained: {problem}\n"),
        (None, None) => {}
    }
    text
}

fn shown(density: &Density) -> Shown {
    Shown {
        views: density.views,
        spacing_metres: density.spacing_metres,
        cell_metres: density.cell_metres,
        cells: density.cells.len(),
        thin_cells: density.thin_cells(),
        thin_share: density.thin_share(),
    }
}

/// One line about ground that too few photos see, if it is more than [`THIN_SHARE`] of the ground.
fn warning(density: &Density) -> Option<String> {
    let (kind, share) = (density.kind.name(), density.thin_share());
    let advice = match density.kind {
        ViewKind::Street => "expect blur at eye level; 1 to 3 m apart are usual",
        ViewKind::Aerial => "expect blur from the air; photos usually overlap by 60 to 80 %",
    };
    let spacing = density.spacing_metres.map_or(String::new(), |metres| format!(" (they are {metres:.1} m apart)"));
    (share > THIN_SHARE).then(|| {
        format!(
            "thin: {:.0} % of the ground near {kind} photos is seen by them from fewer than {ENOUGH_PLACES} near places{spacing}: {advice}",
            100.0 * share
        )
    })
}

/// Extent of the points along the ground's axes and up, without outliers.
fn extent_metres(capture: &Capture) -> [f64; 3] {
    let ground = blocks::Ground::of(capture);
    let points: Vec<_> =
        capture.points.positions.iter().filter(|p| p.is_finite()).map(|&p| ground.from_world(p)).collect();
    std::array::from_fn(|axis| {
        let mut values: Vec<f64> = points.iter().map(|p| p[axis]).collect();
        values.sort_by(f64::total_cmp);
        let Some(last) = values.len().checked_sub(1) else { return 0.0 };
        let at = |share: f64| values[(share * last as f64).round() as usize];
        at(0.99) - at(0.01)
    })
}
