//! Finds what changed between a model and new photos of it: pixels whose render differs, and the surface of what is there now.
//!
//! A place may be filled only if the photos that show it have changed there (the visual hull, Laurentini 1994). Of these, surface
//! places whose colour differs between the photos that see them are carved away, as long as there are any (space carving, Kutulakos
//! and Seitz 2000).

use glam::{DVec3, IVec3};
use scene::{Camera, Pixels, Splats};

use crate::error::TrainError;
use crate::importance::EvaluationViews;

/// Half of the side of the square that differences are averaged over, pixels: sharp texture that splats blur is no change.
const BLUR: usize = 2;
/// A pixel has changed if it differs by more than this, and by more than so many times the median difference.
const MIN_CHANGE: f32 = 0.08;
const CHANGE_PER_MEDIAN: f32 = 4.0;
/// It has not if it differs by less than this share of that.
const SAME_SHARE: f32 = 0.5;
/// Voxels along a side of the cube around the area.
const VOXELS: i32 = 80;
/// Fewest photos that show a filled place as changed, of those that show it; where one photo is all, one.
const MIN_PHOTOS: u32 = 2;
/// A place is free where more of the photos have not changed.
const MAX_SAME: f64 = 0.15;
/// Largest standard deviation of a surface place's colour over the photos that see it, 0 to 1.
const MAX_SPREAD: f64 = 0.16;
/// Rounds of carving.
const MAX_ROUNDS: usize = 12;

/// What a pixel says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Change {
    Changed,
    Same,
    /// Masked, or between both.
    Unknown,
}

struct ChangedPhoto {
    camera: Camera,
    width: usize,
    height: usize,
    rgb: Vec<u8>,
    changes: Vec<Change>,
}

impl ChangedPhoto {
    /// The pixel that shows a place, if any.
    fn pixel(&self, place: DVec3) -> Option<usize> {
        let (pixel, depth) = self.camera.project(place);
        let (x, y) = (pixel.x.floor(), pixel.y.floor());
        let is_inside = depth > 0.0 && x >= 0.0 && y >= 0.0 && x < self.width as f64 && y < self.height as f64;
        is_inside.then(|| y as usize * self.width + x as usize)
    }

    fn colour(&self, pixel: usize) -> DVec3 {
        let area = self.width * self.height;
        DVec3::from([0, 1, 2].map(|c| f64::from(self.rgb[c * area + pixel]) / 255.0))
    }
}

/// The differences between splats and photos.
pub struct Changes {
    photos: Vec<ChangedPhoto>,
}

/// A place on a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfacePlace {
    /// World metres.
    pub place: DVec3,
    /// sRGB.
    pub colour: [u8; 3],
}

impl Changes {
    /// Renders the views and compares them with their photos.
    ///
    /// # Errors
    /// A window that cannot be read.
    pub fn find(views: &EvaluationViews, splats: &Splats) -> Result<Self, TrainError> {
        let mut cameras = views.views.iter().filter_map(|view| view.at(0).map(|(_, _, camera)| camera));
        let mut compared: Vec<(Camera, Pixels, Vec<f32>)> = Vec::new();
        views.pictures(splats, |_, photo, picture| {
            let camera = cameras.next().expect("a picture of each view");
            compared.push((camera, photo.clone(), difference(photo, picture)));
        })?;
        let mut all: Vec<f32> = compared.iter().flat_map(|(.., difference)| difference.iter().copied()).collect();
        let middle = all.len() / 2;
        let median = if all.is_empty() { 0.0 } else { *all.select_nth_unstable_by(middle, f32::total_cmp).1 };
        let threshold = MIN_CHANGE.max(CHANGE_PER_MEDIAN * median);
        let photos = compared.into_iter().map(|(camera, photo, difference)| {
            let is_masked = |i: usize| photo.mask.as_ref().is_some_and(|mask| mask[i] < 128);
            let change = |(i, &difference): (usize, &f32)| match difference {
                _ if is_masked(i) => Change::Unknown,
                d if d > threshold => Change::Changed,
                d if d < SAME_SHARE * threshold => Change::Same,
                _ => Change::Unknown,
            };
            let changes = difference.iter().enumerate().map(change).collect();
            ChangedPhoto { camera, width: photo.width as usize, height: photo.height as usize, rgb: photo.rgb, changes }
        });
        Ok(Self { photos: photos.collect() })
    }

    /// Number of changed pixels, a mean over the photos.
    pub fn pixels(&self) -> f64 {
        let changed = |photo: &ChangedPhoto| photo.changes.iter().filter(|change| **change == Change::Changed).count();
        self.photos.iter().map(changed).sum::<usize>() as f64 / self.photos.len().max(1) as f64
    }

    /// The surface of what fills the changed pixels within a ball: at most `count` places, in a fixed order.
    pub fn surface(&self, centre: DVec3, radius: f64, count: usize) -> Vec<SurfacePlace> {
        let edge = 2.0 * radius / f64::from(VOXELS);
        let mut filled =
            Voxels { corner: centre - radius, edge, filled: vec![false; (VOXELS * VOXELS * VOXELS) as usize] };
        for voxel in Voxels::all() {
            let place = filled.place(voxel);
            if place.distance(centre) <= radius && self.is_hull(place) {
                filled.set(voxel, true);
            }
        }
        let mut surface = Vec::new();
        for round in 0..=MAX_ROUNDS {
            surface.clear();
            let mut carved = Vec::new();
            for voxel in Voxels::all().filter(|&voxel| filled.is_surface(voxel)) {
                let place = filled.place(voxel);
                let seen = self.photos.iter().filter_map(|photo| {
                    let pixel = photo.pixel(place)?;
                    let shows = photo.changes[pixel] != Change::Same && !filled.hides(voxel, photo.camera.centre());
                    shows.then(|| photo.colour(pixel))
                });
                let seen: Vec<DVec3> = seen.collect();
                let mean = seen.iter().sum::<DVec3>() / seen.len().max(1) as f64;
                let variance =
                    seen.iter().map(|colour| (*colour - mean).powf(2.0)).sum::<DVec3>() / seen.len().max(1) as f64;
                if seen.len() > 1 && variance.max_element() > MAX_SPREAD * MAX_SPREAD && round < MAX_ROUNDS {
                    carved.push(voxel);
                } else if !seen.is_empty() {
                    let colour = (255.0 * mean).round().to_array().map(|level| level as u8);
                    surface.push(SurfacePlace { place, colour });
                }
            }
            carved.iter().for_each(|&voxel| filled.set(voxel, false));
            if carved.is_empty() {
                break;
            }
        }
        let step = surface.len().div_ceil(count.max(1)).max(1);
        surface.into_iter().step_by(step).collect()
    }

    /// Whether photos show that a place is filled, or could be.
    fn is_hull(&self, place: DVec3) -> bool {
        let (mut changed, mut same) = (0u32, 0u32);
        for photo in &self.photos {
            match photo.pixel(place).map(|pixel| photo.changes[pixel]) {
                Some(Change::Changed) => changed += 1,
                Some(Change::Same) => same += 1,
                _ => {}
            }
        }
        let enough = MIN_PHOTOS.min(self.photos.len() as u32).max(1);
        changed >= enough && f64::from(same) <= MAX_SAME * f64::from(changed + same)
    }
}

/// A cube of voxels.
struct Voxels {
    corner: DVec3,
    edge: f64,
    filled: Vec<bool>,
}

impl Voxels {
    fn all() -> impl Iterator<Item = IVec3> {
        (0..VOXELS).flat_map(|z| (0..VOXELS).flat_map(move |y| (0..VOXELS).map(move |x| IVec3::new(x, y, z))))
    }

    fn place(&self, voxel: IVec3) -> DVec3 {
        self.corner + (voxel.as_dvec3() + 0.5) * self.edge
    }

    fn index(voxel: IVec3) -> Option<usize> {
        let is_inside = voxel.min_element() >= 0 && voxel.max_element() < VOXELS;
        is_inside.then(|| ((voxel.z * VOXELS + voxel.y) * VOXELS + voxel.x) as usize)
    }

    fn is_filled(&self, voxel: IVec3) -> bool {
        Self::index(voxel).is_some_and(|i| self.filled[i])
    }

    fn set(&mut self, voxel: IVec3, filled: bool) {
        if let Some(i) = Self::index(voxel) {
            self.filled[i] = filled;
        }
    }

    /// Whether a voxel is filled and one of its six neighbours is not.
    fn is_surface(&self, voxel: IVec3) -> bool {
        let neighbours = [IVec3::X, IVec3::NEG_X, IVec3::Y, IVec3::NEG_Y, IVec3::Z, IVec3::NEG_Z];
        self.is_filled(voxel) && neighbours.iter().any(|&step| !self.is_filled(voxel + step))
    }

    /// Whether a filled voxel is between this one and a camera. The two voxels next to it do not count: a surface is a voxel thick.
    fn hides(&self, voxel: IVec3, camera: DVec3) -> bool {
        let from = voxel.as_dvec3() + 0.5;
        let step = ((camera - self.corner) / self.edge - from).normalize_or_zero();
        let at = |k: i32| (from + f64::from(k) * step).floor().as_ivec3();
        (3..2 * VOXELS).map(at).take_while(|&at| Self::index(at).is_some()).any(|at| self.is_filled(at))
    }
}

/// The largest difference of a channel between a photo and a render (three planes), each averaged over a square; 0 to 1.
fn difference(photo: &Pixels, picture: &[f32]) -> Vec<f32> {
    let (width, height, area) = (photo.width as usize, photo.height as usize, photo.area());
    let mut largest = vec![0.0f32; area];
    for channel in 0..3 {
        let plane = channel * area..(channel + 1) * area;
        let pairs = picture[plane.clone()].iter().zip(&photo.rgb[plane]);
        let signed: Vec<f32> = pairs.map(|(a, b)| a.clamp(0.0, 1.0) - f32::from(*b) / 255.0).collect();
        let rows = averaged(&signed, width, height, 1, width);
        let both = averaged(&rows, height, width, width, 1);
        largest.iter_mut().zip(both).for_each(|(largest, now)| *largest = largest.max(now.abs()));
    }
    largest
}

/// Averages along lines of `length` values, `step` apart; lines begin `next` apart. At the ends over the values that exist.
fn averaged(values: &[f32], length: usize, lines: usize, step: usize, next: usize) -> Vec<f32> {
    let mut out = vec![0.0; values.len()];
    for line in 0..lines {
        let at = |i: usize| line * next + i * step;
        for i in 0..length {
            let around = i.saturating_sub(BLUR)..(i + BLUR + 1).min(length);
            let count = around.len() as f32;
            out[at(i)] = around.map(|k| values[at(k)]).sum::<f32>() / count;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::{DQuat, Vec3};
    use scene::{Pinhole, Rect, Rigid, Splat};

    use super::*;
    use crate::{TrainView, WindowSource};

    const SIDE: u32 = 96;

    /// A camera 8 m from the origin and 4 m up, that looks at it.
    fn camera(angle: f64) -> Camera {
        let down = DQuat::from_rotation_x(-(4.0f64 / 8.0).atan());
        let back = DQuat::from_rotation_z(angle) * DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2) * down;
        let eye = back * DVec3::new(0.0, 0.0, -80f64.sqrt());
        let rotation = back.inverse();
        let pinhole = Pinhole { width: SIDE, height: SIDE, fx: 110.0, fy: 110.0, cx: 48.0, cy: 48.0 };
        Camera { pinhole, camera_from_world: Rigid { rotation, translation: -(rotation * eye) } }
    }

    fn views(count: usize) -> Vec<TrainView> {
        let view = |i: usize| {
            let camera = camera(std::f64::consts::TAU * i as f64 / count as f64);
            TrainView { view: i as u32, mip: 0, rect: camera.full(), camera, camera_from_context: None }
        };
        (0..count).map(view).collect()
    }

    /// Photos of a red ball of 1 m radius on grey.
    struct Ball(Vec<TrainView>);

    impl WindowSource for Ball {
        fn window(&self, view: u32, _: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
            let camera = self.0[view as usize].camera;
            let centre = camera.camera_from_world.apply(DVec3::ZERO);
            let area = rect.area() as usize;
            let is_red = |i: usize| {
                let (x, y) = ((i % SIDE as usize) as f64 + 0.5, (i / SIDE as usize) as f64 + 0.5);
                let ray = DVec3::new((x - 48.0) / 110.0, (y - 48.0) / 110.0, 1.0).normalize();
                (centre - ray * centre.dot(ray)).length() < 1.0
            };
            let rgb = (0..3 * area).map(|i| if is_red(i % area) { [200, 30, 30][i / area] } else { 128 }).collect();
            Ok(Arc::new(Pixels { width: rect.width, height: rect.height, rgb, ..Pixels::default() }))
        }
    }

    /// A large grey ball around everything.
    fn grey() -> Splats {
        let mut splats = Splats::new(0);
        for i in 0..600 {
            let (turn, height) = (f64::from(i) * 2.399963, 1.0 - 2.0 * (f64::from(i) + 0.5) / 600.0);
            let flat = (1.0 - height * height).sqrt();
            let place = 40.0 * DVec3::new(flat * turn.cos(), flat * turn.sin(), height);
            splats.push(&Splat::round(place.as_vec3(), 1.6, Vec3::splat(128.0 / 255.0), 0.99));
        }
        splats
    }

    #[test]
    fn the_surface_of_a_new_ball_is_found() {
        let views = views(8);
        let source = Ball(views.clone());
        let around =
            EvaluationViews { views: &views, context: None, antialiased: false, exposures: None, source: &source };
        let changes = Changes::find(&around, &grey()).unwrap();
        // The disk of 1 m radius at 8.9 m.
        let disk = std::f64::consts::PI * (110.0f64 / 80f64.sqrt()).powi(2);
        assert!((changes.pixels() / disk - 1.0).abs() < 0.25, "{} of {disk}", changes.pixels());
        let surface = changes.surface(DVec3::ZERO, 2.0, 100_000);
        assert!(surface.len() > 500, "{}", surface.len());
        for at in &surface {
            // The hull of eight views from above ends in a point below.
            let outside = at.place.length() - 1.0;
            assert!(outside < 0.35 || at.place.z < 0.0, "{} is {outside} m outside", at.place);
            assert!(at.colour[0] > 120 && at.colour[1] < 80, "{:?}", at.colour);
        }
        let few = changes.surface(DVec3::ZERO, 2.0, 100);
        assert!((50..=100).contains(&few.len()), "{}", few.len());
        // Far from the change, and where nothing has changed, nothing is.
        assert_eq!(changes.surface(DVec3::new(0.0, 0.0, -30.0), 1.0, 100), []);
    }

    #[test]
    fn photos_of_what_the_model_shows_have_not_changed() {
        struct Grey;
        impl WindowSource for Grey {
            fn window(&self, _: u32, _: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
                let rgb = vec![128; 3 * rect.area() as usize];
                Ok(Arc::new(Pixels { width: rect.width, height: rect.height, rgb, ..Pixels::default() }))
            }
        }
        let views = views(4);
        let around =
            EvaluationViews { views: &views, context: None, antialiased: false, exposures: None, source: &Grey };
        let changes = Changes::find(&around, &grey()).unwrap();
        assert_eq!(changes.pixels(), 0.0);
        assert_eq!(changes.surface(DVec3::ZERO, 2.0, 100), []);
    }
}
