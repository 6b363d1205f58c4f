//! Target depths of the views from lidar, radar and depth maps, and the colours of points from sweeps, with the photos in the store.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec2;
use scene::{ArtefactId, BadInput, Capture, Pixels, View};
use store::BlockingStore;

use super::error::IngestError;
use super::from_map::{FromMap, Maps};
use super::undistorter::LastUndistorter;
use crate::depth_samples::DepthSamples;
use crate::lidar::{Scan, Sweep, visible};
use crate::mip_tiles::MipLayout;
use crate::observations::Observations;
use crate::open::Source;
use crate::radar::RoadStrip;

/// A view shows the road of sweeps within this distance of it, metres.
const ROAD_METRES: f64 = 40.0;
/// Side of the squares of a picture that get a depth of the road each, as a share of the focal length: 3.4°. Closer ones would weigh
/// more than the points that the view observed.
const SQUARE: f64 = 0.06;

/// What lidar and its depth map add to a view.
#[derive(Default)]
pub(super) struct Measured {
    depth: Option<ArtefactId>,
    /// Number of samples behind it.
    samples: usize,
    /// Colours of the points that this view colours; `None` for those on excluded pixels.
    colours: Vec<(u32, Option<[u8; 3]>)>,
    /// What became of its depth map.
    map: Option<FromMap>,
}

/// The sweeps, the points from lidar and the depth maps, by view.
pub(super) struct Depths<'a> {
    sweeps: &'a [Sweep],
    /// The sweeps taken during a view.
    of_view: Vec<Vec<u32>>,
    /// The points that a view colours, as indices of the capture's points.
    coloured_by: BTreeMap<u32, Vec<u32>>,
    road: &'a [RoadStrip],
    /// The strip of which the sweep was taken with a view.
    road_of_view: BTreeMap<u32, usize>,
    /// Where there is a road.
    observations: Option<Observations>,
    maps: Maps<'a>,
}

impl<'a> Depths<'a> {
    pub(super) fn new(source: &'a Source, downscale: u32) -> Self {
        let mut of_view = vec![Vec::new(); source.capture.views.len()];
        for (sweep, Sweep { views, .. }) in (0..).zip(&source.sweeps) {
            views.iter().for_each(|&view| of_view[view as usize].push(sweep));
        }
        let mut coloured_by: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        let first = (source.capture.points.len() - source.seeds.len()) as u32;
        for (point, &view) in (first..).zip(&source.seeds) {
            coloured_by.entry(view).or_default().push(point);
        }
        let road_of_view =
            (0..).zip(&source.road).flat_map(|(i, strip)| strip.views().iter().map(move |&view| (view, i)));
        Self {
            sweeps: &source.sweeps,
            of_view,
            coloured_by,
            road: &source.road,
            road_of_view: road_of_view.collect(),
            observations: (!source.road.is_empty()).then(|| Observations::new(&source.capture)),
            maps: Maps::new(source, downscale),
        }
    }

    /// Whether there is anything to do for a view.
    pub(super) fn concerns(&self, view: usize) -> bool {
        self.has_lidar(view) || self.road_of_view.contains_key(&(view as u32)) || self.maps.has(view)
    }

    fn has_lidar(&self, view: usize) -> bool {
        !self.of_view[view].is_empty() || self.coloured_by.contains_key(&(view as u32))
    }

    /// Projects sweeps and points into an ingested view, and reads its depth map. Lidar comes before the map where both have a depth.
    ///
    /// # Errors
    /// A sweep or a map that cannot be read, or a failing store.
    pub(super) fn measure(
        &self,
        capture: &Capture,
        number: usize,
        store: &BlockingStore,
        last_undistorter: &mut LastUndistorter,
    ) -> Result<Measured, IngestError> {
        let view = &capture.views[number];
        let has_lidar = self.has_lidar(number);
        let pixels = (has_lidar || view.masked).then(|| finest(view, store)).transpose()?;
        let mask = pixels.as_ref().and_then(|pixels| pixels.mask.as_deref());
        let is_used = is_used(view.camera.pinhole.width, mask);
        let (depths, map) = self.samples(capture, number, &is_used, last_undistorter)?;
        let depth = if depths.is_empty() { None } else { Some(store.put(depths.encode())?) };
        let colours = match &pixels {
            Some(pixels) if has_lidar => self.colours(capture, number, pixels, is_used),
            _ => Vec::new(),
        };
        Ok(Measured { depth, samples: depths.len(), colours, map })
    }

    /// The depths of a view at used pixels, without its photo, and what became of its depth map.
    ///
    /// # Errors
    /// A sweep or a map that cannot be read.
    pub(super) fn samples(
        &self,
        capture: &Capture,
        number: usize,
        is_used: &dyn Fn(u32, u32) -> bool,
        last_undistorter: &mut LastUndistorter,
    ) -> Result<(DepthSamples, Option<FromMap>), BadInput> {
        let camera = &capture.views[number].camera;
        let mut returns = Vec::new();
        for &sweep in &self.of_view[number] {
            returns.extend(self.sweeps[sweep as usize].read()?.into_iter().map(|found| found.place));
        }
        let seen = visible(camera, (0..).zip(returns));
        let mut seen: Vec<(u32, u32, f32)> =
            seen.into_iter().filter(|s| is_used(s.x, s.y)).map(|s| (s.x, s.y, s.depth)).collect();
        let map = self.maps.measure(capture, number, is_used, last_undistorter)?;
        let mut held: Vec<(u32, u32)> = seen.iter().map(|&(x, y, _)| (y, x)).collect();
        held.sort_unstable();
        let map = map.map(|mut map| {
            let samples = std::mem::take(&mut map.samples).into_iter();
            seen.extend(samples.filter(|&(x, y, _)| held.binary_search(&(y, x)).is_err()));
            map
        });
        seen.extend(self.of_road(capture, number, &seen, is_used));
        let (width, height) = (camera.pinhole.width, camera.pinhole.height);
        Ok((DepthSamples::new(width, height, seen.into_iter()), map))
    }

    /// Depths of the road where a view has no others: one in each square of the picture without measured depths and without points
    /// that the view observed. Those squares are where photos cannot be trusted: dark, in fog, or without texture.
    fn of_road(
        &self,
        capture: &Capture,
        number: usize,
        measured: &[(u32, u32, f32)],
        is_used: &dyn Fn(u32, u32) -> bool,
    ) -> Vec<(u32, u32, f32)> {
        let Some(&own) = self.road_of_view.get(&(number as u32)) else { return Vec::new() };
        let camera = &capture.views[number].camera;
        let centre = camera.centre();
        let near = self.road.iter().filter(|strip| strip.origin().distance(centre) < ROAD_METRES);
        let places = near.flat_map(RoadStrip::places).filter(|place| !self.road[own].hides(*place));
        let seen = visible(camera, (0..).zip(places));
        let side = (SQUARE * camera.pinhole.fx.min(camera.pinhole.fy)).max(1.0) as u32;
        let square = |x: u32, y: u32| (y / side, x / side);
        let observed = self.observations.iter().flat_map(|all| all.of(number)).map(|&point| {
            let (at, _) = camera.project(capture.points.positions[point as usize]);
            pixel_at(at, camera.pinhole.width, camera.pinhole.height)
        });
        let known = measured.iter().map(|&(x, y, _)| (x, y)).chain(observed);
        let mut taken: BTreeSet<(u32, u32)> = known.map(|(x, y)| square(x, y)).collect();
        let first = seen.into_iter().filter(|s| is_used(s.x, s.y) && taken.insert(square(s.x, s.y)));
        first.map(|s| (s.x, s.y, s.depth)).collect()
    }

    /// The colours of the points that a view colours.
    fn colours(
        &self,
        capture: &Capture,
        number: usize,
        pixels: &Pixels,
        is_used: impl Fn(u32, u32) -> bool,
    ) -> Vec<(u32, Option<[u8; 3]>)> {
        let camera = &capture.views[number].camera;
        let colour = |&point: &u32| {
            let (at, _) = camera.project(capture.points.positions[point as usize]);
            let (x, y) = pixel_at(at, pixels.width, pixels.height);
            let channel = |c: usize| pixels.rgb[c * pixels.area() + (y * pixels.width + x) as usize];
            (point, is_used(x, y).then(|| [0, 1, 2].map(channel)))
        };
        self.coloured_by.get(&(number as u32)).into_iter().flatten().map(colour).collect()
    }
}

/// Whether a mask of this width leaves a pixel.
pub(super) fn is_used(width: u32, mask: Option<&[u8]>) -> impl Fn(u32, u32) -> bool {
    move |x, y| mask.is_none_or(|mask| mask[y as usize * width as usize + x as usize] >= 128)
}

/// The pixel at a position, the nearest one outside of the image.
fn pixel_at(at: DVec2, width: u32, height: u32) -> (u32, u32) {
    let side = |v: f64, side: u32| (v.max(0.0) as u32).min(side - 1);
    (side(at.x, width), side(at.y, height))
}

/// Enters what was measured into the capture: depths, and colours of points. Points on excluded pixels are removed, as they lie on
/// moving objects. Returns the number of depth samples, and what became of the depth map of each view that has one.
pub(super) fn enter(capture: &mut Capture, measured: Vec<(usize, Measured)>) -> (usize, Vec<(usize, FromMap)>) {
    let mut removed = vec![false; capture.points.len()];
    let (mut samples, mut maps) = (0, Vec::new());
    for (view, measured) in measured {
        capture.views[view].depth = measured.depth;
        samples += measured.samples;
        maps.extend(measured.map.map(|map| (view, map)));
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
    (samples, maps)
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
