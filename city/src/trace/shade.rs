//! The light that comes back from a surface: sun with hard shadows, sky from above, light from the ground below, glass
//! that mirrors and lets through, and air between.

use glam::{Vec2, Vec3, vec3};
use serde::{Deserialize, Serialize};

use super::{
    pattern,
    world::{Hit, Meets, Moment, Ray},
};
use crate::{Class, Material};

/// Metres that a ray starts off the surface it leaves.
const OFF: f32 = 2e-3;
/// What glass mirrors of light that meets it squarely.
const GLASS: f32 = 0.04;

/// Share of what a pane swallows that its dust sends back.
const DUST: f32 = 0.15;

/// Sun, sky and air. Light is linear RGB; 1 is what a white wall sends back in full sun.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Light {
    /// Unit vector towards the sun.
    pub towards_sun: Vec3,
    /// Light of the sun on a surface that faces it.
    pub sun: Vec3,
    /// Light of the sky straight above.
    pub zenith: Vec3,
    /// Light of the sky just above the horizon, and what far ground fades into.
    pub horizon: Vec3,
    /// Light that the ground throws up.
    pub ground: Vec3,
    /// How far lamps are turned on, 0 to 1: those of streets, cars and rooms.
    pub lamps: f32,
    /// Extinction by the air, 1/m: 0 for clear air, 0.03 for thick fog.
    pub fog: f32,
    /// How wet what faces up is, 0 to 1: darker, and a mirror at a grazing angle.
    pub wet: f32,
    /// How much pattern roads show, 0 to 1.
    pub road_pattern: f32,
}

impl Default for Light {
    /// A clear day, the sun at 56° in the south-east.
    fn default() -> Self {
        Self {
            towards_sun: vec3(0.435_194_5, -0.340_587, 0.833_475_6),
            sun: vec3(0.98, 0.91, 0.8),
            zenith: vec3(0.22, 0.32, 0.48),
            horizon: vec3(0.6, 0.67, 0.76),
            ground: vec3(0.15, 0.14, 0.12),
            lamps: 0.0,
            fog: 0.0,
            wet: 0.0,
            road_pattern: 1.0,
        }
    }
}

impl Light {
    /// Every number finite and not negative, the sun's direction one.
    pub fn is_sane(&self) -> bool {
        let lights = [self.sun, self.zenith, self.horizon, self.ground];
        let numbers = [self.lamps, self.fog, self.wet, self.road_pattern];
        (self.towards_sun.length() - 1.0).abs() < 1e-2
            && lights.iter().all(|l| l.is_finite() && l.min_element() >= 0.0)
            && numbers.iter().all(|n| n.is_finite() && *n >= 0.0)
    }

    /// The sky's light from a direction: pale at the horizon, deeper above.
    pub fn sky(&self, direction: Vec3) -> Vec3 {
        let height = direction.z.max(0.0);
        self.horizon.lerp(self.zenith, 1.0 - (-3.2 * height).exp())
    }

    /// Light of sky and ground on a surface with this normal.
    fn around(&self, normal: Vec3) -> Vec3 {
        let sky = 0.5 * (self.zenith + self.horizon);
        self.ground.lerp(sky, 0.5 + 0.5 * normal.z)
    }
}

/// Light that arrives along a ray, in two parts: what sky and ground send onto near surfaces is less in corners, and how
/// much less is found out for a pixel and not for each of its samples.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Glow {
    /// All but the light from around.
    pub(crate) direct: Vec3,
    /// The light from around, as it is in the open.
    pub(crate) around: Vec3,
}

impl Glow {
    pub(crate) fn scale(self, by: Vec3) -> Self {
        Self { direct: self.direct * by, around: self.around * by }
    }

    fn add(self, light: Vec3) -> Self {
        Self { direct: self.direct + light, ..self }
    }

    pub(crate) fn plus(self, other: Self) -> Self {
        Self { direct: self.direct + other.direct, around: self.around + other.around }
    }
}

/// Shades rays at a moment.
pub(crate) struct Shader<'a> {
    pub(crate) moment: &'a Moment<'a>,
    pub(crate) light: &'a Light,
    /// Width of a sample per metre of distance.
    pub(crate) spread: f32,
}

impl Shader<'_> {
    /// The light along a ray.
    pub(crate) fn glow(&self, ray: &Ray) -> Glow {
        self.of(ray, self.moment.cast(ray, Meets::Everything).as_ref())
    }

    /// The light along a ray of which it is known what it meets first.
    pub(crate) fn of(&self, ray: &Ray, hit: Option<&Hit>) -> Glow {
        hit.map_or_else(|| self.sky(ray), |hit| self.surface(ray, hit))
    }

    fn sky(&self, ray: &Ray) -> Glow {
        Glow { direct: self.light.sky(ray.direction), around: Vec3::ZERO }
    }

    /// The light that a surface sends back along a ray: glass mirrors, and shows what is behind it.
    fn surface(&self, ray: &Ray, hit: &Hit) -> Glow {
        let (_, material) = self.moment.material(hit);
        if material.transparency <= 0.0 {
            return self.opaque(ray, hit, true);
        }
        let clear = material.transparency.min(1.0);
        let mirrored = fresnel(GLASS, -hit.normal.dot(ray.direction));
        let beyond = Ray { from: hit.distance + 1e-3, ..*ray };
        let behind = match self.moment.cast(&beyond, Meets::Opaque) {
            Some(behind) => self.opaque(&beyond, &behind, false),
            None => self.sky(ray),
        };
        // what does not go through is lost in the pane, but for the dust on it
        let own = self.opaque(ray, hit, false).scale(Vec3::splat(DUST * (1.0 - clear)));
        let tint = Vec3::ONE.lerp(material.base_colour, 0.5) * clear;
        let through = behind.scale(tint).plus(own).scale(Vec3::splat(1.0 - mirrored));
        through.add(mirrored * self.mirror(ray, hit, 0.0))
    }

    fn opaque(&self, ray: &Ray, hit: &Hit, mirrors: bool) -> Glow {
        let (row, material) = self.moment.material(hit);
        let class = self.moment.class(hit);
        let point = ray.at(hit.distance);
        let paint = self.paint(ray, hit, row, material, class);
        let wet = self.light.wet * (2.0 * hit.normal.z - 1.0).clamp(0.0, 1.0);
        let matt = paint * (1.0 - material.metallic) * (1.0 - 0.45 * wet);
        let sun = self.sun(point, hit, class);
        let mut glow = Glow { direct: matt * sun, around: matt * self.light.around(hit.normal) };
        let gloss = ((1.0 - material.roughness) * (1.0 - material.roughness)).max(0.5 * wet);
        if mirrors && (gloss > 0.1 || material.metallic > 0.1) {
            glow = self.gloss(ray, hit, material, gloss, paint, sun, glow);
        }
        if self.light.lamps > 0.0 {
            glow = glow.add(self.light.lamps * (paint * self.moment.lamps().glow(row) + matt * self.lamps(point, hit)));
        }
        self.air(ray, hit, point, glow)
    }

    /// Light of the sun at a point. Leaves glow against it.
    fn sun(&self, point: Vec3, hit: &Hit, class: Class) -> Vec3 {
        let facing = hit.normal.dot(self.light.towards_sun);
        let leaf = class == Class::Vegetation;
        let share = if leaf { facing.abs() * if facing > 0.0 { 0.8 } else { 0.45 } } else { facing };
        if share <= 0.0 || self.light.sun == Vec3::ZERO {
            return Vec3::ZERO;
        }
        let side = if facing > 0.0 { hit.normal } else { -hit.normal };
        let shadow = Ray::new(point + (OFF + 1e-5 * hit.distance) * side, self.light.towards_sun);
        if self.moment.is_blocked(&shadow) { Vec3::ZERO } else { share * self.light.sun }
    }

    /// Light of street lamps at a point.
    fn lamps(&self, point: Vec3, hit: &Hit) -> Vec3 {
        let start = point + (OFF + 1e-5 * hit.distance) * hit.normal;
        self.moment.lamps().shine(start, hit.normal, |from, to| {
            let way = to - from;
            !self.moment.is_blocked(&Ray { to: way.length(), ..Ray::new(from, way.normalize_or(Vec3::Z)) })
        })
    }

    /// What paint, metal and wet ground add: a soft mirror of sky or walls, and the sun's blurred image.
    fn gloss(&self, ray: &Ray, hit: &Hit, material: &Material, gloss: f32, paint: Vec3, sun: Vec3, matt: Glow) -> Glow {
        let cosine = -hit.normal.dot(ray.direction);
        let square = Vec3::splat(GLASS).lerp(paint, material.metallic.clamp(0.0, 1.0));
        let share = (square + (Vec3::ONE - square) * gloss * (1.0 - cosine.clamp(0.0, 1.0)).powi(5)).min(Vec3::ONE);
        let half = (self.light.towards_sun - ray.direction).normalize_or_zero();
        let tight = 4.0 + 300.0 * gloss * gloss;
        let spot = hit.normal.dot(half).max(0.0).powf(tight) * (tight + 8.0) / 25.0;
        let mirrored = self.mirror(ray, hit, material.roughness);
        matt.scale(Vec3::ONE - share).add(share * (mirrored + spot * sun))
    }

    /// The light that a mirror at the hit would show; a rough one shows the sky's and the street's mean.
    fn mirror(&self, ray: &Ray, hit: &Hit, roughness: f32) -> Vec3 {
        let direction = (ray.direction - 2.0 * ray.direction.dot(hit.normal) * hit.normal).normalize_or_zero();
        let blurred = self.light.around(direction);
        if roughness > 0.6 {
            return blurred;
        }
        let away = Ray { from: OFF, ..Ray::new(ray.at(hit.distance) + OFF * hit.normal, direction) };
        let sharp = match self.moment.cast(&away, Meets::Opaque) {
            Some(other) => {
                let glow = self.opaque(&away, &other, false);
                glow.direct + 0.8 * glow.around
            }
            None => self.light.sky(direction),
        };
        sharp.lerp(blurred, roughness)
    }

    /// Air takes over: by place outside the city, so that it is the same from everywhere, and by distance in fog.
    fn air(&self, ray: &Ray, hit: &Hit, point: Vec3, glow: Glow) -> Glow {
        let extent = self.moment.city().extent_metres.max(100.0) as f32;
        let outside = (point.truncate().length() - 0.75 * extent).max(0.0);
        let clear = (-outside / (1.5 * extent) - self.light.fog * (hit.distance - ray.from.min(OFF))).exp();
        glow.scale(Vec3::splat(clear)).add((1.0 - clear) * self.light.horizon)
    }

    /// The surface's own colour.
    fn paint(&self, ray: &Ray, hit: &Hit, row: u16, material: &Material, class: Class) -> Vec3 {
        let amount = match class {
            Class::Road | Class::RoadMarking => self.light.road_pattern,
            _ => 1.0,
        };
        let (uv, size) = footprint(self.moment, ray, hit, self.spread);
        pattern::colour(material, u32::from(row), &self.moment.city().texts, uv, size, amount)
    }
}

/// Fresnel's share of mirrored light, after Schlick 1994.
fn fresnel(square: f32, cosine: f32) -> f32 {
    square + (1.0 - square) * (1.0 - cosine.clamp(0.0, 1.0)).powi(5)
}

/// Where a ray meets the surface in the surface's own coordinates, and how far its sample reaches in them: as wide as the
/// sample is across the view, longer along it where the surface is seen at an angle.
fn footprint(moment: &Moment, ray: &Ray, hit: &Hit, spread: f32) -> (Vec2, Vec2) {
    let mesh = moment.mesh(hit);
    let corners = mesh.triangles[hit.triangle as usize].map(|c| c as usize);
    let [uv, second, third] = corners.map(|c| mesh.uvs[c]);
    let (second, third) = (second - uv, third - uv);
    let [a, b, c] = corners.map(|c| mesh.positions[c]);
    let (e, f) = (b - a, c - a);
    let (ee, ef, ff) = (e.dot(e), e.dot(f), f.dot(f));
    let area = (ee * ff - ef * ef).max(1e-12);
    // the pixel's width is spread evenly over u and v by how metres stretch to them, exact for uv in metres
    let stretch = |d: Vec2| (d.x * d.x * ff - 2.0 * d.x * d.y * ef + d.y * d.y * ee).max(0.0) / area;
    let scale = Vec2::new(stretch(Vec2::new(second.x, third.x)).sqrt(), stretch(Vec2::new(second.y, third.y)).sqrt());
    let across = spread * hit.distance;
    let cosine = -hit.normal.dot(ray.direction);
    let long = (1.0 / cosine.max(0.03)).min(30.0);
    let pose = super::motion::pose_at(moment.actor(hit), moment.seconds).rotation.as_quat();
    let view = pose.inverse() * (ray.direction - hit.normal * ray.direction.dot(hit.normal)).normalize_or_zero();
    // how much of the long way runs along u and along v
    let (p, q) = (view.dot(e), view.dot(f));
    let (s, t) = ((p * ff - q * ef) / area, (q * ee - p * ef) / area);
    let along = (second * s + third * t).abs();
    let size = across * (scale + along * (long - 1.0));
    (uv + hit.corners.x * second + hit.corners.y * third, size)
}
