//! Opens captures, ingests their photos, and reads cameras.

use std::path::Path;

use dataset::ingest::{IngestOptions, Ingested, downscaled, ingest};
use dataset::mips::MIN_MIP_SIDE;
use dataset::open::{OpenOptions, Source};
use eval::{PhotoOptions, Photos};
use model::Model;
use scene::{BadInput, Camera, Capture, Pinhole};
use store::BlockingStore;

use crate::args::PlanOptions;
use crate::failure::Failure;
use crate::observer::OutputObserver;
use crate::output::Output;

/// Names of unused images that are printed.
const MAX_LEFT_OUT: usize = 3;

/// Opens a capture's photos and cameras, and notes the images that are left out.
pub(crate) fn open(path: &Path, output: &Output) -> Result<Source, BadInput> {
    open_with(path, &OpenOptions::default(), output)
}

/// Opens a capture to plan it with these options: also its lidar, from which initial points and target depths come.
pub(crate) fn open_to_plan(path: &Path, options: &PlanOptions, output: &Output) -> Result<Source, BadInput> {
    open_with(path, &OpenOptions { lidar: !options.no_lidar, ..OpenOptions::default() }, output)
}

fn open_with(path: &Path, options: &OpenOptions, output: &Output) -> Result<Source, BadInput> {
    let source = dataset::open::open(path, options)?;
    for (name, reason) in source.left_out.iter().take(MAX_LEFT_OUT) {
        output.note(format!("left out {name}: {reason}"));
    }
    if source.left_out.len() > MAX_LEFT_OUT {
        output.note(format!("left out {} more images", source.left_out.len() - MAX_LEFT_OUT));
    }
    Ok(source)
}

/// The default name of a capture: that of its folder.
pub(crate) fn name_of(path: &Path) -> String {
    let path = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Ingests a capture's photos into a store, with progress.
pub(crate) fn ingest_photos(
    source: &Source,
    store: &BlockingStore,
    downscale: u32,
    output: &Output,
) -> Result<Ingested, Failure> {
    let _traced = tracing::info_span!("ingest").entered();
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let progress = output.progress("photos", source.photos.len() as u64);
    Ok(ingest(source, store, &IngestOptions { downscale, threads }, &|done, _| progress.at(done as u64, ""))?)
}

/// Ingests the photos that a model is measured on, with progress.
pub(crate) fn photos_of(
    model: &Model,
    source: &Source,
    options: &PhotoOptions,
    output: &Output,
) -> Result<Photos, Failure> {
    let _traced = tracing::info_span!("ingest").entered();
    Ok(Photos::ingest(model, source, options, &OutputObserver::new(output))?)
}

/// The capture with the cameras that ingest will give it at this divisor of its size.
///
/// # Errors
/// A divisor that leaves too few pixels of a photo.
pub(crate) fn shrunk(capture: &Capture, downscale: u32) -> Result<Capture, BadInput> {
    let mut capture = capture.clone();
    for view in &mut capture.views {
        let k = &mut view.camera.pinhole;
        *k = downscaled(*k, downscale);
        if downscale > 1 && k.width.min(k.height) < MIN_MIP_SIDE {
            let problem = format!("{downscale} leaves less than {MIN_MIP_SIDE} pixels of {}", view.name);
            return Err(BadInput::new("--downscale", problem, "give a smaller divisor"));
        }
    }
    Ok(capture)
}

/// The camera with its picture stretched to this size.
pub(crate) fn resized(camera: &Camera, width: u32, height: u32) -> Camera {
    let k = &camera.pinhole;
    let (x, y) = (f64::from(width) / f64::from(k.width), f64::from(height) / f64::from(k.height));
    let pinhole = Pinhole { width, height, fx: k.fx * x, fy: k.fy * y, cx: k.cx * x, cy: k.cy * y };
    Camera { pinhole, ..*camera }
}

/// The names and cameras of a capture or of a `transforms.json`; photos need not exist.
pub(crate) fn read_cameras(path: &Path) -> Result<Vec<(String, Camera)>, BadInput> {
    let source = dataset::open::open(path, &OpenOptions { cameras_only: true, ..OpenOptions::default() })?;
    Ok(source.capture.views.into_iter().map(|view| (view.name, view.camera)).collect())
}
