//! Opens captures, ingests their photos, and reads cameras.

use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};

use dataset::depth_maps::DepthMapOptions;
use dataset::ingest::{IngestOptions, Ingested, downscaled, ingest};
use dataset::mips::MIN_MIP_SIDE;
use dataset::open::{OpenOptions, Source};
use dataset::zones::{CocoFile, LabelMaps, OwnLabels, ZoneSource};
use eval::{PhotoOptions, Photos, load_identified_detector};
use model::Model;
use scene::{ArtefactId, BadInput, Camera, Capture, Pinhole, View, Zones};
use store::BlockingStore;

use crate::args::{DepthKind, OWN_LABELS, PlanOptions, ZoneFinder};
use crate::failure::Failure;
use crate::observer::OutputObserver;
use crate::output::Output;

/// Names of unused images that are printed.
const MAX_LEFT_OUT: usize = 3;

/// Opens a capture's photos and cameras, and notes the images that are left out.
pub(crate) fn open(path: &Path, output: &Output) -> Result<Source, BadInput> {
    open_with(path, &OpenOptions::default(), output)
}

/// Opens a capture to plan it with these options: also its lidar, from which initial points and target depths come, and its depth
/// maps if their targets are used.
pub(crate) fn open_to_plan(path: &Path, options: &PlanOptions, output: &Output) -> Result<Source, BadInput> {
    let is_used = options.depth_weight > 0.0;
    let depths = depth_maps(options)?.filter(|_| is_used);
    let given = [
        ("--depths", options.depths.is_some()),
        ("--depth-kind", options.depth_kind != DepthKind::Metric),
        ("--depth-unit", options.depth_unit.is_some()),
    ];
    let given = given.into_iter().find(|(_, is_given)| *is_given).map(|(name, _)| name);
    if let Some(name) = given.filter(|_| !is_used) {
        let advice = "give the weight of the depths' loss, such as --depth-weight 0.1";
        return Err(BadInput::new(name, "has no effect without --depth-weight", advice));
    }
    let open = OpenOptions { lidar: !options.no_lidar, radar: !options.no_radar, depths, ..OpenOptions::default() };
    let mut source = open_with(path, &open, output)?;
    if options.no_masks {
        source.unmask();
    }
    match given.filter(|_| source.depth_maps() == 0) {
        Some(name) => {
            Err(BadInput::new(name, "is given for depth maps, and the capture has none", "give their --depths"))
        }
        None => Ok(source),
    }
}

/// Opens a capture to show what is in it: as [`open_to_plan`], and depth maps whether they are used or not.
pub(crate) fn open_to_inspect(path: &Path, options: &PlanOptions) -> Result<Source, BadInput> {
    let depths = depth_maps(options)?;
    let options = OpenOptions { lidar: !options.no_lidar, radar: !options.no_radar, depths, ..OpenOptions::default() };
    open_with(path, &options, &Output::silent())
}

/// How to find depth maps, unless they are left out.
fn depth_maps(options: &PlanOptions) -> Result<Option<DepthMapOptions>, BadInput> {
    let kind = match options.depth_kind {
        DepthKind::Metric => dataset::depth_maps::DepthKind::Metric,
        DepthKind::Relative => dataset::depth_maps::DepthKind::Relative,
        DepthKind::Inverse => dataset::depth_maps::DepthKind::Inverse,
    };
    if options.depth_unit.is_some() && options.depth_kind != DepthKind::Metric {
        let problem = "is of metric depth maps; others get their scale from the sparse points";
        return Err(BadInput::new("--depth-unit", problem, "leave it, or --depth-kind"));
    }
    let maps = DepthMapOptions { folder: options.depths.clone(), kind, unit: options.depth_unit };
    Ok((!options.no_depths).then_some(maps))
}

/// Opens a capture with these options, and notes the images that are left out.
pub(crate) fn open_with(path: &Path, options: &OpenOptions, output: &Output) -> Result<Source, BadInput> {
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

/// Where the options say that objects on the photos of a capture, opened from this path, come from.
///
/// # Errors
/// A file that is no detector, objects that do not fit the photos, or a capture without labels.
pub(crate) fn zone_source(
    finder: &ZoneFinder,
    capture: &Path,
    source: &Source,
) -> Result<Option<ZoneSource>, BadInput> {
    match (&finder.zone_detector, &finder.zones) {
        (Some(path), _) => {
            let (detector, id) = load_identified_detector(path)?;
            Ok(Some(ZoneSource::Detector(Box::new(detector), id)))
        }
        (None, Some(path)) if path.as_os_str() == OWN_LABELS => {
            Ok(Some(ZoneSource::OwnLabels(OwnLabels::open(capture, source)?)))
        }
        (None, Some(path)) if path.is_dir() => Ok(Some(ZoneSource::LabelMaps(LabelMaps::open(path, source)?))),
        (None, Some(path)) => {
            let file = CocoFile::read(path)?;
            // Before any photo is read.
            file.zones(&source.capture)?;
            Ok(Some(ZoneSource::Coco(file)))
        }
        (None, None) => Ok(None),
    }
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
    let ingested =
        ingest(source, store, &IngestOptions { downscale, threads }, &|done, _| progress.at(done as u64, ""))?;
    let left_out = &ingested.depth_maps.left_out;
    for (name, reason) in left_out.iter().take(MAX_LEFT_OUT) {
        output.note(format!("left out the depth map of {name}: {reason}"));
    }
    if left_out.len() > MAX_LEFT_OUT {
        output.note(format!("left out {} more depth maps", left_out.len() - MAX_LEFT_OUT));
    }
    Ok(ingested)
}

/// Looks for the objects on a capture's photos, with progress.
pub(crate) fn find_zones(
    capture: &Capture,
    from: &ZoneSource,
    store: &BlockingStore,
    output: &Output,
) -> Result<(Zones, ArtefactId), Failure> {
    let _traced = tracing::info_span!("zones").entered();
    let progress = output.progress("objects", capture.views.len() as u64);
    let (zones, id) = dataset::zones::find(capture, from, store, &|done, _| progress.at(done as u64, ""))?;
    drop(progress);
    output.note(format!("{} objects on {} photos", zones.len(), zones.of_views.len()));
    Ok((zones, id))
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

/// The views of a capture or of a `transforms.json`; photos need not exist.
pub(crate) fn read_cameras(path: &Path) -> Result<Vec<View>, BadInput> {
    let source = dataset::open::open(path, &OpenOptions { cameras_only: true, ..OpenOptions::default() })?;
    Ok(source.capture.views)
}

/// Paths of the views' files below an output folder: their names without extensions.
///
/// # Errors
/// A name that leads out of the folder, or two views with one path.
pub(crate) fn stems<'a>(capture: &Path, names: impl Iterator<Item = &'a str>) -> Result<Vec<PathBuf>, BadInput> {
    let stems = names.map(stem).collect::<Result<Vec<_>, _>>()?;
    let mut taken = BTreeSet::new();
    match stems.iter().find(|stem| !taken.insert(*stem)) {
        None => Ok(stems),
        Some(twice) => {
            let problem = format!("two views would both be written as {}.png", twice.display());
            Err(BadInput::new(capture.display().to_string(), problem, "rename one of them"))
        }
    }
}

fn stem(name: &str) -> Result<PathBuf, BadInput> {
    let path: PathBuf = Path::new(name).components().filter(|part| *part != Component::CurDir).collect();
    let inside = path.components().all(|part| matches!(part, Component::Normal(_)));
    if !inside || path.as_os_str().is_empty() {
        let advice = "name views by relative paths without ..";
        return Err(BadInput::new(format!("view '{name}'"), "has a name that leaves the output folder", advice));
    }
    Ok(path.with_extension(""))
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
        assert!(stems(Path::new("city"), ["a.png", "a.jpg"].into_iter()).is_err());
    }
}
