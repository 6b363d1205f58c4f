//! Shading: sunlight with hard shadows, ambient light of sky and ground, glass with reflection and transmission, and
//! haze.

use glam::{Vec2, Vec3, vec3};
use serde::{Deserialize, Serialize};

use super::{
    pattern,
    ray::{Hit, Ray, RayMask},
    world::Moment,
};
use crate::{Class, Material};

/// Offset of secondary rays from their surface, metres.
const OFFSET: f32 = 2e-3;
/// Reflectance of glass at normal incidence.
const GLASS: f32 = 0.04;

/// Share of the light absorbed by a pane that its dust scatters back.
const DUST: f32 = 0.15;

/// Sun, sky and air. Radiance is linear RGB; 1 is a white wall in full sun.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Light {
    /// Unit vector towards the sun.
    pub towards_sun: Vec3,
    /// Irradiance of the sun on a surface that faces it.
    pub sun: Vec3,
    /// Radiance of the sky at the zenith.
    pub zenith: Vec3,
    /// Radiance of the sky at the horizon, and of the haze.
    pub horizon: Vec3,
    /// Ambient light from the ground.
    pub ground: Vec3,
    /// Brightness of the lamps of streets, cars and rooms, 0 to 1.
    pub lamps: f32,
    /// Extinction of the air, 1/m: 0 for clear air, 0.03 for thick fog.
    pub fog: f32,
    /// Wetness of surfaces that face up, 0 to 1: wet surfaces are darker and reflect at grazing angles.
    pub wet: f32,
    /// Strength of road patterns, 0 to 1.
    pub road_pattern: f32,
}

impl Default for Light {
    /// A clear day, the sun 56° high in the south-east.
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
    /// Whether every number is finite and not negative, and the sun's direction a unit vector.
    pub fn is_valid(&self) -> bool {
        let lights = [self.sun, self.zenith, self.horizon, self.ground];
        let numbers = [self.lamps, self.fog, self.wet, self.road_pattern];
        (self.towards_sun.length() - 1.0).abs() < 1e-2
            && lights.iter().all(|l| l.is_finite() && l.min_element() >= 0.0)
            && numbers.iter().all(|n| n.is_finite() && *n >= 0.0)
    }

    /// Radiance of the sky in a direction.
    pub fn sky(&self, direction: Vec3) -> Vec3 {
        let height = direction.z.max(0.0);
        self.horizon.lerp(self.zenith, 1.0 - (-3.2 * height).exp())
    }

    /// Ambient light of sky and ground on a surface with this normal.
    fn ambient(&self, normal: Vec3) -> Vec3 {
        let sky = 0.5 * (self.zenith + self.horizon);
        self.ground.lerp(sky, 0.5 + 0.5 * normal.z)
    }
}

/// Radiance along a ray in two parts. Ambient light is reduced by ambient occlusion, which is computed once per pixel
/// and not per sample.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Radiance {
    /// All but ambient light.
    pub(crate) direct: Vec3,
    /// Ambient light without occlusion.
    pub(crate) ambient: Vec3,
}

impl Radiance {
    pub(crate) fn scale(self, by: Vec3) -> Self {
        Self { direct: self.direct * by, ambient: self.ambient * by }
    }

    fn add(self, light: Vec3) -> Self {
        Self { direct: self.direct + light, ..self }
    }

    pub(crate) fn plus(self, other: Self) -> Self {
        Self { direct: self.direct + other.direct, ambient: self.ambient + other.ambient }
    }
}

/// Shades rays at one time.
pub(crate) struct Shader<'a> {
    pub(crate) moment: &'a Moment<'a>,
    pub(crate) light: &'a Light,
    /// Width of a sample per metre of distance.
    pub(crate) spread: f32,
}

impl Shader<'_> {
    /// The radiance along a ray.
    pub(crate) fn radiance(&self, ray: &Ray) -> Radiance {
        self.shade_hit(ray, self.moment.cast(ray, RayMask::All).as_ref())
    }

    /// The radiance along a ray whose first hit is known.
    pub(crate) fn shade_hit(&self, ray: &Ray, hit: Option<&Hit>) -> Radiance {
        hit.map_or_else(|| self.sky(ray), |hit| self.surface(ray, hit))
    }

    fn sky(&self, ray: &Ray) -> Radiance {
        Radiance { direct: self.light.sky(ray.direction), ambient: Vec3::ZERO }
    }

    /// The radiance of a surface: glass reflects, and transmits the radiance behind it.
    fn surface(&self, ray: &Ray, hit: &Hit) -> Radiance {
        let (_, material) = self.moment.material(hit);
        if material.transparency <= 0.0 {
            return self.opaque(ray, hit, true);
        }
        let clear = material.transparency.min(1.0);
        let mirrored = fresnel(GLASS, -hit.normal.dot(ray.direction));
        let beyond = Ray { t_min: hit.distance + 1e-3, ..*ray };
        let behind = match self.moment.cast(&beyond, RayMask::Opaque) {
            Some(behind) => self.opaque(&beyond, &behind, false),
            None => self.sky(ray),
        };
        // light that is not transmitted is absorbed, except for scattering by dust
        let dust = self.opaque(ray, hit, false).scale(Vec3::splat(DUST * (1.0 - clear)));
        let tint = Vec3::ONE.lerp(material.base_colour, 0.5) * clear;
        let through = behind.scale(tint).plus(dust).scale(Vec3::splat(1.0 - mirrored));
        through.add(mirrored * self.reflection(ray, hit, 0.0))
    }

    fn opaque(&self, ray: &Ray, hit: &Hit, mirrors: bool) -> Radiance {
        let (row, material) = self.moment.material(hit);
        let class = self.moment.class(hit);
        let point = ray.at(hit.distance);
        let paint = self.paint(ray, hit, row, material, class);
        let wet = self.light.wet * (2.0 * hit.normal.z - 1.0).clamp(0.0, 1.0);
        let matt = paint * (1.0 - material.metallic) * (1.0 - 0.45 * wet);
        let sun = self.sun(point, hit, class);
        let mut radiance = Radiance { direct: matt * sun, ambient: matt * self.light.ambient(hit.normal) };
        let gloss = ((1.0 - material.roughness) * (1.0 - material.roughness)).max(0.5 * wet);
        if mirrors && (gloss > 0.1 || material.metallic > 0.1) {
            radiance = self.specular(ray, hit, material, gloss, paint, sun, radiance);
        }
        if self.light.lamps > 0.0 {
            radiance = radiance
                .add(self.light.lamps * (paint * self.moment.lamps().emission(row) + matt * self.lamps(point, hit)));
        }
        self.apply_haze(ray, hit, point, radiance)
    }

    /// Sunlight at a point. Leaves are translucent.
    fn sun(&self, point: Vec3, hit: &Hit, class: Class) -> Vec3 {
        let facing = hit.normal.dot(self.light.towards_sun);
        let leaf = class == Class::Vegetation;
        let share = if leaf { facing.abs() * if facing > 0.0 { 0.8 } else { 0.45 } } else { facing };
        if share <= 0.0 || self.light.sun == Vec3::ZERO {
            return Vec3::ZERO;
        }
        let side = if facing > 0.0 { hit.normal } else { -hit.normal };
        let shadow = Ray::new(point + (OFFSET + 1e-5 * hit.distance) * side, self.light.towards_sun);
        if self.moment.is_occluded(&shadow) { Vec3::ZERO } else { share * self.light.sun }
    }

    /// Irradiance of street lamps at a point.
    fn lamps(&self, point: Vec3, hit: &Hit) -> Vec3 {
        let start = point + (OFFSET + 1e-5 * hit.distance) * hit.normal;
        self.moment.lamps().irradiance(start, hit.normal, |from, to| {
            let way = to - from;
            !self.moment.is_occluded(&Ray { t_max: way.length(), ..Ray::new(from, way.normalize_or(Vec3::Z)) })
        })
    }

    /// Adds the specular part of paint, metal and wet ground: a reflection and the highlight of the sun.
    fn specular(
        &self,
        ray: &Ray,
        hit: &Hit,
        material: &Material,
        gloss: f32,
        paint: Vec3,
        sun: Vec3,
        matt: Radiance,
    ) -> Radiance {
        let cosine = -hit.normal.dot(ray.direction);
        let square = Vec3::splat(GLASS).lerp(paint, material.metallic.clamp(0.0, 1.0));
        let share = (square + (Vec3::ONE - square) * gloss * (1.0 - cosine.clamp(0.0, 1.0)).powi(5)).min(Vec3::ONE);
        let half = (self.light.towards_sun - ray.direction).normalize_or_zero();
        let tight = 4.0 + 300.0 * gloss * gloss;
        let spot = hit.normal.dot(half).max(0.0).powf(tight) * (tight + 8.0) / 25.0;
        let mirrored = self.reflection(ray, hit, material.roughness);
        matt.scale(Vec3::ONE - share).add(share * (mirrored + spot * sun))
    }

    /// Reflected radiance at a hit; rough surfaces reflect ambient light.
    fn reflection(&self, ray: &Ray, hit: &Hit, roughness: f32) -> Vec3 {
        let direction = (ray.direction - 2.0 * ray.direction.dot(hit.normal) * hit.normal).normalize_or_zero();
        let blurred = self.light.ambient(direction);
        if roughness > 0.6 {
            return blurred;
        }
        let away = Ray { t_min: OFFSET, ..Ray::new(ray.at(hit.distance) + OFFSET * hit.normal, direction) };
        let sharp = match self.moment.cast(&away, RayMask::Opaque) {
            Some(other) => {
                let radiance = self.opaque(&away, &other, false);
                radiance.direct + 0.8 * radiance.ambient
            }
            None => self.light.sky(direction),
        };
        sharp.lerp(blurred, roughness)
    }

    /// Blends towards the horizon's radiance: outside the city by position, so that it is the same in all views, and by
    /// distance in fog.
    fn apply_haze(&self, ray: &Ray, hit: &Hit, point: Vec3, radiance: Radiance) -> Radiance {
        let extent = self.moment.city().extent_metres.max(100.0) as f32;
        let outside = (point.truncate().length() - 0.75 * extent).max(0.0);
        let clear = (-outside / (1.5 * extent) - self.light.fog * (hit.distance - ray.t_min.min(OFFSET))).exp();
        radiance.scale(Vec3::splat(clear)).add((1.0 - clear) * self.light.horizon)
    }

    /// The base colour with its pattern.
    fn paint(&self, ray: &Ray, hit: &Hit, row: u16, material: &Material, class: Class) -> Vec3 {
        let amount = match class {
            Class::Road | Class::RoadMarking => self.light.road_pattern,
            _ => 1.0,
        };
        let (uv, size) = footprint(self.moment, ray, hit, self.spread);
        pattern::colour(material, u32::from(row), &self.moment.city().texts, uv, size, amount)
    }
}

/// Fresnel reflectance (Schlick 1994).
fn fresnel(square: f32, cosine: f32) -> f32 {
    square + (1.0 - square) * (1.0 - cosine.clamp(0.0, 1.0)).powi(5)
}

/// The uv of a hit and the footprint of the sample in uv: as wide as the sample across the view direction, longer along
/// it at grazing angles.
fn footprint(moment: &Moment, ray: &Ray, hit: &Hit, spread: f32) -> (Vec2, Vec2) {
    let mesh = moment.mesh(hit);
    let corners = mesh.triangles[hit.triangle as usize].map(|c| c as usize);
    let [uv, second, third] = corners.map(|c| mesh.uvs[c]);
    let (second, third) = (second - uv, third - uv);
    let [a, b, c] = corners.map(|c| mesh.positions[c]);
    let (e, f) = (b - a, c - a);
    let (ee, ef, ff) = (e.dot(e), e.dot(f), f.dot(f));
    let area = (ee * ff - ef * ef).max(1e-12);
    // scale from metres to uv; exact where uv are metres
    let stretch = |d: Vec2| (d.x * d.x * ff - 2.0 * d.x * d.y * ef + d.y * d.y * ee).max(0.0) / area;
    let scale = Vec2::new(stretch(Vec2::new(second.x, third.x)).sqrt(), stretch(Vec2::new(second.y, third.y)).sqrt());
    let across = spread * hit.distance;
    let cosine = -hit.normal.dot(ray.direction);
    let long = (1.0 / cosine.max(0.03)).min(30.0);
    let pose = super::motion::pose_at(moment.actor(hit), moment.seconds).rotation.as_quat();
    let view = pose.inverse() * (ray.direction - hit.normal * ray.direction.dot(hit.normal)).normalize_or_zero();
    // the share of the elongation along u and along v
    let (p, q) = (view.dot(e), view.dot(f));
    let (s, t) = ((p * ff - q * ef) / area, (q * ee - p * ef) / area);
    let along = (second * s + third * t).abs();
    let size = across * (scale + along * (long - 1.0));
    (uv + hit.barycentrics.x * second + hit.barycentrics.y * third, size)
}
