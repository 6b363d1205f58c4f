//! Renders photos, masks and per-pixel ground truth. Files are written as they are rendered; only features are kept.

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use city::City;
use city::random::{Random, bits};
use city::sense::Shot;
use city::trace::{Frame, RenderOptions, World, render_frame};
use glam::{DVec3, Vec3};
use image::ColorType;
use rayon::prelude::*;

use super::ground_truth;
use super::output::{create_folder, write_png};
use super::settings::{Progress, Settings, SynthError, unsupported};
use super::tracks_and_boxes::Instances;

/// Maximum of pixels rendered concurrently.
const MAX_PIXELS_IN_FLIGHT: usize = 1 << 23;
/// Maximum of features per photo.
const MAX_FEATURES: usize = 120;
/// Pixels tried per wanted feature.
const TRIES_PER_FEATURE: usize = 4;
/// Contrast, in levels, from which a pixel is always detected as a feature.
const FULL_DETECTION_CONTRAST: f32 = 28.0;

/// A feature that structure from motion would detect in a view.
pub(super) struct Feature {
    /// True position on the surface, world metres.
    pub(super) position: DVec3,
    /// True normal of the surface, facing the view.
    pub(super) normal: Vec3,
    /// Colour in the photo.
    pub(super) colour: [u8; 3],
    /// Size of a pixel of the view at the surface, metres.
    pub(super) footprint: f64,
}

/// Data kept of the rendered photos.
pub(super) struct Rendered {
    /// Features of each shot.
    pub(super) features: Vec<Vec<Feature>>,
    /// For each shot a line of `boxes3d.json`.
    pub(super) boxes: Vec<String>,
}

/// Renders and writes all photos, and detects features in them.
pub(super) fn render_all(
    out: &Path,
    world: &World,
    shots: &[Shot],
    settings: &Settings,
    progress: Progress,
) -> Result<Rendered, SynthError> {
    let masks = has_moving_actors(world.city());
    create_folder(&out.join("images"))?;
    if masks {
        create_folder(&out.join("masks"))?;
    }
    if settings.truth {
        ground_truth::create_folders(out)?;
    }
    let options = RenderOptions { faults: settings.faults.clone(), ..RenderOptions::default() };
    let done = AtomicUsize::new(0);
    let pixels = settings.width as usize * settings.height as usize;
    // Rows of a photo are rendered in parallel too. Chunks bound the photos that threads hold while they work on rows of others.
    let chunk = (MAX_PIXELS_IN_FLIGHT / pixels).clamp(1, 2 * rayon::current_num_threads());
    let instances = Instances::new(world.city());
    let mut all = Rendered { features: Vec::with_capacity(shots.len()), boxes: Vec::with_capacity(shots.len()) };
    for (start, chunk) in shots.chunks(chunk).enumerate().map(|(i, shots)| (i * chunk, shots)) {
        let one = |(i, shot): (usize, &Shot)| -> Result<(Vec<Feature>, String), SynthError> {
            let rendered = render_frame(world, shot, &options).map_err(|e| unsupported(&e))?;
            let name = format!("{}.png", shot.name);
            write_png(&out.join("images").join(&name), &rendered.rgb, &rendered, ColorType::Rgb8)?;
            if masks {
                let usable: Vec<u8> = rendered.mask.iter().map(|&moves| if moves == 0 { 255 } else { 0 }).collect();
                write_png(&out.join("masks").join(&name), &usable, &rendered, ColorType::L8)?;
            }
            if settings.truth {
                ground_truth::write(out, &shot.name, &rendered)?;
            }
            progress("photos", done.fetch_add(1, Ordering::Relaxed) + 1, shots.len());
            let random = Random::new(bits(settings.city.seed ^ 0x5EED, (start + i) as u64));
            Ok((detect_features(world, shot, &rendered, random), instances.boxes(shot, &rendered)))
        };
        let views: Vec<_> = chunk.par_iter().enumerate().map(one).collect();
        for view in views {
            let (features, boxes) = view?;
            all.features.push(features);
            all.boxes.push(boxes);
        }
    }
    Ok(all)
}

/// Detects features: random pixels with contrast, on static opaque surfaces.
fn detect_features(world: &World, shot: &Shot, frame: &Frame, mut random: Random) -> Vec<Feature> {
    let (width, height) = (frame.width as usize, frame.height as usize);
    let k = &shot.camera.pinhole;
    let world_from_camera = shot.camera.camera_from_world.inverse();
    let materials = &world.city().materials;
    let mut features = Vec::new();
    for _ in 0..TRIES_PER_FEATURE * MAX_FEATURES {
        let (x, y) = (2 + random.below(width - 4), 2 + random.below(height - 4));
        let (i, chance) = (y * width + x, random.unit());
        let is_glass = materials.get(usize::from(frame.first.material[i])).is_none_or(|m| m.transparency > 0.0);
        let depth = f64::from(frame.first.depth[i]);
        if is_glass || frame.moves[i] != 0 || depth <= 0.3 || chance >= contrast(frame, x, y) / FULL_DETECTION_CONTRAST
        {
            continue;
        }
        let local = DVec3::new((x as f64 + 0.5 - k.cx) / k.fx, (y as f64 + 0.5 - k.cy) / k.fy, 1.0);
        features.push(Feature {
            position: world_from_camera.apply(local * depth),
            normal: Vec3::from(frame.normals[i]),
            colour: [0, 1, 2].map(|c| frame.rgb[3 * i + c]),
            footprint: depth / k.fx,
        });
        if features.len() == MAX_FEATURES {
            break;
        }
    }
    features
}

/// Contrast of a pixel with the pixels at distance two to its left, right, top and bottom, in levels of green.
fn contrast(frame: &Frame, x: usize, y: usize) -> f32 {
    let width = frame.width as usize;
    let green = |x: usize, y: usize| f32::from(frame.rgb[3 * (y * width + x) + 1]);
    let here = green(x, y);
    let across = (here - green(x - 2, y)).abs().max((here - green(x + 2, y)).abs());
    let along = (here - green(x, y - 2)).abs().max((here - green(x, y + 2)).abs());
    0.5 * (across + along)
}

/// Whether any actor moves. Then all photos have masks: readers of `transforms.json` expect masks of all frames or of none.
pub(super) fn has_moving_actors(city: &City) -> bool {
    city.actors.iter().any(|actor| actor.trajectory.is_some())
}
