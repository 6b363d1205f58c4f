//! `plat objects pose`: poses of vehicles from their positions and the road of a model.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::Read;
use std::path::Path;

use ::render::surface::Surface;
use glam::{DQuat, DVec3};
use scene::objects::{self, Tracks};
use scene::{BadInput, CodecError, MovingObject, PathPose};
use serde::Serialize;
use store::file::save;
use train::{Positions, RoadPoses, road_poses};

use crate::args::PoseArgs;
use crate::commands::export::make_parent;
use crate::failure::Failure;
use crate::output::Output;

/// As for `tracks.json` beside a capture.
const MAX_BYTES: u64 = 1 << 28;
/// Splats this near to a position, metres along the ground, tell where its road is.
const NEAR_METRES: f64 = 12.0;
/// The positions are looked up by cells of this side, metres.
const CELL_METRES: f64 = 8.0;

#[derive(Serialize)]
struct Posed<'a> {
    command: &'static str,
    out: &'a Path,
    objects: usize,
    /// Poses of all objects, and how many of them fill gaps.
    poses: usize,
    filled: usize,
    /// At how many the object lies on the road.
    on_road: usize,
    /// Splats of the model that lie near the paths.
    splats: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    against: Option<Errors>,
}

/// Errors of the poses at whose times the true ones are known.
#[derive(Serialize)]
struct Errors {
    poses: usize,
    /// Degrees of the whole rotation, and of the heading alone.
    median_degrees: f64,
    median_heading_degrees: f64,
    within_10_degrees: f64,
    within_30_degrees: f64,
    /// Metres of the origin's height.
    median_height_metres: f64,
    worst_height_metres: f64,
}

pub(crate) fn run(args: &PoseArgs, output: &Output) -> Result<(), Failure> {
    let given = read(&args.positions, objects::read_positions)?;
    let truth = args.against.as_deref().map(|path| read(path, objects::read)).transpose()?;
    if let (Some(path), Some(truth)) = (&args.against, &truth)
        && !truth.objects.iter().any(|own| given.objects.iter().any(|object| object.id == own.id))
    {
        let problem = format!("has none of the objects of {}", args.positions.display());
        return Err(BadInput::new(path.display().to_string(), problem, "give true paths of the same names").into());
    }
    let ground_from_world = model::ground_from_world(&args.model)?;
    let model = model::read(&args.model)?;
    let cell = |place: DVec3| [place.x, place.y].map(|side| (side / CELL_METRES).floor() as i64);
    let reach = (NEAR_METRES / CELL_METRES).ceil() as i64;
    let mut near = BTreeSet::new();
    for pose in given.objects.iter().flat_map(|object| &object.path) {
        let [x, y] = cell(ground_from_world * pose.world_from_object.translation);
        (-reach..=reach).for_each(|i| near.extend((-reach..=reach).map(|j| [x + i, y + j])));
    }
    let road = Surface::new(&model.splats, ground_from_world, |place| near.contains(&cell(place)));
    let splats = road.len();
    if splats == 0 {
        let problem = format!("lie nowhere near the splats of {}", args.model.display());
        let advice = "give positions in the axes of the model's capture, metres";
        return Err(BadInput::new(args.positions.display().to_string(), problem, advice).into());
    }
    let progress = output.progress("posing", given.objects.len() as u64);
    let mut posed = Vec::new();
    let mut on_road = 0;
    for (done, object) in (1..).zip(&given.objects) {
        let RoadPoses { path, on_road: lies } = on_the_road(object, &road);
        on_road += lies;
        posed.push(MovingObject { path, ..object.clone() });
        progress.at(done, "");
    }
    drop(progress);
    objects::check_all(&posed).map_err(|error| {
        BadInput::new(args.positions.display().to_string(), error.to_string(), "correct the positions")
    })?;
    let poses = |objects: &[MovingObject]| objects.iter().map(|object| object.path.len()).sum::<usize>();
    let said = Posed {
        command: "objects pose",
        out: &args.out,
        objects: posed.len(),
        poses: poses(&posed),
        filled: poses(&posed) - poses(&given.objects),
        on_road,
        splats,
        against: truth.map(|truth| errors(&posed, &truth.objects)),
    };
    make_parent(&args.out)?;
    save(&args.out, &objects::write(&Tracks { objects: posed, seconds: given.seconds }))?;
    let mut text = format!(
        "{} objects, {} poses, {} of which fill gaps, {} on the road",
        said.objects, said.poses, said.filled, said.on_road
    );
    if on_road == 0 {
        output.note("no pose has a road of the model under three corners: heights and tilts are not those of a road");
    }
    if let Some(errors) = &said.against {
        text += &format!(
            "\nrotation off by {:.1} degrees in the median, by up to 10 in {:.1} % of {} poses, by up to 30 in {:.1} %; height by {:.2} m",
            errors.median_degrees,
            100.0 * errors.within_10_degrees,
            errors.poses,
            100.0 * errors.within_30_degrees,
            errors.median_height_metres
        );
    }
    output.result(&said, &format!("{text}\n{}", args.out.display()))
}

/// Reads objects from a file.
///
/// # Errors
/// A file that cannot be read or decoded, or without objects.
pub(crate) fn read(path: &Path, decode: fn(&[u8]) -> Result<Tracks, CodecError>) -> Result<Tracks, BadInput> {
    let bad = |problem: String, advice: &str| BadInput::new(path.display().to_string(), problem, advice);
    let mut bytes = Vec::new();
    let read = File::open(path).and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes));
    read.map_err(|error| bad(format!("cannot be read ({error})"), "check the path"))?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(bad(format!("is larger than {} MB", MAX_BYTES >> 20), "leave out objects that are not needed"));
    }
    let tracks = decode(&bytes).map_err(|error| bad(error.to_string(), "correct the file"))?;
    if tracks.objects.is_empty() {
        return Err(bad("has no object".into(), "name objects in \"tracks\""));
    }
    Ok(tracks)
}

fn on_the_road(object: &MovingObject, road: &Surface) -> RoadPoses {
    let places: Vec<(f64, DVec3)> =
        object.path.iter().map(|pose| (pose.seconds, pose.world_from_object.translation)).collect();
    let first = object.path.first().map(|pose| pose.world_from_object.rotation);
    let is_known = first.is_some_and(|rotation| rotation != DQuat::IDENTITY);
    let first = first.filter(|_| is_known);
    road_poses(&Positions { places: &places, low: object.low, high: object.high, first }, road)
}

/// Errors against true objects of the same names, at the times of poses between theirs.
fn errors(posed: &[MovingObject], truth: &[MovingObject]) -> Errors {
    let (mut degrees, mut headings, mut heights) = (Vec::new(), Vec::new(), Vec::new());
    for object in posed {
        let Some(own) = truth.iter().find(|own| own.id == object.id) else { continue };
        for PathPose { seconds, world_from_object: found } in &object.path {
            let Some(right) = own.pose(*seconds) else { continue };
            degrees.push(found.rotation.angle_between(right.rotation).to_degrees());
            let ahead = [found, &right].map(|pose| pose.rotation * DVec3::X);
            let turn = ahead[0].truncate().angle_to(ahead[1].truncate());
            headings.push(turn.abs().to_degrees());
            heights.push((found.translation - right.translation).z.abs());
        }
    }
    for values in [&mut degrees, &mut headings, &mut heights] {
        values.sort_by(f64::total_cmp);
    }
    let median = |values: &[f64]| values.get(values.len() / 2).copied().unwrap_or(0.0);
    let within = |limit: f64| degrees.partition_point(|off| *off <= limit) as f64 / degrees.len().max(1) as f64;
    Errors {
        poses: degrees.len(),
        median_degrees: median(&degrees),
        median_heading_degrees: median(&headings),
        within_10_degrees: within(10.0),
        within_30_degrees: within(30.0),
        median_height_metres: median(&heights),
        worst_height_metres: heights.last().copied().unwrap_or(0.0),
    }
}
