//! How densely a capture photographs the ground, apart for aerial and street views: the distance between photos, and the ground
//! that too few of them see from nearby.
//!
//! A model shows what lies between its training photos. Where the next photo is as far away as the wall that it shows, the
//! surface is seen from nearby once, and a model of it is blurred from any other place.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::FRAC_1_SQRT_2;

use glam::{DVec2, DVec3};
use scene::Capture;

use crate::ground::{Ground, Square, quantile};
use crate::view_kind::{ViewKind, kinds_of};
use crate::visibility::{Observations, is_usable};

/// A cell that fewer places than this photograph from nearby is thin.
pub const ENOUGH_PLACES: u32 = 3;
/// A photo is near if it is at most this many times as far away as the nearest one.
const NEAR: f64 = 2.0;
/// Photos count as two places if they are this share of the nearest photo's distance apart (14°); so the cameras of a car count once.
const PLACE_SHARE: f64 = 0.25;
/// Places are counted up to this number.
const MAX_PLACES: usize = 9;
/// Side of a cell in median distances between photos and the points that they observe.
const CELL_SHARE: f64 = 0.5;
/// Most cells along the side of the root square.
const MAX_CELLS: f64 = 256.0;
/// Cells that are farther from any photo than this many median distances are not what the capture is about.
const REACH: f64 = 2.0;
/// Cells with fewer observed points are left out.
const MIN_POINTS: u32 = 3;
/// Photos at most whose distance to the next one is measured.
const MAX_MEASURED: usize = 1000;
/// Neighbours of a photo that are tried as the next one of its drive.
const NEIGHBOURS: usize = 16;

/// How densely the views of one kind photograph the ground.
#[derive(Debug, Clone, PartialEq)]
pub struct Density {
    /// The kind of the views.
    pub kind: ViewKind,
    /// Number of views.
    pub views: usize,
    /// Median distance of a photo to the next that looks the same way, metres. `None` if there are no two such.
    pub spacing_metres: Option<f64>,
    /// Side of a cell, metres.
    pub cell_metres: f64,
    /// The ground within reach of the photos, by row and column.
    pub cells: Vec<Cell>,
}

/// A square of the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cell {
    /// Its place, ground coordinates.
    pub square: Square,
    /// From how many places photos show it from nearby, at most 9.
    pub places: u32,
}

impl Cell {
    /// Whether too few places show it.
    pub fn is_thin(&self) -> bool {
        self.places < ENOUGH_PLACES
    }
}

impl Density {
    /// Number of thin cells.
    pub fn thin_cells(&self) -> usize {
        self.cells.iter().filter(|cell| cell.is_thin()).count()
    }

    /// Share of the cells that are thin, 0 to 1.
    pub fn thin_share(&self) -> f64 {
        self.thin_cells() as f64 / self.cells.len().max(1) as f64
    }
}

/// The density of each kind of views that a capture has.
pub fn densities(capture: &Capture) -> Vec<Density> {
    let (observations, ground) = (Observations::of(capture), Ground::of(capture));
    let kinds = kinds_of(capture, &observations, &ground);
    let of = |kind: ViewKind| {
        let is_kind = |view: usize| kinds[view] == kind && is_usable(&capture.views[view].camera);
        let views: Vec<usize> = (0..kinds.len()).filter(|&view| is_kind(view)).collect();
        let (cell_metres, cells) = cells(capture, &observations, &ground, is_kind);
        let spacing_metres = spacing_metres(capture, &views);
        (!views.is_empty()).then_some(Density { kind, views: views.len(), spacing_metres, cell_metres, cells })
    };
    ViewKind::ALL.into_iter().filter_map(of).collect()
}

/// Median distance of these views to the next one that looks the same way, within 45°.
///
/// A car may have several cameras that look the same way. The next photo of the drive is told from those by the photo before it,
/// which is about as far away on the other side.
fn spacing_metres(capture: &Capture, views: &[usize]) -> Option<f64> {
    let rays: Vec<(DVec3, DVec3)> = (views.iter().map(|&view| &capture.views[view].camera))
        .map(|camera| (camera.centre(), camera.forward()))
        .collect();
    let spacing = |of: &(DVec3, DVec3)| {
        let alike = |other: &&(DVec3, DVec3)| other.1.dot(of.1) >= FRAC_1_SQRT_2 && other.0 != of.0;
        let mut offsets: Vec<DVec3> = rays.iter().filter(alike).map(|other| other.0 - of.0).collect();
        offsets.sort_by(|a, b| a.length_squared().total_cmp(&b.length_squared()));
        let has_opposite = |ahead: &&DVec3| {
            let metres = ahead.length();
            let near = offsets.iter().take_while(|offset| offset.length() <= 1.5 * metres);
            near.into_iter().any(|behind| (*behind + **ahead).length() <= 0.5 * metres)
        };
        let next = offsets.iter().take(NEIGHBOURS).find(has_opposite).or(offsets.first());
        next.map(|offset| offset.length())
    };
    let mut metres: Vec<f64> =
        rays.iter().step_by(rays.len().div_ceil(MAX_MEASURED).max(1)).filter_map(spacing).collect();
    (!metres.is_empty()).then(|| quantile(&mut metres, 0.5))
}

/// The points that views of a kind observe in a cell, and those views.
#[derive(Default)]
struct Observed {
    sum: DVec3,
    points: u32,
    views: BTreeSet<u32>,
}

/// The side of a cell, and the cells within reach of the views of a kind.
fn cells(
    capture: &Capture,
    observations: &Observations,
    ground: &Ground,
    is_kind: impl Fn(usize) -> bool,
) -> (f64, Vec<Cell>) {
    let of_kind = || observations.all.iter().filter(|s| is_kind(s.view as usize));
    let typical_metres = quantile(&mut of_kind().map(|s| s.depth_metres).collect::<Vec<f64>>(), 0.5);
    let side = (CELL_SHARE * typical_metres).max(ground.edge_metres / MAX_CELLS);
    let mut observed: BTreeMap<[i64; 2], Observed> = BTreeMap::new();
    let mut last = None;
    for s in of_kind() {
        let place = capture.points.positions[s.point as usize];
        let at = ground.from_world(place);
        let column = |metres: f64| (metres / side).floor() as i64;
        let cell = observed.entry([column(at.y), column(at.x)]).or_default();
        cell.views.insert(s.view);
        if last != Some(s.point) {
            last = Some(s.point);
            (cell.sum, cell.points) = (cell.sum + place, cell.points + 1);
        }
    }
    let cell = |([row, column], observed): ([i64; 2], Observed)| {
        let centre = observed.sum / f64::from(observed.points);
        let cameras = observed.views.iter().map(|&view| capture.views[view as usize].camera.centre());
        let (nearest_metres, places) = places(centre, cameras, side);
        let min = DVec2::new(column as f64, row as f64) * side;
        let is_in_reach = observed.points >= MIN_POINTS && nearest_metres <= REACH * typical_metres;
        is_in_reach.then_some(Cell { square: Square { min, max: min + side }, places })
    };
    (side, observed.into_iter().filter_map(cell).collect())
}

/// The distance of the nearest of these cameras to a place, at least `least`, and from how many places near ones see it.
fn places(place: DVec3, cameras: impl Iterator<Item = DVec3>, least: f64) -> (f64, u32) {
    let mut cameras: Vec<(f64, DVec3)> = cameras.map(|at| (at.distance(place).max(least), at)).collect();
    cameras.sort_by(|a, b| a.0.total_cmp(&b.0));
    let nearest = cameras.first().map_or(f64::INFINITY, |camera| camera.0);
    let mut apart: Vec<DVec3> = Vec::new();
    for &(_, at) in cameras.iter().take_while(|camera| camera.0 <= NEAR * nearest) {
        if apart.len() < MAX_PLACES && apart.iter().all(|other| other.distance(at) >= PLACE_SHARE * nearest) {
            apart.push(at);
        }
    }
    (nearest, apart.len() as u32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{aerial, capture, look_at, noise};

    /// Stops along a street between walls 14 m apart; `mounts` are offsets (ahead, left) and directions of the cameras of a car.
    fn drive(stops: usize, spacing: f64, mounts: &[[f64; 3]]) -> Capture {
        let cameras: Vec<_> = (0..stops)
            .flat_map(|i| {
                mounts.iter().map(move |&[ahead, left, degrees]| {
                    let eye = DVec3::new(i as f64 * spacing + ahead, left, 1.6);
                    let (sine, cosine) = degrees.to_radians().sin_cos();
                    look_at(eye, eye + DVec3::new(cosine, sine, 0.0), DVec3::Z)
                })
            })
            .collect();
        let length = stops as f64 * spacing;
        let place = |i: u64| {
            let side = if i.is_multiple_of(2) { -7.0 } else { 7.0 };
            DVec3::new(noise(2 * i) * length, side, 9.0 * noise(2 * i + 1))
        };
        let mut drive = capture(&cameras, (0..2000).map(place).collect(), true);
        // Points are recognised up to 30 m away.
        let points = &mut drive.points;
        let (mut track_start, mut seen_by) = (vec![0], Vec::new());
        for (i, place) in points.positions.iter().enumerate() {
            let track = points
                .track(i)
                .unwrap()
                .iter()
                .filter(|view| cameras[**view as usize].centre().distance(*place) < 30.0);
            seen_by.extend(track);
            track_start.push(seen_by.len() as u32);
        }
        (points.track_start, points.seen_by) = (track_start, seen_by);
        drive
    }

    const SIX: [[f64; 3]; 6] = [
        [0.8, 0.3, 0.0],
        [0.8, -0.3, 0.0],
        [0.0, 0.55, 90.0],
        [0.0, -0.55, -90.0],
        [-0.8, 0.3, 180.0],
        [-0.8, -0.3, 180.0],
    ];

    #[test]
    fn spacing_is_that_of_the_stops_whatever_the_rig() {
        for (spacing, mounts) in [(3.0, &SIX[..]), (1.0, &SIX), (2.0, &SIX[2..3]), (11.0, &SIX[..1])] {
            let found = densities(&drive(40, spacing, mounts));
            assert_eq!((found.len(), found[0].kind, found[0].views), (1, ViewKind::Street, 40 * mounts.len()));
            let metres = found[0].spacing_metres.unwrap();
            assert!((metres - spacing).abs() < 0.01 * spacing, "{metres} for {spacing}");
        }
        let survey = densities(&aerial(6, 120.0, 2000));
        assert_eq!((survey.len(), survey[0].kind), (1, ViewKind::Aerial));
        assert!((survey[0].spacing_metres.unwrap() - 20.0).abs() < 1e-6);
        let alone = drive(1, 1.0, &SIX[..1]);
        assert_eq!(densities(&alone)[0].spacing_metres, None);
        assert_eq!(densities(&Capture::default()), []);
    }

    #[test]
    fn widely_spaced_photos_leave_thin_ground() {
        let [close, wide] =
            [(100, 2.0), (20, 25.0)].map(|(stops, spacing)| densities(&drive(stops, spacing, &SIX)).remove(0));
        assert!(close.cells.len() > 10 && close.thin_share() < 0.2, "{}", close.thin_share());
        assert!(wide.cells.len() > 10 && wide.thin_share() > 0.5, "{}", wide.thin_share());
        assert!(densities(&aerial(8, 200.0, 4000))[0].thin_share() < 0.1);
        assert_eq!(wide.thin_cells(), wide.cells.iter().filter(|cell| cell.places < 3).count());
    }

    #[test]
    fn places_are_near_and_apart() {
        let at = |x: f64| DVec3::new(x, 10.0, 0.0);
        let count = |xs: &[f64]| places(DVec3::ZERO, xs.iter().map(|&x| at(x)), 1.0);
        assert_eq!(count(&[0.0, 0.5, -0.5, 5.0, -5.0]), (10.0, 3));
        // Those at more than 20 m do not count.
        assert_eq!(count(&[0.0, 18.0, 400.0]), (10.0, 1));
        assert_eq!(count(&[]), (f64::INFINITY, 0));
    }
}
