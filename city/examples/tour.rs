//! Renders views of a generated city from a street, a surveillance camera and the air, by day and with faults, and
//! plots lidar, radar and occupancy: `cargo run --release -p city --example tour -- FOLDER [KM2 [SEED]]`.

use std::{path::Path, time::Instant};

use city::{
    City, CitySettings,
    faults::{Fault, FaultKind},
    occupancy::{FREE, Grid, voxelize},
    sense::{
        Shot,
        lidar::Lidar,
        radar::Radar,
        rig::{Rig, drive},
        survey::{Fixed, Survey, fixed, survey},
    },
    trace::{RenderOptions, World, render_frame},
};
use glam::{DQuat, DVec2, DVec3, UVec3};
use image::{Rgb, RgbImage};
use scene::Rigid;

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

fn main() -> Result<()> {
    let mut words = std::env::args().skip(1);
    let folder = words.next().ok_or("name a folder for the pictures")?;
    let folder = Path::new(&folder);
    std::fs::create_dir_all(folder)?;
    let area_km2 = words.next().map_or(Ok(0.2), |word| word.parse())?;
    let seed = words.next().map_or(Ok(1), |word| word.parse())?;
    let start = Instant::now();
    let city = City::generate(&CitySettings { area_km2, seed, ..CitySettings::default() })?;
    let triangles: usize = city.actors.iter().map(|a| city.assets[a.asset as usize].mesh.triangles.len()).sum();
    println!(
        "generated in {:.2} s: {} actors of {} assets, {triangles} triangles",
        start.elapsed().as_secs_f64(),
        city.actors.len(),
        city.assets.len()
    );
    let start = Instant::now();
    let world = World::new(&city)?;
    println!("indexed in {:.2} s", start.elapsed().as_secs_f64());
    let day = RenderOptions::default();
    let with_fault =
        |kind| RenderOptions { faults: vec![Fault { kind, strength: 1.0, seed: 3 }], ..RenderOptions::default() };

    let street = drive(&city, &Rig { width: 1408, height: 600, ..Rig::default() })?;
    println!("{} shots of a drive", street.len());
    let round = street.len() / 6 / 2 * 6;
    for (shot, what) in
        street[round..].iter().zip(["front", "", "left", "", "rear"]).filter(|(_, what)| !what.is_empty())
    {
        save_render(&world, shot, &day, folder, what)?;
    }
    let path: Vec<&Shot> = street.iter().filter(|shot| shot.sensor == "left").collect();
    let here = &path[path.len() / 2];
    let pose = Rigid { rotation: DQuat::IDENTITY, translation: here.camera.centre() };
    plan(&world, &pose, here, folder)?;
    let other = &street[street.len() / 5 / 6 * 6];
    for (what, options) in [
        ("street", &day),
        ("night", &with_fault(FaultKind::Night)),
        ("rain", &with_fault(FaultKind::Rain)),
        ("fog", &with_fault(FaultKind::Fog)),
    ] {
        save_render(&world, other, options, folder, what)?;
    }
    let posts = fixed(&world.at(0.0), &Fixed { cameras: 2, pictures: 1, ..Fixed::default() })?;
    for (i, shot) in posts.iter().enumerate() {
        save_render(&world, shot, &day, folder, &format!("fixed-{i}"))?;
    }
    let half = DVec2::splat(60.0);
    let block = Survey { tilt_degrees: 45.0, area: Some([-half, half]), ..Survey::default() };
    let above = survey(&city, &block)?;
    for (i, what) in [(0, "nadir"), (1, "oblique")] {
        save_render(&world, &above[i], &day, folder, what)?;
    }
    Ok(())
}

/// Plots a lidar sweep by intensity, radar detections (receding red, approaching green, ghosts blue) and occupied
/// voxels by class, each from above.
fn plan(world: &World, pose: &Rigid, here: &Shot, folder: &Path) -> Result<()> {
    let mut points = RgbImage::new(800, 800);
    let mut dot = |x: f64, y: f64, size: i32, colour: [u8; 3]| {
        for (i, j) in (0..size * size).map(|n| (n % size, n / size)) {
            let (u, v) = (400 + (x * 5.0) as i32 + i, 400 - (y * 5.0) as i32 + j);
            if (0..800).contains(&u) && (0..800).contains(&v) {
                points.put_pixel(u as u32, v as u32, Rgb(colour));
            }
        }
    };
    let sweep = Lidar::default().sweep(world, pose, &here.motion, here.seconds, &[])?;
    let lost = sweep.returns.iter().filter(|r| r.lost).count();
    println!("lidar: {} returns, {lost} lost", sweep.returns.len());
    for r in sweep.returns.iter().filter(|r| !r.lost) {
        let at = r.direction.as_dvec3() * f64::from(r.range);
        dot(at.x, at.y, 1, [60 + (195.0 * r.intensity.sqrt()) as u8; 3]);
    }
    let found = Radar::default().sweep(&world.at(here.seconds), pose, &here.motion, &[])?;
    println!("radar: {} detections, {} ghosts", found.len(), found.iter().filter(|d| d.ghost).count());
    for d in found {
        let (sine, cosine) = f64::from(d.azimuth).sin_cos();
        let colour = if d.ghost {
            [60, 90, 255]
        } else if d.velocity > 0.0 {
            [255, 60, 60]
        } else {
            [60, 255, 60]
        };
        dot(cosine * f64::from(d.range), sine * f64::from(d.range), 4, colour);
    }
    points.save(folder.join("lidar-radar.png"))?;
    let start = Instant::now();
    let grid = Grid::new(*pose, DVec3::new(-40.0, -40.0, -3.0), DVec3::new(40.0, 40.0, 9.8), 0.1)?;
    let filled = voxelize(world.city(), here.seconds, &grid)?;
    println!(
        "occupancy: {} of {} voxels in {:.2} s",
        filled.occupied_count(),
        filled.semantic.len(),
        start.elapsed().as_secs_f64()
    );
    let top = |x: u32, y: u32| {
        let column =
            (0..grid.size.z).rev().map(|z| (z, filled.semantic[filled.index(UVec3::new(x, grid.size.y - 1 - y, z))]));
        column.into_iter().find(|(_, class)| *class != FREE)
    };
    let colour = |(z, class): (u32, u8)| {
        let hue = (u32::from(class) + 1).wrapping_mul(2_654_435_761);
        [0, 8, 16].map(|shift| ((hue >> shift & 255) * (80 + z) / 208) as u8)
    };
    let image = RgbImage::from_fn(grid.size.x, grid.size.y, |x, y| Rgb(top(x, y).map_or([0; 3], colour)));
    Ok(image.save(folder.join("occupancy.png"))?)
}

fn save_render(world: &World, shot: &Shot, options: &RenderOptions, folder: &Path, what: &str) -> Result<()> {
    let start = Instant::now();
    let picture = render_frame(world, shot, options)?;
    println!("{what}: {} in {:.2} s", shot.name, start.elapsed().as_secs_f64());
    let image =
        image::RgbImage::from_raw(picture.width, picture.height, picture.rgb).ok_or("a picture of another size")?;
    Ok(image.save(folder.join(format!("{what}.png")))?)
}
