//! What goes wrong in a real capture, each by name, strength and seed.
//!
//! | fault | acts on | at strength 1 |
//! |---|---|---|
//! | exposure drift | shots | the gain wanders between ⅓ and 3 over some tens of seconds |
//! | motion blur | shots | the shutter is open for 1/15 s, and the mount shakes |
//! | pose noise | shots | reported poses are off by 0.5 m and 2° (1σ) |
//! | sparse views | shots | nine of ten shots are missing |
//! | sensor dropout | shots, sweeps | each sensor is silent for half the time, some seconds at once |
//! | night | light, picture | moonlight, lamps and lit rooms, grain |
//! | rain | light, picture | overcast, wet, streaked |
//! | fog | light | 100 m of sight |
//! | textureless road | light | roads of one colour |
//! | lens dirt | picture | spots and a veil, the same in all of a sensor's pictures |
//! | moving unmasked | mask | no moving object is masked |
//!
//! At strength 0 each of them changes nothing.

use std::fmt;
use std::str::FromStr;

use glam::{DQuat, DVec3, Vec2, Vec3, vec3};
use scene::{BadInput, Rigid};
use serde::{Deserialize, Serialize};

use crate::{
    random::{Random, bits},
    sense::Shot,
    settings::named,
    trace::{Light, Options, frame::grain},
};

named!(
    /// What goes wrong.
    Kind, "fault", {
        /// The gain wanders.
        ExposureDrift = "exposure-drift",
        /// The sun is down.
        Night = "night",
        /// Overcast, wet and streaked.
        Rain = "rain",
        /// Air that one does not see far through.
        Fog = "fog",
        /// The shutter is open for long.
        MotionBlur = "motion-blur",
        /// Reported poses are off.
        PoseNoise = "pose-noise",
        /// Shots are missing.
        SparseViews = "sparse-views",
        /// Sensors are silent for seconds.
        SensorDropout = "sensor-dropout",
        /// Masks miss things that move.
        MovingUnmasked = "moving-unmasked",
        /// Roads without texture.
        TexturelessRoad = "textureless-road",
        /// Spots on the lens.
        LensDirt = "lens-dirt",
    }
);

/// One thing that goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// What.
    pub kind: Kind,
    /// How badly, 0 (not at all) to 1.
    pub strength: f32,
    /// Of its randomness.
    pub seed: u64,
}

impl Fault {
    /// The strength is one.
    pub fn is_sane(&self) -> bool {
        (0.0..=1.0).contains(&self.strength)
    }
}

impl FromStr for Fault {
    type Err = BadInput;

    /// `KIND` or `KIND=STRENGTH`, as people type it; the seed is 0.
    fn from_str(text: &str) -> Result<Self, BadInput> {
        let (kind, strength) = text.split_once('=').unwrap_or((text, "1"));
        let strength = strength.parse().ok().filter(|s| (0.0..=1.0).contains(s)).ok_or_else(|| {
            let problem = format!("{strength:?} is no strength");
            BadInput::new("fault", problem, "give it as fog=0.4, with a strength from 0 to 1")
        })?;
        Ok(Self { kind: kind.parse()?, strength, seed: 0 })
    }
}

/// The faults of shots: gains, shutters and reported poses changed, some shots gone.
pub fn spoil_shots(mut shots: Vec<Shot>, faults: &[Fault]) -> Vec<Shot> {
    for fault in faults.iter().filter(|f| f.is_sane() && f.strength > 0.0) {
        match fault.kind {
            Kind::ExposureDrift => shots.iter_mut().for_each(|shot| drift(shot, fault)),
            Kind::MotionBlur => shots.iter_mut().for_each(|shot| shake(shot, fault)),
            Kind::PoseNoise => shots.iter_mut().for_each(|shot| displace(shot, fault)),
            Kind::SparseViews => shots.retain(|shot| of(fault, &shot.name).unit() >= 0.9 * fault.strength),
            Kind::SensorDropout => shots.retain(|shot| !is_silent(faults, &shot.sensor, shot.seconds)),
            _ => {}
        }
    }
    shots
}

/// Whether a sensor is silent at a moment: whole stretches of 2 s, half of them at strength 1.
pub fn is_silent(faults: &[Fault], sensor: &str, seconds: f64) -> bool {
    let stretch = (seconds / 2.0).floor() as i64 as u64;
    faults.iter().filter(|f| f.kind == Kind::SensorDropout).any(|fault| {
        let draw = Random::new(bits(of(fault, sensor).bits(), stretch)).unit();
        draw < 0.5 * fault.strength
    })
}

/// Whether a data set's masks miss an actor, in all pictures.
pub fn is_forgotten(faults: &[Fault], actor: u32) -> bool {
    faults
        .iter()
        .filter(|f| f.kind == Kind::MovingUnmasked)
        .any(|fault| Random::new(bits(fault.seed, u64::from(actor))).unit() < fault.strength)
}

/// The light that faults leave.
pub(crate) fn spoil_light(light: &Light, faults: &[Fault]) -> Light {
    let mut light = *light;
    for fault in faults {
        let s = fault.strength;
        match fault.kind {
            Kind::Night => {
                let down = (1.0 - s) * (1.0 - s);
                light.sun *= vec3(0.022, 0.027, 0.036).lerp(Vec3::ONE, down);
                for part in [&mut light.zenith, &mut light.horizon, &mut light.ground] {
                    *part *= vec3(0.03, 0.036, 0.05).lerp(Vec3::ONE, down);
                }
                light.lamps = light.lamps.max(s);
            }
            Kind::Rain => {
                overcast(&mut light, 0.95 * s);
                light.wet += s;
                light.fog += 0.004 * s;
            }
            Kind::Fog => {
                overcast(&mut light, 0.85 * s);
                light.fog += 0.03 * s;
            }
            Kind::TexturelessRoad => light.road_pattern *= 1.0 - s,
            _ => {}
        }
    }
    light
}

/// The sun's light goes to the sky, which greys.
fn overcast(light: &mut Light, share: f32) {
    let grey = |c: Vec3| Vec3::splat(c.dot(vec3(0.21, 0.72, 0.07)));
    let spread = 0.25 * share * light.sun;
    light.sun *= 1.0 - share;
    for part in [&mut light.zenith, &mut light.horizon] {
        *part = part.lerp(grey(*part), share) + 0.6 * grey(spread);
    }
    let mean = 0.5 * (light.zenith + light.horizon);
    light.zenith = light.zenith.lerp(mean, 0.7 * share);
    light.horizon = light.horizon.lerp(mean, 0.7 * share);
}

/// The faults of pictures, on linear light after the gain.
pub(crate) fn spoil_picture(light: &mut [Vec3], width: usize, shot: &Shot, options: &Options) {
    for fault in options.faults.iter().filter(|f| f.strength > 0.0) {
        match fault.kind {
            Kind::Night => roughen(light, shot, fault),
            Kind::Rain => streak(light, width, shot, fault, 0.8 * options.light.horizon * shot.exposure),
            Kind::LensDirt => soil(light, width, shot, fault),
            _ => {}
        }
    }
}

/// The randomness of a fault for something by name.
fn of(fault: &Fault, name: &str) -> Random {
    let key = name.bytes().fold(bits(fault.seed, fault.kind as u64), |key, byte| bits(key, u64::from(byte)));
    Random::new(key)
}

/// A sum of slow waves of each sensor's own: about 1σ = 0.5 octaves and never over 1.6.
fn drift(shot: &mut Shot, fault: &Fault) {
    let mut random = of(fault, &shot.sensor);
    let wave = |random: &mut Random| {
        let period = f64::from(random.range(7.0, 60.0));
        (std::f64::consts::TAU * (shot.seconds / period + f64::from(random.unit()))).sin() as f32
    };
    let sum: f32 = (0..4).map(|_| wave(&mut random)).sum();
    shot.exposure *= (0.4 * sum * fault.strength).exp2();
}

fn shake(shot: &mut Shot, fault: &Fault) {
    let mut random = of(fault, &shot.name);
    let mut normal = || f64::from(random.normal());
    let jolt = DVec3::new(normal(), normal(), normal()) * 0.08;
    shot.shutter_seconds = shot.shutter_seconds.max(f64::from(fault.strength) / 15.0);
    shot.motion.spin += jolt * f64::from(fault.strength);
}

fn displace(shot: &mut Shot, fault: &Fault) {
    let mut random = of(fault, &shot.name);
    let mut normal = || f64::from(random.normal());
    let strength = f64::from(fault.strength);
    let shift = DVec3::new(normal(), normal(), normal()) * 0.5 * strength;
    let turn = DVec3::new(normal(), normal(), normal()) * (2.0 * strength).to_radians();
    let pose = shot.reported.camera_from_world.inverse();
    let rotation = (DQuat::from_scaled_axis(turn) * pose.rotation).normalize();
    shot.reported.camera_from_world = Rigid { rotation, translation: pose.translation + shift }.inverse();
}

/// Grain of a sensor at high gain: that of photons grows with the root of light, that of reading is always there.
fn roughen(light: &mut [Vec3], shot: &Shot, fault: &Fault) {
    let seed = of(fault, &shot.name).bits() as u32;
    for (i, value) in light.iter_mut().enumerate() {
        let mut channel = 0;
        *value = value.map(|c| {
            channel += 3;
            // the sum of three even numbers is near enough to a normal one, with variance 1/4
            let draw = (0..3).map(|n| grain(seed, i, channel + n)).sum::<f32>() - 1.5;
            c + 2.0 * draw * fault.strength * (0.003 + 0.03 * c.max(0.0).sqrt())
        });
    }
}

/// Drops on their way down: thin streaks, lighter than what they hide.
fn streak(light: &mut [Vec3], width: usize, shot: &Shot, fault: &Fault, drop: Vec3) {
    let height = light.len() / width.max(1);
    let mut random = of(fault, &shot.name);
    let count = (0.0025 * fault.strength * light.len() as f32) as usize;
    let slant = random.range(-0.2, 0.2);
    for _ in 0..count {
        let (x, y) = (random.range(0.0, width as f32), random.range(-0.1, 1.0) * height as f32);
        let near = random.unit() * random.unit();
        let length = (0.01 + 0.08 * near) * height as f32;
        let thick = 0.12 + 0.3 * near;
        for step in 0..length as usize {
            let at = Vec2::new(x + slant * step as f32, y + step as f32);
            let (u, v) = (at.x.floor() as i64, at.y as i64);
            if u < 0 || v < 0 || at.y < 0.0 || u >= width as i64 || v >= height as i64 {
                continue;
            }
            let value = &mut light[v as usize * width + u as usize];
            *value = value.lerp(drop, thick);
        }
    }
}

/// Spots out of focus: each takes a part of the picture's light and puts a part of its mean there.
fn soil(light: &mut [Vec3], width: usize, shot: &Shot, fault: &Fault) {
    let mean = light.iter().sum::<Vec3>() / light.len().max(1) as f32;
    let veil = 0.05 * fault.strength;
    light.iter_mut().for_each(|value| *value = value.lerp(mean, veil));
    let height = light.len() / width.max(1);
    let mut random = of(fault, &shot.sensor);
    let brown = mean * vec3(0.5, 0.42, 0.32);
    for _ in 0..30 {
        let centre = Vec2::new(random.unit() * width as f32, random.unit() * height as f32);
        let radius = (0.008 + 0.05 * random.unit().powi(3)) * width as f32;
        let thick = fault.strength * random.range(0.3, 0.9);
        let (low, high) = ((centre - radius).max(Vec2::ZERO), centre + radius);
        for y in low.y as usize..(high.y as usize + 1).min(height) {
            for x in low.x as usize..(high.x as usize + 1).min(width) {
                let off = Vec2::new(x as f32 + 0.5, y as f32 + 0.5).distance(centre) / radius;
                let soft = (2.0 - 2.0 * off).clamp(0.0, 1.0);
                let value = &mut light[y * width + x];
                *value = value.lerp(brown, thick * soft * soft * (3.0 - 2.0 * soft));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_are_read_as_people_type_them() {
        for &kind in Kind::ALL {
            assert_eq!(kind.to_string().parse(), Ok(Fault { kind, strength: 1.0, seed: 0 }));
        }
        assert_eq!("fog=0.25".parse(), Ok(Fault { kind: Kind::Fog, strength: 0.25, seed: 0 }));
        for text in ["", "fogg", "fog=", "fog=-0.1", "fog=1.1", "fog=nan", "fog=inf", "fog=0.1=2"] {
            let refusal = text.parse::<Fault>().unwrap_err().to_string();
            assert!(refusal.starts_with("fault") && !refusal.contains('\n'), "{refusal}");
        }
    }
}
