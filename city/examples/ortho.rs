//! Rasterises a city from above and from streets with flat shading, for visual inspection without the ray tracer.
//!
//! `cargo run --release -p city --example ortho -- LAYOUT AREA_KM2 FOLDER [SEED] [PLAIN]`
//! writes `LAYOUT-above.png`, `LAYOUT-oblique.png` and `LAYOUT-street-K.png`.

use std::path::Path;

use city::{Actor, City, CitySettings, Class, Mesh, Pattern, Traffic};
use glam::{DVec3, Vec3};

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
    let file = |what: String| Path::new(folder).join(format!("{layout}-{what}.png"));
    let above = View::new(Vec3::Z * 500.0, Vec3::Y * 1e-3, None, half + 20.0);
    draw(&city, &above, [1100, 1100], &file("above".to_owned()))?;
    let oblique =
        View::new(Vec3::new(-0.35 * half, -0.9 * half, 75.0), Vec3::new(0.0, -0.2 * half, 5.0), Some(0.9), 1.0);
    draw(&city, &oblique, [1280, 800], &file("oblique".to_owned()))?;
    // along the last lane (the deck's, if there is one) and from above it
    if let Some(lane) = city.streets.last() {
        let [here, ahead] = [lane.len() / 3, 2 * lane.len() / 3].map(|k| lane[k].as_vec3());
        let over = View::new(here + Vec3::new(0.0, -12.0, 16.0), ahead, Some(0.9), 1.0);
        draw(&city, &over, [1280, 800], &file("over".to_owned()))?;
        draw(
            &city,
            &View::new(here + 1.8 * Vec3::Z, ahead + Vec3::Z, Some(0.9), 1.0),
            [1280, 800],
            &file("last".to_owned()),
        )?;
    }
    let catalogues: [(&str, f32, &[&str]); 4] = [
        (
            "vehicles",
            7.0,
            &["hatch", "saloon", "estate", "offroad", "taxi", "van", "pickup", "motor", "bicycle", "bus,", "truck"],
        ),
        ("people", 1.2, &["person 1", "person 2"]),
        (
            "furniture",
            3.0,
            &[
                "lamp", "old", "sig", "street", "yield", "bin", "bench", "boll", "hyd", "shel", "col", "fence", "wall",
                "hedge",
            ],
        ),
        ("trees", 8.0, &["tree"]),
    ];
    for (name, apart, starts) in catalogues {
        let catalogue = catalogue(&city, f64::from(apart), starts);
        let side = apart * (catalogue.actors.len() as f32).sqrt();
        let view = View::new(
            Vec3::new(0.5 * side, -0.6 * side, 0.5 * side),
            Vec3::new(-0.5 * apart, -0.5 * apart, 0.0),
            Some(0.62),
            1.0,
        );
        draw(&catalogue, &view, [1500, 1000], &file(format!("catalogue-{name}")))?;
    }
    let count = city.streets.len();
    for k in 0..count.min(4) {
        let street = &city.streets[k * count / count.min(4)];
        let at = street.len() * (1 + k) / 6;
        let [here, ahead] = [at, (at + 4).min(street.len() - 1)].map(|k| street[k].as_vec3() + 1.8 * Vec3::Z);
        draw(&city, &View::new(here, ahead, Some(1.1), 1.0), [1280, 800], &file(format!("street-{k}")))?;
    }
    Ok(())
}

/// The assets with these name prefixes, side by side.
fn catalogue(city: &City, apart: f64, starts: &[&str]) -> City {
    let shown = |name: &str| starts.iter().any(|start| name.starts_with(start));
    let assets: Vec<_> = city.assets.iter().filter(|a| shown(&a.name)).cloned().collect();
    let columns = (assets.len() as f64).sqrt().ceil() as usize;
    let actor = |k: usize| {
        let translation = apart
            * DVec3::new((k % columns) as f64 - 0.5 * columns as f64, (k / columns) as f64 - 0.5 * columns as f64, 0.0);
        let pose = scene::Rigid { translation, ..scene::Rigid::IDENTITY };
        Actor { asset: k as u32, class: Class::Terrain, instance: 0, world_from_asset: pose, trajectory: None }
    };
    City {
        materials: city.materials.clone(),
        actors: (0..assets.len()).map(actor).collect(),
        assets,
        ..City::default()
    }
}

/// A camera: perspective with half the image width at unit distance, or orthographic with half the image height in
/// metres.
struct View {
    eye: Vec3,
    axes: [Vec3; 3],
    lens: Option<f32>,
    reach: f32,
}

impl View {
    fn new(eye: Vec3, target: Vec3, lens: Option<f32>, reach: f32) -> Self {
        let ahead = (target - eye).normalize();
        let right = ahead.cross(Vec3::Z).normalize();
        Self { eye, axes: [right, right.cross(ahead), ahead], lens, reach }
    }

    /// A triangle in camera axes, clipped at the near plane, as a fan.
    fn seen(&self, corners: [Vec3; 3]) -> Vec<Vec3> {
        const NEAR: f32 = 0.2;
        let inner = corners.map(|p| Vec3::from(self.axes.map(|axis| axis.dot(p - self.eye))));
        let mut fan = Vec::with_capacity(4);
        for k in 0..3 {
            let (a, b) = (inner[k], inner[(k + 1) % 3]);
            if a.z > NEAR {
                fan.push(a);
            }
            if (a.z > NEAR) != (b.z > NEAR) {
                fan.push(a.lerp(b, (NEAR - a.z) / (b.z - a.z)));
            }
        }
        fan
    }

    /// Pixel and depth (increasing with distance, linear on the screen) of a point in camera axes.
    fn project(&self, p: Vec3, [width, height]: [usize; 2]) -> Vec3 {
        let (half_width, half_height) = (0.5 * width as f32, 0.5 * height as f32);
        let (scale, depth) = match self.lens {
            Some(lens) => (half_width / (lens * p.z), -1.0 / p.z),
            None => (half_height / self.reach, p.z),
        };
        Vec3::new(half_width + p.x * scale, half_height - p.y * scale, depth)
    }
}

/// Renders the city with a depth buffer.
fn draw(city: &City, view: &View, size: [usize; 2], file: &Path) -> image::ImageResult<()> {
    let [width, height] = size;
    let mut colours = vec![Vec3::new(0.55, 0.7, 0.9); width * height];
    let mut depths = vec![f32::INFINITY; width * height];
    for actor in &city.actors {
        let mesh = &city.assets[actor.asset as usize].mesh;
        let world: Vec<Vec3> = mesh.positions.iter().map(|p| place(actor, *p)).collect();
        for k in 0..mesh.triangles.len() {
            let corners = mesh.triangles[k].map(|i| world[i as usize]);
            let fan: Vec<Vec3> = view.seen(corners).into_iter().map(|p| view.project(p, size)).collect();
            let name = &city.materials[usize::from(mesh.materials[k])].name;
            let thin = ["glass", "leaves", "needles", "hedge"].iter().any(|thin| name.contains(thin));
            for pair in fan.windows(2).skip(1) {
                let [a, b, c] = [fan[0], pair[0], pair[1]];
                // back faces are magenta: only panes and leaves should show them
                let behind = (b - a).truncate().perp_dot((c - a).truncate()) > 0.0;
                let colour = if behind && !thin { Vec3::new(1.0, 0.0, 1.0) } else { shade(city, mesh, k, corners) };
                fill(&mut colours, &mut depths, width, height, [a, b, c], colour);
            }
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

/// A triangle's colour under a sun.
fn shade(city: &City, mesh: &Mesh, k: usize, [a, b, c]: [Vec3; 3]) -> Vec3 {
    let material = &city.materials[usize::from(mesh.materials[k])];
    let normal = (b - a).cross(c - a).normalize_or_zero();
    let light = 0.45 + 0.55 * normal.dot(Vec3::new(-0.4, -0.5, 0.77)).max(0.0);
    let stripes = match material.pattern {
        Pattern::Plain => 1.0,
        // some variation between triangles
        _ => 0.94 + 0.12 * (mesh.uvs[mesh.triangles[k][0] as usize].element_sum() * 7.3).fract().abs(),
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
