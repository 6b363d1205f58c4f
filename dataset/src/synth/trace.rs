//! Casting rays into the city: a flat grid over the solids, sun with hard shadows, and whole views.

use glam::{Vec2, Vec3, vec3};
use scene::Camera;

use super::city::{self, Layout, Shape, Solid};
use super::surface;

/// Side of a grid cell, metres.
const CELL: f32 = 4.0;
/// Unit vector towards the sun.
const SUN: Vec3 = vec3(0.435_194_5, -0.340_587, 0.833_475_6);
const SUN_LIGHT: Vec3 = vec3(1.0, 0.95, 0.86);
const SKY_LIGHT: Vec3 = vec3(0.36, 0.41, 0.5);
/// Farther than any ray needs to go, metres.
const FAR: f32 = 1e5;

/// The city with an index over it.
pub(super) struct World {
    pub(super) layout: Layout,
    pub(super) solids: Vec<Solid>,
    cells: Vec<Cell>,
    /// Solids of all cells, one after the other.
    members: Vec<u32>,
    side: usize,
    origin: Vec2,
    top: f32,
}

#[derive(Clone, Copy, Default)]
struct Cell {
    start: u32,
    end: u32,
    /// Height of the tallest solid in the cell.
    top: f32,
}

/// Where a ray first meets the city; `solid` is `None` on the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Hit {
    pub(super) distance: f32,
    pub(super) normal: Vec3,
    pub(super) solid: Option<u32>,
}

struct Ray {
    origin: Vec3,
    direction: Vec3,
    inverse: Vec3,
}

impl Ray {
    fn new(origin: Vec3, direction: Vec3) -> Self {
        // no component is exactly zero, so that slab tests never meet 0 · ∞
        let apart = |c: f32| if c.abs() < 1e-9 { 1e-9 } else { c };
        let direction = Vec3::new(apart(direction.x), apart(direction.y), apart(direction.z));
        Self { origin, direction, inverse: direction.recip() }
    }
}

impl World {
    pub(super) fn new(layout: Layout) -> Self {
        let solids = city::build(&layout);
        let half = 0.5 * layout.extent + 12.0;
        let side = (2.0 * half / CELL).ceil() as usize;
        let origin = Vec2::splat(-half);
        let mut lists = vec![Vec::new(); side * side];
        let mut cells = vec![Cell::default(); side * side];
        for (i, solid) in solids.iter().enumerate() {
            let index = |c: f32| (((c + half) / CELL) as usize).min(side - 1);
            for y in index(solid.min.y)..=index(solid.max.y) {
                for x in index(solid.min.x)..=index(solid.max.x) {
                    lists[y * side + x].push(i as u32);
                    let cell = &mut cells[y * side + x];
                    cell.top = cell.top.max(solid.max.z);
                }
            }
        }
        let mut members = Vec::new();
        for (cell, list) in cells.iter_mut().zip(lists) {
            cell.start = members.len() as u32;
            members.extend(list);
            cell.end = members.len() as u32;
        }
        let top = solids.iter().fold(0.0, |top: f32, s| top.max(s.max.z));
        Self { layout, solids, cells, members, side, origin, top }
    }

    /// The nearest hit along a unit direction.
    pub(super) fn cast(&self, origin: Vec3, direction: Vec3) -> Option<Hit> {
        let ray = Ray::new(origin, direction);
        let ground = if ray.direction.z < 0.0 { -origin.z * ray.inverse.z } else { f32::INFINITY };
        match self.walk(&ray, ground.min(FAR), false) {
            Some(hit) => Some(hit),
            None if ground < FAR => Some(Hit { distance: ground, normal: Vec3::Z, solid: None }),
            None => None,
        }
    }

    /// True where a solid lies on the segment of this length.
    pub(super) fn is_blocked(&self, origin: Vec3, direction: Vec3, length: f32) -> bool {
        self.walk(&Ray::new(origin, direction), length, true).is_some()
    }

    /// The nearest (or any) solid within `length`, cell by cell along the ray.
    fn walk(&self, ray: &Ray, length: f32, any: bool) -> Option<Hit> {
        let high = self.origin + self.side as f32 * CELL;
        let (low, high) = (self.origin.extend(-1.0), high.extend(self.top));
        let (from, to) = ((low - ray.origin) * ray.inverse, (high - ray.origin) * ray.inverse);
        let mut t = from.min(to).max_element().max(0.0);
        let t_end = from.max(to).min_element().min(length);
        if t >= t_end {
            return None;
        }
        let entry = (ray.origin + t * ray.direction).truncate() - self.origin;
        let last = self.side as i32 - 1;
        let mut cell = (entry / CELL).floor().as_ivec2().clamp(glam::IVec2::ZERO, glam::IVec2::splat(last));
        let step = glam::IVec2::new(ray.direction.x.signum() as i32, ray.direction.y.signum() as i32);
        let edge = self.origin + (cell + (step + 1) / 2).as_vec2() * CELL;
        let mut next = (edge - ray.origin.truncate()) * ray.inverse.truncate();
        let stride = CELL * ray.inverse.truncate().abs();
        let mut best: Option<Hit> = None;
        let mut nearest = length;
        loop {
            let leave = next.min_element().min(t_end);
            let content = self.cells[cell.y as usize * self.side + cell.x as usize];
            let lowest = ray.origin.z + ray.direction.z * if ray.direction.z < 0.0 { leave } else { t };
            if lowest <= content.top {
                for &i in &self.members[content.start as usize..content.end as usize] {
                    if let Some((distance, normal)) = intersect(&self.solids[i as usize], ray, nearest) {
                        nearest = distance;
                        best = Some(Hit { distance, normal, solid: Some(i) });
                        if any {
                            return best;
                        }
                    }
                }
            }
            if leave >= t_end || nearest <= leave {
                return best;
            }
            t = leave;
            if next.x < next.y {
                cell.x += step.x;
                next.x += stride.x;
            } else {
                cell.y += step.y;
                next.y += stride.y;
            }
            if cell.min_element() < 0 || cell.max_element() > last {
                return best;
            }
        }
    }

    /// Linear light that arrives along a ray; `spread` is a pixel's width per metre of distance.
    pub(super) fn light(&self, origin: Vec3, direction: Vec3, spread: f32) -> Vec3 {
        match self.cast(origin, direction) {
            Some(hit) => self.shade(origin + hit.distance * direction, &hit, spread),
            None => square(surface::sky_colour(direction)),
        }
    }

    /// Linear light that a hit point sends back. Surfaces are matt: the same from everywhere.
    pub(super) fn shade(&self, point: Vec3, hit: &Hit, spread: f32) -> Vec3 {
        let footprint = spread * hit.distance;
        let paint = match hit.solid {
            Some(i) => surface::solid_colour(&self.solids[i as usize], point, hit.normal, footprint),
            None => surface::ground_colour(&self.layout, point.truncate(), footprint),
        };
        let facing = hit.normal.dot(SUN);
        let lit = facing > 0.0 && !self.is_blocked(point + 2e-3 * hit.normal, SUN, FAR);
        let sky = SKY_LIGHT * (0.75 + 0.25 * hit.normal.z);
        let light = if lit { sky + facing * SUN_LIGHT } else { sky };
        let colour = square(paint.clamp(Vec3::ZERO, Vec3::ONE)) * light;
        // haze takes over outside the city, by place and not by distance, so that it is the same from everywhere
        let outside = (point.truncate().length() - self.layout.extent).max(0.0);
        square(surface::HORIZON).lerp(colour, (-outside / (1.5 * self.layout.extent)).exp())
    }

    /// A view, 8-bit sRGB, rows from the top: 2×2 rays a pixel, averaged in linear light.
    pub(super) fn view(&self, camera: &Camera) -> Vec<u8> {
        let k = &camera.pinhole;
        let world_from_camera = camera.camera_from_world.inverse();
        let origin = world_from_camera.translation.as_vec3();
        let rotation = world_from_camera.rotation.as_quat();
        let axes = [rotation * Vec3::X, rotation * Vec3::Y, rotation * Vec3::Z];
        let (fx, fy, cx, cy) = (k.fx as f32, k.fy as f32, k.cx as f32, k.cy as f32);
        let mut rgb = Vec::with_capacity(3 * k.width as usize * k.height as usize);
        for y in 0..k.height {
            for x in 0..k.width {
                let mut sum = Vec3::ZERO;
                for (dx, dy) in [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)] {
                    let (u, v) = ((x as f32 + dx - cx) / fx, (y as f32 + dy - cy) / fy);
                    let direction = (u * axes[0] + v * axes[1] + axes[2]).normalize();
                    sum += self.light(origin, direction, 1.0 / fx);
                }
                rgb.extend(encode(0.25 * sum));
            }
        }
        rgb
    }
}

/// 8-bit values of linear light, with a gamma of 2: close to sRGB's curve, and exact on every machine.
pub(super) fn encode(linear: Vec3) -> [u8; 3] {
    let bytes = linear.clamp(Vec3::ZERO, Vec3::ONE).to_array();
    bytes.map(|c| (255.0 * c.sqrt() + 0.5) as u8)
}

fn square(colour: Vec3) -> Vec3 {
    colour * colour
}

/// The nearest entry of a ray into a solid, in `(0, nearest)`, and the normal there.
fn intersect(solid: &Solid, ray: &Ray, nearest: f32) -> Option<(f32, Vec3)> {
    let (a, b) = ((solid.min - ray.origin) * ray.inverse, (solid.max - ray.origin) * ray.inverse);
    let (near, far) = (a.min(b), a.max(b));
    let (mut enter, mut leave) = (near.max_element(), far.min_element());
    if enter >= leave || leave <= 0.0 || enter >= nearest {
        return None;
    }
    let mut normal = match () {
        _ if enter == near.x => Vec3::new(-ray.direction.x.signum(), 0.0, 0.0),
        _ if enter == near.y => Vec3::new(0.0, -ray.direction.y.signum(), 0.0),
        _ => Vec3::new(0.0, 0.0, -ray.direction.z.signum()),
    };
    match solid.shape {
        Shape::Box => {}
        Shape::Gable { along_x } => {
            let centre = 0.5 * (solid.min + solid.max);
            let half = centre - solid.min;
            for side in [-1.0, 1.0] {
                let slope = match along_x {
                    true => Vec3::new(0.0, side * 2.0 * half.z, half.y),
                    false => Vec3::new(side * 2.0 * half.z, 0.0, half.x),
                };
                let outward = slope.normalize();
                let height = outward.dot(ray.origin - centre.with_z(solid.max.z));
                let t = -height / outward.dot(ray.direction);
                match outward.dot(ray.direction) < 0.0 {
                    true if t > enter => (enter, normal) = (t, outward),
                    true => {}
                    false => leave = leave.min(t),
                }
            }
        }
        Shape::Ellipsoid => {
            let (centre, radius) = (0.5 * (solid.min + solid.max), 0.5 * (solid.max - solid.min));
            let (o, d) = ((ray.origin - centre) / radius, ray.direction / radius);
            let (dd, od) = (d.dot(d), o.dot(d));
            let root = od * od - dd * (o.dot(o) - 1.0);
            if root <= 0.0 {
                return None;
            }
            enter = (-od - root.sqrt()) / dd;
            normal = ((o + enter * d) / radius).normalize();
        }
    }
    (enter > 0.0 && enter < leave && enter < nearest).then_some((enter, normal))
}
