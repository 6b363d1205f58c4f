//! Mesh builder: primitives with a current material, class and frame.
//!
//! Every face has its own corners, for hard edges, and uv in metres along and across its first edge.

pub(crate) mod furniture;
pub(crate) mod ground;
pub(crate) mod house;
pub(crate) mod person;
pub(crate) mod tree;
pub(crate) mod vehicle;

use glam::{Affine3A, Vec2, Vec3};

use crate::materials::{self, Surface};
use crate::types::{Asset, Class, Mesh};

/// A mesh under construction.
#[derive(Debug, Clone)]
pub(crate) struct Builder {
    mesh: Mesh,
    material: Surface,
    class: Class,
    frame: Affine3A,
}

impl Builder {
    pub(crate) fn new(class: Class) -> Self {
        Self { mesh: Mesh::default(), material: materials::CONCRETE, class, frame: Affine3A::IDENTITY }
    }

    pub(crate) fn finish(self, name: impl Into<String>) -> Asset {
        Asset { name: name.into(), mesh: self.mesh }
    }

    /// Sets the material of the next faces.
    pub(crate) fn paint(&mut self, material: Surface) -> &mut Self {
        self.material = material;
        self
    }

    /// Sets the class of the next faces.
    pub(crate) fn class(&mut self, class: Class) -> &mut Self {
        self.class = class;
        self
    }

    /// Runs `build` in a nested frame.
    pub(crate) fn within(&mut self, frame: Affine3A, build: impl FnOnce(&mut Self)) {
        let before = self.frame;
        self.frame = before * frame;
        build(self);
        self.frame = before;
    }

    /// Adds a corner, for faces with shared corners.
    pub(crate) fn corner(&mut self, at: Vec3, uv: Vec2) -> u32 {
        let index = self.mesh.positions.len() as u32;
        self.mesh.positions.push(self.frame.transform_point3(at));
        self.mesh.uvs.push(uv);
        index
    }

    /// Adds a triangle of existing corners unless it is degenerate.
    pub(crate) fn face(&mut self, corners: [u32; 3]) {
        let [a, b, c] = corners.map(|i| self.mesh.positions[i as usize]);
        if (b - a).cross(c - a).length_squared() < 1e-12 {
            return;
        }
        self.mesh.triangles.push(corners);
        self.mesh.materials.push(self.material.0);
        self.mesh.classes.push(self.class);
    }

    /// A triangle, counter-clockwise seen from outside.
    pub(crate) fn triangle(&mut self, [a, b, c]: [Vec3; 3]) {
        let along = (b - a).normalize_or(Vec3::X);
        let across = (b - a).cross(c - a).cross(along).normalize_or(Vec3::Y);
        let corners = [a, b, c].map(|p| self.corner(p, Vec2::new((p - a).dot(along), (p - a).dot(across))));
        self.face(corners);
    }

    /// A four-sided face, counter-clockwise seen from outside; u runs from `a` to `b`, v from `a` to `d`.
    pub(crate) fn quad(&mut self, corners: [Vec3; 4]) {
        let [a, b, c, d] = corners;
        let along = (b - a).try_normalize().unwrap_or((c - d).normalize_or(Vec3::X));
        let across = (b - a).cross(d - a).cross(along).try_normalize();
        let across = across.unwrap_or((c - a).cross(d - a).cross(along).normalize_or(Vec3::Y));
        let corners = corners.map(|p| self.corner(p, Vec2::new((p - a).dot(along), (p - a).dot(across))));
        self.two_faces(corners);
    }

    /// An upright rectangle that faces -y, with x and z as uv, so that brick courses continue across adjacent panels.
    pub(crate) fn panel(&mut self, [x0, x1]: [f32; 2], [z0, z1]: [f32; 2], y: f32) {
        if x1 - x0 < 1e-3 || z1 - z0 < 1e-3 {
            return;
        }
        let corners = [[x0, z0], [x1, z0], [x1, z1], [x0, z1]];
        let corners = corners.map(|[x, z]| self.corner(Vec3::new(x, y, z), Vec2::new(x, z)));
        self.two_faces(corners);
    }

    /// A closed slab: a face with a thickness behind it.
    pub(crate) fn plank(&mut self, top: [Vec3; 4], thickness: f32) {
        let down = -(top[1] - top[0]).cross(top[3] - top[0]).normalize_or(Vec3::Z) * thickness;
        self.quad(top);
        let [a, b, c, d] = top.map(|p| p + down);
        self.quad([d, c, b, a]);
        for k in 0..4 {
            let next = (k + 1) % 4;
            self.quad([top[k] + down, top[next] + down, top[next], top[k]]);
        }
    }

    /// A four-sided face with uv from 0 to 1, for texts.
    pub(crate) fn plate(&mut self, corners: [Vec3; 4]) {
        let uvs = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
        let corners: [u32; 4] = std::array::from_fn(|k| self.corner(corners[k], uvs[k]));
        self.two_faces(corners);
    }

    fn two_faces(&mut self, [a, b, c, d]: [u32; 4]) {
        self.face([a, b, c]);
        self.face([a, c, d]);
    }

    /// An upright box without its bottom face.
    pub(crate) fn block(&mut self, min: Vec3, max: Vec3) {
        self.tapered([min.truncate(), max.truncate()], min.z, [min.truncate(), max.truncate()], max.z);
    }

    /// A box with all six sides.
    pub(crate) fn cuboid(&mut self, min: Vec3, max: Vec3) {
        self.block(min, max);
        let p = |x, y| Vec3::new(x, y, min.z);
        self.quad([p(min.x, max.y), p(max.x, max.y), p(max.x, min.y), p(min.x, min.y)]);
    }

    /// The frustum between two rectangles (min, max) at two heights: sides and top.
    pub(crate) fn tapered(&mut self, low: [Vec2; 2], z0: f32, high: [Vec2; 2], z1: f32) {
        let around = |[a, b]: [Vec2; 2], z: f32| {
            [Vec3::new(a.x, a.y, z), Vec3::new(b.x, a.y, z), Vec3::new(b.x, b.y, z), Vec3::new(a.x, b.y, z)]
        };
        let (low, high) = (around(low, z0), around(high, z1));
        for k in 0..4 {
            let next = (k + 1) % 4;
            self.quad([low[k], low[next], high[next], high[k]]);
        }
        self.quad(high);
    }

    /// A truncated cone between two points with `sides` sides and both caps.
    pub(crate) fn tube(&mut self, from: Vec3, to: Vec3, radius: [f32; 2], sides: usize) {
        let axis = (to - from).normalize_or(Vec3::Z);
        let right = axis.any_orthonormal_vector();
        let ahead = axis.cross(right);
        let rim = |centre: Vec3, radius: f32, k: usize| {
            let angle = std::f32::consts::TAU * k as f32 / sides as f32;
            centre + radius * (angle.cos() * right + angle.sin() * ahead)
        };
        for k in 0..sides {
            let [a, b] = [k, (k + 1) % sides];
            self.quad([rim(from, radius[0], a), rim(from, radius[0], b), rim(to, radius[1], b), rim(to, radius[1], a)]);
            self.triangle([from, rim(from, radius[0], b), rim(from, radius[0], a)]);
            self.triangle([to, rim(to, radius[1], a), rim(to, radius[1], b)]);
        }
    }

    /// An ellipsoid of `rings` rings and twice as many sectors, its radius at a unit direction scaled by `swell`.
    pub(crate) fn ball(&mut self, centre: Vec3, radii: Vec3, rings: usize, swell: &dyn Fn(Vec3) -> f32) {
        let sectors = 2 * rings;
        let direction = |ring: usize, sector: usize| {
            let polar = std::f32::consts::PI * ring as f32 / rings as f32;
            let turn = std::f32::consts::TAU * sector as f32 / sectors as f32;
            Vec3::new(polar.sin() * turn.cos(), polar.sin() * turn.sin(), polar.cos())
        };
        let mean = (radii.x + radii.y + radii.z) / 3.0;
        let corners: Vec<u32> = (0..=rings)
            .flat_map(|ring| (0..=sectors).map(move |sector| (ring, sector)))
            .map(|(ring, sector)| {
                let unit = direction(ring, sector % sectors);
                let around = std::f32::consts::TAU * mean * sector as f32 / sectors as f32;
                let down = std::f32::consts::PI * mean * ring as f32 / rings as f32;
                self.corner(centre + radii * unit * swell(unit), Vec2::new(around, -down))
            })
            .collect();
        for ring in 0..rings {
            for sector in 0..sectors {
                let at = |r: usize, s: usize| corners[r * (sectors + 1) + s];
                self.two_faces([
                    at(ring + 1, sector),
                    at(ring + 1, sector + 1),
                    at(ring, sector + 1),
                    at(ring, sector),
                ]);
            }
        }
    }

    /// Extrudes a profile in the x-z plane, counter-clockwise seen from -y, from y = -w to y = w, without caps.
    pub(crate) fn extrude(&mut self, profile: &[Vec2], half_width: &dyn Fn(Vec2) -> f32) {
        for k in 0..profile.len() {
            let (p, q) = (profile[k], profile[(k + 1) % profile.len()]);
            let (wp, wq) = (half_width(p), half_width(q));
            let at = |p: Vec2, y: f32| Vec3::new(p.x, y, p.y);
            self.quad([at(p, -wp), at(p, wp), at(q, wq), at(q, -wq)]);
        }
    }

    /// Both caps of an extruded profile that is star-shaped around `centre`.
    pub(crate) fn caps(&mut self, profile: &[Vec2], centre: Vec2, half_width: &dyn Fn(Vec2) -> f32) {
        for k in 0..profile.len() {
            let (p, q) = (profile[k], profile[(k + 1) % profile.len()]);
            let at = |p: Vec2, side: f32| Vec3::new(p.x, side * half_width(p), p.y);
            self.triangle([at(centre, -1.0), at(p, -1.0), at(q, -1.0)]);
            self.triangle([at(centre, 1.0), at(q, 1.0), at(p, 1.0)]);
        }
    }

    /// The lowest z.
    pub(crate) fn lowest(&self) -> f32 {
        self.mesh.positions.iter().fold(f32::INFINITY, |low, p| low.min(p.z))
    }

    /// Translates the whole mesh.
    pub(crate) fn shift(&mut self, by: Vec3) {
        for p in &mut self.mesh.positions {
            *p += by;
        }
    }
}
