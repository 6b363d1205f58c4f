//! The motion of one object along the ground: an extended Kalman filter with a constant turn rate, and its smoother.
//!
//! The state is x, y (metres), heading (radians), speed (metres per second) and turn rate (radians per second). Between two times
//! speed and turn rate stay, but for random accelerations (the model "CTRV" of Schubert et al. 2008). The smoother is that of Rauch,
//! Tung and Striebel with the filter's linearisations: what is known later corrects what was believed before.

use std::f64::consts::{PI, TAU};

use glam::DVec2;
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

type State = SVector<f64, 5>;
type Covariance = SMatrix<f64, 5, 5>;

/// Random accelerations, 1σ: along the heading (m/s²) and of the turn rate (rad/s²).
const ACCELERATION: f64 = 2.5;
const TURNING: f64 = 0.8;
/// What a step adds to every variance, so that no covariance is singular.
const FLOOR: f64 = 1e-6;
/// Below this turn rate a path is straight, radians per second.
const STRAIGHT: f64 = 1e-4;
/// No vehicle or person that moves turns faster, radians per second.
const MAX_TURN: f64 = 1.5;
/// 1σ of heading (radians), speed (m/s) and turn rate (rad/s) of an object that was seen twice.
const FIRST: [f64; 3] = [0.5, 3.0, 0.3];

/// How fast an object went away from a sensor that saw it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Radial {
    /// Direction from the sensor, of unit length.
    pub(crate) away: DVec2,
    /// Over ground, metres per second; negative towards the sensor.
    pub(crate) speed: f64,
    /// 1σ of that.
    pub(crate) sigma: f64,
}

/// Where an object was seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Place {
    /// Ground metres.
    pub(crate) middle: DVec2,
    /// Variances and covariance: xx, xy, yy, m².
    pub(crate) covariance: [f64; 3],
    /// Its velocity, if the sensor measures that.
    pub(crate) radial: Option<Radial>,
}

impl Place {
    /// As sure in all directions: 1σ in metres.
    pub(crate) fn around(middle: DVec2, sigma: f64) -> Self {
        Self { middle, covariance: [sigma * sigma, 0.0, sigma * sigma], radial: None }
    }

    /// 1σ along a direction of unit length, and across it, metres.
    pub(crate) fn along(middle: DVec2, ahead: DVec2, [along, across]: [f64; 2]) -> Self {
        let (a, b) = (along * along, across * across);
        let covariance = [
            a * ahead.x * ahead.x + b * ahead.y * ahead.y,
            (a - b) * ahead.x * ahead.y,
            a * ahead.y * ahead.y + b * ahead.x * ahead.x,
        ];
        Self { middle, covariance, radial: None }
    }

    /// The sum of the variances along both axes, m².
    pub(crate) fn variance(&self) -> f64 {
        self.covariance[0] + self.covariance[2]
    }
}

/// A state and its covariance.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Belief {
    mean: State,
    covariance: Covariance,
}

impl Belief {
    /// Of an object at the first of two places, between which `seconds` went by.
    pub(crate) fn between(first: &Place, second: &Place, seconds: f64) -> Self {
        let way = second.middle - first.middle;
        let speed = way.length() / seconds;
        let mean = State::new(first.middle.x, first.middle.y, way.y.atan2(way.x), speed, 0.0);
        let mut covariance = Covariance::zeros();
        let [xx, xy, yy] = first.covariance;
        (covariance[(0, 0)], covariance[(0, 1)], covariance[(1, 0)], covariance[(1, 1)]) = (xx, xy, xy, yy);
        let noise = (xx + yy + second.covariance[0] + second.covariance[2]).sqrt();
        // The direction of a way is as uncertain as its ends are, seen from each other.
        covariance[(2, 2)] = (noise / way.length().max(0.1)).clamp(FIRST[0], PI).powi(2);
        covariance[(3, 3)] = (noise / seconds).max(FIRST[1]).powi(2);
        covariance[(4, 4)] = FIRST[2].powi(2);
        Self { mean, covariance }
    }

    /// Ground metres.
    pub(crate) fn middle(&self) -> DVec2 {
        DVec2::new(self.mean[0], self.mean[1])
    }

    /// Metres per second, in the ground's axes.
    pub(crate) fn velocity(&self) -> DVec2 {
        DVec2::from_angle(self.mean[2]) * self.mean[3]
    }

    /// Some time later, and the derivative of that state by this one.
    fn later(&self, seconds: f64) -> (Self, Covariance) {
        let [x, y, heading, speed, turn] = self.mean.into();
        let (sin, cos) = heading.sin_cos();
        let t = seconds;
        let mut f = Covariance::identity();
        f[(2, 4)] = t;
        let ahead = if turn.abs() < STRAIGHT {
            (f[(0, 2)], f[(0, 3)], f[(0, 4)]) = (-speed * t * sin, t * cos, -0.5 * speed * t * t * sin);
            (f[(1, 2)], f[(1, 3)], f[(1, 4)]) = (speed * t * cos, t * sin, 0.5 * speed * t * t * cos);
            DVec2::new(speed * t * cos, speed * t * sin)
        } else {
            let (later_sin, later_cos) = (heading + turn * t).sin_cos();
            let (along, across) = ((later_sin - sin) / turn, (cos - later_cos) / turn);
            (f[(0, 2)], f[(0, 3)]) = (-speed * across, along);
            f[(0, 4)] = speed * (t * later_cos - along) / turn;
            (f[(1, 2)], f[(1, 3)]) = (speed * along, across);
            f[(1, 4)] = speed * (t * later_sin - across) / turn;
            DVec2::new(speed * along, speed * across)
        };
        let mut g = SMatrix::<f64, 5, 2>::zeros();
        (g[(0, 0)], g[(1, 0)], g[(3, 0)]) = (0.5 * t * t * cos, 0.5 * t * t * sin, t);
        (g[(2, 1)], g[(4, 1)]) = (0.5 * t * t, t);
        let noise = Matrix2::new(ACCELERATION * ACCELERATION, 0.0, 0.0, TURNING * TURNING);
        let mean = State::new(x + ahead.x, y + ahead.y, heading + turn * t, speed, turn);
        let covariance =
            f * self.covariance * f.transpose() + g * noise * g.transpose() + Covariance::identity() * FLOOR;
        (Self { mean, covariance }, f)
    }

    /// Where it will be some time later.
    pub(crate) fn predicted(&self, seconds: f64) -> Self {
        self.later(seconds).0
    }

    /// The difference of a place from the believed one, and the inverse of that difference's covariance.
    fn innovation(&self, place: &Place) -> Option<(Vector2<f64>, Matrix2<f64>)> {
        let [xx, xy, yy] = place.covariance;
        let own = self.covariance.fixed_view::<2, 2>(0, 0);
        let inverse = (own + Matrix2::new(xx, xy, xy, yy)).try_inverse()?;
        Some((Vector2::new(place.middle.x - self.mean[0], place.middle.y - self.mean[1]), inverse))
    }

    /// Squared distance of a place, in units of the standard deviation; infinite if that is unknown.
    pub(crate) fn distance(&self, place: &Place) -> f64 {
        let along = self.innovation(place).map_or(f64::INFINITY, |(off, inverse)| (off.transpose() * inverse * off)[0]);
        let radial = place.radial.map_or(0.0, |radial| {
            let (off, _, variance) = self.radial(&radial);
            off * off / variance
        });
        along + radial
    }

    /// How unlikely an object of this belief is to be seen at a place: twice the negative logarithm of its density, but for what is the same
    /// for all places. Unlike the distance, it does not favour beliefs of which little is known.
    pub(crate) fn surprise(&self, place: &Place) -> f64 {
        let spread = self.innovation(place).map_or(f64::INFINITY, |(_, inverse)| -inverse.determinant().ln());
        let radial = place.radial.map_or(0.0, |radial| self.radial(&radial).2.ln());
        self.distance(place) + spread + radial
    }

    /// The difference of a radial velocity from the believed one, its derivative by the state times the covariance, and the variance of
    /// that difference.
    fn radial(&self, seen: &Radial) -> (f64, State, f64) {
        let (sin, cos) = self.mean[2].sin_cos();
        let (along, across) = (seen.away.x * cos + seen.away.y * sin, seen.away.y * cos - seen.away.x * sin);
        let derivative = State::new(0.0, 0.0, self.mean[3] * across, along, 0.0);
        let shared = self.covariance * derivative;
        (seen.speed - self.mean[3] * along, shared, derivative.dot(&shared) + seen.sigma * seen.sigma)
    }

    /// After it was seen at a place.
    pub(crate) fn updated(&self, place: &Place) -> Self {
        let Some((off, inverse)) = self.innovation(place) else { return self.clone() };
        let gain = self.covariance.fixed_columns::<2>(0) * inverse;
        let mut mean = self.mean + gain * off;
        mean[4] = mean[4].clamp(-MAX_TURN, MAX_TURN);
        let covariance = self.covariance - gain * self.covariance.fixed_rows::<2>(0);
        let placed = Self { mean, covariance: 0.5 * (covariance + covariance.transpose()) };
        place.radial.map_or(placed.clone(), |radial| placed.going(&radial))
    }

    /// After its radial velocity was measured.
    fn going(&self, seen: &Radial) -> Self {
        let (off, shared, variance) = self.radial(seen);
        let mut mean = self.mean + shared * (off / variance);
        mean[4] = mean[4].clamp(-MAX_TURN, MAX_TURN);
        Self { mean, covariance: self.covariance - shared * shared.transpose() / variance }
    }
}

/// An object at a time: its middle, heading and speed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Motion {
    pub(crate) middle: DVec2,
    /// Radians, 0 along x, to the left is more; the direction of travel.
    pub(crate) heading: f64,
    /// Metres per second, never negative.
    pub(crate) speed: f64,
}

/// The most likely motion at each of these times (seconds, ascending), with where it was seen at them. `first` is the belief at the
/// first time, before it was seen then.
pub(crate) fn smoothed(first: &Belief, seen: &[(f64, Option<Place>)]) -> Vec<Motion> {
    let Some(&(mut at, _)) = seen.first() else { return Vec::new() };
    let (mut predicted, mut updated, mut steps) = (Vec::new(), Vec::new(), Vec::new());
    let mut belief = first.clone();
    for (seconds, place) in seen {
        let (before, derivative) = belief.later(seconds - at);
        at = *seconds;
        belief = place.map_or_else(|| before.clone(), |place| before.updated(&place));
        predicted.push(before);
        steps.push(derivative);
        updated.push(belief.clone());
    }
    for i in (0..updated.len().saturating_sub(1)).rev() {
        let (next, expected) = (&updated[i + 1], &predicted[i + 1]);
        let Some(inverse) = expected.covariance.try_inverse() else { continue };
        let gain = updated[i].covariance * steps[i + 1].transpose() * inverse;
        let mut off = next.mean - expected.mean;
        off[2] = (off[2] + PI).rem_euclid(TAU) - PI;
        let mean = updated[i].mean + gain * off;
        let covariance = updated[i].covariance + gain * (next.covariance - expected.covariance) * gain.transpose();
        updated[i] = Belief { mean, covariance };
    }
    let motion = |belief: &Belief| {
        let [x, y, heading, speed, _] = belief.mean.into();
        let heading = if speed < 0.0 { heading + PI } else { heading };
        Motion { middle: DVec2::new(x, y), heading: (heading + PI).rem_euclid(TAU) - PI, speed: speed.abs() }
    };
    updated.iter().map(motion).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(middle: DVec2, sigma: f64) -> Place {
        Place::around(middle, sigma)
    }

    /// On a circle of 20 m at 8 m/s.
    fn on_circle(seconds: f64) -> DVec2 {
        20.0 * DVec2::from_angle(0.4 * seconds)
    }

    fn noise(i: usize) -> DVec2 {
        let random = |k: u64| f64::from(scene::random::uniform(i as u64, k)) - 0.5;
        DVec2::new(random(0), random(1))
    }

    #[test]
    fn derivatives_are_those_of_the_prediction() {
        for turn in [0.0, 0.3, -1.2] {
            let at = Belief { mean: State::new(3.0, -2.0, 0.7, 8.0, turn), covariance: Covariance::identity() };
            let (later, derivative) = at.later(0.5);
            for k in 0..5 {
                let mut moved = at.clone();
                moved.mean[k] += 1e-3;
                let numeric = (moved.later(0.5).0.mean - later.mean) / 1e-3;
                assert!(
                    (numeric - derivative.column(k)).norm() < 1e-2,
                    "{turn} {k}: {numeric} {}",
                    derivative.column(k)
                );
            }
        }
    }

    #[test]
    fn a_turning_object_is_found_again_behind_what_hides_it() {
        let seen: Vec<(f64, Option<Place>)> = (0..40)
            .map(|i| {
                let seconds = 0.2 * f64::from(i);
                let is_hidden = (15..25).contains(&i);
                (seconds, (!is_hidden).then(|| place(on_circle(seconds) + 0.4 * noise(i as usize), 0.15)))
            })
            .collect();
        let first = Belief::between(&seen[0].1.unwrap(), &seen[1].1.unwrap(), 0.2);
        // Forwards alone, to the end of the gap.
        let (mut belief, mut at) = (first.clone(), 0.0);
        for (seconds, place) in &seen[..25] {
            belief = belief.predicted(seconds - at);
            at = *seconds;
            belief = place.map_or_else(|| belief.clone(), |place| belief.updated(&place));
        }
        let off = (belief.predicted(0.2).middle() - on_circle(5.0)).length();
        assert!(off < 3.0 && belief.predicted(0.2).distance(&place(on_circle(5.0), 0.15)) < 9.0, "{off}");
        let smooth = smoothed(&first, &seen);
        for (motion, (seconds, place)) in smooth.iter().zip(&seen) {
            let off = motion.middle.distance(on_circle(*seconds));
            assert!(off < if place.is_some() { 0.35 } else { 0.8 }, "{seconds}: {off}");
            let heading = 0.4 * seconds + 0.5 * PI;
            let turned = (motion.heading - heading + PI).rem_euclid(TAU) - PI;
            assert!(turned.abs() < 0.25 && (motion.speed - 8.0).abs() < 1.5, "{seconds}: {turned} {}", motion.speed);
        }
        let mean = |places: Vec<f64>| places.iter().sum::<f64>() / places.len() as f64;
        let raw = seen.iter().filter_map(|(at, place)| Some(place.as_ref()?.middle.distance(on_circle(*at))));
        let smooth = smooth.iter().zip(&seen).filter(|(_, seen)| seen.1.is_some());
        let after = mean(smooth.map(|(motion, (at, _))| motion.middle.distance(on_circle(*at))).collect());
        assert!(after < 0.7 * mean(raw.collect()), "smoothing takes noise away");
    }

    #[test]
    fn a_radial_velocity_makes_speed_and_heading_surer() {
        // Seen twice at nearly the same place: nothing is known of the velocity but what the radar says.
        let at = |x: f64| Place::along(DVec2::new(x, 0.0), DVec2::X, [0.8, 0.4]);
        let towards = |x: f64| Place { radial: Some(Radial { away: DVec2::X, speed: -9.0, sigma: 0.3 }), ..at(x) };
        let belief = Belief::between(&at(20.0), &at(19.4), 0.1).predicted(0.1);
        let blind = belief.updated(&at(19.4));
        let radar = belief.updated(&towards(19.4));
        let off = |of: &Belief| (of.velocity() - DVec2::new(-9.0, 0.0)).length();
        assert!(off(&radar) < 1.0 && off(&radar) < 0.5 * off(&blind), "{} {}", off(&radar), off(&blind));
        // What goes the other way at the same place is another object.
        let away = Place { radial: Some(Radial { away: DVec2::X, speed: 9.0, sigma: 0.3 }), ..at(18.5) };
        assert!(radar.predicted(0.1).distance(&towards(18.5)) < 12.0 && radar.predicted(0.1).distance(&away) > 12.0);
        // The derivative agrees with finite differences.
        let belief = Belief { mean: State::new(3.0, -2.0, 0.7, 8.0, 0.2), covariance: Covariance::identity() };
        let seen = Radial { away: DVec2::from_angle(2.1), speed: 1.5, sigma: 0.3 };
        let (off, shared, _) = belief.radial(&seen);
        for k in 0..5 {
            let mut moved = belief.clone();
            moved.mean[k] += 1e-5;
            let numeric = (off - moved.radial(&seen).0) / 1e-5;
            assert!((numeric - shared[k]).abs() < 1e-3, "{k}: {numeric} {}", shared[k]);
        }
    }

    #[test]
    fn what_is_seen_makes_beliefs_surer_and_time_less_sure() {
        let (a, b) = (place(DVec2::ZERO, 0.2), place(DVec2::new(2.0, 0.0), 0.2));
        let belief = Belief::between(&a, &b, 0.2);
        let later = belief.predicted(0.2);
        assert!(
            (later.middle() - b.middle).length() < 1e-9 && (later.velocity() - DVec2::new(10.0, 0.0)).length() < 1e-9
        );
        let far = place(DVec2::new(9.0, 0.0), 0.2);
        assert!(
            later.distance(&b) < later.distance(&far) && later.predicted(1.0).distance(&far) < later.distance(&far)
        );
        assert!(later.updated(&b).distance(&far) > later.distance(&far));
        assert!(smoothed(&belief, &[]).is_empty());
    }
}
