//! Ingested photos whole, and how much of a zone their mask hides.

use std::sync::Arc;

use perceive::{MAX_MASKED, masked_share};
use scene::{BadInput, Capture, Pixels, Rect, Zone};
use store::BlockingStore;

use crate::ingest::IngestError;
use crate::windows::{WindowError, WindowReader};

/// Reads the photos of a capture one after the other.
pub(super) struct Photos<'a> {
    capture: &'a Capture,
    reader: WindowReader,
}

impl<'a> Photos<'a> {
    pub(super) fn new(capture: &'a Capture, store: &BlockingStore) -> Self {
        Self { capture, reader: reader(capture, store) }
    }

    /// The zones of a view without those that its photo's mask hides.
    ///
    /// # Errors
    /// As [`whole`].
    pub(super) fn without_masked(&self, view: usize, mut zones: Vec<Zone>) -> Result<Vec<Zone>, IngestError> {
        if self.capture.views[view].masked && !zones.is_empty() {
            let photo = whole(&self.reader, view)?;
            zones.retain(|zone| !is_masked(&photo, zone));
        }
        Ok(zones)
    }
}

/// A reader of photos that are read once.
pub(super) fn reader(capture: &Capture, store: &BlockingStore) -> WindowReader {
    let without_points = Capture { views: capture.views.clone(), ..Capture::default() };
    WindowReader::new(Arc::new(without_points), store.clone(), 0)
}

/// The photo of a view at mip 0.
///
/// # Errors
/// A failing store, or damaged pixels.
pub(super) fn whole(reader: &WindowReader, view: usize) -> Result<Arc<Pixels>, IngestError> {
    let of = &reader.capture().views[view];
    let k = of.camera.pinhole;
    let rect = Rect { x: 0, y: 0, width: k.width, height: k.height };
    reader.window(view as u32, 0, rect).map_err(|error| match error {
        WindowError::Store { error, .. } => error.into(),
        other => BadInput::new(&of.name, other.to_string(), "ingest the capture again").into(),
    })
}

/// Whether the photo's mask hides more than half of a zone.
pub(super) fn is_masked(photo: &Pixels, zone: &Zone) -> bool {
    let Some(hidden) = &photo.mask else { return false };
    let width = photo.width as usize;
    let share = match &zone.mask {
        None => masked_share(hidden, width, zone.corners),
        Some(mask) => {
            let spans = mask
                .spans(photo.width)
                .filter_map(|(y, x)| hidden.get(y as usize * width..)?.get(x.start as usize..x.end as usize));
            let count = spans.flatten().filter(|value| **value < 128).count();
            count as f64 / (mask.area() as f64).max(1.0)
        }
    };
    share > MAX_MASKED
}

#[cfg(test)]
mod tests {
    use scene::MaskBuilder;

    use super::*;

    #[test]
    fn an_object_is_masked_by_its_own_pixels() {
        // The left half of 8 × 4 pixels is masked.
        let mask = (0..32).map(|i| if i % 8 < 4 { 0 } else { 255 }).collect();
        let mut photo = Pixels { width: 8, height: 4, rgb: vec![0; 96], mask: Some(mask), ..Pixels::default() };
        let zone = |spans: &[(u32, std::ops::Range<u32>)]| {
            let mut builder = MaskBuilder::new(8);
            spans.iter().for_each(|(y, x)| builder.push(*y, x.clone()));
            let (mask, corners) = builder.finish().unwrap();
            Zone { corners, class: 0, score: 1.0, mask: Some(mask) }
        };
        // Two of three pixels, although the box has as many masked pixels as others.
        let left = zone(&[(0, 2..4), (1, 5..6)]);
        let half = zone(&[(0, 3..5)]);
        assert!(is_masked(&photo, &left) && !is_masked(&photo, &half));
        assert!(!is_masked(&photo, &Zone { mask: None, ..left.clone() }));
        photo.mask = None;
        assert!(!is_masked(&photo, &left));
    }
}
