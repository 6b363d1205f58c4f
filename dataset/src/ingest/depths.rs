//! Measured depths of the views and the colours of points from lidar, from the photos in the store.

use std::collections::BTreeMap;

use scene::{ArtefactId, BadInput, Capture, Pixels, View};
use store::BlockingStore;

use super::error::IngestError;
use crate::depth_samples::DepthSamples;
use crate::lidar::{Sweep, visible};
use crate::mip_tiles::MipLayout;
use crate::open::Source;

/// What lidar adds to a view.
#[derive(Default)]
pub(super) struct Measured {
    depth: Option<ArtefactId>,
    /// Number of samples behind it.
    samples: usize,
    /// Colours of the points that this view colours; `None` for those on excluded pixels.
    colours: Vec<(u32, Option<[u8; 3]>)>,
}

/// The sweeps and the points from lidar, by view.
pub(super) struct Lidar<'a> {
    sweeps: &'a [Sweep],
    /// The sweeps taken during a view.
    of_view: Vec<Vec<u32>>,
    /// The points that a view colours, as indices of the capture's points.
    coloured_by: BTreeMap<u32, Vec<u32>>,
}

impl<'a> Lidar<'a> {
    pub(super) fn new(source: &'a Source) -> Self {
        let mut of_view = vec![Vec::new(); source.capture.views.len()];
        for (sweep, Sweep { views, .. }) in (0..).zip(&source.sweeps) {
            views.iter().for_each(|&view| of_view[view as usize].push(sweep));
        }
        let mut coloured_by: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        let first = (source.capture.points.len() - source.seeds.len()) as u32;
        for (point, &view) in (first..).zip(&source.seeds) {
            coloured_by.entry(view).or_default().push(point);
        }
        Self { sweeps: &source.sweeps, of_view, coloured_by }
    }

    /// Whether there is anything to do for a view.
    pub(super) fn concerns(&self, view: usize) -> bool {
        !self.of_view[view].is_empty() || self.coloured_by.contains_key(&(view as u32))
    }

    /// Projects sweeps and points into an ingested view.
    ///
    /// # Errors
    /// A sweep that cannot be read, or a failing store.
    pub(super) fn measure(
        &self,
        capture: &Capture,
        number: usize,
        store: &BlockingStore,
    ) -> Result<Measured, IngestError> {
        let view = &capture.views[number];
        let pixels = finest(view, store)?;
        let is_used =
            |x: u32, y: u32| pixels.mask.as_ref().is_none_or(|mask| mask[(y * pixels.width + x) as usize] >= 128);
        let mut returns = Vec::new();
        for &sweep in &self.of_view[number] {
            returns.extend(self.sweeps[sweep as usize].read()?.into_iter().map(|found| found.place));
        }
        let seen = visible(&view.camera, (0..).zip(returns));
        let seen = seen.into_iter().filter(|s| is_used(s.x, s.y)).map(|s| (s.x, s.y, s.depth));
        let depths = DepthSamples::new(pixels.width, pixels.height, seen);
        let depth = if depths.is_empty() { None } else { Some(store.put(depths.encode())?) };
        let colour = |&point: &u32| {
            let (at, _) = view.camera.project(capture.points.positions[point as usize]);
            let side = |v: f64, side: u32| (v.max(0.0) as u32).min(side - 1);
            let (x, y) = (side(at.x, pixels.width), side(at.y, pixels.height));
            let channel = |c: usize| pixels.rgb[c * pixels.area() + (y * pixels.width + x) as usize];
            (point, is_used(x, y).then(|| [0, 1, 2].map(channel)))
        };
        let colours = self.coloured_by.get(&(number as u32)).into_iter().flatten().map(colour).collect();
        Ok(Measured { depth, samples: depths.len(), colours })
    }
}

/// Enters what lidar adds into the capture: depths, and colours of points. Points on excluded pixels are removed, as they lie on
/// moving objects. Returns the number of depth samples.
pub(super) fn enter(capture: &mut Capture, measured: Vec<(usize, Measured)>) -> usize {
    let mut removed = vec![false; capture.points.len()];
    let mut samples = 0;
    for (view, measured) in measured {
        capture.views[view].depth = measured.depth;
        samples += measured.samples;
        for (point, colour) in measured.colours {
            match colour {
                Some(colour) => capture.points.colours[point as usize] = colour,
                None => removed[point as usize] = true,
            }
        }
    }
    if removed.contains(&true) {
        capture.points = capture.points.filter(|i| !removed[i]);
    }
    samples
}

/// Mip 0 of an ingested view.
fn finest(view: &View, store: &BlockingStore) -> Result<Pixels, IngestError> {
    let pinhole = view.camera.pinhole;
    let layout = MipLayout { width: pinhole.width, height: pinhole.height, masked: view.masked };
    let bytes = store.get(view.mips[0])?;
    let decoded = bytes.get(..layout.index_len()).ok_or_else(|| scene::CodecError::new("is cut short"));
    let decoded = decoded.and_then(|head| {
        let (index, rect) = (layout.index(head)?, view.camera.full());
        let ranges = index.ranges(rect).unwrap_or_default();
        let parts: Vec<&[u8]> =
            ranges.iter().map(|r| bytes.get(r.start as usize..r.end as usize).unwrap_or_default()).collect();
        index.window(rect, &parts)
    });
    let advice = "delete the artefact and ingest again";
    Ok(decoded
        .map_err(|e| BadInput::new(format!("artefact {} of {}", view.mips[0], view.name), e.to_string(), advice))?)
}
