//! Finds what changed between a model and new photos of it: pixels whose render differs, and the surface of what is there now.
//!
//! A place may be filled only if the photos that show it have changed there (the visual hull, Laurentini 1994), and if the photos saw
//! through it before: where something has left, nothing has to be added. Of these, surface places whose colour differs between
//! the photos that see them are carved away, as long as there are any (space carving, Kutulakos and Seitz 2000).

use glam::{DVec3, IVec3, Quat, Vec3};
use scene::{Camera, Pixels, Splats, column};

use crate::error::TrainError;
use crate::importance::EvaluationViews;

/// Half of the side of the square that colours are averaged over, pixels.
const BLUR: usize = 2;
/// A pixel has changed if a channel of the render is so far outside of what the photo has within so many pixels. Splats blur what is
/// sharp: their colour is then between those around.
const MIN_CHANGE: f32 = 0.05;
const AROUND: usize = 9;
/// It has not if no channel differs by more than this.
const MAX_SAME_DIFFERENCE: f32 = 0.04;
/// Voxels along a side of the cube around the area.
const VOXELS: i32 = 80;
/// Smallest share of all photos that show a filled place as changed: rays of a few that meet are chance.
const MIN_PHOTOS: f64 = 0.5;
/// Opacity from which a splat hides what is behind it, and how far it reaches, in standard deviations.
const MIN_OPACITY: f32 = 0.3;
const REACH: f32 = 1.5;
/// The least that it reaches, in edges of a voxel.
const THIN: f32 = 0.6;
/// A place is free where more of the photos have not changed.
const MAX_SAME: f64 = 0.15;
/// Largest standard deviation of a surface place's colour over the photos that see it, 0 to 1.
const MAX_SPREAD: f64 = 0.12;
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
        // `at(0)` is always Some, so there is one for each picture.
        let mut cameras = views.views.iter().filter_map(|view| view.at(0).map(|(_, _, camera)| camera));
        let mut photos = Vec::new();
        views.pictures(splats, |_, photo, picture| {
            let camera = cameras.next().expect("a picture of each view");
            let (width, height) = (photo.width as usize, photo.height as usize);
            photos.push(ChangedPhoto {
                camera,
                width,
                height,
                rgb: photo.rgb.clone(),
                changes: compare(photo, picture),
            });
        })?;
        Ok(Self { photos })
    }

    /// Number of changed pixels, a mean over the photos.
    pub fn pixels(&self) -> f64 {
        let changed = |photo: &ChangedPhoto| photo.changes.iter().filter(|change| **change == Change::Changed).count();
        self.photos.iter().map(changed).sum::<usize>() as f64 / self.photos.len().max(1) as f64
    }

    /// The surface of what fills the changed pixels within a ball, and what the splats were before it: at most `count` places, in a fixed
    /// order.
    pub fn surface(&self, splats: &Splats, centre: DVec3, radius: f64, count: usize) -> Vec<SurfacePlace> {
        let edge = 2.0 * radius / f64::from(VOXELS);
        let before = Voxels::of(splats, centre - radius, edge);
        let mut filled =
            Voxels { corner: centre - radius, edge, filled: vec![false; (VOXELS * VOXELS * VOXELS) as usize] };
        for voxel in Voxels::all() {
            let place = filled.place(voxel);
            if place.distance(centre) <= radius && self.is_hull(place) && self.was_free(&before, voxel) {
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

    /// Whether most of the cameras that show a voxel saw it before, and it was empty.
    fn was_free(&self, before: &Voxels, voxel: IVec3) -> bool {
        let place = before.place(voxel);
        let showing = self.photos.iter().filter(|photo| photo.pixel(place).is_some());
        let (mut seen, mut all) = (0u32, 0u32);
        for photo in showing {
            all += 1;
            seen += u32::from(!before.hides(voxel, photo.camera.centre()));
        }
        !before.is_filled(voxel) && 2 * seen > all
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
        let enough = (MIN_PHOTOS * self.photos.len() as f64).max(1.0);
        f64::from(changed) >= enough && f64::from(same) <= MAX_SAME * f64::from(changed + same)
    }
}

/// A cube of voxels.
struct Voxels {
    corner: DVec3,
    edge: f64,
    filled: Vec<bool>,
}

impl Voxels {
    /// Those that opaque splats fill.
    fn of(splats: &Splats, corner: DVec3, edge: f64) -> Self {
        let mut voxels = Self { corner, edge, filled: vec![false; (VOXELS * VOXELS * VOXELS) as usize] };
        let least = (MIN_OPACITY / (1.0 - MIN_OPACITY)).ln();
        for i in (0..splats.len()).filter(|&i| splats.col(column::OPACITY)[i] >= least) {
            let splat = splats.get(i);
            let [w, x, y, z] = splat.quat;
            let own_from_world = Quat::from_xyzw(x, y, z, w).normalize().inverse();
            // A thin one fills the voxels that it passes.
            let reach = splat.log_scale.to_array().map(|size| (REACH * size.exp()).max(THIN * edge as f32));
            let reach = Vec3::from(reach);
            let bound = |place: Vec3| (((place.as_dvec3() - corner) / edge).floor()).as_ivec3();
            let [low, high] = [-1.0, 1.0].map(|side| bound(splat.mean + Vec3::splat(side * reach.max_element())));
            let [low, high] = [low, high].map(|voxel| voxel.clamp(IVec3::ZERO, IVec3::splat(VOXELS - 1)));
            for z in low.z..=high.z {
                for y in low.y..=high.y {
                    for x in low.x..=high.x {
                        let voxel = IVec3::new(x, y, z);
                        let arm = own_from_world * (voxels.place(voxel).as_vec3() - splat.mean);
                        if (arm / reach).length_squared() <= 1.0 {
                            voxels.set(voxel, true);
                        }
                    }
                }
            }
        }
        voxels
    }

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

/// What each pixel of a photo says beside a render (three planes).
fn compare(photo: &Pixels, picture: &[f32]) -> Vec<Change> {
    let (width, height, area) = (photo.width as usize, photo.height as usize, photo.area());
    let (mut outside, mut differs) = (vec![0.0f32; area], vec![0.0f32; area]);
    for channel in 0..3 {
        let plane = channel * area..(channel + 1) * area;
        let shown: Vec<f32> = picture[plane.clone()].iter().map(|colour| colour.clamp(0.0, 1.0)).collect();
        let taken: Vec<f32> = photo.rgb[plane].iter().map(|level| f32::from(*level) / 255.0).collect();
        let mean = |values: &[f32]| values.iter().sum::<f32>() / values.len() as f32;
        let [shown, taken] = [shown, taken].map(|values| filtered(&values, width, height, BLUR, &mean));
        let least = filtered(&taken, width, height, AROUND, &|values| values.iter().copied().fold(f32::MAX, f32::min));
        let most = filtered(&taken, width, height, AROUND, &|values| values.iter().copied().fold(f32::MIN, f32::max));
        for i in 0..area {
            outside[i] = outside[i].max(least[i] - shown[i]).max(shown[i] - most[i]);
            differs[i] = differs[i].max((shown[i] - taken[i]).abs());
        }
    }
    let is_masked = |i: usize| photo.mask.as_ref().is_some_and(|mask| mask[i] < 128);
    let change = |i: usize| match (outside[i], differs[i]) {
        _ if is_masked(i) => Change::Unknown,
        (outside, _) if outside > MIN_CHANGE => Change::Changed,
        (_, differs) if differs < MAX_SAME_DIFFERENCE => Change::Same,
        _ => Change::Unknown,
    };
    (0..area).map(change).collect()
}

/// A function of the values within `reach` pixels along rows, then of these along columns; at the edges of those that exist.
fn filtered(values: &[f32], width: usize, height: usize, reach: usize, of: &dyn Fn(&[f32]) -> f32) -> Vec<f32> {
    let along = |values: &[f32], length: usize, transposed: &mut Vec<f32>| {
        transposed.resize(values.len(), 0.0);
        let lines = values.len() / length.max(1);
        for (line, values) in values.chunks_exact(length).enumerate() {
            for i in 0..length {
                let around = &values[i.saturating_sub(reach)..(i + reach + 1).min(length)];
                transposed[i * lines + line] = of(around);
            }
        }
    };
    let (mut columns, mut rows) = (Vec::new(), Vec::new());
    along(values, width, &mut columns);
    along(&columns, height, &mut rows);
    rows
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::DQuat;
    use scene::{Pinhole, Rect, Rigid, Splat};

    use super::*;
    use crate::{TrainView, WindowSource};

    const SIDE: u32 = 256;
    const FOCAL: f64 = 400.0;
    const MIDDLE: f64 = 128.0;

    /// A camera 8 m from the origin and 4 m up, that looks at it.
    fn camera(angle: f64) -> Camera {
        let down = DQuat::from_rotation_x(-(4.0f64 / 8.0).atan());
        let back = DQuat::from_rotation_z(angle) * DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2) * down;
        let eye = back * DVec3::new(0.0, 0.0, -80f64.sqrt());
        let rotation = back.inverse();
        let pinhole = Pinhole { width: SIDE, height: SIDE, fx: FOCAL, fy: FOCAL, cx: MIDDLE, cy: MIDDLE };
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
                let ray = DVec3::new((x - MIDDLE) / FOCAL, (y - MIDDLE) / FOCAL, 1.0).normalize();
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
        // The ball's disk without its rim, where the photo has grey within AROUND pixels (a square).
        let radius = FOCAL / 80f64.sqrt();
        let [least, most] = [radius - 1.5 * AROUND as f64, radius].map(|r| std::f64::consts::PI * r * r);
        assert!((least..most).contains(&changes.pixels()), "{} of {least} to {most}", changes.pixels());
        let surface = changes.surface(&grey(), DVec3::ZERO, 2.0, 100_000);
        assert!(surface.len() > 500, "{}", surface.len());
        for at in &surface {
            // The hull of eight views from above ends in a point below.
            let outside = at.place.length() - 1.0;
            assert!(outside < 0.35 || at.place.z < 0.0, "{} is {outside} m outside", at.place);
            assert!(at.colour[0] > 120 && at.colour[1] < 80, "{:?}", at.colour);
        }
        let few = changes.surface(&grey(), DVec3::ZERO, 2.0, 100);
        assert!((50..=100).contains(&few.len()), "{}", few.len());
        // Far from the change, and where nothing has changed, nothing is.
        assert_eq!(changes.surface(&grey(), DVec3::new(0.0, 0.0, -30.0), 1.0, 100), []);
    }

    #[test]
    fn what_hides_a_place_was_not_seen_through() {
        let mut ball = grey();
        ball.push(&Splat::round(Vec3::ZERO, 0.0, Vec3::ONE, 0.99));
        let views = views(8);
        let source = Ball(views.clone());
        let around =
            EvaluationViews { views: &views, context: None, antialiased: false, exposures: None, source: &source };
        let changes = Changes::find(&around, &ball).unwrap();
        assert!(changes.pixels() > 100.0);
        // A white ball that is larger became a red one.
        assert!(changes.surface(&ball, DVec3::ZERO, 1.2, 1000).is_empty());
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
        assert_eq!(changes.surface(&grey(), DVec3::ZERO, 2.0, 100), []);
    }
}
