//! Prints statistics of a generated city: seconds to generate, triangles, actors, bytes.
//!
//! `cargo run --release -p city --example city_stats -- --area-km2 A [--layout L] [--traffic T]`

use std::time::Instant;

use city::{City, CitySettings, Traffic};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let mut settings = CitySettings { traffic: Traffic::Heavy, ..CitySettings::default() };
    for pair in arguments.chunks(2) {
        let [option, value] = pair else { return Err("an option lacks its value".into()) };
        match option.as_str() {
            "--area-km2" => settings.area_km2 = value.parse()?,
            "--layout" => settings.layout = value.parse()?,
            "--traffic" => settings.traffic = value.parse()?,
            "--seed" => settings.seed = value.parse()?,
            "--plain" => settings.plain = value.parse()?,
            other => return Err(format!("there is no {other}").into()),
        }
    }
    let start = Instant::now();
    let city = City::generate(&settings)?;
    let seconds = start.elapsed().as_secs_f64();
    let unique: usize = city.assets.iter().map(|a| a.mesh.triangles.len()).sum();
    let shown: usize = city.actors.iter().map(|a| city.assets[a.asset as usize].mesh.triangles.len()).sum();
    let moving = city.actors.iter().filter(|a| a.trajectory.is_some()).count();
    let street_km = city.streets.iter().flat_map(|s| s.windows(2)).map(|w| w[0].distance(w[1])).sum::<f64>() / 1e3;
    println!(
        "{} {} km²: {seconds:.2} s, {shown} triangles, {unique} unique, {} assets, {} actors ({moving} moving), {street_km:.1} km of free lanes, {:.0} MB (peak of the process {:.0} MB)",
        settings.layout,
        settings.area_km2,
        city.assets.len(),
        city.actors.len(),
        bytes(&city) as f64 / 1e6,
        peak_megabytes(),
    );
    let mut kinds = std::collections::BTreeMap::new();
    for actor in &city.actors {
        *kinds.entry(actor.class).or_insert(0) += 1;
    }
    println!("{kinds:?}");
    Ok(())
}

/// Size of the city's data, bytes.
fn bytes(city: &City) -> usize {
    let meshes: usize = city
        .assets
        .iter()
        .map(|a| &a.mesh)
        .map(|m| {
            20 * m.positions.capacity()
                + 12 * m.triangles.capacity()
                + 2 * m.materials.capacity()
                + m.classes.capacity()
        })
        .sum();
    let moves: usize =
        city.actors.iter().filter_map(|a| a.trajectory.as_ref()).map(|t| size_of_val(&t.waypoints[..])).sum();
    meshes + moves + size_of_val(&city.actors[..])
}

/// Peak resident memory of the process, where available (Linux).
fn peak_megabytes() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    line.and_then(|l| l.split_whitespace().next()?.parse::<f64>().ok()).map_or(f64::NAN, |kb| kb / 1e3)
}
