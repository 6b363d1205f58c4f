//! Draws what the tracer makes of the stage: `cargo run --release -p city --example look -- FOLDER`.

use std::path::Path;

use city::{
    faults::{self, Fault, Kind},
    sense::{Shot, looking, pinhole},
    stage,
    trace::{Frame, Layer, Options, World, frame},
};
use glam::DVec3;

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

fn main() -> Result<()> {
    let folder = std::env::args().nth(1).ok_or("name a folder for the pictures")?;
    let folder = Path::new(&folder);
    std::fs::create_dir_all(folder)?;
    let city = stage::city();
    let world = World::new(&city)?;
    let camera = looking(pinhole(960, 540, 90.0)?, DVec3::new(-8.0, -9.0, 2.2), DVec3::new(0.55, 1.0, -0.02), DVec3::Y);
    let mut shot = Shot::new("stage".into(), "front", 2.9, camera);
    shot.motion.velocity = DVec3::new(8.0, 0.0, 0.0);
    draw(folder, "plain", &frame(&world, &shot, &Options::default())?)?;
    for kind in Kind::ALL {
        for strength in [0.5, 1.0] {
            let options = Options { faults: vec![Fault { kind, strength, seed: 3 }], ..Options::default() };
            let Some(shot) = faults::spoil_shots(vec![shot.clone()], &options.faults).pop() else { continue };
            let picture = frame(&world, &shot, &options)?;
            save(folder, &format!("{kind:?}-{strength}"), &picture, &picture.rgb)?;
        }
    }
    let mut rolling = shot.clone();
    (rolling.rolling_shutter_seconds, rolling.motion.spin) = (0.08, DVec3::new(0.0, 0.0, 3.0));
    let picture = frame(&world, &rolling, &Options::default())?;
    save(folder, "rolling", &picture, &picture.rgb)
}

/// Every image of a frame.
fn draw(folder: &Path, name: &str, picture: &Frame) -> Result<()> {
    save(folder, name, picture, &picture.rgb)?;
    let normals: Vec<u8> = picture.normals.iter().flatten().map(|n| (127.5 + 127.5 * n) as u8).collect();
    save(folder, &format!("{name}-normals"), picture, &normals)?;
    let moves: Vec<u8> = picture.moves.iter().flat_map(|&m| [255 * m; 3]).collect();
    save(folder, &format!("{name}-moves"), picture, &moves)?;
    for (layer, which) in [(&picture.first, "first"), (&picture.behind, "behind")] {
        for (what, rgb) in images(layer) {
            save(folder, &format!("{name}-{which}-{what}"), picture, &rgb)?;
        }
    }
    Ok(())
}

fn images(layer: &Layer) -> [(&'static str, Vec<u8>); 4] {
    let depth =
        layer.depth.iter().flat_map(|&d| if d > 0.0 { [(255.0 / (1.0 + 0.06 * d)) as u8; 3] } else { [0, 0, 60] });
    let colour = |label: u32| [0u32, 8, 16].map(|shift| (label.wrapping_mul(2_654_435_761) >> shift) as u8);
    [
        ("depth", depth.collect()),
        ("semantic", layer.semantic.iter().flat_map(|&s| colour(u32::from(s) + 1)).collect()),
        ("instance", layer.instance.iter().flat_map(|&i| colour(i)).collect()),
        ("material", layer.material.iter().flat_map(|&m| colour(u32::from(m) + 1)).collect()),
    ]
}

fn save(folder: &Path, name: &str, picture: &Frame, rgb: &[u8]) -> Result<()> {
    let image =
        image::RgbImage::from_raw(picture.width, picture.height, rgb.to_vec()).ok_or("a picture of another size")?;
    Ok(image.save(folder.join(format!("{name}.png")))?)
}
