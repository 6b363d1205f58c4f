//! Measures rays per second and core: `cargo run --release -p city --example rays [-- KM2]`, in a generated city of
//! this area, or by default in a fixed scene that does not change with the generator:
//!
//! a square kilometre with 4,000 houses with window frames and panes of twenty sorts, 3,000 trees of 2,000
//! triangles of five sorts, 400 moving boxes. Three cameras: in a street, over the roofs, from 300 m straight down.
//! Rays are cast by one thread and timed by its CPU time, so that other load on the machine has little influence.

use std::time::Instant;

use city::{
    City, CitySettings, Class, Mesh,
    random::Random,
    sense::{Shot, camera_towards, pinhole},
    test_scene,
    trace::{Moment, Ray, RayMask, RenderOptions, World, render_frame},
};
use glam::{DVec3, Vec2, Vec3, vec3};

const PITCH: f32 = 1000.0 / 64.0;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let city = match std::env::args().nth(1) {
        Some(area) => City::generate(&CitySettings { area_km2: area.parse()?, ..CitySettings::default() })?,
        None => town(),
    };
    let triangles: usize = city.actors.iter().map(|a| city.assets[a.asset as usize].mesh.triangles.len()).sum();
    println!("{} actors of {} assets, {triangles} triangles", city.actors.len(), city.assets.len());
    let start = Instant::now();
    let world = World::new(&city)?;
    println!("indexed in {:.2} s", start.elapsed().as_secs_f64());
    let start = Instant::now();
    let moment = world.at(1.0);
    println!("a moment in {:.1} ms", start.elapsed().as_secs_f64() * 1e3);
    let lens = pinhole(960, 540, 90.0)?;
    let street = city.streets.iter().find(|street| street[0].truncate().length() < 0.4 * city.extent_metres);
    let (corner, ahead) = street.map_or((DVec3::ZERO, DVec3::X), |s| (s[0], s[s.len() - 1] - s[0]));
    let places = [
        ("street", corner + DVec3::Z * 1.7, ahead.with_z(0.0)),
        ("roofs", DVec3::new(-400.0, -400.0, 60.0), DVec3::new(1.0, 1.0, -0.4)),
        ("nadir", DVec3::new(0.0, 0.0, 300.0), DVec3::NEG_Z),
    ];
    let (mut rays_of_all, mut seconds_of_all) = (0.0, 0.0);
    for (name, centre, forward) in places {
        let shot = Shot::new(name.into(), name, 1.0, camera_towards(lens, centre, forward, DVec3::Y));
        let rays = rays(&shot);
        let start = cpu_seconds();
        let mut shadows = Vec::new();
        let hits = rays
            .iter()
            .filter(|ray| {
                shadow(&moment, ray).is_some_and(|s| {
                    shadows.push(s);
                    true
                })
            })
            .count();
        let primary = cpu_seconds() - start;
        let start = cpu_seconds();
        let dark = shadows.iter().filter(|ray| moment.is_occluded(ray)).count();
        let secondary = cpu_seconds() - start;
        let rate = |count: usize, seconds: f64| count as f64 / seconds / 1e6;
        rays_of_all += (rays.len() + shadows.len()) as f64;
        seconds_of_all += primary + secondary;
        println!(
            "{name:7} primary {:5.2} Mrays/s ({hits} hits), shadow {:5.2} Mrays/s ({dark} dark), both {:5.2} Mrays/s, one core",
            rate(rays.len(), primary),
            rate(shadows.len(), secondary),
            rate(rays.len() + shadows.len(), primary + secondary),
        );
        let start = Instant::now();
        let picture = render_frame(&world, &shot, &RenderOptions::default())?;
        let seconds = start.elapsed().as_secs_f64();
        println!(
            "        a whole frame of {} × {} in {seconds:.2} s, {} threads",
            picture.width,
            picture.height,
            rayon::current_num_threads()
        );
    }
    println!("all: {:.2} Mrays/s per core, primary and shadow", rays_of_all / seconds_of_all / 1e6);
    Ok(())
}

/// CPU time of this thread, seconds, where available (Linux); otherwise wall time.
fn cpu_seconds() -> f64 {
    static START: std::sync::OnceLock<Instant> = std::sync::OnceLock::new();
    let wall = START.get_or_init(Instant::now).elapsed().as_secs_f64();
    let running = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    running.and_then(|text| text.split(' ').next()?.parse().ok()).map_or(wall, |nanoseconds: f64| nanoseconds * 1e-9)
}

fn rays(shot: &Shot) -> Vec<Ray> {
    let (k, pose) = (shot.camera.pinhole, shot.camera.camera_from_world.inverse());
    let mut rays = Vec::new();
    for y in 0..k.height {
        for x in 0..k.width {
            let local = DVec3::new((f64::from(x) + 0.5 - k.cx) / k.fx, (f64::from(y) + 0.5 - k.cy) / k.fy, 1.0);
            rays.push(Ray::new(pose.translation.as_vec3(), (pose.rotation * local).normalize().as_vec3()));
        }
    }
    rays
}

fn shadow(moment: &Moment, ray: &Ray) -> Option<Ray> {
    let hit = moment.cast(ray, RayMask::All)?;
    Some(Ray::new(ray.at(hit.distance) + 2e-3 * hit.normal, vec3(0.435_194_5, -0.340_587, 0.833_475_6)))
}

fn town() -> City {
    let mut city = test_scene::city();
    let van = city.actors.pop().expect("the test scene has a van");
    city.actors.clear();
    city.streets = vec![vec![DVec3::new(-300.0, 0.0, 0.0), DVec3::X * 400.0]];
    city.extent_metres = 1000.0;
    let mut random = Random::new(7);
    let ground = test_scene::rectangle(
        vec3(-1000.0, -1000.0, 0.0),
        Vec3::X * 2000.0,
        Vec3::Y * 2000.0,
        test_scene::ASPHALT,
        Class::Road,
    );
    test_scene::add_actor(&mut city, "ground", ground, Class::Road, 0, DVec3::ZERO);
    let first = city.assets.len() as u32;
    city.assets.extend((0..20).map(|i| city::Asset { name: format!("house {i}"), mesh: house(&mut random.fork(i)) }));
    city.assets.extend((0..5).map(|i| city::Asset { name: format!("tree {i}"), mesh: tree(&mut random.fork(90 + i)) }));
    for i in 0..64 * 64 {
        let corner = Vec2::new((i % 64) as f32 * PITCH - 500.0, (i / 64) as f32 * PITCH - 500.0);
        // every fourth row and column is a street
        let street = i % 64 % 4 == 0 || (i / 64) % 4 == 0;
        let actor = |asset, at: Vec2, class| city::Actor {
            asset,
            class,
            instance: i as u32 + 1,
            world_from_asset: test_scene::pose_at_point(at.extend(0.0).as_dvec3()),
            trajectory: None,
        };
        if !street {
            city.actors.push(actor(first + random.below(20) as u32, corner, Class::Building));
        }
        for side in 0..if street { 2 } else { 0 } {
            let at = corner + Vec2::new(2.0 + 9.0 * side as f32, 3.0);
            city.actors.push(actor(first + 20 + random.below(5) as u32, at, Class::Vegetation));
        }
    }
    for i in 0..400 {
        let mut car = van.clone();
        for point in &mut car.trajectory.as_mut().expect("it drives").waypoints {
            point.world_from_asset.translation +=
                DVec3::new(f64::from(random.range(-480.0, 480.0)), f64::from(i / 25 * 62), 0.0);
        }
        city.actors.push(car);
    }
    city
}

/// A house of 3 to 7 storeys, each bay with a frame of four bars and a pane.
fn house(random: &mut Random) -> Mesh {
    let (side, storeys) = (PITCH, 3 + random.below(5));
    let top = 3.1 * storeys as f32;
    let mut mesh = test_scene::cuboid(Vec3::ZERO, vec3(side, side, top), test_scene::BRICK, Class::Building);
    for storey in 0..storeys {
        for bay in 0..5 {
            let (x, z) = (1.0 + 2.9 * bay as f32, 0.9 + 3.1 * storey as f32);
            for y in [-0.06, side] {
                let bar = |x0: f32, z0: f32, x1: f32, z1: f32| {
                    test_scene::cuboid(
                        vec3(x + x0, y, z + z0),
                        vec3(x + x1, y + 0.06, z + z1),
                        test_scene::PLASTER,
                        Class::Building,
                    )
                };
                for part in
                    [bar(0.0, 0.0, 0.1, 1.5), bar(1.1, 0.0, 1.2, 1.5), bar(0.1, 0.0, 1.1, 0.1), bar(0.1, 1.4, 1.1, 1.5)]
                {
                    test_scene::append(&mut mesh, &part);
                }
                let pane = vec3(x + 0.1, y + 0.03, z + 0.1);
                test_scene::append(
                    &mut mesh,
                    &test_scene::rectangle(pane, Vec3::X, Vec3::Z * 1.3, test_scene::GLASS, Class::Building),
                );
            }
        }
    }
    mesh
}

/// A trunk and 1,000 leaves of two triangles in a ball.
fn tree(random: &mut Random) -> Mesh {
    let mut mesh =
        test_scene::cuboid(vec3(-0.15, -0.15, 0.0), vec3(0.15, 0.15, 3.0), test_scene::BRICK, Class::Vegetation);
    for _ in 0..1000 {
        let out = vec3(random.normal(), random.normal(), random.normal()).normalize_or(Vec3::Z);
        let at = out * 2.4 * random.unit().powf(0.4) + 4.6 * Vec3::Z;
        let along = vec3(random.normal(), random.normal(), random.normal()).normalize_or(Vec3::X) * 0.3;
        let up = along.cross(out).normalize_or(Vec3::Z) * 0.2;
        test_scene::append(&mut mesh, &test_scene::rectangle(at, along, up, test_scene::LEAF, Class::Vegetation));
    }
    mesh
}
