//! `plat render`: renders a model from the cameras of a capture, or as a film along them.
//!
//! A camera with a lens model is rendered as its ideal pinhole, which is what ingest undistorts its photo to.

use std::path::{Path, PathBuf};

use ::render::Options;
use eval::{Composition, Moment, Picture, Renderer, TemporalFilter, write_png};
use glam::{DQuat, Vec3};
use model::ModelObject;
use scene::sensors::Sensors;
use scene::{BLOCK_ATTRIBUTE, BadInput, Splats, View, npy};
use serde::Serialize;
use store::file::save;

use crate::args::{FilmArgs, RenderArgs};
use crate::clock::Stopwatch;
use crate::failure::{Failure, make_folder};
use crate::film::Film;
use crate::output::Output;
use crate::{backend, captures};

/// How much of a pixel's colour the tint of an object takes.
const TINT: f32 = 0.5;

#[derive(Serialize)]
struct Rendered<'a> {
    command: &'static str,
    out: &'a Path,
    /// Pictures.
    views: usize,
    splats: usize,
    /// Objects that move, in their own splats.
    objects: usize,
    backend: String,
    antialiased: bool,
    cpu_seconds: f64,
    wall_seconds: f64,
    /// Views per second, writing files included.
    fps: f64,
    /// Mean change of a surface's colour from picture to picture, 0 to 1, before and after --smooth.
    #[serde(skip_serializing_if = "Option::is_none")]
    flicker: Option<[f64; 2]>,
}

pub(crate) fn run(args: &RenderArgs, output: &Output) -> Result<(), Failure> {
    let backend = backend::open(args.backend)?;
    let mut model = model::read(&args.model)?;
    if let Some(attribute) = &args.by {
        model.splats = coloured(&model.splats, attribute, &args.model)?;
    }
    let views = captures::read_cameras(&args.cameras)?;
    let film = &args.film;
    let path = film.sequence.map(|per_second| film_path(&views, film, per_second, &args.cameras)).transpose()?;
    // All names are checked before the first picture is rendered.
    let names = match path {
        Some(_) => Vec::new(),
        None => captures::stems(&args.cameras, views.iter().map(|view| view.name.as_str()))?,
    };
    let of_view = |view: &View| Moment { seconds: view.seconds, camera: view.camera };
    let mut moments = path.unwrap_or_else(|| views.iter().map(of_view).collect());
    for moment in &mut moments {
        let size = args.size;
        moment.camera = size.map_or(moment.camera, |size| captures::resized(&moment.camera, size.width, size.height));
        moment.seconds = args.time.or(moment.seconds);
    }
    let antialiased = (model.antialiased || args.antialiased) && !args.classic;
    let has_depth = args.depth || film.smooth.is_some();
    let options = Options { antialiased, extras: has_depth, inverse_depth: has_depth, ..model.options() };
    let flat = Options { extras: false, inverse_depth: false, ..options };
    let clock = Stopwatch::start();
    let mut renderer = Renderer::new(&backend)?;
    let objects = placed(&model.objects, args)?;
    if film.overlay && objects.is_empty() {
        let problem = format!("has no effect, as no object that moves is drawn of {}", args.model.display());
        return Err(BadInput::new("--overlay", problem, "omit it, or train the model with --objects").into());
    }
    if !args.only.is_empty() {
        model.splats = Splats::new(0);
    }
    let splats = renderer.upload(&model.splats)?;
    let composition = Composition::new(&renderer, objects.iter())?;
    let (black, labels) = if film.overlay { tints(&model.splats, &objects) } else { (Splats::new(0), Vec::new()) };
    let tinted = (renderer.upload(&black)?, Composition::new(&renderer, labels.iter())?);
    let mut filter = film.smooth.map(|newest| TemporalFilter::new(newest as f32));
    let mut written = None;
    let progress = output.progress("rendering", moments.len() as u64);
    for (i, Moment { seconds, camera }) in moments.iter().enumerate() {
        let shown = composition.at(&renderer, *seconds)?;
        let frame = renderer.compose(&splats, &shown, camera, &options)?;
        let mut picture = Picture::of(frame);
        if let Some(filter) = &mut filter {
            picture = filter.filtered(picture, camera);
        }
        if film.overlay {
            let shown = tinted.1.at(&renderer, *seconds)?;
            let tint = renderer.compose(&tinted.0, &shown, camera, &flat)?;
            add_tint(&mut picture, &tint.colour);
        }
        if let Some(per_second) = film.sequence {
            let film = match &mut written {
                Some(film) => film,
                None => {
                    let size = (camera.pinhole.width, camera.pinhole.height);
                    written.insert(Film::create(&args.out, size, moments.len() as u32, per_second)?)
                }
            };
            film.push(&picture.image())?;
        } else {
            write_view(&args.out.join(&names[i]), &picture, args.depth)?;
        }
        progress.at(i as u64 + 1, "");
    }
    drop(progress);
    written.map_or(Ok(()), Film::finish)?;
    let rendered = Rendered {
        command: "render",
        out: &args.out,
        views: moments.len(),
        splats: model.splats.len(),
        objects: objects.len(),
        backend: renderer.name(),
        antialiased,
        cpu_seconds: clock.cpu_seconds(),
        wall_seconds: clock.wall_seconds(),
        fps: moments.len() as f64 / clock.wall_seconds().max(1e-9),
        flicker: filter.and_then(|filter| filter.flicker()),
    };
    let mut text = format!("{} views of {} splats, rendered on {}", rendered.views, rendered.splats, rendered.backend);
    if let Some([before, after]) = rendered.flicker {
        text += &format!("\nflicker {:.2} of 255, {:.2} before it was smoothed", 255.0 * after, 255.0 * before);
    }
    output.result(&rendered, &format!("{text}\n{}", args.out.display()))
}

/// The cameras of a film: along those of one sensor.
fn film_path(views: &[View], film: &FilmArgs, per_second: f64, cameras: &Path) -> Result<Vec<Moment>, Failure> {
    let Sensors { names, of_views } = scene::sensors::sensors(views);
    let chosen = match &film.sensor {
        Some(name) => names.iter().position(|of| of == name),
        None => (names.len() == 1).then_some(0),
    };
    let Some(chosen) = chosen else {
        let shown: Vec<&str> = names.iter().take(20).map(String::as_str).collect();
        let problem = format!("has {} sensors: {}", names.len(), shown.join(", "));
        let help = "name one of them by --sensor";
        return Err(BadInput::new(cameras.display().to_string(), problem, help).into());
    };
    let of_sensor = views.iter().zip(&of_views).filter(|(_, taken)| taken.sensor as usize == chosen);
    let of_sensor: Vec<&View> = of_sensor.map(|(view, _)| view).collect();
    let path = eval::camera_path(&of_sensor, per_second);
    Ok(path.map_err(|problem| BadInput::new("--sequence", problem, "give fewer pictures a second"))?)
}

/// Writes a picture, and its depths, under a path without ending.
fn write_view(stem: &Path, picture: &Picture, has_depth: bool) -> Result<(), Failure> {
    let file = |ending: &str| {
        let mut path = stem.to_path_buf().into_os_string();
        path.push(ending);
        PathBuf::from(path)
    };
    let png = file(".png");
    make_folder(png.parent().unwrap_or(stem))?;
    write_png(&png, &picture.image())?;
    if has_depth {
        save(&file(".depth.npy"), &npy::write_f32(&[picture.height, picture.width], &picture.depth))?;
    }
    Ok(())
}

/// The static scene in black, and each object in a colour of its own.
fn tints(splats: &Splats, objects: &[ModelObject]) -> (Splats, Vec<ModelObject>) {
    let of = |(i, object): (usize, &ModelObject)| {
        let splats = eval::painted(&object.splats, eval::label_colour(i as u32 + 1));
        ModelObject { splats, ..object.clone() }
    };
    (eval::painted(splats, Vec3::ZERO), objects.iter().enumerate().map(of).collect())
}

/// Mixes in the colours of objects, whose brightest channel is what a pixel shows of an object.
fn add_tint(picture: &mut Picture, tint: &[f32]) {
    let area = picture.width * picture.height;
    for i in 0..area {
        let colour = [0, 1, 2].map(|plane| tint[plane * area + i]);
        let share = TINT * colour.iter().fold(0.0f32, |most, value| most.max(*value)).min(1.0);
        for (plane, value) in colour.into_iter().enumerate() {
            let own = &mut picture.colour[plane * area + i];
            *own = (1.0 - share) * *own + TINT * value;
        }
    }
}

/// The objects to draw, where they are to be.
fn placed(objects: &[ModelObject], args: &RenderArgs) -> Result<Vec<ModelObject>, Failure> {
    const ALL: &str = "all";
    if objects.is_empty() && args.time.is_some() {
        let problem = format!("has no effect, as {} has no objects that move", args.model.display());
        return Err(BadInput::new("--time", problem, "omit it, or train the model with --objects").into());
    }
    let moved = args.moves.iter().map(|of| &of.id);
    for id in args.without.iter().filter(|id| *id != ALL).chain(&args.only).chain(moved) {
        if objects.iter().all(|object| object.about.id != *id) {
            let names: Vec<&str> = objects.iter().map(|object| object.about.id.as_str()).collect();
            let has = if names.is_empty() { "none".into() } else { names.join(", ") };
            let problem = format!("has no object '{id}', it has {has}");
            return Err(BadInput::new(args.model.display().to_string(), problem, "give one of its objects").into());
        }
    }
    let is_drawn = |object: &&ModelObject| {
        let is = |ids: &[String]| ids.contains(&object.about.id);
        if args.only.is_empty() {
            !is(&args.without) && !args.without.iter().any(|id| id == ALL)
        } else {
            is(&args.only)
        }
    };
    let mut drawn: Vec<ModelObject> = objects.iter().filter(is_drawn).cloned().collect();
    for of in &args.moves {
        for object in drawn.iter_mut().filter(|object| object.about.id == of.id) {
            for pose in &mut object.about.path {
                let at = &mut pose.world_from_object;
                at.translation += of.metres;
                at.rotation = (at.rotation * DQuat::from_rotation_z(of.degrees.to_radians())).normalize();
            }
        }
    }
    Ok(drawn)
}

/// The model's splats, coloured by an attribute.
fn coloured(splats: &Splats, attribute: &str, path: &Path) -> Result<Splats, Failure> {
    if let Some(coloured) = eval::coloured_by(splats, attribute) {
        return Ok(coloured);
    }
    if attribute == BLOCK_ATTRIBUTE && path.is_dir() {
        let labelled = model::read_tree(path)?.merged_with_blocks();
        return eval::coloured_by(&labelled, attribute)
            .ok_or_else(|| Failure::Work("splats without their blocks".into()));
    }
    let problem = format!(
        "has no attribute '{attribute}', it has {}",
        match splats.attribute_names().join(", ") {
            names if names.is_empty() => "none".into(),
            names => names,
        }
    );
    Err(BadInput::new(
        path.display().to_string(),
        problem,
        "train with --label-blocks, or give a folder and --by block",
    )
    .into())
}
