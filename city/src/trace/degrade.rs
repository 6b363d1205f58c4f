//! Faults that act on light and on images: night, weather, lens dirt and plain roads. Faults of shots are applied by
//! [`crate::faults::degrade_shots`].

use glam::{Vec2, Vec3, vec3};

use super::{pattern::grain, shade::Light};
use crate::{
    faults::{Fault, FaultKind, named_random},
    sense::Shot,
};

/// Applies faults to the light.
pub(crate) fn degrade_light(light: &Light, faults: &[Fault]) -> Light {
    let mut light = *light;
    for fault in faults {
        let s = fault.strength;
        match fault.kind {
            FaultKind::Night => {
                let down = (1.0 - s) * (1.0 - s);
                light.sun *= vec3(0.022, 0.027, 0.036).lerp(Vec3::ONE, down);
                for part in [&mut light.zenith, &mut light.horizon, &mut light.ground] {
                    *part *= vec3(0.03, 0.036, 0.05).lerp(Vec3::ONE, down);
                }
                light.lamps = light.lamps.max(s);
            }
            FaultKind::Rain => {
                overcast(&mut light, 0.95 * s);
                light.wet += s;
                light.fog += 0.004 * s;
            }
            FaultKind::Fog => {
                overcast(&mut light, 0.85 * s);
                light.fog += 0.03 * s;
            }
            FaultKind::TexturelessRoad => light.road_pattern *= 1.0 - s,
            _ => {}
        }
    }
    light
}

/// Moves a share of the sunlight into the sky and desaturates it.
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

/// Applies faults to an image of linear light after the gain; `sky` is the light at the horizon.
pub(crate) fn degrade_image(light: &mut [Vec3], width: usize, shot: &Shot, faults: &[Fault], sky: Vec3) {
    for fault in faults.iter().filter(|f| f.strength > 0.0) {
        match fault.kind {
            FaultKind::Night => add_grain(light, shot, fault),
            FaultKind::Rain => add_rain(light, width, shot, fault, 0.8 * sky * shot.exposure),
            FaultKind::LensDirt => add_lens_dirt(light, width, shot, fault),
            _ => {}
        }
    }
}

/// Sensor noise at high gain: shot noise grows with the square root of light, read noise is constant.
fn add_grain(light: &mut [Vec3], shot: &Shot, fault: &Fault) {
    let seed = named_random(fault, &shot.name).bits() as u32;
    for (i, value) in light.iter_mut().enumerate() {
        let mut channel = 0;
        *value = value.map(|c| {
            channel += 3;
            // the sum of three uniform numbers is nearly normal, with variance 1/4
            let draw = (0..3).map(|n| grain(seed, i, channel + n)).sum::<f32>() - 1.5;
            c + 2.0 * draw * fault.strength * (0.003 + 0.03 * c.max(0.0).sqrt())
        });
    }
}

/// Falling drops: thin streaks in the colour of the sky.
fn add_rain(light: &mut [Vec3], width: usize, shot: &Shot, fault: &Fault, drop: Vec3) {
    let height = light.len() / width.max(1);
    let mut random = named_random(fault, &shot.name);
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

/// Spots out of focus, each blended towards the image's mean, and a veil over the whole image.
fn add_lens_dirt(light: &mut [Vec3], width: usize, shot: &Shot, fault: &Fault) {
    let mean = light.iter().sum::<Vec3>() / light.len().max(1) as f32;
    let veil = 0.05 * fault.strength;
    light.iter_mut().for_each(|value| *value = value.lerp(mean, veil));
    let height = light.len() / width.max(1);
    let mut random = named_random(fault, &shot.sensor);
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
