//! A shot as a picture and its truth.
//!
//! Truth is of the one ray through the pixel's centre, at the middle of its row's exposure. A pixel's colour is what this ray
//! shows where its neighbours show the same; where they differ, at edges of things and of shadows, and where the picture
//! is blurred, it is the mean of stratified samples, spread over the time its row is exposed (Whitted 1980).

use glam::{DVec2, DVec3, Quat, Vec2, Vec3};
use rayon::prelude::*;
use scene::Rigid;
use serde::{Deserialize, Serialize};

use super::{
    pattern::unit,
    shade::{Glow, Light, Shader},
    world::{Hit, Meets, Moment, Ray, World},
};
use crate::{
    Class,
    faults::{self, Fault},
    sense::Shot,
};

/// The most pixels of a picture.
pub const MOST_PIXELS: u64 = 1 << 26;
/// [`Layer::semantic`] where a layer has nothing to say: there is no glass to look through.
pub const NOTHING: u8 = 255;
/// [`Layer::material`] of the sky and of nothing.
pub const NO_MATERIAL: u16 = u16::MAX;
/// Times for which what moves is placed anew while a picture is taken: an odd number, so that one is its middle.
const TICKS: usize = 15;
/// Side of the square of pixels that share their tries for light from around: one direction each. With fewer, what stands
/// near shows as so many faint shadows of itself.
const SQUARE: u32 = 8;
/// How much a pixel may differ from a neighbour in a colour's square root, of 1, and be left at one sample.
const SMOOTH: f32 = 0.035;
/// How near something must be to take light from around away, metres.
const CORNER: f32 = 4.0;

/// How pictures are made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Options {
    /// Samples along each side of a pixel that is not like its neighbours, 1 to 8.
    pub samples: u32,
    /// Whether near surfaces keep sky and ground light from each other.
    pub corners: bool,
    /// Sun, sky and air.
    pub light: Light,
    /// What goes wrong: those of the light and of the picture. Those of shots are [`faults::spoil_shots`]' business.
    pub faults: Vec<Fault>,
}

impl Default for Options {
    fn default() -> Self {
        Self { samples: 2, corners: true, light: Light::default(), faults: Vec::new() }
    }
}

/// A picture that cannot be made.
#[derive(Debug, thiserror::Error, Clone, PartialEq, Eq)]
pub enum FrameError {
    /// No pixels, or more than [`MOST_PIXELS`].
    #[error("a picture of {0} × {1} pixels")]
    Size(u32, u32),
    /// A camera, time or setting that is not finite or out of its range.
    #[error("{0} is out of range")]
    Setting(&'static str),
}

/// What is first along each pixel's ray; rows from the top.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Layer {
    /// Metres along the optical axis; 0 for the sky and for nothing.
    pub depth: Vec<f32>,
    /// [`Class`], or [`NOTHING`].
    pub semantic: Vec<u8>,
    /// [`crate::Actor::instance`]; 0 for what is not counted.
    pub instance: Vec<u32>,
    /// Row of [`crate::City::materials`], or [`NO_MATERIAL`].
    pub material: Vec<u16>,
}

/// A picture and its truth, all of `width × height`, rows from the top.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Frame {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// sRGB, three bytes a pixel.
    pub rgb: Vec<u8>,
    /// What is seen first, glass too.
    pub first: Layer,
    /// What is seen through glass; [`NOTHING`] where there is none.
    pub behind: Layer,
    /// Unit normals in the world, turned to the camera; zero for the sky.
    pub normals: Vec<[f32; 3]>,
    /// Truth: 1 on what moves in the course of the city's time (has a trajectory), 0 elsewhere.
    pub moves: Vec<u8>,
    /// As a data set would mask it: `moves`, less what [`faults::Kind::MovingUnmasked`] forgets.
    pub mask: Vec<u8>,
}

/// Takes a shot. The same shot gives the same bytes, whatever the number of threads.
///
/// # Errors
/// [`FrameError`] for sizes and numbers that cannot be.
pub fn frame(world: &World, shot: &Shot, options: &Options) -> Result<Frame, FrameError> {
    check(shot, options)?;
    let take = Take::new(world, shot, options);
    let rows: Vec<Row> = (0..take.height).into_par_iter().map(|y| take.row(y)).collect();
    let mut out = Frame { width: take.width, height: take.height, ..Frame::default() };
    let mut glows = Vec::with_capacity(rows.len() * take.width as usize);
    let mut open = Vec::with_capacity(glows.capacity());
    for row in rows {
        glows.extend(row.glows);
        open.extend(row.open);
        out.take(row.truth);
    }
    if take.side > 1 {
        take.sharpen(&mut glows);
    }
    let mut light = merge(&out, &glows, &open);
    for value in &mut light {
        *value *= shot.exposure;
    }
    faults::spoil_picture(&mut light, take.width as usize, shot, options);
    out.rgb = light.par_iter().flat_map_iter(|&linear| encode(linear)).collect();
    Ok(out)
}

/// Bytes of linear light after sRGB's curve (IEC 61966-2-1).
pub fn encode(linear: Vec3) -> [u8; 3] {
    linear.to_array().map(|c| {
        let c = c.clamp(0.0, 1.0);
        let curved = if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
        (255.0 * curved + 0.5) as u8
    })
}

fn check(shot: &Shot, options: &Options) -> Result<(), FrameError> {
    let k = &shot.camera.pinhole;
    if k.width == 0 || k.height == 0 || u64::from(k.width) * u64::from(k.height) > MOST_PIXELS {
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
    if !options.light.is_sane() || options.faults.iter().any(|f| !f.is_sane()) {
        return Err(FrameError::Setting("the light or a fault"));
    }
    Ok(())
}

/// A shot being taken.
struct Take<'a> {
    shot: &'a Shot,
    options: &'a Options,
    light: Light,
    world_from_camera: Rigid,
    width: u32,
    height: u32,
    /// Samples along each side.
    side: u32,
    /// The city at even steps of the time that the picture takes.
    moments: Vec<Moment<'a>>,
}

/// The mean light of a pixel's samples, and of those at its left, right, upper and lower side.
#[derive(Default)]
struct Sampled {
    mean: Glow,
    sides: [Glow; 4],
}

/// Whether light differs so much that it shows.
fn differ(a: &Glow, b: &Glow) -> bool {
    let seen = |glow: &Glow| (glow.direct + glow.around).map(f32::sqrt);
    (seen(a) - seen(b)).abs().max_element() > SMOOTH
}

/// A row of a picture.
struct Row {
    truth: Frame,
    glows: Vec<Glow>,
    /// Whether light from around arrives, along one direction a pixel.
    open: Vec<bool>,
}

impl<'a> Take<'a> {
    fn new(world: &'a World, shot: &'a Shot, options: &'a Options) -> Self {
        let span = shot.shutter_seconds + shot.rolling_shutter_seconds;
        let ticks = if span > 0.0 { TICKS } else { 1 };
        let at = |i: usize| world.at(shot.seconds + span * ((i as f64 + 0.5) / ticks as f64 - 0.5));
        let k = &shot.camera.pinhole;
        Self {
            shot,
            options,
            light: faults::spoil_light(&options.light, &options.faults),
            world_from_camera: shot.camera.camera_from_world.inverse(),
            width: k.width,
            height: k.height,
            // a blur needs more moments than edges need samples
            side: if shot.shutter_seconds > 0.0 { options.samples.max(4) } else { options.samples },
            moments: (0..ticks).into_par_iter().map(at).collect(),
        }
    }

    /// The city and the camera this long after the middle of the picture's time.
    fn moment(&self, after: f64) -> (&Moment<'a>, Rigid) {
        let span = self.shot.shutter_seconds + self.shot.rolling_shutter_seconds;
        let tick = if span > 0.0 { (after / span + 0.5) * self.moments.len() as f64 } else { 0.0 };
        let moment = &self.moments[(tick.max(0.0) as usize).min(self.moments.len() - 1)];
        (moment, self.shot.motion.carry(&self.world_from_camera, after))
    }

    /// When a row is read out, from the middle of the picture's time.
    fn row_time(&self, y: u32) -> f64 {
        self.shot.rolling_shutter_seconds * ((f64::from(y) + 0.5) / f64::from(self.height) - 0.5)
    }

    fn row(&self, y: u32) -> Row {
        let time = self.row_time(y);
        let (moment, pose) = self.moment(time);
        let shader = Shader { moment, light: &self.light, spread: self.spread(1) };
        let mut row = Row { truth: Frame::default(), glows: Vec::new(), open: Vec::new() };
        for x in 0..self.width {
            let (ray, along) = self.ray(&pose, f64::from(x) + 0.5, f64::from(y) + 0.5);
            let hit = moment.cast(&ray, Meets::Everything);
            self.truth(&mut row.truth, moment, &ray, along, hit.as_ref());
            row.open.push(self.is_open(moment, &ray, hit.as_ref(), x, y));
            row.glows.push(if self.blurs() { Glow::default() } else { shader.of(&ray, hit.as_ref()) });
        }
        row
    }

    /// Whether samples of a pixel are of different times.
    fn blurs(&self) -> bool {
        self.shot.shutter_seconds > 0.0
    }

    /// Width of a sample per metre of distance, of so many along each side of a pixel.
    fn spread(&self, side: u32) -> f32 {
        1.2 / (self.shot.camera.pinhole.fx as f32 * side as f32)
    }

    /// Samples anew what is not like its neighbours; then, as long as there are any, the neighbours of which the samples on
    /// their side tell that they are not alike either: so a line is followed where it passes between pixels' centres.
    fn sharpen(&self, glows: &mut [Glow]) {
        let (width, height) = (self.width as usize, self.height as usize);
        let mut done = vec![false; glows.len()];
        let beside = |i: usize| {
            let (x, y) = (i % width, i / width);
            let there = [x > 0, x + 1 < width, y > 0, y + 1 < height];
            let place = [i.wrapping_sub(1), i + 1, i.wrapping_sub(width), i + width];
            (0..4).filter(move |&side| there[side]).map(move |side| (side, place[side]))
        };
        let is_edge = |i: &usize| self.blurs() || beside(*i).any(|(_, j)| differ(&glows[*i], &glows[j]));
        let mut edges: Vec<usize> = (0..glows.len()).into_par_iter().filter(is_edge).collect();
        while !edges.is_empty() {
            let sampled: Vec<Sampled> =
                edges.par_iter().map(|&i| self.colour((i % width) as u32, (i / width) as u32)).collect();
            for (&i, pixel) in edges.iter().zip(&sampled) {
                (glows[i], done[i]) = (pixel.mean, true);
            }
            let mut more = Vec::new();
            for (&i, pixel) in edges.iter().zip(&sampled) {
                for (side, j) in beside(i) {
                    if !done[j] && differ(&pixel.sides[side], &glows[j]) {
                        done[j] = true;
                        more.push(j);
                    }
                }
            }
            edges = more;
        }
    }

    /// The ray through a place of the picture, and how many metres of depth a metre along it is.
    fn ray(&self, pose: &Rigid, x: f64, y: f64) -> (Ray, f32) {
        let k = &self.shot.camera.pinhole;
        let local = DVec3::new((x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0);
        let length = local.length();
        let direction = (pose.rotation * (local / length)).as_vec3().normalize_or(Vec3::Z);
        (Ray::new(pose.translation.as_vec3(), direction), (1.0 / length) as f32)
    }

    /// Samples a pixel.
    fn colour(&self, x: u32, y: u32) -> Sampled {
        let (time, side) = (self.row_time(y), self.side);
        let samples = side * side;
        let spread = self.spread(side);
        let mut out = Sampled::default();
        for i in 0..samples {
            let (column, line) = (i % side, i / side);
            let place = (DVec2::new(f64::from(column), f64::from(line)) + 0.5) / f64::from(side);
            // each sample has its own part of the exposure, and neighbours other ones
            let turn = (i * 7 + x * 5 + y * 11) % samples;
            let blur = self.shot.shutter_seconds * ((f64::from(turn) + 0.5) / f64::from(samples) - 0.5);
            let (moment, pose) = self.moment(time + blur);
            let (ray, _) = self.ray(&pose, f64::from(x) + place.x, f64::from(y) + place.y);
            let glow = Shader { moment, light: &self.light, spread }.glow(&ray);
            out.mean = out.mean.plus(glow);
            for (sum, at_rim) in
                out.sides.iter_mut().zip([column == 0, column + 1 == side, line == 0, line + 1 == side])
            {
                *sum = if at_rim { sum.plus(glow) } else { *sum };
            }
        }
        let share = |glow: Glow, of: u32| glow.scale(Vec3::splat(1.0 / of as f32));
        Sampled { mean: share(out.mean, samples), sides: out.sides.map(|glow| share(glow, side)) }
    }

    fn truth(&self, out: &mut Frame, moment: &Moment, ray: &Ray, along: f32, hit: Option<&Hit>) {
        out.first.push(moment, along, hit);
        let normal = hit.map_or(Vec3::ZERO, |h| h.normal);
        out.normals.push(normal.to_array());
        let moves = hit.is_some_and(|h| moment.actor(h).trajectory.is_some());
        out.moves.push(u8::from(moves));
        let forgotten = hit.is_some_and(|h| faults::is_forgotten(&self.options.faults, h.actor));
        out.mask.push(u8::from(moves && !forgotten));
        match hit {
            Some(h) if moment.material(h).1.transparency > 0.0 => {
                let beyond = Ray { from: h.distance + 1e-3, ..*ray };
                out.behind.push(moment, along, moment.cast(&beyond, Meets::Opaque).as_ref());
            }
            _ => out.behind.push_nothing(),
        }
    }

    /// Whether a direction, another one for each pixel of a square, is free.
    fn is_open(&self, moment: &Moment, ray: &Ray, hit: Option<&Hit>, x: u32, y: u32) -> bool {
        let Some(hit) = hit.filter(|_| self.options.corners) else { return true };
        let which = (x % SQUARE) * SQUARE + y % SQUARE;
        // Fibonacci's spiral on the disc, lifted onto the hemisphere: directions as frequent as their light counts
        let radius = ((which as f32 + 0.5) / (SQUARE * SQUARE) as f32).sqrt();
        let angle = which as f32 * 2.399_963_2;
        let disc = Vec2::new(angle.cos(), angle.sin()) * radius;
        let local = disc.extend((1.0 - radius * radius).max(0.0).sqrt());
        let direction = Quat::from_rotation_arc(Vec3::Z, hit.normal.normalize_or(Vec3::Z)) * local;
        let start = ray.at(hit.distance) + (2e-3 + 1e-5 * hit.distance) * hit.normal;
        !moment.is_blocked(&Ray { to: CORNER, ..Ray::new(start, direction) })
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
        self.semantic.push(NOTHING);
        self.instance.push(0);
        self.material.push(NO_MATERIAL);
    }

    fn take(&mut self, rest: Self) {
        self.depth.extend(rest.depth);
        self.semantic.extend(rest.semantic);
        self.instance.extend(rest.instance);
        self.material.extend(rest.material);
    }
}

impl Frame {
    fn take(&mut self, rest: Self) {
        self.first.take(rest.first);
        self.behind.take(rest.behind);
        self.normals.extend(rest.normals);
        self.moves.extend(rest.moves);
        self.mask.extend(rest.mask);
    }
}

/// One light of two: that from around is less where, of the directions that a pixel and its neighbours on the same
/// surface tried, some were taken. What takes the light away sends a third of it back.
fn merge(frame: &Frame, glows: &[Glow], open: &[bool]) -> Vec<Vec3> {
    let (width, height) = (frame.width as i32, frame.height as i32);
    let side = SQUARE as i32;
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
        glows[i].direct + glows[i].around * (share + 0.33 * (1.0 - share))
    };
    (0..glows.len()).into_par_iter().map(one).collect()
}

/// A number in [0, 1) of a pixel, for grain.
pub(crate) fn grain(seed: u32, i: usize, channel: i32) -> f32 {
    unit(super::pattern::hash(seed, i as i32, channel))
}
