//! The first splats: one for every sparse point, as large as the gap to its neighbours, and a backdrop behind them.

use glam::{DVec3, Vec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use scene::{SparsePoints, Splat, Splats};

use crate::{TrainView, WindowSource, morton};

/// Neighbours whose mean distance gives a splat its size, as in 3DGS.
const NEIGHBOURS: usize = 3;

/// Round splats at `points` with `opacity`; sizes stay within `bounds` (metres).
pub fn from_points(points: &SparsePoints, sh_degree: u8, opacity: f32, bounds: [f32; 2]) -> Splats {
    let mut splats = Splats::new(sh_degree);
    if points.is_empty() {
        return splats;
    }
    let positions: Vec<[f64; 3]> = points.positions.iter().map(|p| p.to_array()).collect();
    let Ok(tree) = ImmutableKdTree::<f64, 3>::new_from_slice(&positions) else { return splats };
    let wanted = std::num::NonZero::new(NEIGHBOURS + 1).expect("four is not zero");
    for (position, colour) in positions.iter().zip(&points.colours) {
        let near = tree.query(position).nearest_n::<SquaredEuclidean<f64>>(wanted).execute();
        // The nearest is the point itself.
        let gaps: Vec<f64> = near.iter().skip(1).map(|n| n.distance.sqrt()).collect();
        let gap = gaps.iter().sum::<f64>() / gaps.len().max(1) as f64;
        let size = (gap as f32).clamp(bounds[0], bounds[1]);
        let colour = Vec3::from_array(colour.map(|c| f32::from(c) / 255.0));
        let mean = glam::DVec3::from_array(*position).as_vec3();
        splats.push(&Splat::round(mean, size.ln(), colour, opacity));
    }
    splats
}

/// Rows of at most `most` of some places, in growing order: evenly along a Morton curve, so that dense places stay denser.
pub fn thinned(places: &[DVec3], most: usize) -> Vec<usize> {
    let n = places.len();
    if n <= most {
        return (0..n).collect();
    }
    let axis = |k: usize| -> Vec<f32> { places.iter().map(|p| p[k] as f32).collect() };
    let [x, y, z] = [0, 1, 2].map(axis);
    let order = morton::order([&x, &y, &z]);
    let mut rows: Vec<usize> = (0..most).map(|i| order[i * n / most] as usize).collect();
    rows.sort_unstable();
    rows
}

/// Splats of a backdrop; 6° apart.
const BACKDROP: usize = 1024;

/// Standard deviation of a backdrop's splats at this distance.
pub fn backdrop_size_metres(radius_metres: f64) -> f64 {
    radius_metres * (4.0 * std::f64::consts::PI / BACKDROP as f64).sqrt() * 0.6
}

/// A sphere of opaque splats around everything, wherever a view looks, coloured by what the views show in each direction: the sky, and whatever
/// else no point was found on. It gives every ray something to end in, so that near splats are not stretched to fill
/// the distance. `centre` and `radius_metres` should enclose cameras and points with room to spare.
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
    // A Fibonacci lattice: turn by the golden angle, equal steps in height.
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
    for ((_, (_, _, camera)), photo) in coarsest.zip(crate::source::each(source, windows)) {
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
    // Neighbours on the lattice are 3.5 / sqrt(n) apart; what nobody sees, nor anything beside it, needs no splat.
    let beside = (1.5 * 3.5 / (BACKDROP as f64).sqrt()).cos();
    let cosine = |a: &[f64; 3], b: &[f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let seen: Vec<&[f64; 3]> = directions.iter().zip(&sums).filter(|(_, sum)| sum[3] > 0.0).map(|(d, _)| d).collect();
    let shown = |direction: &[f64; 3]| seen.iter().any(|other| cosine(direction, other) > beside);
    let size = backdrop_size_metres(radius_metres);
    let mut splats = Splats::new(sh_degree);
    for (direction, sum) in directions.iter().zip(&sums).filter(|(direction, _)| shown(direction)) {
        // At the rim: what all views show on average.
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
    fn thinning_keeps_shares_of_places() {
        // Three quarters of the points stand at x = 0 .. 1, one quarter at 100 .. 101.
        let at = |i: usize| {
            DVec3::new(if i.is_multiple_of(4) { 100.0 } else { 0.0 }, 0.0, 0.0) + DVec3::splat(i as f64 / 4e3)
        };
        let places: Vec<DVec3> = (0..4000).map(at).collect();
        let rows = thinned(&places, 400);
        assert!(rows.len() == 400 && rows.windows(2).all(|w| w[0] < w[1]));
        let far = rows.iter().filter(|&&i| places[i].x > 50.0).count();
        assert!((99..=101).contains(&far), "{far}");
        assert_eq!(thinned(&places, 5000).len(), 4000);
        assert_eq!(thinned(&[], 3), Vec::<usize>::new());
    }
}
