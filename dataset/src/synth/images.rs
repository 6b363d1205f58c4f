//! Photos, masks and the truth of their pixels; written as they are made, never all held.

use std::io::Cursor;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use city::random::{Random, bits};
use city::sense::Shot;
use city::trace::{Frame, RenderOptions, World, render_frame};
use glam::{DVec3, Vec3};
use image::{ColorType, ImageFormat};
use rayon::prelude::*;
use store::file::{SaveError, save};

use super::scene_files::Instances;
use super::{Progress, Settings, SynthError, city_moves, impossible, make, truth};

/// Pixels of photos that are in the making at once.
const PIXELS_AT_ONCE: usize = 1 << 23;
/// Sparse points that a photo gives at most.
const POINTS_OF_A_VIEW: usize = 120;
/// Places of a photo that are tried for a point, for each that is wanted.
const TRIES: usize = 4;
/// Bytes by which a place has to differ from its surroundings to be found for certain.
const CERTAIN: f32 = 28.0;

/// A place that a view shows and that structure from motion would find.
pub(super) struct Seed {
    /// Truth: on the surface, world metres.
    pub(super) position: DVec3,
    /// Truth: of the surface, turned to the view.
    pub(super) normal: Vec3,
    /// As the photo shows it.
    pub(super) colour: [u8; 3],
    /// Metres that a pixel of the view covers there.
    pub(super) footprint: f64,
}

/// What is kept of the photos.
pub(super) struct Taken {
    /// Of each shot.
    pub(super) seeds: Vec<Vec<Seed>>,
    /// Of each shot, a line for its boxes.
    pub(super) boxes: Vec<String>,
}

/// Takes all photos, and says what structure from motion would find in each of them.
pub(super) fn take(
    out: &Path,
    world: &World,
    shots: &[Shot],
    settings: &Settings,
    progress: Progress,
) -> Result<Taken, SynthError> {
    let masks = city_moves(world.city());
    make(&out.join("images"))?;
    if masks {
        make(&out.join("masks"))?;
    }
    if settings.truth {
        truth::prepare(out)?;
    }
    let options = RenderOptions { faults: settings.faults.clone(), ..RenderOptions::default() };
    let done = AtomicUsize::new(0);
    let pixels = settings.width as usize * settings.height as usize;
    // Rows are shared out as well: a chunk bounds the photos that threads hold while they help with others' rows.
    let chunk = (PIXELS_AT_ONCE / pixels).clamp(1, 2 * rayon::current_num_threads());
    let instances = Instances::new(world.city());
    let mut all = Taken { seeds: Vec::with_capacity(shots.len()), boxes: Vec::with_capacity(shots.len()) };
    for (start, chunk) in shots.chunks(chunk).enumerate().map(|(i, shots)| (i * chunk, shots)) {
        let one = |(i, shot): (usize, &Shot)| -> Result<(Vec<Seed>, String), SynthError> {
            let taken = render_frame(world, shot, &options).map_err(|e| impossible(&e))?;
            let name = format!("{}.png", shot.name);
            png(&out.join("images").join(&name), &taken.rgb, &taken, ColorType::Rgb8)?;
            if masks {
                let usable: Vec<u8> = taken.mask.iter().map(|&moves| if moves == 0 { 255 } else { 0 }).collect();
                png(&out.join("masks").join(&name), &usable, &taken, ColorType::L8)?;
            }
            if settings.truth {
                truth::write(out, &shot.name, &taken)?;
            }
            progress("photos", done.fetch_add(1, Ordering::Relaxed) + 1, shots.len());
            let random = Random::new(bits(settings.city.seed ^ 0x5EED, (start + i) as u64));
            Ok((seeds_of(world, shot, &taken, random), instances.boxes(shot, &taken)))
        };
        let taken: Vec<_> = chunk.par_iter().enumerate().map(one).collect();
        for view in taken {
            let (seeds, boxes) = view?;
            all.seeds.push(seeds);
            all.boxes.push(boxes);
        }
    }
    Ok(all)
}

/// Writes a picture of the frame's size.
pub(super) fn png(path: &Path, bytes: &[u8], frame: &Frame, kind: ColorType) -> Result<(), SaveError> {
    let mut png = Cursor::new(Vec::new());
    image::write_buffer_with_format(&mut png, bytes, frame.width, frame.height, kind, ImageFormat::Png)
        .map_err(|e| SaveError::new(path, &e))?;
    save(path, png.get_ref())
}

/// Places with contrast, on what stands still and is no glass.
fn seeds_of(world: &World, shot: &Shot, frame: &Frame, mut random: Random) -> Vec<Seed> {
    let (width, height) = (frame.width as usize, frame.height as usize);
    let k = &shot.camera.pinhole;
    let world_from_camera = shot.camera.camera_from_world.inverse();
    let materials = &world.city().materials;
    let mut seeds = Vec::new();
    for _ in 0..TRIES * POINTS_OF_A_VIEW {
        let (x, y) = (2 + random.below(width - 4), 2 + random.below(height - 4));
        let (i, found) = (y * width + x, random.unit());
        let clear = materials.get(usize::from(frame.first.material[i])).is_none_or(|m| m.transparency > 0.0);
        let depth = f64::from(frame.first.depth[i]);
        if clear || frame.moves[i] != 0 || depth <= 0.3 || found >= contrast(frame, x, y) / CERTAIN {
            continue;
        }
        let local = DVec3::new((x as f64 + 0.5 - k.cx) / k.fx, (y as f64 + 0.5 - k.cy) / k.fy, 1.0);
        seeds.push(Seed {
            position: world_from_camera.apply(local * depth),
            normal: Vec3::from(frame.normals[i]),
            colour: [0, 1, 2].map(|c| frame.rgb[3 * i + c]),
            footprint: depth / k.fx,
        });
        if seeds.len() == POINTS_OF_A_VIEW {
            break;
        }
    }
    seeds
}

/// How much a pixel differs from those two pixels to its left, right, top and bottom, in bytes of green.
fn contrast(frame: &Frame, x: usize, y: usize) -> f32 {
    let width = frame.width as usize;
    let green = |x: usize, y: usize| f32::from(frame.rgb[3 * (y * width + x) + 1]);
    let here = green(x, y);
    let across = (here - green(x - 2, y)).abs().max((here - green(x + 2, y)).abs());
    let along = (here - green(x, y - 2)).abs().max((here - green(x, y + 2)).abs());
    0.5 * (across + along)
}
