//! Networks as artefacts: a plan names the detector that looks for objects and that its training asks, and every worker
//! loads the same one.

use perceive::Detector;
use perceive::aligned::{Aligned, Weights};
use scene::frame::{self, Kind};
use scene::{ArtefactId, BadInput};
use store::BlockingStore;

use crate::ingest::IngestError;

/// A network: the header is the text of its model card, if it has one, the bulk its ONNX file.
pub const NETWORK: Kind = Kind(*b"netw", 1);

/// A network's artefact from the bytes of its ONNX file and the text of its model card.
pub fn to_frame(onnx: &[u8], card: Option<&str>) -> Vec<u8> {
    frame::encode(NETWORK, &card, onnx)
}

/// Loads a detector.
///
/// # Errors
/// Not in the store, damaged, or no detector.
pub fn load_detector(store: &BlockingStore, id: ArtefactId) -> Result<Detector, IngestError> {
    load(store, id, |name, onnx, card| Detector::load(name, onnx.to_vec(), card))
}

/// Loads a detector with its gradient.
///
/// # Errors
/// Not in the store, damaged, or a network without a gradient.
pub fn load_aligned(store: &BlockingStore, id: ArtefactId) -> Result<Aligned, IngestError> {
    load(store, id, |name, onnx, card| Aligned::new(name, onnx, card, Weights::default()))
}

fn load<T>(
    store: &BlockingStore,
    id: ArtefactId,
    of: impl FnOnce(&str, &[u8], Option<&str>) -> Result<T, BadInput>,
) -> Result<T, IngestError> {
    let (name, bytes) = (format!("artefact {id}"), store.get(id)?);
    let read = frame::decode(NETWORK, &bytes);
    let (card, onnx): (Option<String>, &[u8]) =
        read.map_err(|error| BadInput::new(name.clone(), error.to_string(), "submit the job again"))?;
    Ok(of(&name, onnx, card.as_deref())?)
}
