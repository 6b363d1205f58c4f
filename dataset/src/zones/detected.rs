//! Zones that a detector finds.

use std::ops::Range;

use perceive::{Detector, Picture};
use scene::frame::{self, Kind};
use scene::{ArtefactId, BadInput, Pixels, Zone, Zones};
use store::BlockingStore;

use super::photos::{is_masked, whole};
use crate::ingest::IngestError;
use crate::windows::WindowReader;

/// What a detector found on a photo.
const RECORD: Kind = Kind(*b"seen", 2);
/// Part of the name of a record. Raise it with each change of what a detector is shown or of what is kept of its boxes.
const FORMAT: u32 = 1;

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

/// What a [checked](check_detector) detector finds on some views, as it is: not smoothed, and [`Zones::of_views`] are those of the
/// range only. `goes_on` is called with the number of views done; if it says no, the rest is left out.
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
                let zones = found(detector, &*whole(reader, number)?)?;
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
        let zone = Zone { corners, class: of.class as u16, score: of.score.clamp(0.0, 1.0), mask: None };
        (!is_empty && !is_masked(photo, &zone)).then_some(zone)
    });
    Ok(zones.take(Zones::MAX).collect())
}
