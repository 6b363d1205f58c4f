//! What GPS and an inertial unit say along a path, and how far off the poses are that are reported.
//!
//! A GPS error is a slow wander (a Gauss-Markov process, Gelb 1974) and white noise. Gyro and accelerometer have a
//! bias that walks and white noise (the usual model, Woodman 2007); the accelerometer feels what holds the car up.

use glam::{DQuat, DVec3};
use scene::{Camera, Rigid};
use serde::{Deserialize, Serialize};

use super::{SenseError, Shot, check_count, check_range, survey::catmull_rom};
use crate::{
    Waypoint,
    random::{Random, bits},
};

/// Metres per second squared, down.
pub const GRAVITY: f64 = 9.806_65;

/// Errors of GPS, of a unit's make and how often it is read.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Inertial {
    /// Readings of gyro and accelerometer a second.
    pub rate: f64,
    /// Every how manyth reading has a GPS fix.
    pub fix_every: u32,
    /// The wander's spread, metres (1σ); up it is twice that.
    pub wander_metres: f64,
    /// Seconds in which the wander forgets.
    pub wander_seconds: f64,
    /// White noise of a fix, metres (1σ); up it is twice that.
    pub fix_noise_metres: f64,
    /// White noise of reported headings and tilts, degrees (1σ).
    pub attitude_noise_degrees: f64,
    /// White noise of the gyro, rad/s (1σ of a reading).
    pub gyro_noise: f64,
    /// Spread of the gyro's bias at the start, rad/s.
    pub gyro_bias: f64,
    /// White noise of the accelerometer, m/s² (1σ of a reading).
    pub accelerometer_noise: f64,
    /// Spread of the accelerometer's bias at the start, m/s².
    pub accelerometer_bias: f64,
    /// Share of its spread that a bias walks in a second (1σ).
    pub bias_walk: f64,
    /// Of all of it.
    pub seed: u64,
}

impl Default for Inertial {
    /// A unit for cars and GPS with corrections.
    fn default() -> Self {
        Self {
            rate: 100.0,
            fix_every: 100,
            wander_metres: 0.3,
            wander_seconds: 60.0,
            fix_noise_metres: 0.03,
            attitude_noise_degrees: 0.1,
            gyro_noise: 2e-3,
            gyro_bias: 5e-4,
            accelerometer_noise: 2e-2,
            accelerometer_bias: 1e-2,
            bias_walk: 0.02,
            seed: 1,
        }
    }
}

/// A reading and its truth. Gyro and accelerometer are in the body's axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// The city's clock.
    pub seconds: f64,
    /// Truth: the pose.
    pub world_from_body: Rigid,
    /// Truth: world metres per second.
    pub velocity: DVec3,
    /// Truth: turning, rad/s.
    pub true_gyro: DVec3,
    /// Truth: what an accelerometer without errors feels, m/s²: at rest [`GRAVITY`] up.
    pub true_accelerometer: DVec3,
    /// Truth: the gyro's bias.
    pub gyro_bias: DVec3,
    /// Truth: the accelerometer's bias.
    pub accelerometer_bias: DVec3,
    /// Reading: rad/s.
    pub gyro: DVec3,
    /// Reading: m/s².
    pub accelerometer: DVec3,
    /// Reading: world metres, where there was a fix.
    pub fix: Option<DVec3>,
}

impl Inertial {
    /// # Errors
    /// [`SenseError`] for settings that cannot be.
    pub fn check(&self) -> Result<(), SenseError> {
        check_range("rate", self.rate, 0.1, 1e4)?;
        check_range("fix_every", f64::from(self.fix_every), 1.0, 1e9)?;
        check_range("wander_seconds", self.wander_seconds, 1e-3, 1e9)?;
        let spreads = [
            ("wander_metres", self.wander_metres),
            ("fix_noise_metres", self.fix_noise_metres),
            ("attitude_noise_degrees", self.attitude_noise_degrees),
            ("gyro_noise", self.gyro_noise),
            ("gyro_bias", self.gyro_bias),
            ("accelerometer_noise", self.accelerometer_noise),
            ("accelerometer_bias", self.accelerometer_bias),
            ("bias_walk", self.bias_walk),
        ];
        spreads.iter().try_for_each(|(name, spread)| check_range(name, *spread, 0.0, 1e4).map(|_| ()))
    }

    /// Readings along a path that is passed smoothly.
    ///
    /// # Errors
    /// [`SenseError`] for settings or a path that cannot be, or more readings than a list may hold.
    pub fn readings(&self, path: &[Waypoint]) -> Result<Vec<Reading>, SenseError> {
        self.check()?;
        let sane = path.iter().all(|w| w.seconds.is_finite() && w.world_from_asset.is_sane());
        if !sane || path.windows(2).any(|pair| pair[0].seconds >= pair[1].seconds) {
            return Err(SenseError::Setting("the path"));
        }
        let (Some(first), Some(last)) = (path.first(), path.last()) else { return Ok(Vec::new()) };
        let readings = check_count((last.seconds - first.seconds) * self.rate + 1.0)?;
        let wander = self.wander(first.seconds, last.seconds)?;
        let mut random = Random::new(self.seed).fork(23);
        let (mut gyro_bias, mut accelerometer_bias) =
            (normal(&mut random) * self.gyro_bias, normal(&mut random) * self.accelerometer_bias);
        let walk = self.bias_walk / self.rate.sqrt();
        let mut all = Vec::with_capacity(readings);
        for i in 0..readings {
            let seconds = first.seconds + i as f64 / self.rate;
            let Some(truth) = state(path, seconds, 0.5 / self.rate) else { break };
            let fix = (i as u64).is_multiple_of(u64::from(self.fix_every)).then(|| {
                truth.world_from_body.translation
                    + wander.at(seconds)
                    + normal(&mut random) * upright(self.fix_noise_metres)
            });
            all.push(Reading {
                gyro_bias,
                accelerometer_bias,
                gyro: truth.true_gyro + gyro_bias + normal(&mut random) * self.gyro_noise,
                accelerometer: truth.true_accelerometer
                    + accelerometer_bias
                    + normal(&mut random) * self.accelerometer_noise,
                fix,
                ..truth
            });
            gyro_bias += normal(&mut random) * self.gyro_bias * walk;
            accelerometer_bias += normal(&mut random) * self.accelerometer_bias * walk;
        }
        Ok(all)
    }

    /// Reports shots as GPS and attitude would: all shots of a moment are off by the same, as cameras on one car are.
    ///
    /// # Errors
    /// [`SenseError`] for settings that cannot be, or shots over more time than can be walked through.
    pub fn report(&self, mut shots: Vec<Shot>) -> Result<Vec<Shot>, SenseError> {
        self.check()?;
        let times = || shots.iter().map(|s| s.seconds).filter(|s| s.is_finite());
        let (first, last) = (times().fold(f64::INFINITY, f64::min), times().fold(f64::NEG_INFINITY, f64::max));
        if first > last {
            return Ok(shots);
        }
        let wander = self.wander(first, last)?;
        for shot in &mut shots {
            let mut random = Random::new(bits(self.seed, shot.seconds.to_bits())).fork(29);
            let shift = wander.at(shot.seconds) + normal(&mut random) * upright(self.fix_noise_metres);
            let turn = DQuat::from_scaled_axis(normal(&mut random) * self.attitude_noise_degrees.to_radians());
            let pose = shot.reported.camera_from_world.inverse();
            let off = Rigid { rotation: (turn * pose.rotation).normalize(), translation: pose.translation + shift };
            shot.reported = Camera { camera_from_world: off.inverse(), ..shot.reported };
        }
        Ok(shots)
    }

    /// The slow part of the GPS error: a knot each second.
    fn wander(&self, from: f64, to: f64) -> Result<Wander, SenseError> {
        let knots = check_count(to - from + 2.0)?;
        let mut random = Random::new(self.seed).fork(31);
        let keep = (-1.0 / self.wander_seconds).exp();
        let spread = upright(self.wander_metres);
        let mut knot = normal(&mut random) * spread;
        let mut all = Vec::with_capacity(knots);
        for _ in 0..knots {
            all.push(knot);
            knot = knot * keep + normal(&mut random) * spread * (1.0 - keep * keep).sqrt();
        }
        Ok(Wander { from, knots: all })
    }
}

struct Wander {
    from: f64,
    knots: Vec<DVec3>,
}

impl Wander {
    fn at(&self, seconds: f64) -> DVec3 {
        let way = (seconds - self.from).max(0.0);
        let (i, last) = (way as usize, self.knots.len() - 1);
        self.knots[i.min(last)].lerp(self.knots[(i + 1).min(last)], way.fract())
    }
}

/// Up, GPS is twice as far off.
fn upright(spread: f64) -> DVec3 {
    DVec3::new(spread, spread, 2.0 * spread)
}

fn normal(random: &mut Random) -> DVec3 {
    DVec3::new(f64::from(random.normal()), f64::from(random.normal()), f64::from(random.normal()))
}

/// Truth at a moment, from differences over `step` seconds to both sides.
fn state(path: &[Waypoint], seconds: f64, step: f64) -> Option<Reading> {
    let (before, here, after) =
        (catmull_rom(path, seconds - step)?, catmull_rom(path, seconds)?, catmull_rom(path, seconds + step)?);
    let velocity = (after.translation - before.translation) / (2.0 * step);
    let acceleration = (after.translation - 2.0 * here.translation + before.translation) / (step * step);
    let turn = (before.rotation.inverse() * after.rotation).normalize();
    let turn = if turn.w < 0.0 { -turn } else { turn };
    Some(Reading {
        seconds,
        world_from_body: here,
        velocity,
        true_gyro: turn.to_scaled_axis() / (2.0 * step),
        true_accelerometer: here.rotation.inverse() * (acceleration + DVec3::Z * GRAVITY),
        gyro_bias: DVec3::ZERO,
        accelerometer_bias: DVec3::ZERO,
        gyro: DVec3::ZERO,
        accelerometer: DVec3::ZERO,
        fix: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{sense::rig, test_scene};

    /// A circle of 20 m at 10 m/s.
    fn circle() -> Vec<Waypoint> {
        let at = |i: i32| {
            let (seconds, angle) = (f64::from(i) * 0.1, f64::from(i) * 0.05);
            let translation = DVec3::new(angle.cos(), angle.sin(), 0.0) * 20.0;
            let heading = DQuat::from_rotation_z(angle + std::f64::consts::FRAC_PI_2);
            Waypoint { seconds, world_from_asset: Rigid { rotation: heading, translation } }
        };
        (0..200).map(at).collect()
    }

    #[test]
    fn a_circle_turns_and_pulls_inwards() {
        let readings = Inertial::default().readings(&circle()).unwrap();
        assert_eq!(readings.len(), 1991);
        let inner = &readings[100..1800];
        let mean = |of: fn(&Reading) -> DVec3| inner.iter().map(of).sum::<DVec3>() / inner.len() as f64;
        assert!((mean(|r| r.true_gyro) - DVec3::Z * 0.5).length() < 1e-3, "{}", mean(|r| r.true_gyro));
        let felt = mean(|r| r.true_accelerometer);
        assert!((felt - DVec3::new(0.0, 5.0, GRAVITY)).length() < 0.02, "{felt}");
        assert!(inner.iter().all(|r| (r.velocity.length() - 10.0).abs() < 0.05));
        let noise =
            inner.iter().map(|r| (r.gyro - r.true_gyro - r.gyro_bias).x.powi(2)).sum::<f64>() / inner.len() as f64;
        assert!((noise.sqrt() - 2e-3).abs() < 2e-4, "{}", noise.sqrt());
        let fixes: Vec<&Reading> = readings.iter().filter(|r| r.fix.is_some()).collect();
        assert_eq!(fixes.len(), 20);
        assert!(fixes.iter().all(|r| (r.fix.unwrap() - r.world_from_body.translation).length() < 4.0));
        assert!(fixes.iter().any(|r| (r.fix.unwrap() - r.world_from_body.translation).length() > 0.01));
    }

    #[test]
    fn cameras_of_one_moment_are_off_by_the_same() {
        let shots = rig::drive(&test_scene::city(), &rig::Rig::default()).unwrap();
        let reported = Inertial::default().report(shots.clone()).unwrap();
        let off = |i: usize| reported[i].reported.centre() - reported[i].camera.centre();
        assert!((off(0) - off(5)).length() < 1e-9 && off(0).length() > 1e-3 && (off(0) - off(60)).length() > 1e-4);
        let none =
            Inertial { wander_metres: 0.0, fix_noise_metres: 0.0, attitude_noise_degrees: 0.0, ..Inertial::default() };
        let exact = none.report(shots).unwrap();
        assert!(exact.iter().all(|s| (s.reported.centre() - s.camera.centre()).length() < 1e-9));
        assert!(Inertial { rate: 0.0, ..Inertial::default() }.check().is_err());
    }
}
