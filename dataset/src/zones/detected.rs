//! Zones that a detector finds.

use perceive::{Detector, Picture};
use scene::frame::{self, Kind};
use scene::{ArtefactId, BadInput, Capture, Pixels, Zone, Zones};
use store::BlockingStore;

use super::photos::{Photos, is_masked};
use crate::ingest::IngestError;

/// What a detector found on a photo.
const RECORD: Kind = Kind(*b"seen", 2);
/// Part of the name of a record. Raise it with each change of what a detector is shown or of what is kept of its boxes.
const FORMAT: u32 = 1;

/// The zones of all photos. What is found on a photo is recorded in the store, so a repeated call only reads records.
///
/// # Errors
/// A network that cannot be run, or a failing store.
pub(super) fn detected(
    capture: &Capture,
    detector: &Detector,
    id: ArtefactId,
    store: &BlockingStore,
    progress: &dyn Fn(usize, usize),
) -> Result<Zones, IngestError> {
    let classes = detector.card().classes.clone();
    if classes.len() > usize::from(u16::MAX) {
        let problem = format!("has {} classes, and {} are the most", classes.len(), u16::MAX);
        return Err(BadInput::new(detector.file(), problem, "map them to fewer in its card").into());
    }
    let photos = Photos::new(capture, store);
    let mut of_views = Vec::with_capacity(capture.views.len());
    for (number, view) in capture.views.iter().enumerate() {
        let key = frame::encode(RECORD, &(FORMAT, id, view.mips.first()), &[]);
        let name = format!("zones/{}", ArtefactId::of(&key));
        let recorded = store.get_record(&name)?;
        let recorded = recorded.and_then(|bytes| frame::decode(RECORD, &bytes).ok().map(|(zones, _)| zones));
        let zones: Vec<Zone> = match recorded {
            Some(zones) => zones,
            None => {
                let zones = found(detector, &*photos.whole(number)?)?;
                store.put_record(&name, frame::encode(RECORD, &zones, &[]))?;
                zones
            }
        };
        of_views.push(zones);
        progress(of_views.len(), capture.views.len());
    }
    Ok(Zones { classes, of_views })
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
