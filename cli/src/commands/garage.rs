//! `plat garage`: takes vehicles out of models, and places them in others.

use std::path::Path;

use eval::WorldBox;
use glam::{DQuat, DVec3};
use model::{Garage, ModelObject, Vehicle, cut_out};
use scene::{BadInput, MovingObject, PathPose, Rigid};
use serde::Serialize;

use crate::args::{GarageAddArgs, GarageListArgs, GaragePlaceArgs, Stand, VehicleBox};
use crate::commands::object_poses;
use crate::failure::Failure;
use crate::output::Output;

/// A vehicle that stands is there from so many seconds before the clock's 0 until so many after: over ten days.
const ALWAYS_SECONDS: f64 = 1e6;

#[derive(Serialize)]
struct Added<'a> {
    command: &'static str,
    garage: &'a Path,
    vehicle: Vehicle,
}

#[derive(Serialize)]
struct Listed<'a> {
    command: &'static str,
    garage: &'a Path,
    vehicles: &'a [Vehicle],
}

#[derive(Serialize)]
struct Placed<'a> {
    command: &'static str,
    model: &'a Path,
    vehicle: &'a str,
    /// Its name in the model.
    id: String,
    poses: usize,
    /// When it is there, seconds.
    from: f64,
    until: f64,
}

pub(crate) fn add(args: &GarageAddArgs, output: &Output) -> Result<(), Failure> {
    let mut garage = Garage::open(&args.garage)?;
    let model = model::read(&args.model)?;
    let (vehicle, splats, swing) = if let Some(id) = &args.object {
        let object = model.objects.iter().find(|object| object.about.id == *id);
        let Some(ModelObject { about, splats, swing }) = object else {
            let names: Vec<&str> = model.objects.iter().map(|object| object.about.id.as_str()).collect();
            let has = if names.is_empty() { "none".into() } else { names.join(", ") };
            let problem = format!("has no object '{id:.64}', it has {has}");
            return Err(BadInput::new(args.model.display().to_string(), problem, "give one of its objects").into());
        };
        let MovingObject { class, low, high, .. } = about.clone();
        let name = args.name.clone().unwrap_or_else(|| id.clone());
        (
            Vehicle { name, class, low, high, antialiased: model.antialiased, splats: splats.len() },
            splats.clone(),
            swing.clone(),
        )
    } else {
        let (Some(area), Some(name)) = (args.area, args.name.clone()) else {
            return Err(BadInput::new("plat garage add", "has nothing to take", "give --object or --box").into());
        };
        let WorldBox { world_from_box, low, high } = standing_box(&area, model::ground_from_world(&args.model)?);
        let splats = cut_out(&model.splats, &world_from_box, low, high);
        let (class, antialiased) = (args.class.clone(), model.antialiased);
        (Vehicle { name, class, low, high, antialiased, splats: splats.len() }, splats, None)
    };
    garage.add(vehicle.clone(), &splats, swing.as_ref())?;
    let text = format!("{}: a {} of {} splats\n{}", vehicle.name, vehicle.class, vehicle.splats, args.garage.display());
    output.result(&Added { command: "garage add", garage: &args.garage, vehicle }, &text)
}

pub(crate) fn list(args: &GarageListArgs, output: &Output) -> Result<(), Failure> {
    let garage = Garage::open(&args.garage)?;
    let vehicles = garage.vehicles();
    if vehicles.is_empty() {
        output.note(format!("{} is empty: plat garage add takes vehicles out of models", args.garage.display()));
    }
    let line = |of: &Vehicle| {
        let DVec3 { x, y, z } = of.high - of.low;
        format!("{:<20} {:<12} {x:.1} x {y:.1} x {z:.1} m  {} splats", of.name, of.class, of.splats)
    };
    let text: Vec<String> = vehicles.iter().map(line).collect();
    output.result(&Listed { command: "garage list", garage: &args.garage, vehicles }, &text.join("\n"))
}

pub(crate) fn place(args: &GaragePlaceArgs, output: &Output) -> Result<(), Failure> {
    let garage = Garage::open(&args.garage)?;
    let (vehicle, splats, swing) = garage.get(&args.vehicle)?;
    let path = match (&args.path, args.at) {
        (Some(file), _) => path_of(file, args.track.as_deref())?,
        (None, Some(stand)) => {
            let mut at = standing(stand, model::ground_from_world(&args.model)?);
            // The lower side's middle stands there, wherever the vehicle's own origin is.
            let middle = 0.5 * (vehicle.low + vehicle.high).with_z(2.0 * vehicle.low.z);
            at.translation -= at.rotation * middle;
            [-ALWAYS_SECONDS, ALWAYS_SECONDS].map(|seconds| PathPose { seconds, world_from_object: at }).to_vec()
        }
        (None, None) => {
            return Err(BadInput::new("plat garage place", "has no place", "give --path or --at").into());
        }
    };
    let id = args.id.clone().unwrap_or_else(|| vehicle.name.clone());
    let (poses, ends) = (path.len(), [path.first(), path.last()].map(|pose| pose.map_or(0.0, |pose| pose.seconds)));
    let object = ModelObject { about: vehicle.on(path, &id), splats, swing };
    model::place(&args.model, object, vehicle.antialiased)?;
    let text = format!("{id} in {}, {poses} poses from {} to {} s", args.model.display(), ends[0], ends[1]);
    let placed = Placed {
        command: "garage place",
        model: &args.model,
        vehicle: &args.vehicle,
        id,
        poses,
        from: ends[0],
        until: ends[1],
    };
    output.result(&placed, &text)
}

/// A box that stands on the ground, in its own axes the origin in the middle of its lower side.
pub(super) fn standing_box(area: &VehicleBox, ground_from_world: DQuat) -> WorldBox {
    let half = 0.5 * area.size;
    let (low, high) = (DVec3::new(-half.x, -half.y, 0.0), DVec3::new(half.x, half.y, area.size.z));
    WorldBox { world_from_box: standing(area.stand, ground_from_world), low, high }
}

/// The pose of a box that stands on the ground.
fn standing(stand: Stand, ground_from_world: DQuat) -> Rigid {
    let rotation = ground_from_world.inverse() * DQuat::from_rotation_z(stand.degrees.to_radians());
    Rigid { rotation: rotation.normalize(), translation: stand.place }
}

/// The path of an object in a file.
fn path_of(file: &Path, track: Option<&str>) -> Result<Vec<PathPose>, BadInput> {
    let tracks = object_poses::read(file, scene::objects::read)?;
    let bad =
        |problem: String| BadInput::new(file.display().to_string(), problem, "name one of its objects with --track");
    let found = match track {
        Some(id) => tracks.objects.into_iter().find(|object| object.id == id),
        None if tracks.objects.len() == 1 => tracks.objects.into_iter().next(),
        None => return Err(bad(format!("has {} objects", tracks.objects.len()))),
    };
    found.map(|object| object.path).ok_or_else(|| bad(format!("has no object '{:.64}'", track.unwrap_or_default())))
}
