//! Draws a city from above and from a street with flat shading, to be looked at: no ray tracer is needed.
//!
//! `cargo run --release -p city --example ortho -- LAYOUT AREA_KM2 FOLDER [SEED] [PLAIN]`
//! writes `LAYOUT-above.png`, `LAYOUT-oblique.png` and `LAYOUT-street-K.png`.

use std::path::Path;

use city::{Actor, City, CitySettings, Mesh, Pattern, Traffic};
use glam::{DVec2, DVec3, Mat4, Vec3};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [layout, area, folder] = arguments.first_chunk().ok_or("say LAYOUT AREA_KM2 FOLDER")?;
    let optional = |k: usize, default: &str| arguments.get(k).map_or(default.to_owned(), String::clone);
    let settings = CitySettings {
        seed: optional(3, "1").parse()?,
        area_km2: area.parse()?,
        layout: layout.parse()?,
        traffic: Traffic::Heavy,
        plain: optional(4, "0").parse()?,
    };
    let city = City::generate(&settings)?;
    let half = 0.5 * city.extent_metres as f32;
    let up = Mat4::look_at_rh(Vec3::new(0.0, 0.0, 500.0), Vec3::ZERO, Vec3::Y);
    let reach = half + 20.0;
    let above = Mat4::orthographic_rh(-reach, reach, -reach, reach, 1.0, 1000.0) * up;
    draw(&city, above, [1100, 1100], &Path::new(folder).join(format!("{layout}-above.png")))?;
    let eye = Vec3::new(-0.35 * half, -0.9 * half, 75.0);
    let oblique = Mat4::perspective_rh(0.9, 1.6, 1.0, 3000.0) * Mat4::look_at_rh(eye, Vec3::new(0.0, -0.2 * half, 5.0), Vec3::Z);
    draw(&city, oblique, [1280, 800], &Path::new(folder).join(format!("{layout}-oblique.png")))?;
    let count = city.streets.len();
    for k in 0..count.min(4) {
        let street = &city.streets[k * count / count.min(4)];
        let at = street.len() * (1 + k) / 6;
        let (here, ahead) = (street[at] + DVec3::Z * 1.8, street[(at + 4).min(street.len() - 1)] + DVec3::Z * 1.8);
        let view = Mat4::look_at_rh(here.as_vec3(), ahead.as_vec3(), Vec3::Z);
        let street = Mat4::perspective_rh(1.0, 1.6, 0.3, 3000.0) * view;
        draw(&city, street, [1280, 800], &Path::new(folder).join(format!("{layout}-street-{k}.png")))?;
    }
    Ok(())
}

/// Draws the city through a projection.
fn draw(city: &City, projection: Mat4, [width, height]: [usize; 2], file: &Path) -> image::ImageResult<()> {
    let mut colours = vec![Vec3::new(0.55, 0.7, 0.9); width * height];
    let mut depths = vec![f32::INFINITY; width * height];
    for actor in &city.actors {
        let mesh = &city.assets[actor.asset as usize].mesh;
        let world: Vec<Vec3> = mesh.positions.iter().map(|p| place(actor, *p)).collect();
        for k in 0..mesh.triangles.len() {
            let corners = mesh.triangles[k].map(|i| world[i as usize]);
            let clip = corners.map(|p| projection * p.extend(1.0));
            // what reaches behind the eye is left out: good enough for a look
            if clip.iter().any(|c| c.w < 0.2) {
                continue;
            }
            let colour = shade(city, mesh, k, corners);
            let screen = clip.map(|c| {
                let p = c.truncate() / c.w;
                Vec3::new((0.5 + 0.5 * p.x) * width as f32, (0.5 - 0.5 * p.y) * height as f32, p.z)
            });
            fill(&mut colours, &mut depths, width, height, screen, colour);
        }
    }
    let mut picture = image::RgbImage::new(width as u32, height as u32);
    for (pixel, colour) in picture.pixels_mut().zip(&colours) {
        pixel.0 = colour.to_array().map(|c| (255.0 * c.clamp(0.0, 1.0).powf(0.4545)) as u8);
    }
    picture.save(file)
}

fn place(actor: &Actor, p: Vec3) -> Vec3 {
    let pose = actor.trajectory.as_ref().map_or(actor.world_from_asset, |t| t.waypoints[0].world_from_asset);
    pose.apply(p.as_dvec3()).as_vec3()
}

/// A triangle's colour under a sun; magenta where it is seen from behind would show wrong winding, so it is darkened.
fn shade(city: &City, mesh: &Mesh, k: usize, [a, b, c]: [Vec3; 3]) -> Vec3 {
    let material = &city.materials[usize::from(mesh.materials[k])];
    let normal = (b - a).cross(c - a).normalize_or_zero();
    let light = 0.45 + 0.55 * normal.dot(Vec3::new(-0.4, -0.5, 0.77)).max(0.0);
    let stripes = match material.pattern {
        Pattern::Plain => 1.0,
        // some variation, for one colour by triangle
        _ => 0.94 + 0.12 * ((DVec2::from(mesh.uvs[mesh.triangles[k][0] as usize].as_dvec2()).element_sum() * 7.3).fract().abs() as f32),
    };
    material.base_colour * light * stripes
}

fn fill(colours: &mut [Vec3], depths: &mut [f32], width: usize, height: usize, [a, b, c]: [Vec3; 3], colour: Vec3) {
    let (low, high) = (a.min(b).min(c), a.max(b).max(c));
    let range = |from: f32, to: f32, end: usize| (from.max(0.0) as usize)..((to + 1.0).clamp(0.0, end as f32) as usize);
    let edge = |p: Vec3, q: Vec3, x: f32, y: f32| (q.x - p.x) * (y - p.y) - (q.y - p.y) * (x - p.x);
    let area = edge(a, b, c.x, c.y);
    if area.abs() < 1e-9 {
        return;
    }
    // seen from behind: shown in magenta, because it should not be
    let colour = if area > 0.0 { Vec3::new(1.0, 0.0, 1.0) } else { colour };
    for y in range(low.y, high.y, height) {
        for x in range(low.x, high.x, width) {
            let (px, py) = (x as f32 + 0.5, y as f32 + 0.5);
            let (u, v) = (edge(b, c, px, py) / area, edge(c, a, px, py) / area);
            let w = 1.0 - u - v;
            if u < 0.0 || v < 0.0 || w < 0.0 {
                continue;
            }
            let depth = u * a.z + v * b.z + w * c.z;
            if depth < depths[x + y * width] {
                depths[x + y * width] = depth;
                colours[x + y * width] = colour;
            }
        }
    }
}
