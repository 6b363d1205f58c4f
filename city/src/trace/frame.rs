//! Renders a shot: an RGB image and its ground truth.
//!
//! Ground truth comes from the ray through the pixel's centre, at the middle of its row's exposure. The colour comes
//! from the same ray where the neighbours look alike. At edges and shadow boundaries, and everywhere with motion blur,
//! it is the mean of stratified samples over the exposure of the row (adaptive supersampling, Whitted 1980).

use glam::{DVec2, DVec3, Quat, Vec2, Vec3};
use rayon::prelude::*;
use scene::Rigid;
use serde::{Deserialize, Serialize};

use super::{
    degrade::{degrade_image, degrade_light},
    ray::{Hit, Ray, RayMask},
    shade::{Light, Radiance, Shader},
    world::{Moment, World},
};
use crate::{
    Class,
    faults::{self, Fault},
    sense::Shot,
};

/// Largest number of pixels of an image.
pub const MAX_PIXELS: u64 = 1 << 26;
/// [`Layer::semantic`] of the layer behind glass where there is no glass.
pub const NO_SURFACE: u8 = 255;
/// [`Layer::material`] of the sky and where there is no surface.
pub const NO_MATERIAL: u16 = u16::MAX;
/// Times within an exposure for which moving actors are placed. Odd, so that one is the middle.
const TIME_STEPS: usize = 15;
/// Side of the square of pixels that share their ambient occlusion rays, one direction each. A smaller square shows
/// separate faint shadows of near objects.
const TILE: u32 = 8;
/// How much a pixel may is_edge_between from a neighbour in a colour's square root, of 1, and be left at one sample.
const EDGE_THRESHOLD: f32 = 0.035;
/// Range of ambient occlusion, metres.
const OCCLUSION_METRES: f32 = 4.0;

/// How images are rendered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RenderOptions {
    /// Samples along each side of a pixel that is supersampled, 1 to 8.
    pub samples: u32,
    /// Ambient occlusion.
    pub corners: bool,
    /// Sun, sky and air.
    pub light: Light,
    /// Faults of light, image and mask. Faults of shots are applied by [`faults::degrade_shots`].
    pub faults: Vec<Fault>,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self { samples: 2, corners: true, light: Light::default(), faults: Vec::new() }
    }
}

/// A shot that cannot be rendered.
#[derive(Debug, thiserror::Error, Clone, PartialEq, Eq)]
pub enum FrameError {
    /// No pixels, or more than [`MAX_PIXELS`].
    #[error("an image of {0} × {1} pixels has no pixels or too many")]
    Size(u32, u32),
    /// A camera, time or setting that is not finite or out of range.
    #[error("{0} is out of range")]
    Setting(&'static str),
}

/// Ground truth of one surface per pixel; rows from the top.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Layer {
    /// Metres along the optical axis; 0 for the sky.
    pub depth: Vec<f32>,
    /// [`Class`], or [`NO_SURFACE`].
    pub semantic: Vec<u8>,
    /// [`crate::Actor::instance`]; 0 for actors without an instance.
    pub instance: Vec<u32>,
    /// Row of [`crate::City::materials`], or [`NO_MATERIAL`].
    pub material: Vec<u16>,
}

/// An image and its ground truth, all `width × height`, rows from the top.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Frame {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// sRGB, three bytes a pixel.
    pub rgb: Vec<u8>,
    /// The first surface, including glass.
    pub first: Layer,
    /// The first opaque surface behind glass; [`NO_SURFACE`] where the first surface is not glass.
    pub behind: Layer,
    /// Unit normals in the world, turned to the camera; zero for the sky.
    pub normals: Vec<[f32; 3]>,
    /// Ground truth: 1 on actors with a trajectory, 0 elsewhere.
    pub moves: Vec<u8>,
    /// The mask of a data set: `moves` without the actors left out by [`faults::FaultKind::MovingUnmasked`].
    pub mask: Vec<u8>,
}

/// Renders a shot. The bytes do not depend on the number of threads.
///
/// # Errors
/// [`FrameError`] for sizes and numbers out of range.
pub fn render_frame(world: &World, shot: &Shot, options: &RenderOptions) -> Result<Frame, FrameError> {
    check(shot, options)?;
    let renderer = FrameRenderer::new(world, shot, options);
    let rows: Vec<FrameRow> = (0..renderer.height).into_par_iter().map(|y| renderer.row(y)).collect();
    let mut out = Frame { width: renderer.width, height: renderer.height, ..Frame::default() };
    let mut radiances = Vec::with_capacity(rows.len() * renderer.width as usize);
    let mut open = Vec::with_capacity(radiances.capacity());
    for row in rows {
        radiances.extend(row.radiances);
        open.extend(row.is_open);
        out.append(row.ground_truth);
    }
    if renderer.side > 1 {
        renderer.supersample_edges(&mut radiances);
    }
    let mut light = combine(&out, &radiances, &open);
    for value in &mut light {
        *value *= shot.exposure;
    }
    degrade_image(&mut light, renderer.width as usize, shot, &options.faults, options.light.horizon);
    out.rgb = light.par_iter().flat_map_iter(|&linear| encode(linear)).collect();
    Ok(out)
}

/// Encodes linear light as sRGB bytes (IEC 61966-2-1).
pub fn encode(linear: Vec3) -> [u8; 3] {
    linear.to_array().map(|c| {
        let c = c.clamp(0.0, 1.0);
        let curved = if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
        (255.0 * curved + 0.5) as u8
    })
}

fn check(shot: &Shot, options: &RenderOptions) -> Result<(), FrameError> {
    let k = &shot.camera.pinhole;
    if k.width == 0 || k.height == 0 || u64::from(k.width) * u64::from(k.height) > MAX_PIXELS {
        return Err(FrameError::Size(k.width, k.height));
    }
    let lens = [k.fx, k.fy].iter().all(|f| f.is_finite() && *f > 1e-3) && k.cx.is_finite() && k.cy.is_finite();
    if !lens || !shot.camera.camera_from_world.is_sane() || shot.camera.centre().abs().max_element() > 1e7 {
        return Err(FrameError::Setting("the camera"));
    }
    let times = [shot.shutter_seconds, shot.rolling_shutter_seconds];
    let moves = shot.motion.velocity.is_finite() && shot.motion.spin.is_finite() && shot.seconds.is_finite();
    if !moves || times.iter().any(|t| !(0.0..=60.0).contains(t)) {
        return Err(FrameError::Setting("the shutter"));
    }
    if !shot.exposure.is_finite() || shot.exposure < 0.0 {
        return Err(FrameError::Setting("the exposure"));
    }
    if !(1..=8).contains(&options.samples) {
        return Err(FrameError::Setting("samples"));
    }
    if !options.light.is_valid() || options.faults.iter().any(|f| !f.is_valid()) {
        return Err(FrameError::Setting("the light or a fault"));
    }
    Ok(())
}

/// Renders one shot.
struct FrameRenderer<'a> {
    shot: &'a Shot,
    options: &'a RenderOptions,
    light: Light,
    world_from_camera: Rigid,
    width: u32,
    height: u32,
    /// Samples along each side.
    side: u32,
    /// The city at even steps of the exposure, rolling shutter included.
    moments: Vec<Moment<'a>>,
}

/// Mean radiance of a pixel's samples, and of those at its left, right, upper and lower side.
#[derive(Default)]
struct Sampled {
    mean: Radiance,
    sides: [Radiance; 4],
}

/// Whether two radiances differ visibly.
fn is_edge_between(a: &Radiance, b: &Radiance) -> bool {
    let seen = |radiance: &Radiance| (radiance.direct + radiance.ambient).map(f32::sqrt);
    (seen(a) - seen(b)).abs().max_element() > EDGE_THRESHOLD
}

/// A row of an image before supersampling.
struct FrameRow {
    ground_truth: Frame,
    radiances: Vec<Radiance>,
    /// Whether the pixel's ambient occlusion ray is free.
    is_open: Vec<bool>,
}

impl<'a> FrameRenderer<'a> {
    fn new(world: &'a World, shot: &'a Shot, options: &'a RenderOptions) -> Self {
        let span = shot.shutter_seconds + shot.rolling_shutter_seconds;
        let steps = if span > 0.0 { TIME_STEPS } else { 1 };
        let at = |i: usize| world.at(shot.seconds + span * ((i as f64 + 0.5) / steps as f64 - 0.5));
        let k = &shot.camera.pinhole;
        Self {
            shot,
            options,
            light: degrade_light(&options.light, &options.faults),
            world_from_camera: shot.camera.camera_from_world.inverse(),
            width: k.width,
            height: k.height,
            // motion blur needs more samples than edges
            side: if shot.shutter_seconds > 0.0 { options.samples.max(4) } else { options.samples },
            moments: (0..steps).into_par_iter().map(at).collect(),
        }
    }

    /// The city and the camera pose this many seconds after the middle of the exposure.
    fn moment(&self, after: f64) -> (&Moment<'a>, Rigid) {
        let span = self.shot.shutter_seconds + self.shot.rolling_shutter_seconds;
        let step = if span > 0.0 { (after / span + 0.5) * self.moments.len() as f64 } else { 0.0 };
        let moment = &self.moments[(step.max(0.0) as usize).min(self.moments.len() - 1)];
        (moment, self.shot.motion.extrapolate(&self.world_from_camera, after))
    }

    /// The time of a row relative to the middle row, seconds (rolling shutter).
    fn row_time(&self, y: u32) -> f64 {
        self.shot.rolling_shutter_seconds * ((f64::from(y) + 0.5) / f64::from(self.height) - 0.5)
    }

    fn row(&self, y: u32) -> FrameRow {
        let time = self.row_time(y);
        let (moment, pose) = self.moment(time);
        let shader = Shader { moment, light: &self.light, spread: self.spread(1) };
        let mut row = FrameRow { ground_truth: Frame::default(), radiances: Vec::new(), is_open: Vec::new() };
        for x in 0..self.width {
            let (ray, along) = self.ray(&pose, f64::from(x) + 0.5, f64::from(y) + 0.5);
            let hit = moment.cast(&ray, RayMask::All);
            self.ground_truth(&mut row.ground_truth, moment, &ray, along, hit.as_ref());
            row.is_open.push(self.is_open(moment, &ray, hit.as_ref(), x, y));
            row.radiances.push(if self.blurs() { Radiance::default() } else { shader.shade_hit(&ray, hit.as_ref()) });
        }
        row
    }

    /// Whether there is motion blur.
    fn blurs(&self) -> bool {
        self.shot.shutter_seconds > 0.0
    }

    /// Width of a sample per metre of distance, with this many samples along each side of a pixel.
    fn spread(&self, side: u32) -> f32 {
        1.2 / (self.shot.camera.pinhole.fx as f32 * side as f32)
    }

    /// Supersamples pixels that differ from a neighbour. Then, repeatedly, neighbours that differ from the new samples
    /// on their side: this follows thin lines that pass between pixel centres.
    fn supersample_edges(&self, radiances: &mut [Radiance]) {
        let (width, height) = (self.width as usize, self.height as usize);
        let mut done = vec![false; radiances.len()];
        let beside = |i: usize| {
            let (x, y) = (i % width, i / width);
            let there = [x > 0, x + 1 < width, y > 0, y + 1 < height];
            let place = [i.wrapping_sub(1), i + 1, i.wrapping_sub(width), i + width];
            (0..4).filter(move |&side| there[side]).map(move |side| (side, place[side]))
        };
        let is_edge =
            |i: &usize| self.blurs() || beside(*i).any(|(_, j)| is_edge_between(&radiances[*i], &radiances[j]));
        let mut edges: Vec<usize> = (0..radiances.len()).into_par_iter().filter(is_edge).collect();
        while !edges.is_empty() {
            let sampled: Vec<Sampled> =
                edges.par_iter().map(|&i| self.sample_pixel((i % width) as u32, (i / width) as u32)).collect();
            for (&i, pixel) in edges.iter().zip(&sampled) {
                (radiances[i], done[i]) = (pixel.mean, true);
            }
            let mut more = Vec::new();
            for (&i, pixel) in edges.iter().zip(&sampled) {
                for (side, j) in beside(i) {
                    if !done[j] && is_edge_between(&pixel.sides[side], &radiances[j]) {
                        done[j] = true;
                        more.push(j);
                    }
                }
            }
            edges = more;
        }
    }

    /// The ray through an image point in pixels, and the depth of one metre along it.
    fn ray(&self, pose: &Rigid, x: f64, y: f64) -> (Ray, f32) {
        let k = &self.shot.camera.pinhole;
        let local = DVec3::new((x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0);
        let length = local.length();
        let direction = (pose.rotation * (local / length)).as_vec3().normalize_or(Vec3::Z);
        (Ray::new(pose.translation.as_vec3(), direction), (1.0 / length) as f32)
    }

    /// Supersamples a pixel.
    fn sample_pixel(&self, x: u32, y: u32) -> Sampled {
        let (time, side) = (self.row_time(y), self.side);
        let samples = side * side;
        let spread = self.spread(side);
        let mut out = Sampled::default();
        for i in 0..samples {
            let (column, line) = (i % side, i / side);
            let place = (DVec2::new(f64::from(column), f64::from(line)) + 0.5) / f64::from(side);
            // samples have different times within the exposure, permuted between pixels
            let turn = (i * 7 + x * 5 + y * 11) % samples;
            let blur = self.shot.shutter_seconds * ((f64::from(turn) + 0.5) / f64::from(samples) - 0.5);
            let (moment, pose) = self.moment(time + blur);
            let (ray, _) = self.ray(&pose, f64::from(x) + place.x, f64::from(y) + place.y);
            let radiance = Shader { moment, light: &self.light, spread }.radiance(&ray);
            out.mean = out.mean.plus(radiance);
            for (sum, at_rim) in
                out.sides.iter_mut().zip([column == 0, column + 1 == side, line == 0, line + 1 == side])
            {
                *sum = if at_rim { sum.plus(radiance) } else { *sum };
            }
        }
        let share = |radiance: Radiance, of: u32| radiance.scale(Vec3::splat(1.0 / of as f32));
        Sampled { mean: share(out.mean, samples), sides: out.sides.map(|radiance| share(radiance, side)) }
    }

    fn ground_truth(&self, out: &mut Frame, moment: &Moment, ray: &Ray, along: f32, hit: Option<&Hit>) {
        out.first.push(moment, along, hit);
        let normal = hit.map_or(Vec3::ZERO, |h| h.normal);
        out.normals.push(normal.to_array());
        let moves = hit.is_some_and(|h| moment.actor(h).trajectory.is_some());
        out.moves.push(u8::from(moves));
        let forgotten = hit.is_some_and(|h| faults::is_left_unmasked(&self.options.faults, h.actor));
        out.mask.push(u8::from(moves && !forgotten));
        match hit {
            Some(h) if moment.material(h).1.transparency > 0.0 => {
                let beyond = Ray { t_min: h.distance + 1e-3, ..*ray };
                out.behind.push(moment, along, moment.cast(&beyond, RayMask::Opaque).as_ref());
            }
            _ => out.behind.push_nothing(),
        }
    }

    /// Whether the ambient occlusion ray of a pixel is free. Pixels of a tile have different directions.
    fn is_open(&self, moment: &Moment, ray: &Ray, hit: Option<&Hit>, x: u32, y: u32) -> bool {
        let Some(hit) = hit.filter(|_| self.options.corners) else { return true };
        let which = (x % TILE) * TILE + y % TILE;
        // a Fibonacci spiral on the disc, lifted onto the hemisphere: cosine-weighted directions
        let radius = ((which as f32 + 0.5) / (TILE * TILE) as f32).sqrt();
        let angle = which as f32 * 2.399_963_2;
        let disc = Vec2::new(angle.cos(), angle.sin()) * radius;
        let local = disc.extend((1.0 - radius * radius).max(0.0).sqrt());
        let direction = Quat::from_rotation_arc(Vec3::Z, hit.normal.normalize_or(Vec3::Z)) * local;
        let start = ray.at(hit.distance) + (2e-3 + 1e-5 * hit.distance) * hit.normal;
        !moment.is_occluded(&Ray { t_max: OCCLUSION_METRES, ..Ray::new(start, direction) })
    }
}

impl Layer {
    fn push(&mut self, moment: &Moment, along: f32, hit: Option<&Hit>) {
        self.depth.push(hit.map_or(0.0, |h| along * h.distance));
        self.semantic.push(hit.map_or(Class::Sky, |h| moment.class(h)) as u8);
        self.instance.push(hit.map_or(0, |h| moment.actor(h).instance));
        self.material.push(hit.map_or(NO_MATERIAL, |h| moment.material(h).0));
    }

    fn push_nothing(&mut self) {
        self.depth.push(0.0);
        self.semantic.push(NO_SURFACE);
        self.instance.push(0);
        self.material.push(NO_MATERIAL);
    }

    fn append(&mut self, rest: Self) {
        self.depth.extend(rest.depth);
        self.semantic.extend(rest.semantic);
        self.instance.extend(rest.instance);
        self.material.extend(rest.material);
    }
}

impl Frame {
    fn append(&mut self, rest: Self) {
        self.first.append(rest.first);
        self.behind.append(rest.behind);
        self.normals.extend(rest.normals);
        self.moves.extend(rest.moves);
        self.mask.extend(rest.mask);
    }
}

/// Combines direct and ambient light. Ambient occlusion is the share of free rays of the pixel and its neighbours on
/// the same surface; occluders reflect a third of the ambient light.
fn combine(frame: &Frame, radiances: &[Radiance], open: &[bool]) -> Vec<Vec3> {
    let (width, height) = (frame.width as i32, frame.height as i32);
    let side = TILE as i32;
    let one = |i: usize| {
        let (x, y) = (i as i32 % width, i as i32 / width);
        let (normal, depth) = (Vec3::from(frame.normals[i]), frame.first.depth[i]);
        let (mut free, mut all) = (0.0, 0.0);
        for (dx, dy) in (0..side * side).map(|n| (n % side - (side - 1) / 2, n / side - (side - 1) / 2)) {
            let (u, v) = (x + dx, y + dy);
            if u < 0 || v < 0 || u >= width || v >= height {
                continue;
            }
            let j = (v * width + u) as usize;
            let near = (frame.first.depth[j] - depth).abs() < 0.05 * depth;
            if j == i || (near && Vec3::from(frame.normals[j]).dot(normal) > 0.9) {
                free += f32::from(u8::from(open[j]));
                all += 1.0;
            }
        }
        let share: f32 = free / all;
        radiances[i].direct + radiances[i].ambient * (share + 0.33 * (1.0 - share))
    };
    (0..radiances.len()).into_par_iter().map(one).collect()
}
