//! A spinning lidar, by default that of CarlaOcc (supplement 1.1: 32 channels from −30° to 10°, 80 m, 20 Hz, 250,000
//! firings per second).
//!
//! The received power is `P = ρ · cos θ · e^(−2αr) / r²`: the lidar equation for a diffuse surface larger than the beam
//! (Jelalian 1992; Wagner 2006), with reflectivity ρ, angle of incidence θ and extinction α. Intensity is `P · r²`,
//! calibrated for range as sensors report it (Material, appendix C). Pulses are lost at random where P is near the
//! noise floor; half of the pulses are lost on a surface of 10 % reflectivity at the maximum range. At glass the
//! stronger of two returns counts: the one of the glass and the one through it.

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use scene::Rigid;
use serde::{Deserialize, Serialize};

use super::{Motion, SenseError, check_count, check_range, rig, rig::Mount};
use crate::{
    Waypoint,
    faults::{self, Fault},
    random::{Random, bits},
    trace::{Hit, Light, Moment, Ray, RayMask, World, degrade::degrade_light},
};

/// Times within a sweep for which moving actors are placed.
const TIME_STEPS: usize = 8;
/// Reflectivity of a surface of which half of the returns are lost at the maximum range.
const THRESHOLD_REFLECTIVITY: f64 = 0.1;

/// Settings of a lidar.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Lidar {
    /// Mounting on the car.
    pub mount: Mount,
    /// Number of beams.
    pub channels: u32,
    /// Elevation of the lowest beam, degrees.
    pub lowest_degrees: f64,
    /// Elevation of the highest beam, degrees.
    pub highest_degrees: f64,
    /// Maximum range, metres.
    pub range_metres: f64,
    /// Revolutions per second.
    pub turns_per_second: f64,
    /// Firings per second, of all beams together.
    pub firings_per_second: f64,
    /// Range noise, metres (1σ).
    pub noise_metres: f64,
    /// Relative intensity noise (1σ).
    pub intensity_noise: f64,
    /// Extinction of clear air, 1/m.
    pub extinction: f64,
    /// Seed of noise and losses.
    pub seed: u64,
}

impl Default for Lidar {
    fn default() -> Self {
        Self {
            mount: Mount { name: "lidar".into(), offset: DVec3::new(0.0, 0.0, 1.73), yaw_degrees: 0.0 },
            channels: 32,
            lowest_degrees: -30.0,
            highest_degrees: 10.0,
            range_metres: 80.0,
            turns_per_second: 20.0,
            firings_per_second: 250_000.0,
            noise_metres: 0.02,
            intensity_noise: 0.05,
            extinction: 0.0005,
            seed: 1,
        }
    }
}

/// One revolution of a lidar.
#[derive(Debug, Clone, PartialEq)]
pub struct Sweep {
    /// City time at the middle of the sweep, seconds.
    pub seconds: f64,
    /// Ground truth: the pose at that time, x forward, y left, z up.
    pub world_from_sensor: Rigid,
    /// The returns of all firings that hit a surface in range, in firing order.
    pub returns: Vec<Return>,
}

/// The result of a firing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Return {
    /// City time of the firing, seconds.
    pub seconds: f64,
    /// Beam index, from the lowest.
    pub channel: u16,
    /// Unit vector in the sensor's axes at the time of firing.
    pub direction: Vec3,
    /// Ground truth: range, metres.
    pub true_range: f64,
    /// Ground truth: the point of the surface, world metres.
    pub point: DVec3,
    /// Ground truth: the surface's class.
    pub class: crate::Class,
    /// Ground truth: the surface's instance.
    pub instance: u32,
    /// Ground truth: the surface's material.
    pub material: u16,
    /// Ground truth: the pulse went through glass.
    pub through_glass: bool,
    /// Ground truth: intensity without noise, 0 to 1.
    pub true_intensity: f32,
    /// Measured: metres.
    pub range: f32,
    /// Measured: calibrated for range, 0 to 1.
    pub intensity: f32,
    /// The pulse was too weak: there is no measurement.
    pub lost: bool,
}

impl Lidar {
    /// # Errors
    /// [`SenseError`] for settings out of range, or more firings per sweep than [`super::MAX_READINGS`].
    pub fn check(&self) -> Result<(), SenseError> {
        check_range("channels", f64::from(self.channels), 1.0, 1024.0)?;
        check_range("lowest_degrees", self.lowest_degrees, -90.0, self.highest_degrees)?;
        check_range("highest_degrees", self.highest_degrees, -90.0, 90.0)?;
        check_range("range_metres", self.range_metres, 0.1, 1e4)?;
        check_range("turns_per_second", self.turns_per_second, 0.1, 1e3)?;
        check_range("firings_per_second", self.firings_per_second, 1.0, 1e8)?;
        check_range("noise_metres", self.noise_metres, 0.0, 10.0)?;
        check_range("intensity_noise", self.intensity_noise, 0.0, 10.0)?;
        check_range("extinction", self.extinction, 0.0, 10.0)?;
        check_count(f64::from(self.channels) * f64::from(self.columns()))?;
        Ok(())
    }

    /// Number of sweeps along a leg.
    ///
    /// # Errors
    /// [`SenseError`] for settings out of range, or more sweeps than [`super::MAX_READINGS`].
    pub fn sweep_count(&self, leg: &[Waypoint]) -> Result<usize, SenseError> {
        self.check()?;
        let (Some(first), Some(last)) = (leg.first(), leg.last()) else { return Ok(0) };
        check_count((last.seconds - first.seconds) * self.turns_per_second)
    }

    /// Firings of each beam in a revolution.
    pub fn columns(&self) -> u32 {
        (self.firings_per_second / self.turns_per_second / f64::from(self.channels)).round().clamp(1.0, 1e9) as u32
    }

    /// A sweep of a lidar whose car drives a leg; `None` for an empty leg or a sensor dropout.
    ///
    /// # Errors
    /// [`SenseError`] for settings out of range.
    pub fn sweep_on_leg(
        &self,
        world: &World,
        leg: &[Waypoint],
        number: usize,
        faults: &[Fault],
    ) -> Result<Option<Sweep>, SenseError> {
        self.check()?;
        let Some(first) = leg.first() else { return Ok(None) };
        let seconds = first.seconds + (number as f64 + 0.5) / self.turns_per_second;
        let Some((pose, motion)) = rig::sensor_pose_at(leg, &self.mount, seconds) else { return Ok(None) };
        if faults::is_dropped_out(faults, &self.mount.name, seconds) {
            return Ok(None);
        }
        self.sweep(world, &pose, &motion, seconds, faults).map(Some)
    }

    /// A sweep centred on a time, with the motion of the sensor and of actors during the sweep.
    ///
    /// # Errors
    /// [`SenseError`] for settings or a pose out of range.
    pub fn sweep(
        &self,
        world: &World,
        pose: &Rigid,
        motion: &Motion,
        seconds: f64,
        faults: &[Fault],
    ) -> Result<Sweep, SenseError> {
        self.check()?;
        if !pose.is_sane() || !motion.velocity.is_finite() || !motion.spin.is_finite() || !seconds.is_finite() {
            return Err(SenseError::Setting("the pose"));
        }
        let columns = self.columns();
        let turn = 1.0 / self.turns_per_second;
        let after = |share: f64| (share - 0.5) * turn;
        let moments: Vec<Moment> = (0..TIME_STEPS)
            .into_par_iter()
            .map(|i| world.at(seconds + after((i as f64 + 0.5) / TIME_STEPS as f64)))
            .collect();
        let fog = f64::from(degrade_light(&Light::default(), faults).fog);
        let column = |i: u32| {
            let share = (f64::from(i) + 0.5) / f64::from(columns);
            let firing = Firing {
                lidar: self,
                moment: &moments[((share * TIME_STEPS as f64) as usize).min(TIME_STEPS - 1)],
                pose: motion.extrapolate(pose, after(share)),
                // clockwise from the rear, so that the middle of the sweep points forward
                azimuth: std::f64::consts::PI - std::f64::consts::TAU * share,
                seconds: seconds + after(share),
                extinction: self.extinction + fog,
                key: bits(bits(self.seed, seconds.to_bits()), u64::from(i)),
            };
            (0..self.channels).filter_map(|channel| firing.fire(channel)).collect::<Vec<_>>()
        };
        let returns: Vec<Vec<Return>> = (0..columns).into_par_iter().map(column).collect();
        Ok(Sweep { seconds, world_from_sensor: *pose, returns: returns.into_iter().flatten().collect() })
    }
}

/// The beams that fire at one time.
struct Firing<'a> {
    lidar: &'a Lidar,
    moment: &'a Moment<'a>,
    pose: Rigid,
    azimuth: f64,
    seconds: f64,
    extinction: f64,
    key: u64,
}

impl Firing<'_> {
    fn fire(&self, channel: u32) -> Option<Return> {
        let lidar = self.lidar;
        let share = if lidar.channels > 1 { f64::from(channel) / f64::from(lidar.channels - 1) } else { 0.5 };
        let elevation = (lidar.lowest_degrees + share * (lidar.highest_degrees - lidar.lowest_degrees)).to_radians();
        let (sine, cosine) = self.azimuth.sin_cos();
        let direction = DVec3::new(cosine * elevation.cos(), sine * elevation.cos(), elevation.sin());
        let towards = (self.pose.rotation * direction).as_vec3().normalize_or(Vec3::X);
        let ray = Ray { t_max: lidar.range_metres as f32, ..Ray::new(self.pose.translation.as_vec3(), towards) };
        let (hit, intensity, through_glass) = self.strongest_return(&ray)?;
        let true_range = f64::from(hit.distance);
        let mut random = Random::new(bits(self.key, u64::from(channel)));
        // noise floor: the power of the threshold reflectivity at the maximum range
        let end = lidar.range_metres;
        let threshold = THRESHOLD_REFLECTIVITY * (-2.0 * lidar.extinction * end).exp() / (end * end);
        let power = intensity / (true_range * true_range).max(0.25);
        let lost = f64::from(random.unit()) > 1.0 / (1.0 + (threshold / power.max(1e-30)).powi(3));
        let range = true_range + f64::from(random.normal()) * lidar.noise_metres;
        let read = intensity * (1.0 + f64::from(random.normal()) * lidar.intensity_noise);
        Some(Return {
            seconds: self.seconds,
            channel: channel as u16,
            direction: direction.as_vec3(),
            true_range,
            point: self.pose.translation + towards.as_dvec3() * true_range,
            class: self.moment.class(&hit),
            instance: self.moment.actor(&hit).instance,
            material: self.moment.material(&hit).0,
            through_glass,
            true_intensity: intensity as f32,
            range: range.max(0.0) as f32,
            intensity: read.clamp(0.0, 1.0) as f32,
            lost,
        })
    }

    /// The stronger return of glass and of the surface behind it.
    fn strongest_return(&self, ray: &Ray) -> Option<(Hit, f64, bool)> {
        let hit = self.moment.cast(ray, RayMask::All)?;
        let own = self.intensity(ray, &hit);
        let clear = f64::from(self.moment.material(&hit).1.transparency.clamp(0.0, 1.0));
        if clear == 0.0 {
            return Some((hit, own, false));
        }
        let beyond = Ray { t_min: hit.distance + 1e-3, ..*ray };
        let behind =
            self.moment.cast(&beyond, RayMask::Opaque).map(|far| (far, clear * clear * self.intensity(ray, &far)));
        let (own_power, square) = (own / f64::from(hit.distance).powi(2), |far: &Hit| f64::from(far.distance).powi(2));
        match behind {
            Some((far, weak)) if weak / square(&far) > own_power => Some((far, weak, true)),
            _ => Some((hit, own, false)),
        }
    }

    fn intensity(&self, ray: &Ray, hit: &Hit) -> f64 {
        let material = self.moment.material(hit).1;
        let cosine = f64::from(-hit.normal.dot(ray.direction)).clamp(0.0, 1.0);
        let clear = f64::from(material.transparency.clamp(0.0, 1.0));
        // the untransmitted share is reflected; a pane at normal incidence gives a specular flash
        let matt = f64::from(material.lidar_reflectivity.clamp(0.0, 1.0)) * cosine * (1.0 - clear);
        let flash = if clear > 0.0 { cosine.powi(400) } else { 0.0 };
        (matt + flash).min(1.0) * (-2.0 * self.extinction * f64::from(hit.distance)).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_scene;

    fn sweep(at: DVec3, faults: &[Fault]) -> Sweep {
        let city = test_scene::city();
        let world = World::new(&city).unwrap();
        Lidar::default().sweep(&world, &test_scene::pose_at_point(at), &Motion::STILL, 0.0, faults).unwrap()
    }

    #[test]
    fn true_points_lie_on_surfaces_and_measurements_near_them() {
        let seen = sweep(DVec3::new(0.0, 0.0, 1.73), &[]);
        assert!(seen.returns.len() > 5000, "{}", seen.returns.len());
        let (mut walls, mut off, mut kept) = (0, 0.0, 0.0);
        for r in &seen.returns {
            let distance = match r.material {
                test_scene::ASPHALT => r.point.z.abs(),
                test_scene::PLASTER => {
                    walls += 1;
                    (r.point.y - 12.0).abs()
                }
                test_scene::BRICK => (r.point.x - 14.0).abs().min((r.point.y - 6.0).abs()),
                _ => 0.0,
            };
            assert!(distance < 1e-3, "{r:?}");
            let again = seen.world_from_sensor.apply(r.direction.as_dvec3() * r.true_range);
            assert!(again.distance(r.point) < 1e-3);
            if !r.lost {
                off += (f64::from(r.range) - r.true_range).powi(2);
                kept += 1.0;
            }
        }
        assert!(walls > 20, "{walls}");
        assert!(((off / kept).sqrt() - 0.02).abs() < 0.002, "{}", (off / kept).sqrt());
    }

    #[test]
    fn glass_transmits_pulses_except_at_normal_incidence() {
        // beams at the height of the pane go through to the wall 2 m behind it
        let seen = sweep(DVec3::new(0.0, 0.0, 1.73), &[]);
        let through: Vec<&Return> = seen.returns.iter().filter(|r| r.through_glass).collect();
        assert!(through.len() > 20 && through.iter().all(|r| r.material == test_scene::PLASTER));
        assert!(through.iter().all(|r| r.true_intensity < 0.5 * 0.85 * 0.85 + 1e-3));
        assert!(seen.returns.iter().any(|r| r.material == test_scene::GLASS), "the squarest beams flash");
    }

    #[test]
    fn distant_and_grazing_returns_are_lost_and_fog_loses_more() {
        let lost = |sweep: &Sweep, near: bool| {
            let some: Vec<&Return> = sweep.returns.iter().filter(|r| (r.true_range < 10.0) == near).collect();
            some.iter().filter(|r| r.lost).count() as f64 / some.len().max(1) as f64
        };
        let clear = sweep(DVec3::new(-50.0, 0.0, 1.73), &[]);
        assert!(
            lost(&clear, true) < 0.02 && lost(&clear, false) > 0.2,
            "{} {}",
            lost(&clear, true),
            lost(&clear, false)
        );
        let fog = Fault { kind: crate::faults::FaultKind::Fog, strength: 1.0, seed: 0 };
        assert!(lost(&sweep(DVec3::new(-50.0, 0.0, 1.73), &[fog]), false) > lost(&clear, false) + 0.05);
    }

    #[test]
    fn a_sweep_is_the_same_for_any_number_of_threads() {
        let city = test_scene::city();
        let world = World::new(&city).unwrap();
        let legs = rig::legs(&city, &rig::Rig::default()).unwrap();
        let lidar = Lidar::default();
        assert_eq!(lidar.sweep_count(&legs[0]), Ok(240));
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| lidar.sweep_on_leg(&world, &legs[0], 50, &[]).unwrap().unwrap())
        };
        let (one, two) = (with(1), with(2));
        assert_eq!(one, two);
        // the van drives on while the lidar turns: its front at the moment of each firing
        let van: Vec<&Return> = one.returns.iter().filter(|r| r.instance == 7 && r.true_range < 80.0).collect();
        assert!(!van.is_empty());
        assert!(Lidar { channels: 0, ..lidar.clone() }.check().is_err());
        assert!(Lidar { firings_per_second: f64::NAN, ..lidar }.check().is_err());
    }
}
