//! Renders the hand-built test scene with every ground truth layer and fault, on contact sheets:
//! `cargo run --release -p city --example test_scene -- FOLDER`.

use std::path::Path;

use city::{
    faults::{self, Fault, FaultKind},
    sense::{Shot, camera_towards, pinhole},
    test_scene,
    trace::{Frame, Layer, RenderOptions, World, render_frame},
};
use glam::DVec3;
use image::{RgbImage, imageops};

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

fn main() -> Result<()> {
    let folder = std::env::args().nth(1).ok_or("name a folder for the pictures")?;
    let folder = Path::new(&folder);
    std::fs::create_dir_all(folder)?;
    let city = test_scene::city();
    let world = World::new(&city)?;
    let camera =
        camera_towards(pinhole(960, 540, 90.0)?, DVec3::new(-8.0, -9.0, 2.2), DVec3::new(0.55, 1.0, -0.02), DVec3::Y);
    let mut shot = Shot::new("stage".into(), "front", 2.9, camera);
    shot.motion.velocity = DVec3::new(8.0, 0.0, 0.0);
    let plain = render_frame(&world, &shot, &RenderOptions::default())?;
    picture(&plain, &plain.rgb)?.save(folder.join("plain.png"))?;
    sheet(&truths(&plain)?, 3).save(folder.join("truths.png"))?;
    sheet(&faulty(&world, &shot)?, 3).save(folder.join("faults.png"))?;
    Ok(())
}

/// Every fault that a picture shows, at half and full strength, and a rolling shutter.
fn faulty(world: &World, shot: &Shot) -> Result<Vec<RgbImage>> {
    let unseen = [FaultKind::PoseNoise, FaultKind::SparseViews, FaultKind::SensorDropout, FaultKind::MovingUnmasked];
    let mut rolling = shot.clone();
    (rolling.rolling_shutter_seconds, rolling.motion.spin) = (0.08, DVec3::new(0.0, 0.0, 3.0));
    let rolled = render_frame(world, &rolling, &RenderOptions::default())?;
    let mut images = vec![picture(&rolled, &rolled.rgb)?];
    for kind in FaultKind::ALL.iter().copied().filter(|kind| !unseen.contains(kind)) {
        for strength in [0.5, 1.0] {
            let options = RenderOptions { faults: vec![Fault { kind, strength, seed: 3 }], ..RenderOptions::default() };
            let shot = faults::degrade_shots(vec![shot.clone()], &options.faults).remove(0);
            let taken = render_frame(world, &shot, &options)?;
            images.push(picture(&taken, &taken.rgb)?);
        }
    }
    Ok(images)
}

/// Every other image of a frame.
fn truths(taken: &Frame) -> Result<Vec<RgbImage>> {
    let mut images = Vec::new();
    for layer in [&taken.first, &taken.behind] {
        for rgb in layers(layer) {
            images.push(picture(taken, &rgb)?);
        }
    }
    let normals: Vec<u8> = taken.normals.iter().flatten().map(|n| (127.5 + 127.5 * n) as u8).collect();
    images.push(picture(taken, &normals)?);
    Ok(images)
}

/// Depth, classes, instances and materials in colours.
fn layers(layer: &Layer) -> [Vec<u8>; 4] {
    let depth =
        layer.depth.iter().flat_map(|&d| if d > 0.0 { [(255.0 / (1.0 + 0.06 * d)) as u8; 3] } else { [0, 0, 60] });
    let colour = |label: u32| [0u32, 8, 16].map(|shift| (label.wrapping_mul(2_654_435_761) >> shift) as u8);
    [
        depth.collect(),
        layer.semantic.iter().flat_map(|&s| colour(u32::from(s) + 1)).collect(),
        layer.instance.iter().flat_map(|&i| colour(i)).collect(),
        layer.material.iter().flat_map(|&m| colour(u32::from(m) + 1)).collect(),
    ]
}

fn picture(taken: &Frame, rgb: &[u8]) -> Result<RgbImage> {
    Ok(RgbImage::from_raw(taken.width, taken.height, rgb.to_vec()).ok_or("a picture of another size")?)
}

/// Pictures side by side at 600 pixels a piece.
fn sheet(images: &[RgbImage], columns: u32) -> RgbImage {
    let height = 600 * images[0].height() / images[0].width();
    let rows = (images.len() as u32).div_ceil(columns);
    let mut sheet = RgbImage::new(604 * columns, (height + 4) * rows);
    for (i, image) in images.iter().enumerate() {
        let small = imageops::resize(image, 600, height, imageops::FilterType::Triangle);
        let (x, y) = (i as u32 % columns * 604, i as u32 / columns * (height + 4));
        imageops::replace(&mut sheet, &small, i64::from(x), i64::from(y));
    }
    sheet
}
