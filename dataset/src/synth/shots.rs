//! Plans the shots: an aerial block, cars and fixed cameras on posts. Cars are on all streets, thinned evenly to their share, or
//! drive whole streets with a given spacing until their share is used up.

use std::collections::BTreeMap;

use city::sense::drives::{Drives, drives};
use city::sense::rig::{Rig, drive, legs, shots_of};
use city::sense::survey::{Fixed, Survey, fixed, survey};
use city::sense::watch::{Watch, watch};
use city::sense::{SenseError, Shot};
use city::trace::World;
use city::{City, Waypoint};
use scene::BadInput;

use super::settings::{Driven, FILM_HZ, SUBJECT, Settings, Watched, unsupported};

/// End of the city's traffic, seconds. Times of an aerial block that takes longer are compressed, as if several aircraft flew.
const TRAFFIC_SECONDS: f64 = 600.0;
/// Flight height of the aerial block, metres: the highest in this range that gives enough shots.
const HEIGHT_RANGE: [f64; 2] = [80.0, 150.0];
/// Maximum flight height as a share of the city's side, so that photos show the city and not its surroundings.
const MAX_HEIGHT_SHARE: f64 = 0.4;
/// Minimum overlap of aerial photos along a line and between lines.
const MIN_OVERLAP: [f64; 2] = [0.6, 0.5];
/// Maximum overlap of aerial photos.
const MAX_OVERLAP: f64 = 0.95;
/// Distance of the outermost stops from the city's edge as a share of the flight height, so that the city fills most of every
/// photo.
const MARGIN_HEIGHT_SHARE: f64 = 0.5;
/// Maximum of that distance as a share of the city's side.
const MAX_MARGIN_SHARE: f64 = 0.25;
/// Offset of a driving car to the right of its lane's middle, so that drives in both directions differ.
const LANE_METRES: f64 = 0.6;
/// Photos per fixed camera.
const PHOTOS_PER_POST: u32 = 10;
/// Height of the cameras around a watched place, metres, and their field of view, degrees.
const WATCH_HEIGHT_METRES: f64 = 4.0;
const WATCH_FIELD_DEGREES: f64 = 65.0;

/// A position of a street car with kept photos, where its lidar and radar measure.
pub(super) struct Station {
    /// `street-` and the numbers of the photos taken there.
    pub(super) name: String,
    /// Index in [`PlannedShots::legs`].
    pub(super) leg: usize,
    /// City time.
    pub(super) seconds: f64,
    /// Number among the stations of its leg.
    pub(super) frame: usize,
    /// Names of the photos taken there.
    pub(super) photos: Vec<String>,
}

impl Station {
    /// The station at a waypoint (indices of the leg and within it) with the photos taken there.
    fn of<'a>(legs: &[Vec<Waypoint>], (leg, i): (usize, usize), shots: impl Iterator<Item = &'a Shot>) -> Self {
        let photos = shots.map(|shot| format!("street-{}", shot.name)).collect();
        Self { name: format!("street-{leg:04}-{i:05}"), leg, seconds: legs[leg][i].seconds, frame: 0, photos }
    }
}

/// All planned shots.
#[derive(Default)]
pub(super) struct PlannedShots {
    /// Names begin with the platform: `aerial-`, `street-`, `fixed-`.
    pub(super) shots: Vec<Shot>,
    /// Trajectories of the cars.
    pub(super) legs: Vec<Vec<Waypoint>>,
    /// Stations along the legs.
    pub(super) stations: Vec<Station>,
    /// With a given spacing.
    pub(super) driven: Option<Driven>,
}

/// Plans the shots.
pub(super) fn plan(world: &World, settings: &Settings) -> Result<PlannedShots, BadInput> {
    if let Some(place) = settings.watched {
        let shots = watched_shots(world, settings, place).map_err(|error| unsupported(&error))?;
        if shots.is_empty() {
            let problem = "has no place for a camera that sees the watched place";
            return Err(BadInput::new(SUBJECT, problem, "choose another place or radius"));
        }
        return Ok(PlannedShots { shots, ..PlannedShots::default() });
    }
    let views = f64::from(settings.views);
    let aerial = (views * settings.aerial).round() as usize;
    let posts = ((views * settings.fixed).round() as usize).min(settings.views as usize - aerial);
    let street = settings.views as usize - aerial - posts;
    let city = world.city();
    let refuse = |error: SenseError| unsupported(&error);
    let mut street = street_shots(city, settings, street).map_err(refuse)?;
    let mut frames: BTreeMap<usize, usize> = BTreeMap::new();
    for station in &mut street.stations {
        let next = frames.entry(station.leg).or_default();
        station.frame = *next;
        *next += 1;
    }
    let taken = [
        aerial_shots(city, settings, aerial).map_err(refuse)?,
        street.shots,
        fixed_shots(world, settings, posts).map_err(refuse)?,
    ];
    let named = |(platform, shots): (&str, Vec<Shot>)| {
        let name = |text: &str| format!("{platform}-{text}");
        shots.into_iter().map(|s| Shot { name: name(&s.name), sensor: name(&s.sensor), ..s }).collect::<Vec<_>>()
    };
    let shots = ["aerial", "street", "fixed"].into_iter().zip(taken).flat_map(named).collect();
    Ok(PlannedShots { shots, ..street })
}

/// A block over the city with nadir and four oblique shots at every stop.
fn aerial_shots(city: &City, settings: &Settings, wanted: usize) -> Result<Vec<Shot>, SenseError> {
    if wanted == 0 {
        return Ok(Vec::new());
    }
    let block = |looseness: f64| {
        // From 1 to 0 the flight height falls to its minimum, from 0 to -1 the overlap grows to its maximum.
        let (up, dense) = (looseness.max(0.0), (-looseness).max(0.0));
        let overlap = |min: f64| min + dense * (MAX_OVERLAP - min);
        let extent = city.extent_metres;
        let top = HEIGHT_RANGE[1].min(MAX_HEIGHT_SHARE * extent).max(HEIGHT_RANGE[0]);
        let height = HEIGHT_RANGE[0] + up * (top - HEIGHT_RANGE[0]);
        let half = 0.5 * extent - (MARGIN_HEIGHT_SHARE * height).min(MAX_MARGIN_SHARE * extent);
        Survey {
            height_metres: height,
            forward_overlap: overlap(MIN_OVERLAP[0]),
            side_overlap: overlap(MIN_OVERLAP[1]),
            tilt_degrees: 45.0,
            width: settings.width,
            height: settings.height,
            area: Some([glam::DVec2::splat(-half), glam::DVec2::splat(half)]),
            ..Survey::default()
        }
    };
    let enough = |looseness: f64| -> Result<bool, SenseError> {
        match block(looseness).stops(city) {
            Ok([lines, stops]) => Ok(5 * lines as usize * stops as usize >= wanted),
            Err(SenseError::TooMany(_)) => Ok(true),
            Err(other) => Err(other),
        }
    };
    let (mut low, mut high) = (-1.0, 1.0);
    if enough(high)? {
        low = high;
    }
    for _ in 0..30 {
        let middle = 0.5 * (low + high);
        if enough(middle)? { low = middle } else { high = middle }
    }
    let block = block(low);
    let all = survey(city, &block)?;
    let mut shots: Vec<Shot> = thinned(all.len(), 5, wanted).into_iter().map(|i| all[i].clone()).collect();
    shots.iter_mut().for_each(|shot| aim_at_stop(shot, block.height_metres));
    let last = shots.iter().map(|s| s.seconds).fold(0.0, f64::max);
    if last > TRAFFIC_SECONDS {
        shots.iter_mut().for_each(|shot| shot.seconds *= TRAFFIC_SECONDS / last);
    }
    Ok(shots)
}

/// Moves an oblique camera back until its optical axis meets the ground below its stop. Survey flights extend beyond the edge of
/// their area likewise: from stops at the edge half of the oblique photos would show the surroundings.
fn aim_at_stop(shot: &mut Shot, height: f64) {
    let forward = shot.camera.forward();
    let back = forward.with_z(0.0) * (height / -forward.z.min(-0.1));
    for camera in [&mut shot.camera, &mut shot.reported] {
        let pose = &mut camera.camera_from_world;
        pose.translation += pose.rotation * back;
    }
}

/// Photos of cars: with a given spacing along whole streets, otherwise evenly from all streets.
fn street_shots(city: &City, settings: &Settings, wanted: usize) -> Result<PlannedShots, SenseError> {
    let rig = Rig { width: settings.width, height: settings.height, ..settings.rig.rig() };
    match settings.spacing {
        _ if wanted == 0 => Ok(PlannedShots::default()),
        None => shots_of_fleet(city, rig, wanted),
        Some(spacing_metres) => {
            let rig = Rig { spacing_metres, lane_metres: LANE_METRES, ..rig };
            let stops = (wanted / rig.cameras.len()).max(1);
            let Drives { legs, driven_metres, street_metres } = drives(city, &rig, stops)?;
            let at = |leg: usize| (0..legs[leg].len()).map(move |i| (leg, i));
            let shots = shots_of(&legs, &rig)?;
            // A chunk of shots, one per camera, for each waypoint in order.
            let photos = shots.chunks(rig.cameras.len());
            let stations = (0..legs.len()).flat_map(at).zip(photos);
            let stations: Vec<Station> = stations.map(|(at, photos)| Station::of(&legs, at, photos.iter())).collect();
            let driven = Driven {
                spacing_metres,
                rig: settings.rig,
                stops: stations.len(),
                metres: driven_metres,
                share: driven_metres / street_metres.max(1e-9),
            };
            Ok(PlannedShots { shots, legs, stations, driven: Some(driven) })
        }
    }
}

/// A car on every street, all at the same time.
fn shots_of_fleet(city: &City, rig: Rig, wanted: usize) -> Result<PlannedShots, SenseError> {
    let metres: f64 = city.streets.iter().flat_map(|street| street.windows(2)).map(|p| p[0].distance(p[1])).sum();
    let cameras = rig.cameras.len();
    // Half of the spacing that gives the wanted number, so that thinning has a choice.
    let spacing = (0.5 * metres * cameras as f64 / wanted as f64).clamp(0.1, 25.0);
    let rig = Rig { spacing_metres: spacing, fleet: true, ..rig };
    let (all, legs) = (drive(city, &rig)?, legs(city, &rig)?);
    let kept = thinned(all.len(), cameras, wanted);
    let mut stops: Vec<usize> = kept.iter().map(|i| i / cameras).collect();
    stops.dedup();
    let positions: Vec<(usize, usize)> =
        legs.iter().enumerate().flat_map(|(leg, points)| (0..points.len()).map(move |i| (leg, i))).collect();
    let station = |&stop: &usize| {
        let &at = positions.get(stop)?;
        let taken = kept.iter().filter(|&&shot| shot / cameras == stop);
        Some(Station::of(&legs, at, taken.map(|&shot| &all[shot])))
    };
    let stations = stops.iter().filter_map(station).collect();
    Ok(PlannedShots { shots: kept.into_iter().map(|i| all[i].clone()).collect(), legs, stations, driven: None })
}

/// Fixed cameras on posts.
fn fixed_shots(world: &World, settings: &Settings, wanted: usize) -> Result<Vec<Shot>, SenseError> {
    if wanted == 0 {
        return Ok(Vec::new());
    }
    let posts = Fixed {
        cameras: (wanted as u32).div_ceil(PHOTOS_PER_POST),
        pictures: PHOTOS_PER_POST,
        width: settings.width,
        height: settings.height,
        seed: settings.city.seed,
        ..Fixed::default()
    };
    let mut shots = fixed(&world.at(posts.start_seconds), &posts)?;
    shots.truncate(wanted);
    Ok(shots)
}

/// Cameras around a place.
fn watched_shots(world: &World, settings: &Settings, place: Watched) -> Result<Vec<Shot>, SenseError> {
    let frames = place.frames();
    let cameras = Watch {
        at: glam::DVec2::new(place.x, place.y),
        radius_metres: place.radius,
        cameras: settings.views / frames,
        height_metres: WATCH_HEIGHT_METRES,
        width: settings.width,
        height: settings.height,
        field_degrees: WATCH_FIELD_DEGREES,
        seconds: 0.0,
        frames,
        frame_rate_hz: FILM_HZ,
    };
    watch(&world.at(cameras.seconds), &cameras)
}

/// Indices of the `wanted` shots to keep, spread evenly over the stops. `shots` counts all shots, `cameras` those of each stop.
/// Where a stop is not kept completely, the cameras take turns.
fn thinned(shots: usize, cameras: usize, wanted: usize) -> Vec<usize> {
    if shots <= wanted {
        return (0..shots).collect();
    }
    let stops = shots / cameras;
    let mut kept: Vec<usize> = (0..wanted).map(|pick| pick * stops / wanted * cameras + pick % cameras).collect();
    kept.sort_unstable();
    kept
}
