//! Looks at a generated city from the street, from a surveillance camera and from the air, by day and in trouble:
//! `cargo run --release -p city --example tour -- FOLDER [KM2 [SEED]]`.

use std::{path::Path, time::Instant};

use city::{
    City, CitySettings,
    faults::{Fault, Kind},
    sense::{
        Shot,
        rig::{Rig, drive},
        survey::{Fixed, Survey, fixed, survey},
    },
    trace::{Options, World, frame},
};
use glam::DVec2;

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
    let day = Options::default();
    let trouble = |kind| Options { faults: vec![Fault { kind, strength: 1.0, seed: 3 }], ..Options::default() };

    let street = drive(&city, &Rig { width: 1408, height: 600, ..Rig::default() })?;
    println!("{} shots of a drive", street.len());
    let round = street.len() / 6 / 2 * 6;
    for (shot, what) in
        street[round..].iter().zip(["front", "", "left", "", "rear"]).filter(|(_, what)| !what.is_empty())
    {
        take(&world, shot, &day, folder, what)?;
    }
    let other = &street[street.len() / 5 / 6 * 6];
    for (what, options) in [
        ("street", &day),
        ("night", &trouble(Kind::Night)),
        ("rain", &trouble(Kind::Rain)),
        ("fog", &trouble(Kind::Fog)),
    ] {
        take(&world, other, options, folder, what)?;
    }
    let posts = fixed(&world.at(0.0), &Fixed { cameras: 2, pictures: 1, ..Fixed::default() })?;
    for (i, shot) in posts.iter().enumerate() {
        take(&world, shot, &day, folder, &format!("fixed-{i}"))?;
    }
    let half = DVec2::splat(60.0);
    let block = Survey { tilt_degrees: 45.0, area: Some([-half, half]), ..Survey::default() };
    let above = survey(&city, &block)?;
    for (i, what) in [(0, "nadir"), (1, "oblique")] {
        take(&world, &above[i], &day, folder, what)?;
    }
    Ok(())
}

fn take(world: &World, shot: &Shot, options: &Options, folder: &Path, what: &str) -> Result<()> {
    let start = Instant::now();
    let picture = frame(world, shot, options)?;
    println!("{what}: {} in {:.2} s", shot.name, start.elapsed().as_secs_f64());
    let image =
        image::RgbImage::from_raw(picture.width, picture.height, picture.rgb).ok_or("a picture of another size")?;
    Ok(image.save(folder.join(format!("{what}.png")))?)
}
