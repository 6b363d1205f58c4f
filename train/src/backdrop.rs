//! The backdrop of a scene: splats behind all others, a dome for the sky and the distance, and a floor under the scene.
//!
//! Every ray ends at a splat of it, so near splats are not stretched to fill the distance. A ray that goes down ends at
//! the floor: behind a road that few sparse points cover, a splat of the dome would be a hundred times too far away, and
//! shift with every step of the camera.

use glam::{DMat3, DQuat, DVec3, Vec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use scene::{Splat, Splats};

use crate::source::{self, WindowSource};
use crate::view::TrainView;

/// Number of directions of the lattice, which are 6° apart.
const DIRECTIONS: usize = 1024;
/// Opacity of a splat.
const OPACITY: f32 = 0.95;
/// Thickness of a splat of the floor, in units of its width.
const FLOOR_THICKNESS: f64 = 0.1;
/// Sine of the angle at which the eye looks onto the floor, for the length of the splats there: the least.
const MIN_SLOPE: f64 = 0.05;

/// Where the backdrop is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Enclosure {
    /// Centre of the dome.
    pub centre: DVec3,
    /// Radius of the dome, metres; it encloses all cameras and points.
    pub radius_metres: f64,
    /// `None` for a dome all round.
    pub floor: Option<Floor>,
}

/// A plane under the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Floor {
    /// Its unit normal, upwards.
    pub up: DVec3,
    /// Its height along `up`, metres.
    pub height_metres: f64,
    /// A place above it. Splats of the floor look alike from here, so they are small below it and large far away.
    pub eye: DVec3,
}

impl Floor {
    /// Where a ray meets the floor from above.
    fn meets(&self, from: DVec3, direction: DVec3) -> Option<DVec3> {
        let (above, slope) = (from.dot(self.up) - self.height_metres, -direction.dot(self.up));
        (above > 0.0 && slope > 0.0).then(|| from + direction * (above / slope)).filter(|place| place.is_finite())
    }
}

impl Enclosure {
    /// Standard deviation of the splats of the dome, metres.
    pub fn size_metres(&self) -> f64 {
        self.radius_metres * (4.0 * std::f64::consts::PI / DIRECTIONS as f64).sqrt() * 0.6
    }

    /// Where a ray meets the floor inside the dome.
    fn on_floor(&self, from: DVec3, direction: DVec3) -> Option<DVec3> {
        let place = self.floor?.meets(from, direction)?;
        (place.distance(self.centre) < self.radius_metres).then_some(place)
    }

    /// The lattice direction that stands for what a ray sees: from the floor's eye to where the ray meets the floor, or
    /// that of the ray, as the dome is far away.
    fn direction(&self, from: DVec3, direction: DVec3) -> DVec3 {
        match (self.floor, self.on_floor(from, direction)) {
            (Some(floor), Some(place)) => (place - floor.eye).normalize_or(direction),
            _ => direction,
        }
    }

    /// The splat in a direction of the lattice.
    fn splat(&self, direction: DVec3, colour: Vec3) -> Splat {
        let size = self.size_metres();
        let Some((floor, place)) = self.floor.and_then(|floor| Some((floor, self.on_floor(floor.eye, direction)?)))
        else {
            let place = self.centre + direction * self.radius_metres;
            return Splat::round(place.as_vec3(), (size as f32).ln(), colour, OPACITY);
        };
        // As wide in the eye as a splat of the dome, so longer where the eye sees it at a flat angle.
        let width = size / self.radius_metres * place.distance(floor.eye);
        let length = width / (-direction.dot(floor.up)).max(MIN_SLOPE);
        let away = direction.reject_from_normalized(floor.up).normalize_or(floor.up.any_orthonormal_vector());
        let turn = DQuat::from_mat3(&DMat3::from_cols(away, floor.up.cross(away), floor.up)).as_quat();
        let axes = DVec3::new(length, width, FLOOR_THICKNESS * width).as_vec3();
        let mut splat = Splat::round(place.as_vec3(), 0.0, colour, OPACITY);
        splat.quat = [turn.w, turn.x, turn.y, turn.z];
        splat.log_scale = axes.to_array().map(f32::ln).into();
        splat
    }

    /// The backdrop, coloured by the mean of what the views show of it, as if nothing stood before it. What no view covers
    /// gets no splats.
    ///
    /// # Errors
    /// A view that cannot be read.
    pub fn splats(&self, views: &[TrainView], source: &dyn WindowSource, sh_degree: u8) -> Result<Splats, String> {
        let directions = lattice();
        let tree = ImmutableKdTree::<f64, 3>::new_from_slice(&directions).map_err(|_| "no lattice".to_string())?;
        let mut sums = vec![[0.0f64; 4]; DIRECTIONS];
        let coarsest = views.iter().filter_map(|view| Some((view.view, (0..=8).rev().find_map(|c| view.at(c))?)));
        let windows = coarsest.clone().map(|(view, (mip, rect, _))| (view, mip, rect));
        for ((_, (_, _, camera)), photo) in coarsest.zip(source::each(source, windows)) {
            let photo = photo?;
            let area = photo.area();
            let (from, world_from_camera) = (camera.centre(), camera.camera_from_world.rotation.inverse());
            for (i, y, x) in (0..area).map(|i| (i, i / photo.width as usize, i % photo.width as usize)) {
                if photo.mask.as_ref().is_some_and(|mask| mask[i] < 128) {
                    continue;
                }
                let k = &camera.pinhole;
                let ray = DVec3::new((x as f64 + 0.5 - k.cx) / k.fx, (y as f64 + 0.5 - k.cy) / k.fy, 1.0);
                let direction = self.direction(from, (world_from_camera * ray).normalize());
                let near = tree.query(&direction.to_array()).nearest_one::<SquaredEuclidean<f64>>().execute();
                let sum = &mut sums[near.item as usize];
                for c in 0..3 {
                    sum[c] += f64::from(photo.rgb[c * area + i]) / 255.0;
                }
                sum[3] += 1.0;
            }
        }
        let total = sums.iter().fold([0.0; 4], |mut t, s| {
            t.iter_mut().zip(s).for_each(|(t, s)| *t += s);
            t
        });
        // Neighbours on the lattice are 3.5 / sqrt(n) apart. Directions without a visible one within 1.5 times that get no
        // splat.
        let min_cosine = (1.5 * 3.5 / (DIRECTIONS as f64).sqrt()).cos();
        let cosine = |a: &[f64; 3], b: &[f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let visible: Vec<&[f64; 3]> =
            directions.iter().zip(&sums).filter(|(_, sum)| sum[3] > 0.0).map(|(d, _)| d).collect();
        let is_near_visible = |direction: &[f64; 3]| visible.iter().any(|other| cosine(direction, other) > min_cosine);
        let mut splats = Splats::new(sh_degree);
        for (direction, sum) in directions.iter().zip(&sums).filter(|(direction, _)| is_near_visible(direction)) {
            // Directions at the rim take the mean colour of all views.
            let sum = if sum[3] > 0.0 { sum } else { &total };
            let colour = Vec3::from_array([0, 1, 2].map(|c| (sum[c] / sum[3].max(1.0)) as f32));
            splats.push(&self.splat(DVec3::from_array(*direction), colour));
        }
        Ok(splats)
    }
}

/// Unit vectors on a Fibonacci lattice: steps of the golden angle in azimuth, equal steps in height.
fn lattice() -> Vec<[f64; 3]> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..DIRECTIONS)
        .map(|i| {
            let z = 1.0 - (2.0 * i as f64 + 1.0) / DIRECTIONS as f64;
            let (sin, cos) = (golden * i as f64).sin_cos();
            let ring = (1.0 - z * z).sqrt();
            [ring * cos, ring * sin, z]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use scene::{Camera, Pinhole, Pixels, Rect, Rigid};

    use super::*;

    const SIDE: u32 = 32;

    /// Photos with a blue upper half and a brown lower half.
    struct Plain;

    impl WindowSource for Plain {
        fn window(&self, _: u32, _: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
            let area = (rect.width * rect.height) as usize;
            let plane = |up: u8, down: u8| (0..area).map(move |i| if i < area / 2 { up } else { down });
            let rgb = plane(0, 100).chain(plane(50, 50)).chain(plane(250, 0)).collect();
            Ok(Arc::new(Pixels { width: rect.width, height: rect.height, rgb, mask: None, weights: None, depth: None }))
        }
    }

    /// Four level views from 2 m above the plane z = 0, to all sides, each 90° wide and high.
    fn views() -> Vec<TrainView> {
        let half = f64::from(SIDE) / 2.0;
        let pinhole = Pinhole { width: SIDE, height: SIDE, fx: half, fy: half, cx: half, cy: half };
        let centre = DVec3::new(1.0, -3.0, 2.0);
        (0..4)
            .map(|view| {
                let (sin, cos) = (f64::from(view) * std::f64::consts::FRAC_PI_2).sin_cos();
                // Camera axes in the world: right, down, forward.
                let axes = DMat3::from_cols(DVec3::new(sin, -cos, 0.0), -DVec3::Z, DVec3::new(cos, sin, 0.0));
                let rotation = DQuat::from_mat3(&axes.transpose());
                let camera_from_world = Rigid { rotation, translation: -(rotation * centre) };
                let rect = Rect { x: 0, y: 0, width: SIDE, height: SIDE };
                TrainView { view, mip: 0, rect, camera: Camera { pinhole, camera_from_world } }
            })
            .collect()
    }

    fn enclosure(floor: bool) -> Enclosure {
        let eye = DVec3::new(0.0, 0.0, 25.0);
        let floor = floor.then_some(Floor { up: DVec3::Z, height_metres: 0.0, eye });
        Enclosure { centre: DVec3::new(0.0, 0.0, 2.0), radius_metres: 200.0, floor }
    }

    /// Whether a splat has one of the two colours of the photos, not their mean.
    fn is_pure(splat: &Splat) -> bool {
        (splat.sh[0][0] - splat.sh[0][2]).abs() > 1.3
    }

    #[test]
    fn what_views_see_below_the_horizon_lies_on_the_floor() {
        let splats = enclosure(true).splats(&views(), &Plain, 0).unwrap();
        let on_floor = |i: usize| splats.mean(i).z.abs() < 1e-3;
        let floor: Vec<usize> = (0..splats.len()).filter(|&i| on_floor(i)).collect();
        assert!(floor.len() > 150 && splats.len() - floor.len() > 150, "{} of {}", floor.len(), splats.len());
        // The few rays to the floor leave many of its splats with the mean colour, but none with that of the sky.
        let [brown, blue] = [-1.0f32, 1.0].map(|sign| {
            floor
                .iter()
                .filter(|&&i| sign * (splats.get(i).sh[0][2] - splats.get(i).sh[0][0]) > 0.0 && is_pure(&splats.get(i)))
                .count()
        });
        assert!(brown * 3 > floor.len() && blue * 20 < floor.len(), "{brown} and {blue} of {}", floor.len());
        for i in 0..splats.len() {
            let splat = splats.get(i);
            let from_centre = splat.mean.as_dvec3() - enclosure(true).centre;
            let [w, x, y, z] = splat.quat;
            let thin = glam::Quat::from_xyzw(x, y, z, w) * Vec3::Z;
            match on_floor(i) {
                true => {
                    assert!(from_centre.length() < 200.0 && thin.z.abs() > 0.9999, "{splat:?}");
                    let [length, width, thickness] = splat.log_scale.to_array().map(f32::exp);
                    assert!(length >= width && (thickness / width - 0.1).abs() < 1e-4, "{splat:?}");
                }
                // The dome may lie a little below the horizon, where the floor is farther than the dome.
                false => assert!((from_centre.length() - 200.0).abs() < 1e-2 && splat.mean.z > -30.0, "{splat:?}"),
            }
        }
    }

    #[test]
    fn without_a_floor_all_is_dome() {
        let dome = enclosure(false);
        let splats = dome.splats(&views(), &Plain, 0).unwrap();
        assert!(splats.len() > 600, "{}", splats.len());
        for i in 0..splats.len() {
            let splat = splats.get(i);
            assert!((splat.mean.as_dvec3().distance(dome.centre) - 200.0).abs() < 1e-2, "{splat:?}");
            assert!((f64::from(splat.log_scale.x.exp()) / dome.size_metres() - 1.0).abs() < 1e-5, "{splat:?}");
        }
    }

    #[test]
    fn views_under_the_floor_see_only_the_dome() {
        let mut sunken = enclosure(true);
        sunken.floor = sunken.floor.map(|floor| Floor { height_metres: 5.0, ..floor });
        let splats = sunken.splats(&views(), &Plain, 0).unwrap();
        assert!((0..splats.len()).all(|i| splats.is_finite(i)) && splats.len() > 600);
    }
}
