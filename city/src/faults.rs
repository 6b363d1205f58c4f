//! Faults of a real capture that can be injected, each by kind, strength and seed.
//!
//! | fault | acts on | at strength 1 |
//! |---|---|---|
//! | exposure drift | shots | the gain varies between ⅓ and 3 over some tens of seconds |
//! | motion blur | shots | 1/15 s of exposure, and the mount shakes |
//! | pose noise | shots | errors of reported poses of 0.5 m and 2° (1σ) |
//! | clock skew | shots | the cameras' clocks differ: reported poses are of another time, 0.1 s off (1σ) |
//! | wrong calibration | shots | errors of focal lengths of 2 %, and of mounts of 5 cm and 0.5° (1σ) |
//! | sparse views | shots | nine of ten shots are missing |
//! | sensor dropout | shots, sweeps | each sensor gives no data for half the time, in stretches of 2 s |
//! | night | light, image | moonlight, lamps and lit rooms, sensor noise |
//! | rain | light, image | overcast, wet ground, streaks |
//! | fog | light | 100 m of visibility |
//! | textureless road | light | roads of one colour |
//! | lens dirt | image | spots and a veil, the same in all images of a sensor |
//! | moving unmasked | mask | no moving object is masked |
//!
//! At strength 0 no fault changes anything.

use std::fmt;
use std::str::FromStr;

use glam::{DQuat, DVec3};
use scene::{BadInput, Rigid};
use serde::{Deserialize, Serialize};

use crate::{
    random::{Random, bits},
    sense::Shot,
    settings::named_enum,
};

named_enum!(
    /// Kinds of faults.
    FaultKind, "fault", {
        /// The gain varies over time.
        ExposureDrift = "exposure-drift",
        /// No sun; lamps are on.
        Night = "night",
        /// Overcast sky, wet ground, streaks in the image.
        Rain = "rain",
        /// Low visibility.
        Fog = "fog",
        /// Long exposure.
        MotionBlur = "motion-blur",
        /// Errors of reported poses.
        PoseNoise = "pose-noise",
        /// Missing shots.
        SparseViews = "sparse-views",
        /// Sensors give no data for seconds at a time.
        SensorDropout = "sensor-dropout",
        /// Moving objects are missing from masks.
        MovingUnmasked = "moving-unmasked",
        /// Roads without texture.
        TexturelessRoad = "textureless-road",
        /// Spots on the lens.
        LensDirt = "lens-dirt",
        /// Cameras whose clocks differ.
        ClockSkew = "clock-skew",
        /// Errors of the cameras' focal lengths and mounts.
        WrongCalibration = "wrong-calibration",
    }
);

/// A fault to inject.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// Kind of fault.
    pub kind: FaultKind,
    /// 0 (no effect) to 1.
    pub strength: f32,
    /// Seed of its random numbers.
    pub seed: u64,
}

impl Fault {
    /// Whether the strength is in its range.
    pub fn is_valid(&self) -> bool {
        (0.0..=1.0).contains(&self.strength)
    }
}

impl FromStr for Fault {
    type Err = BadInput;

    /// Parses `KIND` or `KIND=STRENGTH`; the seed is 0.
    fn from_str(text: &str) -> Result<Self, BadInput> {
        let (kind, strength) = text.split_once('=').unwrap_or((text, "1"));
        let strength = strength.parse().ok().filter(|s| (0.0..=1.0).contains(s)).ok_or_else(|| {
            let problem = format!("{strength:?} is not a strength");
            BadInput::new("fault", problem, "give it as fog=0.4, with a strength from 0 to 1")
        })?;
        Ok(Self { kind: kind.parse()?, strength, seed: 0 })
    }
}

/// Applies faults to shots: changes gains, shutters and reported poses, and removes shots.
pub fn degrade_shots(mut shots: Vec<Shot>, faults: &[Fault]) -> Vec<Shot> {
    for fault in faults.iter().filter(|f| f.is_valid() && f.strength > 0.0) {
        match fault.kind {
            FaultKind::ExposureDrift => shots.iter_mut().for_each(|shot| drift_exposure(shot, fault)),
            FaultKind::MotionBlur => shots.iter_mut().for_each(|shot| blur_motion(shot, fault)),
            FaultKind::PoseNoise => shots.iter_mut().for_each(|shot| perturb_pose(shot, fault)),
            FaultKind::ClockSkew => shots.iter_mut().for_each(|shot| skew_clock(shot, fault)),
            FaultKind::WrongCalibration => shots.iter_mut().for_each(|shot| miscalibrate(shot, fault)),
            FaultKind::SparseViews => {
                shots.retain(|shot| named_random(fault, &shot.name).unit() >= 0.9 * fault.strength)
            }
            FaultKind::SensorDropout => shots.retain(|shot| !is_dropped_out(faults, &shot.sensor, shot.seconds)),
            _ => {}
        }
    }
    shots
}

/// Whether a sensor gives no data at a time: stretches of 2 s, half of them at strength 1.
pub fn is_dropped_out(faults: &[Fault], sensor: &str, seconds: f64) -> bool {
    let stretch = (seconds / 2.0).floor() as i64 as u64;
    faults.iter().filter(|f| f.kind == FaultKind::SensorDropout).any(|fault| {
        let draw = Random::new(bits(named_random(fault, sensor).bits(), stretch)).unit();
        draw < 0.5 * fault.strength
    })
}

/// Whether an actor is missing from the masks of all images.
pub fn is_left_unmasked(faults: &[Fault], actor: u32) -> bool {
    faults
        .iter()
        .filter(|f| f.kind == FaultKind::MovingUnmasked)
        .any(|fault| Random::new(bits(fault.seed, u64::from(actor))).unit() < fault.strength)
}

/// The random numbers of a fault for a shot or sensor by name.
pub(crate) fn named_random(fault: &Fault, name: &str) -> Random {
    let key = name.bytes().fold(bits(fault.seed, fault.kind as u64), |key, byte| bits(key, u64::from(byte)));
    Random::new(key)
}

/// A sum of slow waves that differ by sensor: 1σ is about 0.5 stops, at most 1.6.
fn drift_exposure(shot: &mut Shot, fault: &Fault) {
    let mut random = named_random(fault, &shot.sensor);
    let wave = |random: &mut Random| {
        let period = f64::from(random.range(7.0, 60.0));
        (std::f64::consts::TAU * (shot.seconds / period + f64::from(random.unit()))).sin() as f32
    };
    let sum: f32 = (0..4).map(|_| wave(&mut random)).sum();
    shot.exposure *= (0.4 * sum * fault.strength).exp2();
}

fn blur_motion(shot: &mut Shot, fault: &Fault) {
    let mut random = named_random(fault, &shot.name);
    let mut normal = || f64::from(random.normal());
    let jolt = DVec3::new(normal(), normal(), normal()) * 0.08;
    shot.shutter_seconds = shot.shutter_seconds.max(f64::from(fault.strength) / 15.0);
    shot.motion.spin += jolt * f64::from(fault.strength);
}

fn perturb_pose(shot: &mut Shot, fault: &Fault) {
    let mut random = named_random(fault, &shot.name);
    let strength = f64::from(fault.strength);
    let mut error = |scale: f64| normals(&mut random) * scale * strength;
    let (shift, turn) = (error(0.5), error(2f64.to_radians()));
    let pose = shot.reported.camera_from_world.inverse();
    let rotation = (DQuat::from_scaled_axis(turn) * pose.rotation).normalize();
    shot.reported.camera_from_world = Rigid { rotation, translation: pose.translation + shift }.inverse();
}

fn normals(random: &mut Random) -> DVec3 {
    let mut normal = || f64::from(random.normal());
    DVec3::new(normal(), normal(), normal())
}

/// The pose of another time, the same time off in all shots of a sensor.
fn skew_clock(shot: &mut Shot, fault: &Fault) {
    let seconds = f64::from(named_random(fault, &shot.sensor).normal()) * 0.1 * f64::from(fault.strength);
    let pose = shot.reported.camera_from_world.inverse();
    shot.reported.camera_from_world = shot.motion.extrapolate(&pose, seconds).inverse();
}

/// The same errors in all shots of a sensor.
fn miscalibrate(shot: &mut Shot, fault: &Fault) {
    let mut random = named_random(fault, &shot.sensor);
    let strength = f64::from(fault.strength);
    let scale = 1.0 + 0.02 * f64::from(random.normal()) * strength;
    let mut error = |scale: f64| normals(&mut random) * scale * strength;
    let (shift, turn) = (error(0.05), error(0.5f64.to_radians()));
    shot.reported.pinhole.fx *= scale;
    shot.reported.pinhole.fy *= scale;
    let wrong = Rigid { rotation: DQuat::from_scaled_axis(turn), translation: shift };
    shot.reported.camera_from_world = wrong.compose(&shot.reported.camera_from_world);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_parse_from_their_names() {
        for &kind in FaultKind::ALL {
            assert_eq!(kind.to_string().parse(), Ok(Fault { kind, strength: 1.0, seed: 0 }));
        }
        assert_eq!("fog=0.25".parse(), Ok(Fault { kind: FaultKind::Fog, strength: 0.25, seed: 0 }));
        for text in ["", "fogg", "fog=", "fog=-0.1", "fog=1.1", "fog=nan", "fog=inf", "fog=0.1=2"] {
            let refusal = text.parse::<Fault>().unwrap_err().to_string();
            assert!(refusal.starts_with("fault") && !refusal.contains('\n'), "{refusal}");
        }
    }
}
