//! `plat render`: renders a model from the cameras of a capture.
//!
//! A camera with a lens model is rendered as its ideal pinhole, which is what ingest undistorts its photo to.

use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};

use ::render::{Frame, Options};
use eval::{Renderer, frame_image, write_png};
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
    let names: Vec<PathBuf> = views.iter().map(|(name, _)| stem(name)).collect::<Result<_, _>>()?;
    let mut taken = BTreeSet::new();
    if let Some(twice) = names.iter().find(|name| !taken.insert(*name)) {
        let problem = format!("two views would both be written as {}.png", twice.display());
        return Err(BadInput::new(args.cameras.display().to_string(), problem, "rename one of them").into());
    }
    let antialiased = (model.antialiased || args.antialiased) && !args.classic;
    let options = Options { antialiased, extras: args.depth, ..model.options() };
    let clock = Stopwatch::start();
    let mut renderer = Renderer::new(&backend)?;
    let splats = renderer.upload(&model.splats)?;
    let progress = output.progress("rendering", views.len() as u64);
    for (i, ((_, camera), name)) in views.iter().zip(&names).enumerate() {
        let camera = args.size.map_or(*camera, |size| captures::resized(camera, size.width, size.height));
        let frame = renderer.render(&splats, &camera, &options)?;
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

/// Path of a view's files below the output folder: its name without extension.
fn stem(name: &str) -> Result<PathBuf, BadInput> {
    let path: PathBuf = Path::new(name).components().filter(|part| *part != Component::CurDir).collect();
    let inside = path.components().all(|part| matches!(part, Component::Normal(_)));
    if !inside || path.as_os_str().is_empty() {
        let advice = "name views by relative paths without ..";
        return Err(BadInput::new(format!("view '{name}'"), "has a name that leaves the output folder", advice));
    }
    Ok(path.with_extension(""))
}

/// Mean depth of each pixel, metres; 0 where its alpha is too low.
fn depth_metres(frame: &Frame) -> Vec<f32> {
    let depth = frame.depth.iter().zip(&frame.transmittance);
    depth.map(|(depth, rest)| if 1.0 - rest > MIN_ALPHA { depth / (1.0 - rest) } else { 0.0 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stay_inside_the_output_folder() {
        assert_eq!(stem("./left/0001.v2.jpg").unwrap(), Path::new("left/0001.v2"));
        assert_eq!(stem("plain").unwrap(), Path::new("plain"));
        for bad in ["../up.png", "/etc/x.png", "a/../../b.png", "", "."] {
            assert!(stem(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn depth_is_the_mean_over_alpha() {
        let frame = Frame {
            width: 3,
            height: 1,
            transmittance: vec![0.2, 0.6, 1.0],
            depth: vec![8.0, 4.0, 0.0],
            ..Frame::default()
        };
        assert_eq!(depth_metres(&frame), [10.0, 0.0, 0.0]);
    }
}
