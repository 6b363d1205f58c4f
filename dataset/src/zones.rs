//! Zones of a capture's photos: found by a detector, read from files, or labels that the capture itself has.

mod classes;
mod coco;
mod detected;
mod id_map;
mod label_maps;
mod own_labels;
mod parts;
mod photos;
mod smoothing;

use perceive::Detector;
use scene::frame::{self, Kind};
use scene::{ArtefactId, BadInput, Capture, Zones};
use store::BlockingStore;

pub use self::coco::CocoFile;
pub use self::detected::{check_detector, detect};
pub use self::label_maps::LabelMaps;
pub use self::own_labels::OwnLabels;
pub use self::parts::{gathered, objects_from_frame, objects_to_frame};
use self::photos::Photos;
use crate::ingest::IngestError;

/// The zones of a capture.
pub const ZONES: Kind = Kind(*b"zone", 2);

/// Where zones come from.
pub enum ZoneSource {
    /// A detector, and the artefact of its network and card.
    Detector(Box<Detector>, ArtefactId),
    /// A file of boxes and masks.
    Coco(CocoFile),
    /// A folder of label maps.
    LabelMaps(LabelMaps),
    /// The labels that the capture has.
    OwnLabels(OwnLabels),
}

/// The zones of an ingested capture's photos, and their artefact, a frame of kind [`ZONES`]. Boxes of a detector and of a file
/// are averaged over three photos. What photos' masks hide is left out. `progress` is called with (photos done, photos in
/// total).
///
/// What a detector finds on a photo is recorded in the store, so a repeated call only reads records.
///
/// # Errors
/// A network that cannot be run, objects that do not fit the photos, or a failing store.
pub fn find(
    capture: &Capture,
    from: &ZoneSource,
    store: &BlockingStore,
    progress: &dyn Fn(usize, usize),
) -> Result<(Zones, ArtefactId), IngestError> {
    let zones = match from {
        ZoneSource::Detector(detector, id) => {
            check_detector(detector)?;
            let all = capture.views.len();
            let goes_on = &mut |done| {
                progress(done, all);
                true
            };
            smoothed(capture, detect(&photos::reader(capture, store), 0..all, (detector, *id), store, goes_on)?)
        }
        ZoneSource::Coco(file) => smoothed(capture, without_masked(capture, file.zones(capture)?, store)?),
        ZoneSource::LabelMaps(maps) => without_masked(capture, maps.zones(capture, progress)?, store)?,
        ZoneSource::OwnLabels(labels) => without_masked(capture, labels.zones(capture, progress)?, store)?,
    };
    let checked = zones.check(&capture.views);
    checked.map_err(|error| BadInput::new("the zones", error.to_string(), "correct what they come from"))?;
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

fn smoothed(capture: &Capture, zones: Zones) -> Zones {
    let of_views = smoothing::smoothed(&zones.of_views, |view| follows(capture, view));
    Zones { of_views, ..zones }
}

/// Whether a view comes right after the one before it in a sequence: photos of one folder.
fn follows(capture: &Capture, view: usize) -> bool {
    let folder = |view: usize| capture.views[view].name.rsplit_once('/').map_or("", |(folder, _)| folder);
    view > 0 && folder(view) == folder(view - 1)
}

/// The zones without those that their photos' masks hide.
fn without_masked(capture: &Capture, zones: Zones, store: &BlockingStore) -> Result<Zones, IngestError> {
    let photos = Photos::new(capture, store);
    let of_views = zones.of_views.into_iter().enumerate();
    let of_views = of_views.map(|(view, zones)| photos.without_masked(view, zones)).collect::<Result<_, _>>()?;
    Ok(Zones { of_views, ..zones })
}
