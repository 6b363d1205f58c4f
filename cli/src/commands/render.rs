//! `plat render`: renders a model from the cameras of a capture.
//!
//! A camera with a lens model is rendered as its ideal pinhole, which is what ingest undistorts its photo to.

use std::path::{Path, PathBuf};

use ::render::{Frame, Options};
use eval::{Composition, Renderer, frame_image, write_png};
use glam::DQuat;
use model::ModelObject;
use scene::{BLOCK_ATTRIBUTE, BadInput, Splats, npy};
use serde::Serialize;
use store::file::save;

use crate::args::RenderArgs;
use crate::clock::Stopwatch;
use crate::failure::{Failure, make_folder};
use crate::output::Output;
use crate::{backend, captures};

/// Depth is written where the pixel's alpha is above this.
const MIN_ALPHA: f32 = 0.5;

#[derive(Serialize)]
struct Rendered<'a> {
    command: &'static str,
    out: &'a Path,
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
}

pub(crate) fn run(args: &RenderArgs, output: &Output) -> Result<(), Failure> {
    let backend = backend::open(args.backend)?;
    let mut model = model::read(&args.model)?;
    if let Some(attribute) = &args.by {
        model.splats = coloured(&model.splats, attribute, &args.model)?;
    }
    let views = captures::read_cameras(&args.cameras)?;
    // All names are checked before the first picture is rendered.
    let names = captures::stems(&args.cameras, views.iter().map(|view| view.name.as_str()))?;
    let antialiased = (model.antialiased || args.antialiased) && !args.classic;
    let options = Options { antialiased, extras: args.depth, inverse_depth: args.depth, ..model.options() };
    let clock = Stopwatch::start();
    let mut renderer = Renderer::new(&backend)?;
    let objects = placed(&model.objects, args)?;
    if !args.only.is_empty() {
        model.splats = Splats::new(0);
    }
    let splats = renderer.upload(&model.splats)?;
    let composition = Composition::new(&renderer, objects.iter())?;
    let progress = output.progress("rendering", views.len() as u64);
    for (i, (view, name)) in views.iter().zip(&names).enumerate() {
        let camera = &view.camera;
        let camera = args.size.map_or(*camera, |size| captures::resized(camera, size.width, size.height));
        let placed = composition.at(args.time.or(view.seconds));
        let frame = renderer.compose(&splats, &placed, &camera, &options)?;
        let file = |ending: &str| {
            let mut path = args.out.join(name).into_os_string();
            path.push(ending);
            PathBuf::from(path)
        };
        let picture = file(".png");
        make_folder(picture.parent().unwrap_or(&args.out))?;
        write_png(&picture, &frame_image(frame))?;
        if args.depth {
            save(&file(".depth.npy"), &npy::write_f32(&[frame.height, frame.width], &depth_metres(frame)))?;
        }
        progress.at(i as u64 + 1, "");
    }
    drop(progress);
    let rendered = Rendered {
        command: "render",
        out: &args.out,
        views: views.len(),
        splats: model.splats.len(),
        objects: objects.len(),
        backend: renderer.name(),
        antialiased,
        cpu_seconds: clock.cpu_seconds(),
        wall_seconds: clock.wall_seconds(),
        fps: views.len() as f64 / clock.wall_seconds().max(1e-9),
    };
    let text = format!(
        "{} views of {} splats, rendered on {}\n{}",
        rendered.views,
        rendered.splats,
        rendered.backend,
        args.out.display()
    );
    output.result(&rendered, &text)
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

/// Depth of each pixel, metres: the harmonic mean over its splats, as `plat eval --depth` measures it. The mean would put a wall
/// behind which a little of a sky at 1 km shines through metres too far. 0 where alpha is too low.
fn depth_metres(frame: &Frame) -> Vec<f32> {
    let depth = frame.depth.iter().zip(&frame.transmittance);
    let metres = |(inverse, rest): (&f32, &f32)| (1.0 - rest) / inverse.max(f32::MIN_POSITIVE);
    depth.map(|of| if 1.0 - of.1 > MIN_ALPHA { metres(of) } else { 0.0 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_is_the_harmonic_mean_over_alpha() {
        let frame = Frame {
            width: 3,
            height: 1,
            transmittance: vec![0.2, 0.6, 1.0],
            depth: vec![0.08, 0.4, 0.0],
            ..Frame::default()
        };
        assert_eq!(depth_metres(&frame), [10.0, 0.0, 0.0]);
    }
}
