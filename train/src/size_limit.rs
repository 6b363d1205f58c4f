//! No splat is large for the camera that is nearest to it.
//!
//! A splat of half the camera's distance covers a photo, and the affine projection of EWA splatting is far off for it.
//! Few photos see it so, hence training tolerates it; every other camera near it looks into a haze. Viewers leave out
//! splats whose centre lies outside the picture, so there it makes holes: in CesiumJS and Babylon.js from 1.2 times the
//! picture's half width, in Spark from 1.4 times.

use glam::{DVec3, Vec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;
use scene::{Splats, column};

use crate::view::TrainView;

/// Largest standard deviation of a splat, as a share of its distance from the nearest camera.
const SIGMA_PER_DISTANCE: f64 = 0.25;
/// A camera may be within a splat, whose size must not vanish: no distance counts as less, metres.
const LEAST_DISTANCE: f64 = 0.1;

/// The cameras of the views that a job trains on.
pub(crate) struct SizeLimit {
    cameras: Option<ImmutableKdTree<f64, 3>>,
}

impl SizeLimit {
    pub(crate) fn of(views: &[TrainView]) -> Self {
        let mut places: Vec<[f64; 3]> = views.iter().map(|view| view.camera.centre().to_array()).collect();
        // Windows of one photo share its place, and a tree with many equal places cannot be divided.
        places.retain(|place| place.iter().all(|axis| axis.is_finite()));
        places.sort_by(|a, b| a.iter().map(|x| x.to_bits()).cmp(b.iter().map(|x| x.to_bits())));
        places.dedup();
        Self { cameras: ImmutableKdTree::new_from_slice(&places).ok() }
    }

    /// Largest standard deviation of a splat at `mean`, metres.
    fn metres(cameras: &ImmutableKdTree<f64, 3>, mean: Vec3) -> f64 {
        let one = std::num::NonZero::<usize>::MIN;
        let nearest = cameras.query(&DVec3::from(mean).to_array()).nearest_n::<SquaredEuclidean<f64>>(one).execute();
        let distance = nearest.first().map_or(f64::INFINITY, |camera| camera.distance.sqrt());
        SIGMA_PER_DISTANCE * distance.max(LEAST_DISTANCE)
    }

    /// Shrinks the axes that are longer.
    pub(crate) fn clip(&self, splats: &mut Splats) {
        let Some(cameras) = &self.cameras else { return };
        let rows = (0..splats.len()).into_par_iter();
        let limits: Vec<f32> = rows.map(|i| Self::metres(cameras, splats.mean(i)).ln() as f32).collect();
        for column in &mut splats.columns_mut()[column::LOG_SCALE..column::LOG_SCALE + 3] {
            column.iter_mut().zip(&limits).for_each(|(size, limit)| *size = size.min(*limit));
        }
    }
}

#[cfg(test)]
mod tests {
    use scene::{Camera, Pinhole, Rect, Rigid, Splat};

    use super::*;

    /// A window of a photo from this place.
    fn view(place: DVec3) -> TrainView {
        let pinhole = Pinhole { width: 64, height: 48, fx: 40.0, fy: 40.0, cx: 32.0, cy: 24.0 };
        let camera = Camera { pinhole, camera_from_world: Rigid { translation: -place, ..Rigid::IDENTITY } };
        TrainView {
            view: 0,
            mip: 0,
            rect: Rect { x: 0, y: 0, width: 64, height: 48 },
            camera,
            camera_from_context: None,
        }
    }

    #[test]
    fn splats_shrink_to_a_quarter_of_the_distance_of_the_nearest_camera() {
        let limit = SizeLimit::of(&[view(DVec3::ZERO), view(DVec3::ZERO), view(DVec3::X * 100.0)]);
        let mut splats = Splats::new(0);
        for (x, size) in [(4.0, 2.0f32), (4.0, 0.5), (90.0, 9.0), (0.0, 1.0)] {
            splats.push(&Splat::round(Vec3::X * x, size.ln(), Vec3::splat(0.5), 0.5));
        }
        let long = Splat { log_scale: Vec3::new(5.0, 0.2, 0.3).map(f32::ln), ..splats.get(0) };
        splats.push(&long);
        limit.clip(&mut splats);
        let sizes: Vec<Vec3> = (0..splats.len()).map(|i| splats.get(i).log_scale.exp()).collect();
        let round = [1.0, 0.5, 2.5, 0.025].map(Vec3::splat);
        for (size, expected) in sizes.iter().zip(round.into_iter().chain([Vec3::new(1.0, 0.2, 0.3)])) {
            assert!((size / expected - 1.0).abs().max_element() < 1e-5, "{size} for {expected}");
        }
    }

    #[test]
    fn without_a_view_no_splat_shrinks() {
        let mut splats = Splats::new(0);
        splats.push(&Splat::round(Vec3::ZERO, 3.0, Vec3::splat(0.5), 0.5));
        let before = splats.clone();
        SizeLimit::of(&[]).clip(&mut splats);
        assert_eq!(splats, before);
    }

    #[test]
    fn many_views_from_one_place_are_one_camera() {
        let limit = SizeLimit::of(&vec![view(DVec3::Y); 5000]);
        let mut splats = Splats::new(0);
        splats.push(&Splat::round(Vec3::Y * 9.0, 3.0, Vec3::splat(0.5), 0.5));
        limit.clip(&mut splats);
        assert!((splats.get(0).log_scale.x.exp() - 2.0).abs() < 1e-5);
    }
}
