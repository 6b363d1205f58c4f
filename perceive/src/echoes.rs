//! What moves in the sweeps of a radar, from velocities alone: detections whose radial velocity is not that of the sensor's own motion
//! (Street Detection Gaussians, section 3.4).
//!
//! Neighbours of like velocity are a sighting, whose velocity the filter of a track knows from then on. A single detection may be a
//! reflection by two surfaces.

use glam::DVec3;

use crate::moving_points::GroundHeights;
use crate::tracking::{Kind, Place, Radial, Sighting};

/// Echoes of one object lie this near to another, metres, and go away as fast, metres per second: wheels and turning cars differ within.
const APART_METRES: f64 = 2.0;
const APART_SPEED: f64 = 1.0;
const LEAST_ECHOES: usize = 2;
/// Echoes of a sweep that are looked at, the first ones: a radar of a car gives some hundred detections.
const MAX_ECHOES: usize = 1000;
/// No person and no bicycle goes as fast, metres per second.
const VEHICLE_SPEED: f64 = 9.0;
/// 1σ of where echoes say that an object is: along the ray, as they are of its near side, and across it, metres and radians.
const ALONG_METRES: f64 = 0.8;
const ACROSS_METRES: f64 = 0.4;
const ACROSS_RADIANS: f64 = 0.012;
/// 1σ of its radial velocity, metres per second.
const SPEED: f64 = 0.3;
/// A sighting that is this near was seen by the radar too, metres.
const SAME_METRES: f64 = 3.0;
/// Elevation is not measured: points of an echo are at these heights above the ground, metres, as those of a car are.
const HEIGHTS: [f64; 2] = [0.2, 1.3];
/// Height of a radar above the ground, where that is not known, metres.
const SENSOR_METRES: f64 = 0.6;

/// A detection that moves, in ground axes (z up).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Echo {
    /// Where it is, at the height of the sensor, metres.
    pub place: DVec3,
    /// Where the sensor was.
    pub sensor: DVec3,
    /// Its velocity over ground away from the sensor, metres per second.
    pub speed: f64,
}

/// Adds what a radar saw moving at one time to what was seen by others at it: those get their velocities.
pub fn add_echoes(seen: &mut Vec<Sighting>, echoes: &[Echo], ground: &GroundHeights) {
    let others = seen.len();
    for cluster in clusters(&echoes[..echoes.len().min(MAX_ECHOES)]) {
        let Some(new) = sighting(&cluster, ground) else { continue };
        let near = seen[..others].iter_mut().map(|of| (of.middle().distance(new.middle()), of));
        match near.filter(|(metres, _)| *metres <= SAME_METRES).min_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((_, of)) => {
                of.moves = true;
                of.place.radial = new.place.radial;
                of.kind = of.kind.or(new.kind);
            }
            None => seen.push(new),
        }
    }
}

/// Echoes that are joined by neighbours, in the order of their first ones.
fn clusters(echoes: &[Echo]) -> Vec<Vec<Echo>> {
    let mut left: Vec<Echo> =
        echoes.iter().copied().filter(|of| of.place.is_finite() && of.speed.is_finite()).collect();
    let mut found = Vec::new();
    while !left.is_empty() {
        let mut cluster = vec![left.remove(0)];
        let mut done = 0;
        while let Some(&of) = cluster.get(done) {
            done += 1;
            let is_beside = |other: &Echo| {
                let apart = other.place.truncate().distance(of.place.truncate());
                apart <= APART_METRES && (other.speed - of.speed).abs() <= APART_SPEED
            };
            let (beside, rest): (Vec<Echo>, Vec<Echo>) = left.into_iter().partition(is_beside);
            (left, cluster) = (rest, [cluster, beside].concat());
        }
        found.push(cluster);
    }
    found
}

fn sighting(cluster: &[Echo], ground: &GroundHeights) -> Option<Sighting> {
    if cluster.len() < LEAST_ECHOES {
        return None;
    }
    let mut speeds: Vec<f64> = cluster.iter().map(|of| of.speed).collect();
    speeds.sort_by(f64::total_cmp);
    let (sensor, speed) = (cluster[0].sensor, speeds[speeds.len() / 2]);
    let middle = cluster.iter().map(|of| of.place.truncate()).sum::<glam::DVec2>() / cluster.len() as f64;
    let off = middle - sensor.truncate();
    let away = off.try_normalize()?;
    let across = ACROSS_METRES.hypot(ACROSS_RADIANS * off.length());
    let floor = ground.height(middle).unwrap_or(sensor.z - SENSOR_METRES);
    let points = |of: &Echo| HEIGHTS.map(|height| of.place.with_z(floor + height));
    Some(Sighting {
        place: Place {
            radial: Some(Radial { away, speed, sigma: SPEED }),
            ..Place::along(middle, away, [ALONG_METRES, across])
        },
        points: cluster.iter().flat_map(points).collect(),
        sensor: sensor.truncate(),
        ground: floor,
        moves: true,
        kind: (speed.abs() > VEHICLE_SPEED).then_some(Kind::Car),
    })
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;

    fn echo(x: f64, y: f64, speed: f64) -> Echo {
        Echo { place: DVec3::new(x, y, 0.6), sensor: DVec3::new(0.0, 0.0, 0.6), speed }
    }

    #[test]
    fn neighbours_of_like_velocity_are_an_object() {
        let car = [echo(20.0, 1.0, 10.0), echo(20.2, 2.4, 10.3), echo(21.9, 2.5, 10.1)];
        // A ghost, and someone who passes the car.
        let others = [echo(40.0, 2.0, 20.0), echo(20.5, 1.5, -4.0), echo(21.0, 1.7, -4.2)];
        let mut seen = Vec::new();
        let ground = GroundHeights::new(1.0);
        add_echoes(&mut seen, &[car.to_vec(), others.to_vec()].concat(), &ground);
        assert_eq!(seen.len(), 2);
        let [car, other] = &seen[..] else { unreachable!() };
        assert!(car.middle().distance(DVec2::new(20.7, 1.967)) < 0.01 && car.ground.abs() < 1e-9, "{car:?}");
        let radial = car.place.radial.unwrap();
        assert!(radial.speed == 10.1 && radial.away.y > 0.08 && (radial.away.length() - 1.0).abs() < 1e-9);
        assert_eq!((car.kind, other.kind, car.points.len(), other.points.len()), (Some(Kind::Car), None, 6, 4));
        assert!(car.moves && car.place.variance() < 1.0);
        // Seen by a lidar too: it keeps its place, and learns its velocity.
        let mut known = vec![Sighting { place: Place::around(DVec2::new(22.0, 2.0), 0.3), ..other.clone() }];
        known[0].place.radial = None;
        add_echoes(&mut known, &[echo(20.0, 1.0, 10.0), echo(20.2, 2.4, 10.3)], &ground);
        assert_eq!((known.len(), known[0].middle()), (1, DVec2::new(22.0, 2.0)));
        assert_eq!(known[0].place.radial.map(|radial| radial.speed), Some(10.3));
        add_echoes(&mut seen, &[echo(f64::NAN, 0.0, 1.0), echo(1.0, 0.0, f64::INFINITY)], &ground);
        assert_eq!(seen.len(), 2);
    }
}
