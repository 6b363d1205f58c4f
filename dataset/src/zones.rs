//! Zones of a capture's photos: found by a detector, or read from a file of boxes.

mod boxes_file;
mod parts;
mod smoothing;

use std::ops::Range;
use std::sync::Arc;

use perceive::{Detector, Picture, masked_share};
use scene::frame::{self, Kind};
use scene::{ArtefactId, BadInput, Capture, Pixels, Rect, Zone, Zones};
use store::BlockingStore;

pub use self::boxes_file::BoxesFile;
pub use self::parts::{gathered, objects_from_frame, objects_to_frame};
use crate::ingest::IngestError;
use crate::windows::{WindowError, WindowReader};

/// The zones of a capture.
pub const ZONES: Kind = Kind(*b"zone", 1);
/// What a detector found on a photo.
const RECORD: Kind = Kind(*b"seen", 1);
/// Part of the name of a record. Raise it with each change of what a detector is shown or of what is kept of its boxes.
const FORMAT: u32 = 1;
/// Largest share of a zone that may be masked: moving objects, which no model shows, are not its zones.
const MAX_MASKED: f64 = 0.5;

/// Where zones come from.
pub enum ZoneSource {
    /// A detector, and the artefact of its network and card.
    Detector(Box<Detector>, ArtefactId),
    /// A file of boxes.
    Boxes(BoxesFile),
}

/// The zones of an ingested capture's photos, and their artefact, a frame of kind [`ZONES`]. `progress` is called with (photos
/// done, photos in total).
///
/// What a detector finds on a photo is recorded in the store, so a repeated call only reads records.
///
/// # Errors
/// A network that cannot be run, boxes that do not fit the photos, or a failing store.
pub fn find(
    capture: &Capture,
    from: &ZoneSource,
    store: &BlockingStore,
    progress: &dyn Fn(usize, usize),
) -> Result<(Zones, ArtefactId), IngestError> {
    let found = match from {
        ZoneSource::Detector(detector, id) => {
            check_detector(detector)?;
            let all = capture.views.len();
            let without_points = Capture { views: capture.views.clone(), ..Capture::default() };
            let reader = WindowReader::new(Arc::new(without_points), store.clone(), 0);
            let goes_on = &mut |done| {
                progress(done, all);
                true
            };
            detect(&reader, 0..all, (detector, *id), store, goes_on)?
        }
        ZoneSource::Boxes(file) => file.zones(capture)?,
    };
    let of_views = smoothing::smoothed(&found.of_views, |view| follows(capture, view));
    let zones = Zones { of_views, ..found };
    let checked = zones.check(&capture.views);
    checked.map_err(|error| BadInput::new("the zones", error.to_string(), "correct the file that they come from"))?;
    let id = store.put(frame::encode(ZONES, &zones, &[]))?;
    Ok((zones, id))
}

/// Loads zones of a capture.
///
/// # Errors
/// Not in the store, damaged, or of another capture.
pub fn load(store: &BlockingStore, id: ArtefactId, capture: &Capture) -> Result<Zones, IngestError> {
    let bytes = store.get(id)?;
    let zones =
        frame::decode(ZONES, &bytes).and_then(|(zones, _): (Zones, _)| zones.check(&capture.views).map(|()| zones));
    Ok(zones
        .map_err(|error| BadInput::new(format!("artefact {id}"), error.to_string(), "look for the objects again"))?)
}

/// Whether a view comes right after the one before it in a sequence: photos of one folder.
fn follows(capture: &Capture, view: usize) -> bool {
    let folder = |view: usize| capture.views[view].name.rsplit_once('/').map_or("", |(folder, _)| folder);
    view > 0 && folder(view) == folder(view - 1)
}

/// Refuses a detector that cannot look for objects: it has too many classes, or it cannot be run.
///
/// # Errors
/// Such a detector.
pub fn check_detector(detector: &Detector) -> Result<(), BadInput> {
    let classes = detector.card().classes.len();
    if classes > usize::from(u16::MAX) {
        let problem = format!("has {classes} classes, and {} are the most", u16::MAX);
        return Err(BadInput::new(detector.file(), problem, "map them to fewer in its card"));
    }
    // Every picture is scaled to the same input.
    detector.detect(&Picture { rgb: &[0; 3], width: 1, height: 1 }, 1.0).map(drop)
}

/// What a [checked](check_detector) detector finds on some views, as it is: not smoothed, and [`Zones::of_views`] are those of the range only. `goes_on`
/// is called with the number of views done; if it says no, the rest is left out.
///
/// What is found on a photo is recorded in the store, by the artefacts of the photo and of the detector, so a repeated call only
/// reads records.
///
/// # Errors
/// A network that cannot be run, or a failing store.
pub fn detect(
    reader: &WindowReader,
    views: Range<usize>,
    (detector, id): (&Detector, ArtefactId),
    store: &BlockingStore,
    goes_on: &mut dyn FnMut(usize) -> bool,
) -> Result<Zones, IngestError> {
    let of_range = reader.capture().views.get(views.clone());
    let of_range =
        of_range.ok_or_else(|| BadInput::new("the views", format!("{views:?} do not exist"), "plan again"))?;
    let mut of_views = Vec::with_capacity(of_range.len());
    for (number, view) in views.zip(of_range) {
        let key = frame::encode(RECORD, &(FORMAT, id, view.mips.first()), &[]);
        let name = format!("zones/{}", ArtefactId::of(&key));
        let recorded = store.get_record(&name)?;
        let recorded = recorded.and_then(|bytes| frame::decode(RECORD, &bytes).ok().map(|(zones, _)| zones));
        let zones: Vec<Zone> = match recorded {
            Some(zones) => zones,
            None => {
                let k = view.camera.pinhole;
                let photo = reader.window(number as u32, 0, Rect { x: 0, y: 0, width: k.width, height: k.height });
                let zones = found(detector, &*photo.map_err(|error| unreadable(&view.name, error))?)?;
                store.put_record(&name, frame::encode(RECORD, &zones, &[]))?;
                zones
            }
        };
        of_views.push(zones);
        if !goes_on(of_views.len()) {
            break;
        }
    }
    Ok(Zones { classes: detector.card().classes.clone(), of_views })
}

fn unreadable(view: &str, error: WindowError) -> IngestError {
    match error {
        WindowError::Store { error, .. } => error.into(),
        other => BadInput::new(view, other.to_string(), "ingest the capture again").into(),
    }
}

/// What a detector finds on a photo outside its mask, surest first.
fn found(detector: &Detector, photo: &Pixels) -> Result<Vec<Zone>, BadInput> {
    let (width, height, area) = (photo.width as usize, photo.height as usize, photo.area());
    let rgb: Vec<u8> = (0..area).flat_map(|i| [photo.rgb[i], photo.rgb[area + i], photo.rgb[2 * area + i]]).collect();
    let found = detector.detect(&Picture { rgb: &rgb, width, height }, detector.card().score)?;
    let zones = found.into_iter().filter_map(|of| {
        let [left, top, right, bottom] = of.corners;
        let (w, h) = (width as f32, height as f32);
        let corners = [left.clamp(0.0, w), top.clamp(0.0, h), right.clamp(0.0, w), bottom.clamp(0.0, h)];
        let is_empty = corners[0] >= corners[2] || corners[1] >= corners[3];
        let is_masked = |mask: &Vec<u8>| masked_share(mask, width, corners) > MAX_MASKED;
        let left_out = is_empty || photo.mask.as_ref().is_some_and(is_masked);
        (!left_out).then_some(Zone { corners, class: of.class as u16, score: of.score.clamp(0.0, 1.0) })
    });
    Ok(zones.take(Zones::MAX).collect())
}
