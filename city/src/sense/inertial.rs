//! GPS and IMU readings along a path, and the errors of reported poses.
//!
//! The GPS error is a first-order Gauss–Markov process (Gelb 1974) plus white noise. Gyro and accelerometer have a
//! random-walk bias plus white noise (Woodman 2007); the accelerometer measures specific force, including gravity.

use glam::{DQuat, DVec3};
use scene::{Camera, Rigid};
use serde::{Deserialize, Serialize};

use super::{SenseError, Shot, check_count, check_range, survey::catmull_rom};
use crate::{
    Waypoint,
    random::{Random, bits},
};

/// Standard gravity, metres per second squared.
pub const GRAVITY: f64 = 9.806_65;

/// Rates and error models of GPS and IMU.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Inertial {
    /// IMU readings per second.
    pub rate: f64,
    /// IMU readings per GPS fix.
    pub fix_every: u32,
    /// Gauss–Markov GPS error, metres (1σ); twice that vertically.
    pub wander_metres: f64,
    /// Correlation time of the Gauss–Markov error, seconds.
    pub wander_seconds: f64,
    /// White noise of a fix, metres (1σ); twice that vertically.
    pub fix_noise_metres: f64,
    /// White noise of reported attitudes, degrees (1σ).
    pub attitude_noise_degrees: f64,
    /// White noise of the gyro, rad/s (1σ per reading).
    pub gyro_noise: f64,
    /// Initial gyro bias, rad/s (1σ).
    pub gyro_bias: f64,
    /// White noise of the accelerometer, m/s² (1σ per reading).
    pub accelerometer_noise: f64,
    /// Initial accelerometer bias, m/s² (1σ).
    pub accelerometer_bias: f64,
    /// Random walk of a bias per √s, as a share of its initial spread (1σ).
    pub bias_walk: f64,
    /// Seed of all errors.
    pub seed: u64,
}

impl Default for Inertial {
    /// An automotive IMU, and GPS with corrections.
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

/// A reading and its ground truth. Gyro and accelerometer are in body axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// City time, seconds.
    pub seconds: f64,
    /// Ground truth: the pose.
    pub world_from_body: Rigid,
    /// Ground truth: velocity, world metres per second.
    pub velocity: DVec3,
    /// Ground truth: angular velocity, rad/s.
    pub true_gyro: DVec3,
    /// Ground truth: specific force, m/s²; at rest [`GRAVITY`] upwards.
    pub true_accelerometer: DVec3,
    /// Ground truth: the gyro's bias.
    pub gyro_bias: DVec3,
    /// Ground truth: the accelerometer's bias.
    pub accelerometer_bias: DVec3,
    /// Measured: angular velocity, rad/s.
    pub gyro: DVec3,
    /// Measured: specific force, m/s².
    pub accelerometer: DVec3,
    /// Measured: GPS position, world metres, for readings with a fix.
    pub fix: Option<DVec3>,
}

impl Inertial {
    /// # Errors
    /// [`SenseError`] for settings out of range.
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

    /// Readings along a path, interpolated by a Catmull–Rom spline.
    ///
    /// # Errors
    /// [`SenseError`] for settings or a path out of range, or more readings than [`super::MAX_READINGS`].
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

    /// Adds GPS and attitude errors to reported poses. Shots of the same time get the same error, as cameras on one car
    /// do.
    ///
    /// # Errors
    /// [`SenseError`] for settings out of range, or shots over too long a time.
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

    /// The Gauss–Markov part of the GPS error, one knot per second.
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

/// Standard deviations per axis: the vertical GPS error is twice the horizontal one.
fn upright(spread: f64) -> DVec3 {
    DVec3::new(spread, spread, 2.0 * spread)
}

fn normal(random: &mut Random) -> DVec3 {
    DVec3::new(f64::from(random.normal()), f64::from(random.normal()), f64::from(random.normal()))
}

/// Ground truth at a time, from central differences over ± `step` seconds.
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
    fn a_circle_has_constant_angular_velocity_and_centripetal_acceleration() {
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
    fn cameras_of_one_time_have_the_same_error() {
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
