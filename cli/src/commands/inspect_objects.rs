//! The objects that `plat inspect --detector` and `--zones` find, counted and drawn.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use dataset::windows::WindowReader;
use eval::{count_zones, draw_zones, gallery, photo_image, write_png};
use scene::{Capture, Rect, Zones};
use serde::Serialize;
use store::{BlockingStore, Store};

use crate::args::InspectArgs;
use crate::captures::{find_zones, ingest_photos, open, stems, zone_source};
use crate::failure::{Failure, make_folder, temporary_folder};
use crate::output::Output;

/// Longest side of a drawn photo, pixels.
const SIDE: u32 = 1280;
/// Photos on the sheet.
const ON_SHEET: usize = 24;
/// The sheet's file.
const SHEET: &str = "objects.png";

/// What was found.
#[derive(Serialize)]
pub(super) struct Objects {
    /// By class.
    classes: BTreeMap<String, OfClass>,
    /// Photos that show an object.
    photos: usize,
}

#[derive(Serialize)]
struct OfClass {
    objects: u64,
    /// Of the photos at full size, or at that of --downscale.
    pixels: u64,
}

/// Finds the objects on the capture's photos and draws them, if the options ask for it.
pub(super) fn objects(args: &InspectArgs, output: &Output) -> Result<Option<Objects>, Failure> {
    if !args.finder.is_given() {
        return Ok(None);
    }
    let source = open(&args.capture, &Output::silent())?;
    let Some(from) = zone_source(&args.finder, &args.capture, &source)? else { return Ok(None) };
    let folder = temporary_folder()?;
    let url = args.store.clone().unwrap_or_else(|| folder.path().display().to_string());
    let store = Store::open(&url)?.blocking();
    let capture = ingest_photos(&source, &store, args.plan.downscale, output)?.capture;
    let (zones, _) = find_zones(&capture, &from, &store, output)?;
    if let Some(out) = &args.draw {
        let names = stems(&args.capture, capture.views.iter().map(|view| view.name.as_str()))?;
        let files: Vec<PathBuf> = names.iter().map(|name| out.join(name).with_added_extension("png")).collect();
        make_folder(out)?;
        draw(capture, &store, &zones, &files, &out.join(SHEET), output)?;
    }
    let counts = count_zones(&zones).into_iter();
    let classes = counts.map(|(name, (objects, pixels))| (name.to_owned(), OfClass { objects, pixels })).collect();
    Ok(Some(Objects { classes, photos: zones.of_views.iter().filter(|zones| !zones.is_empty()).count() }))
}

impl Objects {
    /// A line for people.
    pub(super) fn text(&self, views: usize) -> String {
        let classes: Vec<String> =
            self.classes.iter().map(|(name, OfClass { objects, .. })| format!("{objects} {name}")).collect();
        let classes = if classes.is_empty() { "none".to_owned() } else { classes.join(", ") };
        format!("objects: {classes}, on {} of {views} photos\n", self.photos)
    }
}

/// Draws every photo with its objects into a file, and some of them on a sheet.
fn draw(
    capture: Capture,
    store: &BlockingStore,
    zones: &Zones,
    files: &[PathBuf],
    sheet: &Path,
    output: &Output,
) -> Result<(), Failure> {
    let progress = output.progress("pictures", files.len() as u64);
    let capture = Arc::new(capture);
    let reader = WindowReader::new(Arc::clone(&capture), store.clone(), 0);
    let step = files.len().div_ceil(ON_SHEET).max(1);
    let mut on_sheet = Vec::new();
    for (i, (view, file)) in capture.views.iter().zip(files).enumerate() {
        let k = &view.camera.pinhole;
        // The first mip that is small enough, or else the last one.
        let last = view.mips.len().saturating_sub(1) as u8;
        let m = (0..last).find(|m| k.width.max(k.height) >> m <= SIDE).unwrap_or(last);
        let mip = view.camera.mip(m).pinhole;
        let rect = Rect { x: 0, y: 0, width: mip.width, height: mip.height };
        let photo = reader.window(i as u32, m, rect).map_err(|error| Failure::Work(error.to_string()))?;
        let mut picture = photo_image(&photo);
        draw_zones(&mut picture, zones.of(i), &zones.classes, k.width, m);
        if let Some(folder) = file.parent() {
            make_folder(folder)?;
        }
        write_png(file, &picture)?;
        if i % step == 0 {
            on_sheet.push((view.name.clone(), picture));
        }
        progress.at(i as u64 + 1, "");
    }
    Ok(write_png(sheet, &gallery(&on_sheet))?)
}
