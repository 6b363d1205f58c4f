//! Which shots are taken: an aerial block, cars on all streets, cameras on posts; each thinned evenly to its share.

use city::sense::rig::{Rig, drive, legs};
use city::sense::survey::{Fixed, Survey, fixed, survey};
use city::sense::{SenseError, Shot};
use city::trace::World;
use city::{City, Waypoint};
use scene::BadInput;

use super::{Settings, impossible};

/// Until when the city's traffic moves, seconds: what takes longer is done by several at once.
const TRAFFIC_SECONDS: f64 = 600.0;
/// The aerial block is flown as high as lets its shots be enough, within these metres.
const HEIGHTS: [f64; 2] = [80.0, 150.0];
/// Nor higher than this share of the city's side: a photo would show more than the city.
const MOST_HEIGHT: f64 = 0.4;
/// Least overlap of aerial photos, along a line and between lines, and the most.
const OVERLAP: [f64; 2] = [0.6, 0.5];
const MOST_OVERLAP: f64 = 0.95;
/// How far inside of the city's edge the outermost stops are, of the height of flight and at most of the city's side: as
/// near as lets the city, and not what lies around it, fill most of every photo.
const MARGIN: f64 = 0.5;
const MOST_MARGIN: f64 = 0.25;
/// Cameras on a post take so many photos.
const PICTURES_OF_A_POST: u32 = 10;

/// Where a car of the street rig is when it takes photos that are kept: there its lidar turns and its radar looks.
pub(super) struct Station {
    /// `street-` and the numbers that the photos of the round have.
    pub(super) name: String,
    /// Row of [`Views::legs`].
    pub(super) leg: usize,
    /// The city's clock.
    pub(super) seconds: f64,
}

/// Everything that is taken.
pub(super) struct Views {
    /// Named by what took them: `aerial-`, `street-`, `fixed-`.
    pub(super) shots: Vec<Shot>,
    /// How the cars drive.
    pub(super) legs: Vec<Vec<Waypoint>>,
    /// Along the legs.
    pub(super) stations: Vec<Station>,
}

/// Chooses.
pub(super) fn views(world: &World, settings: &Settings) -> Result<Views, BadInput> {
    let views = f64::from(settings.views);
    let aerial = (views * settings.aerial).round() as usize;
    let posts = ((views * settings.fixed).round() as usize).min(settings.views as usize - aerial);
    let street = settings.views as usize - aerial - posts;
    let city = world.city();
    let refuse = |error: SenseError| impossible(&error);
    let ridden = ride(city, settings, street).map_err(refuse)?;
    let taken =
        [fly(city, settings, aerial).map_err(refuse)?, ridden.shots, watch(world, settings, posts).map_err(refuse)?];
    let named = |(platform, shots): (&str, Vec<Shot>)| {
        let name = |text: &str| format!("{platform}-{text}");
        shots.into_iter().map(|s| Shot { name: name(&s.name), sensor: name(&s.sensor), ..s }).collect::<Vec<_>>()
    };
    let shots = ["aerial", "street", "fixed"].into_iter().zip(taken).flat_map(named).collect();
    Ok(Views { shots, ..ridden })
}

/// A block over the city with five headings at every stop.
fn fly(city: &City, settings: &Settings, wanted: usize) -> Result<Vec<Shot>, SenseError> {
    if wanted == 0 {
        return Ok(Vec::new());
    }
    let block = |looseness: f64| {
        // from 1 to 0 the block comes down, from 0 to -1 its photos overlap more
        let (up, dense) = (looseness.max(0.0), (-looseness).max(0.0));
        let overlap = |least: f64| least + dense * (MOST_OVERLAP - least);
        let extent = city.extent_metres;
        let top = HEIGHTS[1].min(MOST_HEIGHT * extent).max(HEIGHTS[0]);
        let height = HEIGHTS[0] + up * (top - HEIGHTS[0]);
        let half = 0.5 * extent - (MARGIN * height).min(MOST_MARGIN * extent);
        Survey {
            height_metres: height,
            forward_overlap: overlap(OVERLAP[0]),
            side_overlap: overlap(OVERLAP[1]),
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
    let mut shots: Vec<Shot> = kept(all.len(), 5, wanted).into_iter().map(|i| all[i].clone()).collect();
    shots.iter_mut().for_each(|shot| aim(shot, block.height_metres));
    let last = shots.iter().map(|s| s.seconds).fold(0.0, f64::max);
    if last > TRAFFIC_SECONDS {
        shots.iter_mut().for_each(|shot| shot.seconds *= TRAFFIC_SECONDS / last);
    }
    Ok(shots)
}

/// Moves an oblique camera back until it looks at the ground under its stop, as crews fly beyond the edges of what they are
/// to show: from over the edge, half of the oblique photos would show what lies around the city.
fn aim(shot: &mut Shot, height: f64) {
    let forward = shot.camera.forward();
    let back = forward.with_z(0.0) * (height / -forward.z.min(-0.1));
    for camera in [&mut shot.camera, &mut shot.reported] {
        let pose = &mut camera.camera_from_world;
        pose.translation += pose.rotation * back;
    }
}

/// A car on every street, all at once.
fn ride(city: &City, settings: &Settings, wanted: usize) -> Result<Views, SenseError> {
    if wanted == 0 {
        return Ok(Views { shots: Vec::new(), legs: Vec::new(), stations: Vec::new() });
    }
    let metres: f64 = city.streets.iter().flat_map(|street| street.windows(2)).map(|p| p[0].distance(p[1])).sum();
    let rig = Rig { width: settings.width, height: settings.height, fleet: true, ..Rig::default() };
    let cameras = rig.cameras.len();
    // half of the spacing that gives as many, so that there is something to choose from
    let spacing = (0.5 * metres * cameras as f64 / wanted as f64).clamp(0.1, 25.0);
    let rig = Rig { spacing_metres: spacing, ..rig };
    let (all, legs) = (drive(city, &rig)?, legs(city, &rig)?);
    let kept = kept(all.len(), cameras, wanted);
    let mut rounds: Vec<usize> = kept.iter().map(|i| i / cameras).collect();
    rounds.dedup();
    let places: Vec<(usize, usize)> =
        legs.iter().enumerate().flat_map(|(leg, points)| (0..points.len()).map(move |i| (leg, i))).collect();
    let station = |&(leg, i): &(usize, usize)| Station {
        name: format!("street-{leg:04}-{i:05}"),
        leg,
        seconds: legs[leg][i].seconds,
    };
    let stations = rounds.iter().filter_map(|&round| places.get(round)).map(station).collect();
    Ok(Views { shots: kept.into_iter().map(|i| all[i].clone()).collect(), legs, stations })
}

/// Cameras on posts.
fn watch(world: &World, settings: &Settings, wanted: usize) -> Result<Vec<Shot>, SenseError> {
    if wanted == 0 {
        return Ok(Vec::new());
    }
    let posts = Fixed {
        cameras: (wanted as u32).div_ceil(PICTURES_OF_A_POST),
        pictures: PICTURES_OF_A_POST,
        width: settings.width,
        height: settings.height,
        seed: settings.city.seed,
        ..Fixed::default()
    };
    let mut shots = fixed(&world.at(posts.start_seconds), &posts)?;
    shots.truncate(wanted);
    Ok(shots)
}

/// Which shots to keep of rounds of a shot of each camera: as many as are wanted, spread evenly over the rounds. Where a
/// round is not kept as a whole, the cameras take turns.
fn kept(shots: usize, cameras: usize, wanted: usize) -> Vec<usize> {
    if shots <= wanted {
        return (0..shots).collect();
    }
    let rounds = shots / cameras;
    let mut kept: Vec<usize> = (0..wanted).map(|pick| pick * rounds / wanted * cameras + pick % cameras).collect();
    kept.sort_unstable();
    kept
}
