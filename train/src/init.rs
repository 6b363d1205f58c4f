//! Initialises splats from sparse points, and a backdrop sphere for the sky and the distance.

use glam::{DVec3, Vec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use scene::{SparsePoints, Splat, Splats};

use crate::morton;
use crate::source::{self, WindowSource};
use crate::view::TrainView;

/// Number of neighbours whose mean distance is a splat's size, as in 3DGS.
const NEIGHBOURS: usize = 3;

/// Isotropic splats at `points` with opacity `opacity`, sizes clamped to `bounds` (metres).
pub fn from_points(points: &SparsePoints, sh_degree: u8, opacity: f32, bounds: [f32; 2]) -> Splats {
    let mut splats = Splats::new(sh_degree);
    if points.is_empty() {
        return splats;
    }
    let positions: Vec<[f64; 3]> = points.positions.iter().map(|p| p.to_array()).collect();
    let Ok(tree) = ImmutableKdTree::<f64, 3>::new_from_slice(&positions) else { return splats };
    let count = std::num::NonZero::new(NEIGHBOURS + 1).expect("four is not zero");
    for (position, colour) in positions.iter().zip(&points.colours) {
        let near = tree.query(position).nearest_n::<SquaredEuclidean<f64>>(count).execute();
        // The nearest neighbour is the point itself.
        let gaps: Vec<f64> = near.iter().skip(1).map(|n| n.distance.sqrt()).collect();
        let gap = gaps.iter().sum::<f64>() / gaps.len().max(1) as f64;
        let size = (gap as f32).clamp(bounds[0], bounds[1]);
        let colour = Vec3::from_array(colour.map(|c| f32::from(c) / 255.0));
        let mean = glam::DVec3::from_array(*position).as_vec3();
        splats.push(&Splat::round(mean, size.ln(), colour, opacity));
    }
    splats
}

/// Indices of at count `count` points, ascending, evenly spaced along a Morton curve, so that relative density is kept.
pub fn subsample(points: &[DVec3], count: usize) -> Vec<usize> {
    let n = points.len();
    if n <= count {
        return (0..n).collect();
    }
    let axis = |k: usize| -> Vec<f32> { points.iter().map(|p| p[k] as f32).collect() };
    let [x, y, z] = [0, 1, 2].map(axis);
    let order = morton::order([&x, &y, &z]);
    let mut rows: Vec<usize> = (0..count).map(|i| order[i * n / count] as usize).collect();
    rows.sort_unstable();
    rows
}

/// Number of splats of a backdrop, which are 6° apart.
const BACKDROP: usize = 1024;

/// Standard deviation of the splats of a backdrop of this radius, metres.
pub fn backdrop_size_metres(radius_metres: f64) -> f64 {
    radius_metres * (4.0 * std::f64::consts::PI / BACKDROP as f64).sqrt() * 0.6
}

/// A sphere of opaque splats around the scene, coloured by the mean of what the views show in each direction: the sky
/// and everything without sparse points. Every ray then ends at a splat, so near splats are not stretched to fill the
/// distance. The sphere of `centre` and `radius_metres` must enclose all cameras and points. Directions that no view
/// covers get no splats.
///
/// # Errors
/// A view that cannot be read.
pub fn backdrop(
    views: &[TrainView],
    source: &dyn WindowSource,
    sh_degree: u8,
    centre: DVec3,
    radius_metres: f64,
) -> Result<Splats, String> {
    // Fibonacci lattice: steps of the golden angle in azimuth, equal steps in height.
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let directions: Vec<[f64; 3]> = (0..BACKDROP)
        .map(|i| {
            let z = 1.0 - (2.0 * i as f64 + 1.0) / BACKDROP as f64;
            let (sin, cos) = (golden * i as f64).sin_cos();
            let ring = (1.0 - z * z).sqrt();
            [ring * cos, ring * sin, z]
        })
        .collect();
    let tree = ImmutableKdTree::<f64, 3>::new_from_slice(&directions).map_err(|_| "no backdrop lattice".to_string())?;
    let mut sums = vec![[0.0f64; 4]; BACKDROP];
    let coarsest = views.iter().filter_map(|view| Some((view.view, (0..=8).rev().find_map(|c| view.at(c))?)));
    let windows = coarsest.clone().map(|(view, (mip, rect, _))| (view, mip, rect));
    for ((_, (_, _, camera)), photo) in coarsest.zip(source::each(source, windows)) {
        let photo = photo?;
        let area = photo.area();
        let world_from_camera = camera.camera_from_world.rotation.inverse();
        for (i, y, x) in (0..area).map(|i| (i, i / photo.width as usize, i % photo.width as usize)) {
            if photo.mask.as_ref().is_some_and(|mask| mask[i] < 128) {
                continue;
            }
            let k = &camera.pinhole;
            let ray = DVec3::new((x as f64 + 0.5 - k.cx) / k.fx, (y as f64 + 0.5 - k.cy) / k.fy, 1.0);
            let direction = (world_from_camera * ray).normalize();
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
    let min_cosine = (1.5 * 3.5 / (BACKDROP as f64).sqrt()).cos();
    let cosine = |a: &[f64; 3], b: &[f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let visible: Vec<&[f64; 3]> =
        directions.iter().zip(&sums).filter(|(_, sum)| sum[3] > 0.0).map(|(d, _)| d).collect();
    let is_near_visible = |direction: &[f64; 3]| visible.iter().any(|other| cosine(direction, other) > min_cosine);
    let size = backdrop_size_metres(radius_metres);
    let mut splats = Splats::new(sh_degree);
    for (direction, sum) in directions.iter().zip(&sums).filter(|(direction, _)| is_near_visible(direction)) {
        // Directions at the rim take the mean colour of all views.
        let sum = if sum[3] > 0.0 { sum } else { &total };
        let colour = Vec3::from_array([0, 1, 2].map(|c| (sum[c] / sum[3].max(1.0)) as f32));
        let mean = centre + DVec3::from_array(*direction) * radius_metres;
        splats.push(&Splat::round(mean.as_vec3(), (size as f32).ln(), colour, 0.95));
    }
    Ok(splats)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn subsampling_keeps_the_density() {
        // Three quarters of the points stand at x = 0 .. 1, one quarter at 100 .. 101.
        let at = |i: usize| {
            DVec3::new(if i.is_multiple_of(4) { 100.0 } else { 0.0 }, 0.0, 0.0) + DVec3::splat(i as f64 / 4e3)
        };
        let points: Vec<DVec3> = (0..4000).map(at).collect();
        let rows = subsample(&points, 400);
        assert!(rows.len() == 400 && rows.windows(2).all(|w| w[0] < w[1]));
        let far = rows.iter().filter(|&&i| points[i].x > 50.0).count();
        assert!((99..=101).contains(&far), "{far}");
        assert_eq!(subsample(&points, 5000).len(), 4000);
        assert_eq!(subsample(&[], 3), Vec::<usize>::new());
    }
}
