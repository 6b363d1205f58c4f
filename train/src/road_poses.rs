//! Poses of an object on the road from a path of its positions (EDeRF, section 3.3).
//!
//! Heading and pitch follow from where it goes, pitch over a longer way. Height, roll and a better pitch follow from contact: lines
//! through the four lower corners of its box meet the road in the splats of the static scene, and the box's lower side is laid on what
//! they meet. Times that are missing are filled by Lagrange's polynomial through the positions next to them.

use std::ops::Range;

use glam::{DMat3, DQuat, DVec2, DVec3};
use render::surface::Surface;
use scene::{PathPose, Rigid};

/// The road lies at most this far above and below where the position says, metres.
const REACH_METRES: f64 = 1.0;
/// Heading follows the velocity over a displacement of at least this length, metres, found within this many seconds on either side.
const DISPLACEMENT_METRES: f64 = 3.0;
const DISPLACEMENT_SECONDS: f64 = 2.0;
/// From this many positions on it may turn in that time: the velocity is that of a parabola through them.
const LEAST_TURNING: usize = 4;
/// Pitch follows the heights of the positions over a way of the second length, metres, within this many seconds on either side: roads do
/// not bend as soon as cars turn, and heights are measured worse than places. Over less than the first length it is not known.
const PITCH_METRES: Range<f64> = 5.0..15.0;
const PITCH_SECONDS: f64 = 5.0;
/// A road under the corners whose slope differs from that pitch by more than this, or that tilts to a side by more, is none, radians.
const OFF_PITCH: f64 = 0.12;
const MAX_ROLL: f64 = 0.2;
/// It stands still where it moves by less than this in that time, metres.
const LEAST_METRES: f64 = 0.5;
/// An object that seems to turn by more than this between two times has changed gear, radians.
const REVERSED: f64 = 2.0;
/// Positions that fill a gap lie within this many seconds of it; longer gaps stay, seconds.
const GAP_SECONDS: f64 = 5.0;
/// Positions on each side of a gap that its polynomial goes through: more would let it swing.
const GAP_SIDE: usize = 2;
/// Positions at most that fill a gap: the median interval may be tiny.
const MAX_FILLED: f64 = 500.0;
/// A corner that lies farther off the plane of the others stands on something else, or on a hole, metres.
const OFF_METRES: f64 = 0.25;
/// No road is steeper, radians.
const MAX_TILT: f64 = 0.6;
/// Rounds of laying the box down: the corners move a little when it tilts.
const ROUNDS: usize = 2;

/// Where an object was, and what of it touches the road.
pub struct Positions<'a> {
    /// Times, seconds, ascending, with the origin of the object's axes in the world, metres.
    pub places: &'a [(f64, DVec3)],
    /// The lower and the upper corner of its box in its own axes (x ahead, y left, z up), metres.
    pub low: DVec3,
    /// As `low`.
    pub high: DVec3,
    /// Its heading at first, if that is known: it may drive backwards.
    pub first: Option<DQuat>,
}

/// A path with poses.
#[derive(Debug, Clone, PartialEq)]
pub struct RoadPoses {
    /// With gaps filled.
    pub path: Vec<PathPose>,
    /// At how many of them the object lies on the road. At the others it keeps the pitch of its displacement, and the height of its
    /// position or of the few corners that found a road.
    pub on_road: usize,
}

/// Poses of an object at its positions, from the road under its corners.
pub fn road_poses(positions: &Positions, road: &Surface) -> RoadPoses {
    let ground_from_world = road.ground_from_world();
    let on_ground = positions.places.iter().map(|(seconds, place)| (*seconds, ground_from_world * *place));
    let places = without_gaps(&on_ground.collect::<Vec<_>>());
    let first = positions.first.map(|rotation| {
        let ahead = ground_from_world * rotation * DVec3::X;
        ahead.y.atan2(ahead.x)
    });
    let courses = courses(&places, first);
    let mut on_road = 0;
    let pose = |(&(seconds, place), &(heading, pitch)): (&(f64, DVec3), &(f64, Option<f64>))| {
        let (rotation, translation, lies) = laid_down(place, heading, pitch, positions, road);
        on_road += usize::from(lies);
        let world_from_object = Rigid {
            rotation: (ground_from_world.inverse() * rotation).normalize(),
            translation: ground_from_world.inverse() * translation,
        };
        PathPose { seconds, world_from_object }
    };
    let path = places.iter().zip(&courses).map(pose).collect();
    RoadPoses { path, on_road }
}

/// The positions with those that are missing, by the median interval.
fn without_gaps(places: &[(f64, DVec3)]) -> Vec<(f64, DVec3)> {
    let mut intervals: Vec<f64> = places.windows(2).map(|pair| pair[1].0 - pair[0].0).collect();
    intervals.sort_by(f64::total_cmp);
    let Some(&interval) = intervals.get(intervals.len() / 2) else { return places.to_vec() };
    let mut filled = Vec::new();
    for (i, &(seconds, place)) in places.iter().enumerate() {
        filled.push((seconds, place));
        let Some(&(next, _)) = places.get(i + 1) else { break };
        let missing = ((next - seconds) / interval).round() - 1.0;
        if !(1.0..=MAX_FILLED).contains(&missing) || next - seconds > 2.0 * GAP_SECONDS {
            continue;
        }
        let near = |other: &&(f64, DVec3)| other.0 >= seconds - GAP_SECONDS && other.0 <= next + GAP_SECONDS;
        let (from, to) = ((i + 1).saturating_sub(GAP_SIDE), (i + 1 + GAP_SIDE).min(places.len()));
        let through: Vec<(f64, DVec3)> = places[from..to].iter().filter(near).copied().collect();
        for k in 1..=missing as u32 {
            let at = seconds + (next - seconds) * f64::from(k) / (missing + 1.0);
            filled.push((at, lagrange(&through, at)));
        }
    }
    filled
}

/// The polynomial through these positions, at a time (equation 5).
fn lagrange(through: &[(f64, DVec3)], at: f64) -> DVec3 {
    let basis = |i: usize| {
        let others = through.iter().enumerate().filter(|(j, _)| *j != i);
        others.map(|(_, other)| (at - other.0) / (through[i].0 - other.0)).product::<f64>()
    };
    through.iter().enumerate().map(|(i, (_, place))| *place * basis(i)).sum()
}

/// Heading and pitch at each position, radians: heading is that of the velocity around it, or of the nearest one that moves.
fn courses(places: &[(f64, DVec3)], first: Option<f64>) -> Vec<(f64, Option<f64>)> {
    let around = |i: usize| {
        let (mut from, mut to) = (i, i);
        loop {
            let apart = (places[to].1 - places[from].1).truncate().length();
            if apart >= DISPLACEMENT_METRES {
                return Some(heading(turning(&places[from..=to], places[i].0)));
            }
            let is_near = |j: usize| (places[j].0 - places[i].0).abs() <= DISPLACEMENT_SECONDS;
            let earlier = from.checked_sub(1).filter(|&j| is_near(j));
            let later = Some(to + 1).filter(|&j| j < places.len() && is_near(j));
            if earlier.is_none() && later.is_none() {
                return (apart >= LEAST_METRES).then(|| heading(velocity(&places[from..=to])));
            }
            (from, to) = (earlier.unwrap_or(from), later.unwrap_or(to));
        }
    };
    let known: Vec<Option<f64>> = (0..places.len()).map(around).collect();
    let nearest = |i: usize| {
        let distance = |j: &usize| (places[*j].0 - places[i].0).abs();
        let with = (0..known.len()).filter(|&j| known[j].is_some());
        with.min_by(|a, b| distance(a).total_cmp(&distance(b))).and_then(|j| known[j])
    };
    let mut before = first;
    let mut headings = Vec::new();
    for (i, found) in known.iter().enumerate() {
        let mut heading = found.or_else(|| nearest(i)).or(first).unwrap_or(0.0);
        if before.is_some_and(|before| turn(before, heading).abs() > REVERSED) {
            heading = turn(0.0, heading + std::f64::consts::PI);
        }
        before = Some(heading);
        headings.push(heading);
    }
    let ways = ways(places, &headings);
    headings.into_iter().enumerate().map(|(i, heading)| (heading, pitch(places, &ways, i))).collect()
}

/// The velocity that fits positions best: of errors of single positions, as those of satellites, less remains than in the displacement
/// from the first to the last.
fn velocity(places: &[(f64, DVec3)]) -> DVec3 {
    let count = places.len() as f64;
    let middle = places.iter().map(|(seconds, _)| seconds).sum::<f64>() / count;
    let centre = places.iter().map(|(_, place)| *place).sum::<DVec3>() / count;
    places.iter().map(|(seconds, place)| (seconds - middle) * (*place - centre)).sum()
}

/// The velocity at a time of the parabola that fits positions best: over a turn they are not as a line has it, least of all where a path
/// begins and ends.
fn turning(places: &[(f64, DVec3)], at: f64) -> DVec3 {
    let (mut matrix, mut right) = (DMat3::ZERO, DMat3::ZERO);
    for (seconds, place) in places {
        let off = seconds - at;
        let row = DVec3::new(1.0, off, off * off);
        matrix += DMat3::from_cols(row * row.x, row * row.y, row * row.z);
        let off = *place - places[0].1;
        right += DMat3::from_cols(row * off.x, row * off.y, row * off.z);
    }
    let found = (matrix.inverse() * right).transpose().y_axis;
    if places.len() >= LEAST_TURNING && found.is_finite() { found } else { velocity(places) }
}

fn heading(along: DVec3) -> f64 {
    along.y.atan2(along.x)
}

/// How far each position lies along the way, metres: steps along the heading, so that errors of many positions do not make it longer.
fn ways(places: &[(f64, DVec3)], headings: &[f64]) -> Vec<f64> {
    let steps = places
        .windows(2)
        .zip(headings)
        .map(|(pair, &heading)| (pair[1].1 - pair[0].1).truncate().dot(DVec2::from_angle(heading)));
    let mut way = 0.0;
    std::iter::once(0.0)
        .chain(steps.map(|step| {
            way += step;
            way
        }))
        .collect()
}

/// The slope of the way around a position, radians; `None` if it is too short.
fn pitch(places: &[(f64, DVec3)], ways: &[f64], i: usize) -> Option<f64> {
    let is_near = |j: usize| (places[j].0 - places[i].0).abs() <= PITCH_SECONDS;
    let (mut from, mut to) = (i, i);
    while (ways[to] - ways[from]).abs() < PITCH_METRES.end {
        let earlier = from.checked_sub(1).filter(|&j| is_near(j));
        let later = Some(to + 1).filter(|&j| j < places.len() && is_near(j));
        if earlier.is_none() && later.is_none() {
            break;
        }
        (from, to) = (earlier.unwrap_or(from), later.unwrap_or(to));
    }
    let (ways, places) = (&ways[from..=to], &places[from..=to]);
    let count = ways.len() as f64;
    let middle = ways.iter().sum::<f64>() / count;
    let height = places.iter().map(|(_, place)| place.z).sum::<f64>() / count;
    let along: f64 = ways.iter().map(|way| (way - middle).powi(2)).sum();
    let rise: f64 = ways.iter().zip(places).map(|(way, (_, place))| (way - middle) * (place.z - height)).sum();
    ((ways[ways.len() - 1] - ways[0]).abs() >= PITCH_METRES.start).then(|| (rise / along).atan())
}

/// From one heading to another, -π to π.
fn turn(from: f64, to: f64) -> f64 {
    (to - from).sin().atan2((to - from).cos())
}

/// Rotation and origin of the object at a position, on the road, in ground axes; and whether three corners of it found one.
fn laid_down(place: DVec3, heading: f64, pitch: Option<f64>, of: &Positions, road: &Surface) -> (DQuat, DVec3, bool) {
    let ahead = DVec2::from_angle(heading);
    // Slopes of the lower side ahead and to the left, and its height under the origin.
    let (mut along, mut across) = (pitch.unwrap_or(0.0).clamp(-MAX_TILT, MAX_TILT).tan(), 0.0);
    let (mut rotation, mut height, mut lies) = (tilted(ahead, along, across), place.z, false);
    for _ in 0..ROUNDS {
        let corners = [(of.low.x, of.low.y), (of.low.x, of.high.y), (of.high.x, of.low.y), (of.high.x, of.high.y)];
        let met = corners.iter().filter_map(|&(x, y)| {
            let corner = DVec3::new(place.x, place.y, height) + rotation * DVec3::new(x, y, of.low.z);
            let above = corner + REACH_METRES * DVec3::Z;
            let found = road.height_below(above, 2.0 * REACH_METRES)?;
            // Where it lies in the axes of the heading.
            let off = corner.truncate() - place.truncate();
            Some((DVec3::new(off.dot(ahead), off.dot(ahead.perp()), found), found - corner.z))
        });
        let met = without_the_odd_one(met.collect());
        let plane = plane(&met).filter(|(_, x, y)| {
            let is_as_steep = pitch.is_none_or(|pitch| (x.atan() - pitch).abs() < OFF_PITCH);
            is_as_steep && x.atan().abs() < MAX_TILT && y.atan().abs() < MAX_ROLL
        });
        lies = plane.is_some();
        match plane {
            Some((base, x, y)) => {
                (along, across) = (x, y);
                rotation = tilted(ahead, along, across);
                // The lower side's middle lies on the plane.
                let middle = rotation * DVec3::new(0.0, 0.0, of.low.z);
                let off = middle.truncate();
                height = base + along * off.dot(ahead) + across * off.dot(ahead.perp()) - middle.z;
            }
            None if met.is_empty() => break,
            None => height += met.iter().map(|(_, off)| off).sum::<f64>() / met.len() as f64,
        }
    }
    (rotation, DVec3::new(place.x, place.y, height), lies)
}

/// The rotation whose x looks ahead and whose lower side has these slopes ahead and to the left.
fn tilted(ahead: DVec2, along: f64, across: f64) -> DQuat {
    let x = ahead.extend(along).normalize();
    let z = x.cross(ahead.perp().extend(across)).normalize();
    DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z)).normalize()
}

/// Leaves out the corner whose height differs most from the others', if by much.
fn without_the_odd_one(mut met: Vec<(DVec3, f64)>) -> Vec<(DVec3, f64)> {
    let mut offs: Vec<f64> = met.iter().map(|(_, off)| *off).collect();
    offs.sort_by(f64::total_cmp);
    let Some(&median) = offs.get(offs.len() / 2) else { return met };
    let lower = offs[(offs.len() - 1) / 2];
    let middle = 0.5 * (median + lower);
    met.retain(|(_, off)| (off - middle).abs() <= OFF_METRES);
    met
}

/// The plane z = base + x·along + y·across that fits best; `None` for fewer than three places.
fn plane(met: &[(DVec3, f64)]) -> Option<(f64, f64, f64)> {
    if met.len() < 3 {
        return None;
    }
    let (mut matrix, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for (place, _) in met {
        let row = DVec3::new(1.0, place.x, place.y);
        matrix += DMat3::from_cols(row * row.x, row * row.y, row * row.z);
        right += row * place.z;
    }
    let found = matrix.inverse() * right;
    (matrix.determinant().abs() > 1e-9 && found.is_finite()).then_some((found.x, found.y, found.z))
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use scene::{Splat, Splats};

    use super::*;
    use crate::random::uniform;

    /// A road that rises by `slope` ahead (x) and by `crossfall` to the left, with a kerb of `kerb` metres beyond y = 3.
    fn road(slope: f32, crossfall: f32, kerb: f32) -> Surface {
        let mut splats = Splats::new(0);
        for i in 0..120 * 24u32 {
            let (x, y) = (0.5 * (i % 120) as f32 - 5.0, 0.5 * (i / 120) as f32 - 6.0);
            let z = slope * x + crossfall * y + if y > 3.0 { kerb } else { 0.0 };
            let mut splat = Splat::round(Vec3::new(x, y, z), 0.3f32.ln(), Vec3::splat(0.5), 0.95);
            splat.log_scale.z = 0.01f32.ln();
            splats.push(&splat);
        }
        Surface::new(&splats, DQuat::IDENTITY, |_| true)
    }

    const LOW: DVec3 = DVec3::new(-2.0, -0.9, 0.0);
    const HIGH: DVec3 = DVec3::new(2.0, 0.9, 1.5);

    fn angle(a: DQuat, b: DQuat) -> f64 {
        a.angle_between(b).to_degrees()
    }

    #[test]
    fn a_car_lies_on_a_slope_with_crossfall_whatever_its_height_was() {
        let (slope, crossfall) = (0.12f32, 0.05f32);
        let surface = road(slope, crossfall, 0.0);
        let at = |i: u32, noise: f64| {
            let t = 0.2 * f64::from(i);
            let off = |k| noise * (f64::from(uniform(3, u64::from(3 * i + k))) - 0.5);
            (t, DVec3::new(2.0 * t, off(0), f64::from(slope) * 2.0 * t + 4.0 * off(1)))
        };
        for noise in [0.0, 0.1] {
            let places: Vec<(f64, DVec3)> = (0..50).filter(|i| !(20..24).contains(i)).map(|i| at(i, noise)).collect();
            let RoadPoses { path, on_road } =
                road_poses(&Positions { places: &places, low: LOW, high: HIGH, first: None }, &surface);
            assert_eq!((path.len(), on_road), (50, 50), "the gap is filled");
            let z = DVec3::new(-f64::from(slope), -f64::from(crossfall), 1.0).normalize();
            let x = DVec3::new(1.0, 0.0, f64::from(slope)).normalize();
            let truth = DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z));
            for pose in &path {
                let Rigid { rotation, translation } = pose.world_from_object;
                let height = translation.z - (f64::from(slope) * translation.x + f64::from(crossfall) * translation.y);
                let off = angle(rotation, truth);
                assert!(off < if noise > 0.0 { 6.0 } else { 1.0 } && height.abs() < 0.05, "{off} degrees, {height} m");
            }
        }
    }

    #[test]
    fn a_car_heads_where_it_turns_and_climbs_as_its_way_does() {
        // A quarter of a circle of 6 m between straight ways, uphill; heights are off by up to half a metre, and no road is known.
        let nowhere = Surface::new(&Splats::new(0), DQuat::IDENTITY, |_| true);
        let (radius, slope) = (6.0, 0.08);
        let arc = radius * std::f64::consts::FRAC_PI_2;
        let at = |gone: f64| match gone - 20.0 {
            on if on < 0.0 => (DVec2::new(on, 0.0), 0.0),
            on if on < arc => {
                let turned = on / radius;
                (radius * DVec2::new(turned.sin(), 1.0 - turned.cos()), turned)
            }
            on => (DVec2::new(radius, radius + on - arc), std::f64::consts::FRAC_PI_2),
        };
        let of = |i: u32| 1.2 * f64::from(i);
        let off = |i: u32, k: u32| f64::from(uniform(5, u64::from(3 * i + k))) - 0.5;
        let place = |i: u32| {
            let noise = 0.1 * DVec2::new(off(i, 0), off(i, 1));
            (0.4 * f64::from(i), (at(of(i)).0 + noise).extend(slope * of(i) + off(i, 2)))
        };
        // Also from the middle of the turn on.
        for from in [0, 19] {
            let places: Vec<(f64, DVec3)> = (from..40).filter(|i| i % 7 != 3).map(place).collect();
            let of_path = Positions { places: &places, low: LOW, high: HIGH, first: None };
            for pose in road_poses(&of_path, &nowhere).path {
                let ahead = pose.world_from_object.rotation * DVec3::X;
                let (_, heading) = at(3.0 * pose.seconds);
                let off = turn(heading, ahead.y.atan2(ahead.x)).to_degrees();
                let pitch = (ahead.z.asin() - slope.atan()).to_degrees();
                assert!(off.abs() < 12.0 && pitch.abs() < 5.0, "{from}, {}: {off} {pitch}", pose.seconds);
            }
        }
    }

    #[test]
    fn many_positions_a_second_do_not_make_a_hill_flatter() {
        // Fifty a second, each 0.1 m off: their steps together are several times the way. It waits from 4 to 8 s.
        let nowhere = Surface::new(&Splats::new(0), DQuat::IDENTITY, |_| true);
        let slope: f64 = 0.1;
        let off = |i: u32, k: u32| f64::from(uniform(6, u64::from(3 * i + k))) - 0.5;
        let place = |i: u32| {
            let seconds = 0.02 * f64::from(i);
            let gone = 5.0 * (seconds.min(4.0) + (seconds - 8.0).max(0.0));
            let noise = 0.2 * DVec3::new(off(i, 0), off(i, 1), off(i, 2));
            (seconds, DVec3::new(gone, 0.0, slope * gone) + noise)
        };
        let places: Vec<(f64, DVec3)> = (0..600).map(place).collect();
        let of_path = Positions { places: &places, low: LOW, high: HIGH, first: None };
        for pose in road_poses(&of_path, &nowhere).path {
            let pitch = (pose.world_from_object.rotation * DVec3::X).z.asin() - slope.atan();
            assert!(pitch.to_degrees().abs() < 2.0, "{}: {}", pose.seconds, pitch.to_degrees());
        }
    }

    #[test]
    fn wheels_on_a_kerb_tilt_the_car() {
        let surface = road(0.0, 0.0, 0.15);
        let places: Vec<(f64, DVec3)> =
            (0..20).map(|i| (0.2 * f64::from(i), DVec3::new(f64::from(i), 3.0, 0.0))).collect();
        let RoadPoses { path, .. } =
            road_poses(&Positions { places: &places, low: LOW, high: HIGH, first: None }, &surface);
        let left = path[10].world_from_object.rotation * DVec3::Y;
        let roll = left.z.asin().to_degrees();
        // 0.15 m over 1.8 m.
        assert!((roll - 4.8).abs() < 0.7, "{roll}");
    }

    #[test]
    fn a_car_that_stands_keeps_its_heading_and_may_reverse() {
        let surface = road(0.0, 0.0, 0.0);
        let x = |i: u32| {
            if i < 10 {
                f64::from(i)
            } else if i < 40 {
                10.0
            } else {
                10.0 - 0.5 * f64::from(i - 40)
            }
        };
        let places: Vec<(f64, DVec3)> = (0..60).map(|i| (0.2 * f64::from(i), DVec3::new(x(i), 0.0, 0.0))).collect();
        let heading = |first: Option<DQuat>| -> Vec<f64> {
            let RoadPoses { path, .. } =
                road_poses(&Positions { places: &places, low: LOW, high: HIGH, first }, &surface);
            path.iter().map(|pose| pose.world_from_object.rotation * DVec3::X).map(|a| a.y.atan2(a.x).abs()).collect()
        };
        assert!(heading(None).iter().all(|turn| *turn < 1e-6));
        let backwards = heading(Some(DQuat::from_rotation_z(std::f64::consts::PI)));
        assert!(backwards.iter().all(|turn| *turn > 3.1), "{backwards:?}");
    }

    #[test]
    fn without_a_road_positions_and_displacements_are_kept() {
        let surface = Surface::new(&Splats::new(0), DQuat::from_rotation_x(0.3), |_| true);
        let up = DQuat::from_rotation_x(-0.3) * DVec3::Z;
        let places: Vec<(f64, DVec3)> =
            (0..9).map(|i| (f64::from(i), (DVec3::X + 0.1 * up) * f64::from(2 * i))).collect();
        let RoadPoses { path, on_road } =
            road_poses(&Positions { places: &places, low: LOW, high: HIGH, first: None }, &surface);
        assert_eq!(on_road, 0);
        for (pose, (seconds, place)) in path.iter().zip(&places) {
            let Rigid { rotation, translation } = pose.world_from_object;
            assert!(pose.seconds == *seconds && translation.distance(*place) < 1e-9);
            assert!((rotation * DVec3::X).distance((DVec3::X + 0.1 * up).normalize()) < 1e-6);
        }
        let one = [(3.0, DVec3::ONE)];
        for (places, count) in [(&one[..], 1), (&[], 0)] {
            let RoadPoses { path, .. } = road_poses(&Positions { places, low: LOW, high: HIGH, first: None }, &surface);
            assert!(path.len() == count && path.iter().all(|pose| pose.world_from_object.is_sane()));
        }
        // Positions at one time, of which only one is right.
        let same = [(1.0, DVec3::ZERO), (1.0 + 1e-9, DVec3::X), (9.0, DVec3::Y)];
        let RoadPoses { path, .. } =
            road_poses(&Positions { places: &same, low: LOW, high: HIGH, first: None }, &surface);
        assert!(path.iter().all(|pose| pose.world_from_object.is_sane()));
    }
}
