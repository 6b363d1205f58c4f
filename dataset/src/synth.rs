//! A small synthetic city as a capture: `plat demo` needs one, and nobody's licence or download stands in the way.
//!
//! Streets, houses, trees and parked cars from a seed; a vehicle that drives the streets with three cameras and a
//! drone above them; photos by ray casting, sparse points with tracks from what the views truly see. World metres,
//! z up, the city centred on the origin. The sky is a plain gradient and part of the photos: a trainer without a sky
//! layer has to explain it with splats.

mod city;
mod surface;
mod trace;

use std::collections::BTreeMap;
use std::fs;
use std::io::Cursor;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DMat3, DQuat, DVec3, Vec2, Vec3};
use image::{ColorType, ImageFormat};
use rayon::prelude::*;
use scene::colmap::{self, ColmapCamera, ColmapImage, ColmapPoints, Reconstruction};
use scene::{BadInput, Camera, CameraModel, Capture, Pinhole, Rigid, SparsePoints, View};
use store::file::{SaveError, save};

use city::{Layout, Random};
use trace::World;

/// The size of a city and of its capture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CitySettings {
    /// Everything random follows from it.
    pub seed: u64,
    /// Side of the square city, metres: 80 to 2,000.
    pub extent_metres: f64,
    /// Number of photos: 16 to 20,000. Three in eight are taken from the air.
    pub views: u32,
    /// Photo width, pixels: 16 to 4,096.
    pub width: u32,
    /// Photo height, pixels: 16 to 4,096.
    pub height: u32,
    /// Share of the city, from its west side, that is a bare plain: 0 to 0.8.
    pub plain: f64,
}

impl Default for CitySettings {
    /// The demo's city: 200 m, 12 megapixels in all.
    fn default() -> Self {
        Self { seed: 1, extent_metres: 200.0, views: 320, width: 240, height: 160, plain: 0.0 }
    }
}

/// What was written.
#[derive(Debug, Clone, PartialEq)]
pub struct CitySummary {
    /// Number of photos.
    pub views: usize,
    /// Number of sparse points.
    pub points: usize,
    /// Mean number of views per point.
    pub mean_track: f64,
    /// Bodies in the city: houses, roofs, balconies, trees, cars and their parts.
    pub solids: usize,
}

/// Why there is no city.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SynthError {
    /// A setting is out of range.
    #[error(transparent)]
    BadInput(#[from] BadInput),
    /// A file or folder could not be written.
    #[error(transparent)]
    Save(#[from] SaveError),
}

/// Where the sparse model goes, and which of its files is written last.
const SPARSE: &str = "sparse/0";
const IMAGES: &str = "images.bin";
/// Share of the photos that the drone takes.
const AERIAL: (usize, usize) = (3, 8);
const DRONE_HEIGHT: f64 = 55.0;
const RIG_HEIGHT: f64 = 2.4;
/// The rig: names, and yaw to the left of the driving direction in degrees.
const RIG: [(&str, f64); 3] = [("front", 0.0), ("left", 60.0), ("right", -60.0)];
/// Standard deviation of a sparse point along each axis, metres.
const POINT_NOISE: f32 = 0.015;
/// A sparse point has at least this many views, as structure from motion asks for.
const SHORTEST_TRACK: usize = 3;

/// Writes a capture in COLMAP's layout, `images/*.png` and `sparse/0/*.bin`, into a directory that it makes.
/// The same settings give the same bytes, whatever the number of threads. `progress` hears `(photos done, photos)`
/// from any thread.
///
/// # Errors
/// Settings out of range, or a directory or file that cannot be written.
pub fn write_city(
    out: &Path,
    settings: &CitySettings,
    progress: impl Fn(usize, usize) + Sync,
) -> Result<CitySummary, SynthError> {
    check(settings)?;
    let world = World::new(Layout::new(settings.seed, settings.extent_metres, settings.plain));
    let views = views(settings, &world.layout);
    let images = out.join("images");
    make(&images)?;
    // An older city is none from here on, and the new one is none before this file is there.
    let last = out.join(SPARSE).join(IMAGES);
    if last.exists() {
        fs::remove_file(&last).map_err(|e| SaveError::new(&last, &e))?;
    }
    let done = AtomicUsize::new(0);
    views.par_iter().try_for_each(|view| {
        let path = images.join(&view.name);
        let (k, mut png) = (&view.camera.pinhole, Cursor::new(Vec::new()));
        let pixels = world.view(&view.camera);
        image::write_buffer_with_format(&mut png, &pixels, k.width, k.height, ColorType::Rgb8, ImageFormat::Png)
            .map_err(|e| SaveError::new(&path, &e))?;
        save(&path, png.get_ref())?;
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, views.len());
        Ok::<_, SynthError>(())
    })?;
    let points = sparse_points(settings, &world, &views);
    let summary = CitySummary {
        views: views.len(),
        points: points.len(),
        mean_track: points.seen_by.len() as f64 / points.len().max(1) as f64,
        solids: world.solids.len(),
    };
    write_sparse(&out.join(SPARSE), &Capture { views, points, geo_origin: None })?;
    Ok(summary)
}

fn check(settings: &CitySettings) -> Result<(), BadInput> {
    let refuse =
        |what: &str, range: &str| Err(BadInput::new("synthetic city", format!("{what} is out of range"), range));
    match settings {
        s if !(80.0..=2000.0).contains(&s.extent_metres) => refuse("its extent", "choose 80 to 2,000 metres"),
        s if !(16..=20_000).contains(&s.views) => refuse("the number of views", "choose 16 to 20,000"),
        s if !(16..=4096).contains(&s.width) => refuse("the photo width", "choose 16 to 4,096 pixels"),
        s if !(16..=4096).contains(&s.height) => refuse("the photo height", "choose 16 to 4,096 pixels"),
        s if !(0.0..=0.8).contains(&s.plain) => refuse("the share of bare plain", "choose 0 to 0.8"),
        _ => Ok(()),
    }
}

fn make(folder: &Path) -> Result<(), SaveError> {
    fs::create_dir_all(folder).map_err(|e| SaveError::new(folder, &e))
}

/// All views in name order: the drone's first, then the vehicle's.
fn views(settings: &CitySettings, layout: &Layout) -> Vec<View> {
    let total = settings.views as usize;
    let aerial = total * AERIAL.0 / AERIAL.1;
    let rigs = (total - aerial).div_ceil(RIG.len());
    let mut random = Random::new(layout.seed, 0xCA3E);
    let mut named: Vec<(String, Camera)> = (0..aerial)
        .map(|i| (format!("aerial_{i:05}.png"), drone(settings, i, &mut random)))
        .chain((0..rigs).flat_map(|i| {
            let (place, heading) = drive(layout, (i as f64 + 0.5) / rigs as f64);
            RIG.map(|(name, yaw)| {
                let direction = direction((heading + yaw).to_radians(), -4f64.to_radians());
                (format!("street_{i:05}_{name}.png"), look(settings, 80.0, place, direction, DVec3::Z))
            })
        }))
        .collect();
    named.truncate(total);
    named.into_iter().map(|(name, camera)| View { name, camera, mips: Vec::new(), masked: false }).collect()
}

/// The drone's `i`-th photo: four oblique headings and straight down in turn, over places that fill the city evenly
/// for any number of photos (Roberts' R2 sequence).
fn drone(settings: &CitySettings, i: usize, random: &mut Random) -> Camera {
    let spread = |step: f64| (0.5 + step * (i + 1) as f64).fract() - 0.5;
    let target = 0.95 * settings.extent_metres * DVec3::new(spread(0.754_877_666_2), spread(0.569_840_290_9), 0.0);
    let height = DRONE_HEIGHT + f64::from(random.range(-2.0, 2.0));
    let heading = (90.0 * (i % 5) as f64 + f64::from(random.range(-6.0, 6.0))).to_radians();
    let tilt = if i % 5 == 4 { 88f64 } else { 50.0 }.to_radians();
    let forward = direction(heading, -tilt);
    look(settings, 70.0, target + forward * (height / forward.z), forward, DVec3::Z)
}

/// Where the vehicle is after this share of its drive along all inner streets, and its heading in degrees.
fn drive(layout: &Layout, share: f64) -> (DVec3, f64) {
    let streets = 2 * (layout.blocks - 1);
    let at = share * f64::from(streets);
    let street = (at as u32).min(streets - 1);
    let line = f64::from(layout.line(1 + street / 2));
    let forth = if (street / 2).is_multiple_of(2) { 1.0 } else { -1.0 };
    let along = forth * (at - f64::from(street) - 0.5) * f64::from(layout.extent);
    let lane = forth * f64::from(city::LANE);
    match street % 2 {
        0 => (DVec3::new(along, line - lane, RIG_HEIGHT), if forth > 0.0 { 0.0 } else { 180.0 }),
        _ => (DVec3::new(line + lane, along, RIG_HEIGHT), 90.0 * forth),
    }
}

/// A unit vector from a heading (counter-clockwise from x) and an elevation, radians.
fn direction(heading: f64, elevation: f64) -> DVec3 {
    let (sin, cos) = elevation.sin_cos();
    DVec3::new(cos * heading.cos(), cos * heading.sin(), sin)
}

/// A camera at a place, with a horizontal field of view in degrees; `up` points up in its picture.
fn look(settings: &CitySettings, field_of_view: f64, place: DVec3, forward: DVec3, up: DVec3) -> Camera {
    let right = forward.cross(up).normalize();
    let axes = DMat3::from_cols(right, forward.cross(right), forward);
    let rotation = DQuat::from_mat3(&axes.transpose()).normalize();
    let focal = 0.5 * f64::from(settings.width) / (0.5 * field_of_view).to_radians().tan();
    let pinhole = Pinhole {
        width: settings.width,
        height: settings.height,
        fx: focal,
        fy: focal,
        cx: 0.5 * f64::from(settings.width),
        cy: 0.5 * f64::from(settings.height),
    };
    Camera { pinhole, camera_from_world: Rigid { rotation, translation: -(rotation * place) } }
}

/// Points on surfaces that views see, each with all the views that see it, and with structure-from-motion noise.
fn sparse_points(settings: &CitySettings, world: &World, views: &[View]) -> SparsePoints {
    let wanted = 80 * settings.views;
    let seed = world.layout.seed;
    let sampled: Vec<_> = (0..wanted)
        .into_par_iter()
        .filter_map(|i| {
            let mut random = Random::new(seed ^ 0x5F3E, i);
            let view = &views[i as usize % views.len()].camera;
            let k = &view.pinhole;
            let (x, y) = (random.range(0.0, k.width as f32), random.range(0.0, k.height as f32));
            let (origin, direction) = ray(view, Vec2::new(x, y));
            let hit = world.cast(origin, direction)?;
            let point = origin + hit.distance * direction;
            if point.truncate().abs().max_element() > 0.5 * world.layout.extent + 25.0 {
                return None;
            }
            let seen_by: Vec<u32> = (0..views.len() as u32)
                .filter(|&v| sees(world, &views[v as usize].camera, point, hit.normal))
                .collect();
            let colour = trace::encode(world.shade(point, &hit, 1.0 / k.fx as f32));
            let noise = POINT_NOISE * Vec3::new(random.normal(), random.normal(), random.normal());
            (seen_by.len() >= SHORTEST_TRACK).then(|| ((point + noise).as_dvec3(), colour, seen_by))
        })
        .collect();
    let mut points = SparsePoints { track_start: vec![0], ..Default::default() };
    for (position, colour, seen_by) in sampled {
        points.positions.push(position);
        points.colours.push(colour);
        points.seen_by.extend(seen_by);
        points.track_start.push(points.seen_by.len() as u32);
    }
    points
}

/// The ray through a place of the image, as origin and unit direction.
fn ray(camera: &Camera, pixel: Vec2) -> (Vec3, Vec3) {
    let k = &camera.pinhole;
    let (x, y) = ((f64::from(pixel.x) - k.cx) / k.fx, (f64::from(pixel.y) - k.cy) / k.fy);
    let world_from_camera = camera.camera_from_world.inverse();
    let direction = world_from_camera.rotation * DVec3::new(x, y, 1.0).normalize();
    (world_from_camera.translation.as_vec3(), direction.as_vec3())
}

/// True where the point lies in the image, faces the camera by more than 5 degrees and nothing stands between.
fn sees(world: &World, camera: &Camera, point: Vec3, normal: Vec3) -> bool {
    let (pixel, depth) = camera.project(point.as_dvec3());
    let k = &camera.pinhole;
    let inside = (0.0..f64::from(k.width)).contains(&pixel.x) && (0.0..f64::from(k.height)).contains(&pixel.y);
    if depth < 0.3 || !inside {
        return false;
    }
    let eye = camera.centre().as_vec3();
    let (to_eye, distance) = ((eye - point).normalize(), eye.distance(point));
    normal.dot(to_eye) > 0.09 && !world.is_blocked(point + 5e-3 * normal, to_eye, distance)
}

fn write_sparse(folder: &Path, capture: &Capture) -> Result<(), SaveError> {
    make(folder)?;
    let model = reconstruction(capture);
    for (name, bytes) in [
        ("cameras.bin", colmap::write_cameras_bin(&model)),
        ("points3D.bin", colmap::write_points_bin(&model)),
        (IMAGES, colmap::write_images_bin(&model)),
    ] {
        save(&folder.join(name), &bytes)?;
    }
    Ok(())
}

/// COLMAP's words for the capture, whose views share one lens or few; ids count from 1.
fn reconstruction(capture: &Capture) -> Reconstruction {
    let mut lenses: Vec<Pinhole> = Vec::new();
    let images = capture.views.iter().zip(1..).map(|(view, id)| {
        let lens = view.camera.pinhole;
        let at = lenses.iter().position(|&other| other == lens).unwrap_or_else(|| {
            lenses.push(lens);
            lenses.len() - 1
        });
        let camera_from_world = view.camera.camera_from_world;
        ColmapImage { id, name: view.name.clone(), camera_id: at as u32 + 1, camera_from_world }
    });
    let images = images.collect();
    let camera = |k: Pinhole| {
        let model = CameraModel::Pinhole([k.fx, k.fy, k.cx, k.cy]);
        ColmapCamera { width: k.width, height: k.height, model }
    };
    let cameras: BTreeMap<u32, ColmapCamera> = (1..).zip(lenses.into_iter().map(camera)).collect();
    let SparsePoints { positions, colours, track_start, seen_by } = capture.points.clone();
    let ids = (1..=positions.len() as u64).collect();
    let track_images = seen_by.iter().map(|view| view + 1).collect();
    Reconstruction { cameras, images, points: ColmapPoints { ids, positions, colours, track_start, track_images } }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: CitySettings =
        CitySettings { seed: 7, extent_metres: 90.0, views: 24, width: 48, height: 32, plain: 0.0 };

    /// All files under a folder with their bytes.
    fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
        ["images", "sparse/0"]
            .iter()
            .flat_map(|part| fs::read_dir(folder.join(part)).unwrap())
            .map(|entry| entry.unwrap().path())
            .map(|path| (path.file_name().unwrap().to_string_lossy().into_owned(), fs::read(&path).unwrap()))
            .collect()
    }

    fn written(settings: &CitySettings, threads: usize) -> (BTreeMap<String, Vec<u8>>, CitySummary) {
        let folder = tempfile::tempdir().unwrap();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let summary = pool.install(|| write_city(folder.path(), settings, |_, _| ())).unwrap();
        (files(folder.path()), summary)
    }

    #[test]
    fn one_seed_gives_the_same_bytes_on_any_number_of_threads() {
        let (one, summary) = written(&SMALL, 1);
        let (three, _) = written(&SMALL, 3);
        assert!(one == three);
        assert_eq!(one.len(), 24 + 3);
        assert!(summary.points > 300 && summary.mean_track > 3.0, "{summary:?}");
        let (other, _) = written(&CitySettings { seed: 8, ..SMALL }, 2);
        assert!(one["points3D.bin"] != other["points3D.bin"]);
    }

    #[test]
    fn views_are_in_name_order_and_see_the_city() {
        let layout = Layout::new(1, 200.0, 0.0);
        let views = views(&CitySettings::default(), &layout);
        assert_eq!(views.len(), 320);
        assert!(views.is_sorted_by(|a, b| a.name < b.name));
        for view in &views {
            let (centre, forward) = (view.camera.centre(), view.camera.forward());
            assert!(view.camera.camera_from_world.is_sane());
            if view.name.starts_with("street") {
                assert!(
                    (centre.z - RIG_HEIGHT).abs() < 1e-9 && centre.abs().max_element() < 100.1,
                    "{} at {centre}",
                    view.name
                );
                let to_line = |c: f64| layout.off_line(c as f32).abs();
                assert!(to_line(centre.x).min(to_line(centre.y)) < 2.0, "{} left its lane", view.name);
            } else {
                assert!(centre.z > 50.0 && forward.z < -0.7);
            }
            // the picture's top is up
            let down = view.camera.camera_from_world.rotation.inverse() * DVec3::Y;
            assert!(down.z < 0.1);
        }
    }

    #[test]
    fn tracked_points_project_onto_their_own_colour() {
        let settings = CitySettings { width: 96, height: 64, ..SMALL };
        let world = World::new(Layout::new(settings.seed, settings.extent_metres, settings.plain));
        let views = views(&settings, &world.layout);
        let points = sparse_points(&settings, &world, &views);
        // seen from where it was sampled, a point has the colour of its pixel, but for edges and blur
        let pictures: Vec<Vec<u8>> = views.iter().map(|view| world.view(&view.camera)).collect();
        let (mut near, mut all) = (0, 0);
        for i in 0..points.len() {
            for &v in points.track(i).unwrap() {
                let (pixel, depth) = views[v as usize].camera.project(points.positions[i]);
                assert!(depth > 0.0);
                let (x, y) = (pixel.x.clamp(0.0, 95.0) as usize, pixel.y.clamp(0.0, 63.0) as usize);
                let seen = &pictures[v as usize][3 * (y * 96 + x)..][..3];
                let off = seen.iter().zip(points.colours[i]).map(|(&a, b)| a.abs_diff(b)).max().unwrap();
                near += usize::from(off < 60);
                all += 1;
            }
        }
        assert!(near * 10 > all * 8, "{near} of {all}");
    }

    #[test]
    fn settings_out_of_range_are_refused() {
        let refused =
            |settings: CitySettings| write_city(Path::new("never-made"), &settings, |_, _| ()).unwrap_err().to_string();
        assert!(refused(CitySettings { extent_metres: f64::NAN, ..SMALL }).contains("80 to 2,000"));
        assert!(refused(CitySettings { views: 0, ..SMALL }).contains("views"));
        assert!(refused(CitySettings { width: 1 << 30, ..SMALL }).contains("width"));
        assert!(!Path::new("never-made").exists());
    }
}
