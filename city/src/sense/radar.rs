//! An automotive radar: some hundred detections per sweep, each with range, azimuth and radial velocity.
//!
//! A fan of rays samples the field of view. Backscatter depends on the class (metal and vehicles most, walls less,
//! ground and leaves little) and on the angle of incidence. Power falls with the fourth power of range (radar equation,
//! Skolnik 2008). The strongest return of each cell of range, azimuth and velocity is a detection; the detections with
//! the largest range-independent power are kept. **Ghosts** model multipath: a return at twice its range and velocity,
//! or one at a larger range and mirrored azimuth. Velocities are relative to the sensor and positive away from it.
//!
//! Street Detection Gaussians (section 3.4) uses radar detections as sparse, geometrically reliable depth.

use std::collections::BTreeMap;

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use scene::Rigid;
use serde::{Deserialize, Serialize};

use super::{Motion, SenseError, check_range, rig::Mount};
use crate::{
    Class,
    faults::{self, Fault},
    random::{Random, bits},
    trace::{Hit, Moment, Ray, RayMask, motion},
};

/// Rays per column of the fan.
const ROWS: u32 = 13;

/// Settings of a radar.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Radar {
    /// Mounting on the car.
    pub mount: Mount,
    /// Horizontal field of view, degrees.
    pub field_degrees: f64,
    /// Vertical field of view, degrees.
    pub elevation_degrees: f64,
    /// Maximum range, metres.
    pub range_metres: f64,
    /// Range resolution, metres.
    pub range_cell_metres: f64,
    /// Azimuth resolution, degrees.
    pub azimuth_cell_degrees: f64,
    /// Velocity resolution, metres per second.
    pub velocity_cell: f64,
    /// Largest number of detections per sweep, without ghosts.
    #[serde(rename = "most")]
    pub max_detections: u32,
    /// Range noise, metres (1σ).
    pub range_noise_metres: f64,
    /// Azimuth noise, degrees (1σ).
    pub azimuth_noise_degrees: f64,
    /// Velocity noise, metres per second (1σ).
    pub velocity_noise: f64,
    /// Mean number of ghosts per detection.
    pub ghosts: f64,
    /// Seed of noise and ghosts.
    pub seed: u64,
}

impl Default for Radar {
    fn default() -> Self {
        Self {
            mount: Mount { name: "radar".into(), offset: DVec3::new(2.0, 0.0, 0.6), yaw_degrees: 0.0 },
            field_degrees: 120.0,
            elevation_degrees: 16.0,
            range_metres: 120.0,
            range_cell_metres: 0.4,
            azimuth_cell_degrees: 1.5,
            velocity_cell: 0.2,
            max_detections: 250,
            range_noise_metres: 0.1,
            azimuth_noise_degrees: 0.4,
            velocity_noise: 0.08,
            ghosts: 0.04,
            seed: 1,
        }
    }
}

/// A radar detection and its ground truth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Detection {
    /// Measured: range, metres.
    pub range: f32,
    /// Measured: azimuth, radians to the left.
    pub azimuth: f32,
    /// Measured: radial velocity relative to the sensor, metres per second, positive away from it.
    pub velocity: f32,
    /// Measured: signal-to-noise ratio, decibels.
    pub power: f32,
    /// Ground truth: the detection is a multipath ghost. Its other ground truth is that of the original return.
    pub ghost: bool,
    /// Ground truth: range, metres.
    pub true_range: f64,
    /// Ground truth: azimuth, radians to the left.
    pub true_azimuth: f64,
    /// Ground truth: radial velocity, metres per second.
    pub true_velocity: f64,
    /// Ground truth: the scattering point, world metres.
    pub point: DVec3,
    /// Ground truth: class.
    pub class: Class,
    /// Ground truth: instance.
    pub instance: u32,
    /// Ground truth: material.
    pub material: u16,
}

impl Radar {
    /// # Errors
    /// [`SenseError`] for settings out of range.
    pub fn check(&self) -> Result<(), SenseError> {
        check_range("field_degrees", self.field_degrees, 1.0, 360.0)?;
        check_range("elevation_degrees", self.elevation_degrees, 0.0, 120.0)?;
        check_range("range_metres", self.range_metres, 1.0, 1e4)?;
        check_range("range_cell_metres", self.range_cell_metres, 1e-3, 1e3)?;
        check_range("azimuth_cell_degrees", self.azimuth_cell_degrees, 0.05, 90.0)?;
        check_range("velocity_cell", self.velocity_cell, 1e-3, 1e3)?;
        check_range("max_detections", f64::from(self.max_detections), 0.0, 1e6)?;
        check_range("range_noise_metres", self.range_noise_metres, 0.0, 1e3)?;
        check_range("azimuth_noise_degrees", self.azimuth_noise_degrees, 0.0, 90.0)?;
        check_range("velocity_noise", self.velocity_noise, 0.0, 1e3)?;
        check_range("ghosts", self.ghosts, 0.0, 10.0)?;
        Ok(())
    }

    /// A sweep from a moving sensor (`world_from_sensor`, x forward, y left, z up); empty during a sensor dropout.
    ///
    /// # Errors
    /// [`SenseError`] for settings or a pose out of range.
    pub fn sweep(
        &self,
        moment: &Moment,
        pose: &Rigid,
        sensor_motion: &Motion,
        faults: &[Fault],
    ) -> Result<Vec<Detection>, SenseError> {
        self.check()?;
        if !pose.is_sane() || !sensor_motion.velocity.is_finite() {
            return Err(SenseError::Setting("the pose"));
        }
        if faults::is_dropped_out(faults, &self.mount.name, moment.seconds) {
            return Ok(Vec::new());
        }
        let mut random = Random::new(bits(self.seed, moment.seconds.to_bits()));
        let kept = self.strongest_per_cell(self.returns(moment, pose, sensor_motion));
        let mut detections: Vec<Detection> = kept.iter().map(|found| self.add_noise(found, &mut random)).collect();
        let ghosts: Vec<Detection> = kept.iter().filter_map(|found| self.ghost_of(found, &mut random)).collect();
        detections.extend(ghosts);
        Ok(detections)
    }

    /// The returns of all rays, without noise.
    fn returns(&self, moment: &Moment, pose: &Rigid, sensor_motion: &Motion) -> Vec<Detection> {
        // four columns per azimuth cell, so that poles are hit
        let columns = (4.0 * self.field_degrees / self.azimuth_cell_degrees).ceil() as u32;
        let column = |i: u32| {
            let azimuth = (self.field_degrees * ((f64::from(i) + 0.5) / f64::from(columns) - 0.5)).to_radians();
            let ray = |row: u32| {
                let elevation = self.elevation_degrees * (f64::from(row) / f64::from(ROWS - 1) - 0.5);
                let (e, (s, c)) = (elevation.to_radians(), azimuth.sin_cos());
                let local = DVec3::new(c * e.cos(), s * e.cos(), e.sin());
                let towards = (pose.rotation * local).as_vec3().normalize_or(Vec3::X);
                Ray { t_max: self.range_metres as f32, ..Ray::new(pose.translation.as_vec3(), towards) }
            };
            let met = |row: u32| self.return_along(moment, pose, sensor_motion, &ray(row), azimuth);
            (0..ROWS).filter_map(met).collect::<Vec<_>>()
        };
        let columns: Vec<Vec<Detection>> = (0..columns).into_par_iter().map(column).collect();
        columns.into_iter().flatten().collect()
    }

    /// The return along a ray; window glass is transparent to radar.
    fn return_along(
        &self,
        moment: &Moment,
        pose: &Rigid,
        sensor_motion: &Motion,
        ray: &Ray,
        azimuth: f64,
    ) -> Option<Detection> {
        let hit = moment.cast(ray, RayMask::Opaque)?;
        let range = f64::from(hit.distance).max(0.05);
        let towards = ray.direction.as_dvec3();
        let point = pose.translation + towards * range;
        let velocity =
            (motion::velocity_at(moment.actor(&hit), moment.seconds, point) - sensor_motion.velocity).dot(towards);
        // a square metre of metal at normal incidence and maximum range is 10 dB above the noise
        let scattered = scattering(moment, &hit, ray).max(1e-9);
        let power = 10.0 + 10.0 * scattered.log10() + 40.0 * (self.range_metres / range).log10();
        Some(Detection {
            range: range as f32,
            azimuth: azimuth as f32,
            velocity: velocity as f32,
            power: power as f32,
            ghost: false,
            true_range: range,
            true_azimuth: azimuth,
            true_velocity: velocity,
            point,
            class: moment.class(&hit),
            instance: moment.actor(&hit).instance,
            material: moment.material(&hit).0,
        })
    }

    /// The strongest return of each cell, and of these the strongest [`Self::max_detections`].
    fn strongest_per_cell(&self, returns: Vec<Detection>) -> Vec<Detection> {
        let mut cells: BTreeMap<[i64; 3], Detection> = BTreeMap::new();
        for found in returns.into_iter().filter(|found| found.power > 0.0) {
            let cell = [
                (found.true_range / self.range_cell_metres) as i64,
                (found.true_azimuth.to_degrees() / self.azimuth_cell_degrees).floor() as i64,
                (found.true_velocity / self.velocity_cell).floor() as i64,
            ];
            let best = cells.entry(cell).or_insert(found);
            if found.power > best.power {
                *best = found;
            }
        }
        let mut kept: Vec<Detection> = cells.into_values().collect();
        // sensitivity-time control: near returns would displace all others
        let range_independent_power = |found: &Detection| f64::from(found.power) + 40.0 * found.true_range.log10();
        kept.sort_by(|a, b| range_independent_power(b).total_cmp(&range_independent_power(a)));
        kept.truncate(self.max_detections as usize);
        kept
    }

    fn add_noise(&self, found: &Detection, random: &mut Random) -> Detection {
        let mut noisy = |value: f32, noise: f64| value + random.normal() * noise as f32;
        Detection {
            range: noisy(found.range, self.range_noise_metres).max(0.0),
            azimuth: noisy(found.azimuth, self.azimuth_noise_degrees.to_radians()),
            velocity: noisy(found.velocity, self.velocity_noise),
            power: noisy(found.power, 1.0),
            ..*found
        }
    }

    /// The ghost of a return, with the probability [`Self::ghosts`].
    fn ghost_of(&self, found: &Detection, random: &mut Random) -> Option<Detection> {
        let appears = random.chance(self.ghosts as f32);
        let twice = random.chance(0.5);
        let farther = random.range(1.1, 1.6);
        let shadow = match twice {
            true => Detection { range: 2.0 * found.range, velocity: 2.0 * found.velocity, ..*found },
            false => Detection { range: farther * found.range, azimuth: -found.azimuth, ..*found },
        };
        let shadow = Detection { ghost: true, power: found.power - 12.0, ..shadow };
        (appears && f64::from(shadow.range) < self.range_metres).then(|| self.add_noise(&shadow, random))
    }
}

/// Radar cross-section of a hit, square metres; plausible values, not measured.
fn scattering(moment: &Moment, hit: &Hit, ray: &Ray) -> f64 {
    let material = moment.material(hit).1;
    let (section, breadth) = match moment.class(hit) {
        Class::Car | Class::Truck | Class::Bus | Class::Train => (1.0, 2),
        Class::Motorcycle | Class::Bicycle | Class::Rider => (0.5, 1),
        Class::Pole | Class::GuardRail | Class::Fence | Class::TrafficSign | Class::TrafficLight => (0.6, 1),
        Class::StreetFurniture => (0.3, 1),
        Class::Person => (0.12, 1),
        Class::Building | Class::Wall | Class::Bridge => (0.12, 4),
        Class::Vegetation => (0.01, 1),
        _ => (0.002, 2),
    };
    let metal = 1.0 + 4.0 * f64::from(material.metallic.clamp(0.0, 1.0));
    let cosine = f64::from(-hit.normal.dot(ray.direction)).clamp(0.0, 1.0);
    section * metal * (0.05 + cosine.powi(breadth))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{test_scene, trace::World};

    #[test]
    fn a_receding_van_has_a_positive_velocity() {
        let city = test_scene::city();
        let world = World::new(&city).unwrap();
        // the van is 20 m ahead of a sensor that follows it at 4 m/s
        let moment = world.at(2.25 + 0.0);
        let pose = test_scene::pose_at_point(DVec3::new(-30.0, -2.0, 0.6));
        let sensor_motion = Motion { velocity: DVec3::X * 4.0, ..Motion::STILL };
        let found = Radar::default().sweep(&moment, &pose, &sensor_motion, &[]).unwrap();
        let van: Vec<&Detection> = found.iter().filter(|d| d.instance == 7 && !d.ghost).collect();
        assert!(!van.is_empty());
        for d in &van {
            // the back of the van: x = −30 + 22.5 − 2.25
            assert!((d.true_range - 20.25 / d.true_azimuth.cos()).abs() < 0.3, "{d:?}");
            assert!((d.true_velocity - 6.0 * d.true_azimuth.cos()).abs() < 0.1, "{d:?}");
            assert!(
                (f64::from(d.velocity) - d.true_velocity).abs() < 0.5
                    && (f64::from(d.range) - d.true_range).abs() < 0.6
            );
        }
        let standing = found.iter().filter(|d| d.instance == 1 && !d.ghost);
        assert!(standing.map(|d| (d.true_velocity + 4.0 * d.true_azimuth.cos()).abs()).fold(0.0, f64::max) < 0.1);
    }

    #[test]
    fn a_van_straight_ahead_moves_at_ten_metres_per_second() {
        let city = test_scene::city();
        let world = World::new(&city).unwrap();
        let radar = Radar { velocity_noise: 0.0, ghosts: 1.0, ..Radar::default() };
        let found = radar
            .sweep(&world.at(3.0), &test_scene::pose_at_point(DVec3::new(-40.0, -2.0, 0.9)), &Motion::STILL, &[])
            .unwrap();
        let nearest = found
            .iter()
            .filter(|d| d.instance == 7 && !d.ghost)
            .min_by(|a, b| a.true_azimuth.abs().total_cmp(&b.true_azimuth.abs()));
        assert!((nearest.unwrap().true_velocity - 10.0).abs() < 0.01);
        let ghosts = found.iter().filter(|d| d.ghost).count();
        assert!(ghosts > 3 && found.len() - ghosts > 20 && found.len() - ghosts <= 250, "{ghosts} of {}", found.len());
        assert_eq!(
            found,
            radar
                .sweep(&world.at(3.0), &test_scene::pose_at_point(DVec3::new(-40.0, -2.0, 0.9)), &Motion::STILL, &[])
                .unwrap()
        );
    }

    #[test]
    fn invalid_settings_are_refused_and_a_dropped_out_sensor_is_silent() {
        assert!(Radar { azimuth_cell_degrees: 0.0, ..Radar::default() }.check().is_err());
        assert!(Radar { ghosts: f64::NAN, ..Radar::default() }.check().is_err());
        let city = test_scene::city();
        let world = World::new(&city).unwrap();
        let out = [Fault { kind: crate::faults::FaultKind::SensorDropout, strength: 1.0, seed: 5 }];
        let pose = test_scene::pose_at_point(DVec3::new(-30.0, 0.0, 0.6));
        let silent = (0..40)
            .filter(|i| {
                Radar::default().sweep(&world.at(f64::from(*i) * 2.0), &pose, &Motion::STILL, &out).unwrap().is_empty()
            })
            .count();
        assert!((10..=30).contains(&silent), "{silent}");
    }
}
