//! `plat render`: what cameras see of a model. A camera with a lens is drawn as its ideal pinhole, which is what ingest
//! undistorts its photo to.

use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};

use ::render::cpu::Renderer;
use ::render::{Frame, Options};
use image::RgbImage;
use scene::{BadInput, npy};
use serde::Serialize;
use store::file::save;

use crate::args::RenderArgs;
use crate::cameras;
use crate::clock::Stopwatch;
use crate::commands::train::make_folder;
use crate::failure::Failure;
use crate::model;
use crate::output::Output;

/// Depth is said where at least this much of the pixel is covered.
const COVERED: f32 = 0.5;

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
    /// Views per second, files included.
    fps: f64,
}

pub(crate) fn run(args: &RenderArgs, output: &Output) -> Result<(), Failure> {
    let model = model::read(&args.model)?;
    let views = cameras::read(&args.cameras)?;
    // All names are judged before the first picture is drawn.
    let names: Vec<PathBuf> = views.iter().map(|(name, _)| stem(name)).collect::<Result<_, _>>()?;
    let mut taken = BTreeSet::new();
    if let Some(twice) = names.iter().find(|name| !taken.insert(*name)) {
        let problem = format!("two views would both be written as {}.png", twice.display());
        return Err(BadInput::new(args.cameras.display().to_string(), problem, "rename one of them").into());
    }
    let antialiased = (model.antialiased || args.antialiased) && !args.classic;
    let options = Options { antialiased, extras: args.depth, ..model.options() };
    let clock = Stopwatch::start();
    let mut renderer = Renderer::default();
    let progress = output.progress("rendering", views.len() as u64);
    for (i, ((_, camera), name)) in views.iter().zip(&names).enumerate() {
        let camera = args.size.map_or(*camera, |size| cameras::resized(camera, size.width, size.height));
        let frame = renderer.forward(&model.splats, None, &camera, &options);
        let file = |ending: &str| {
            let mut path = args.out.join(name).into_os_string();
            path.push(ending);
            PathBuf::from(path)
        };
        let picture = file(".png");
        make_folder(picture.parent().unwrap_or(&args.out))?;
        bench::write_png(&picture, &to_image(frame))?;
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
    let text = format!("{} views of {} splats\n{}", rendered.views, rendered.splats, args.out.display());
    output.result(&rendered, &text)
}

/// Where a view's files go below the output folder, without an ending: its name without extension.
fn stem(name: &str) -> Result<PathBuf, BadInput> {
    let path: PathBuf = Path::new(name).components().filter(|part| *part != Component::CurDir).collect();
    let inside = path.components().all(|part| matches!(part, Component::Normal(_)));
    if !inside || path.as_os_str().is_empty() {
        let advice = "give views names that are relative paths without ..";
        return Err(BadInput::new(format!("view '{name}'"), "has a name that leaves the output folder", advice));
    }
    Ok(path.with_extension(""))
}

/// A frame as an 8-bit picture.
pub(crate) fn to_image(frame: &Frame) -> RgbImage {
    let area = frame.width * frame.height;
    let byte = |value: f32| (value.clamp(0.0, 1.0) * 255.0).round() as u8;
    RgbImage::from_fn(frame.width as u32, frame.height as u32, |x, y| {
        let at = y as usize * frame.width + x as usize;
        image::Rgb([0, 1, 2].map(|channel| byte(frame.colour[channel * area + at])))
    })
}

/// Mean depth of what covers each pixel, metres; 0 where it is not covered.
fn depth_metres(frame: &Frame) -> Vec<f32> {
    let depth = frame.depth.iter().zip(&frame.transmittance);
    depth.map(|(depth, rest)| if 1.0 - rest > COVERED { depth / (1.0 - rest) } else { 0.0 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stay_inside() {
        assert_eq!(stem("./left/0001.v2.jpg").unwrap(), Path::new("left/0001.v2"));
        assert_eq!(stem("plain").unwrap(), Path::new("plain"));
        for bad in ["../up.png", "/etc/x.png", "a/../../b.png", "", "."] {
            assert!(stem(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn depth_is_of_what_covers() {
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
