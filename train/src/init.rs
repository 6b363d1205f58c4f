//! Initialises splats from sparse points, and a backdrop sphere for the sky and the distance.

use glam::{DMat3, DQuat, DVec3, Vec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use scene::{SparsePoints, Splat, Splats, morton};

use crate::source::{self, WindowSource};
use crate::view::TrainView;

/// Number of neighbours whose mean distance sizes a splat, as in 3DGS.
const NEIGHBOURS: usize = 3;
/// Number of neighbours that show how the surface lies.
const SURFACE_NEIGHBOURS: usize = 10;
/// Standard deviation of a splat along the surface, in mean distances of its neighbours.
const WIDTH: f64 = 0.7;
/// Smallest thickness of a splat, in units of its width.
const MIN_THICKNESS: f64 = 0.2;
/// Neighbours whose middle extent is a smaller share of the longest lie on a line.
const MIN_MIDDLE: f64 = 0.02;

/// Splats at `points` with opacity `opacity`, axes clamped to `bounds` (metres). Each is a disk in the plane of its
/// neighbours, as thick as they deviate from it, so that it neither hangs in front of a wall nor shines through it.
pub fn from_points(points: &SparsePoints, sh_degree: u8, opacity: f32, bounds: [f32; 2]) -> Splats {
    let mut splats = Splats::new(sh_degree);
    if points.is_empty() {
        return splats;
    }
    let positions: Vec<[f64; 3]> = points.positions.iter().map(|p| p.to_array()).collect();
    let Ok(tree) = ImmutableKdTree::<f64, 3>::new_from_slice(&positions) else { return splats };
    let count = std::num::NonZero::new(SURFACE_NEIGHBOURS + 1).expect("eleven is not zero");
    for (position, colour) in points.positions.iter().zip(&points.colours) {
        let near = tree.query(&position.to_array()).nearest_n::<SquaredEuclidean<f64>>(count).execute();
        // The nearest neighbour is the point itself.
        let gaps: Vec<f64> = near.iter().skip(1).take(NEIGHBOURS).map(|n| n.distance.sqrt()).collect();
        let width = WIDTH * gaps.iter().sum::<f64>() / gaps.len().max(1) as f64;
        let places: Vec<DVec3> = near.iter().map(|n| points.positions[n.item as usize]).collect();
        let (normal, thickness) = surface(&places);
        let colour = Vec3::from_array(colour.map(|c| f32::from(c) / 255.0));
        let mut splat = Splat::round(position.as_vec3(), 0.0, colour, opacity);
        let turn = DQuat::from_rotation_arc(DVec3::Z, normal).as_quat();
        splat.quat = [turn.w, turn.x, turn.y, turn.z];
        let axes = DVec3::new(width, width, thickness * width).as_vec3();
        splat.log_scale = axes.clamp(Vec3::splat(bounds[0]), Vec3::splat(bounds[1])).to_array().map(f32::ln).into();
        splats.push(&splat);
    }
    splats
}

/// The unit normal of the plane through `places`, and how thick their layer is relative to the narrower of its other
/// two extents, from [`MIN_THICKNESS`] to 1. Places on a line, or all at one place, have no plane: they are 1 thick.
fn surface(places: &[DVec3]) -> (DVec3, f64) {
    let centre = places.iter().sum::<DVec3>() / places.len().max(1) as f64;
    let mut covariance = DMat3::ZERO;
    for place in places {
        let from_centre = *place - centre;
        covariance +=
            DMat3::from_cols(from_centre * from_centre.x, from_centre * from_centre.y, from_centre * from_centre.z);
    }
    let (squared, axes) = principal_axes(covariance);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| squared[a].total_cmp(&squared[b]));
    let [thin, middle, long] = order.map(|axis| squared[axis].max(0.0).sqrt());
    let is_plane = middle > MIN_MIDDLE * long;
    let thickness = if is_plane { (thin / middle).clamp(MIN_THICKNESS, 1.0) } else { 1.0 };
    (axes.col(order[0]).normalize(), thickness)
}

/// Eigenvalues of a symmetric matrix and its eigenvectors as columns: Jacobi's method, whose few sweeps take the same
/// steps for the same matrix everywhere.
fn principal_axes(matrix: DMat3) -> ([f64; 3], DMat3) {
    const SWEEPS: usize = 8;
    let (mut diagonal, mut axes) = (matrix, DMat3::IDENTITY);
    for (p, q) in [(0, 1), (0, 2), (1, 2)].repeat(SWEEPS) {
        let off = diagonal.col(q)[p];
        if off == 0.0 {
            continue;
        }
        // The turn in the plane of p and q that makes the element between them vanish.
        let ratio = (diagonal.col(q)[q] - diagonal.col(p)[p]) / (2.0 * off);
        let tangent = 1f64.copysign(ratio) / (ratio.abs() + ratio.hypot(1.0));
        let cosine = 1.0 / tangent.hypot(1.0);
        let sine = tangent * cosine;
        let mut turn = DMat3::IDENTITY;
        turn.col_mut(p)[p] = cosine;
        turn.col_mut(q)[q] = cosine;
        turn.col_mut(q)[p] = sine;
        turn.col_mut(p)[q] = -sine;
        diagonal = turn.transpose() * diagonal * turn;
        axes *= turn;
    }
    ([0, 1, 2].map(|axis| diagonal.col(axis)[axis]), axes)
}

/// Indices of at most `count` points, ascending, evenly spaced along a Morton curve, so that relative density is kept.
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

    /// 12 × 12 points 0.5 m apart on a wall that faces `normal`, each up to `noise` metres off it.
    fn wall(normal: DVec3, noise: f64) -> SparsePoints {
        let (across, up) = normal.any_orthonormal_pair();
        let off = |i: usize| noise * (i as f64 * 2.399).sin();
        let at = |i: usize| across * (i % 12) as f64 * 0.5 + up * (i / 12) as f64 * 0.5 + normal * off(i);
        SparsePoints {
            positions: (0..144).map(at).collect(),
            colours: vec![[200, 100, 50]; 144],
            ..SparsePoints::default()
        }
    }

    #[test]
    fn splats_lie_in_the_surface_of_their_points() {
        let normal = DVec3::new(1.0, 2.0, -0.5).normalize();
        for (noise, thickness) in [(0.0, 0.199..0.201), (0.3, 0.25..1.001)] {
            let splats = from_points(&wall(normal, noise), 0, 0.3, [1e-3, 10.0]);
            for i in (0..144).filter(|i| (2..10).contains(&(i % 12)) && (2..10).contains(&(i / 12))) {
                let splat = splats.get(i);
                let [w, x, y, z] = splat.quat.map(f64::from);
                let thin = DQuat::from_xyzw(x, y, z, w) * DVec3::Z;
                let [a, b, c] = splat.log_scale.to_array().map(|axis| f64::from(axis.exp()));
                assert!(noise > 0.0 || (thin.dot(normal).abs() > 0.9999 && (a - 0.35).abs() < 1e-4), "{thin} {a}");
                assert!(a == b && thickness.contains(&(c / a)), "{c} of {a}");
            }
        }
    }

    #[test]
    fn points_without_a_plane_become_round_splats() {
        let line = |n: usize| SparsePoints {
            positions: (0..n).map(|i| DVec3::new(i as f64, 2.0 * i as f64, 0.0)).collect(),
            colours: vec![[0; 3]; n],
            ..SparsePoints::default()
        };
        for n in [1, 2, 3, 20] {
            let splats = from_points(&line(n), 0, 0.3, [1e-3, 10.0]);
            assert!((0..n).all(|i| splats.get(i).log_scale == Vec3::splat(splats.get(i).log_scale[0])), "{n}");
        }
        let bounded = from_points(&line(20), 0, 0.3, [2.5, 3.0]);
        assert!((3..17).all(|i| (bounded.get(i).log_scale[0].exp() - 2.5).abs() < 1e-5));
    }

    #[test]
    fn principal_axes_rebuild_the_matrix() {
        let turn = DMat3::from_quat(DQuat::from_xyzw(0.3, -0.2, 0.5, 0.7).normalize());
        for values in [[1.0, 4.0, 9.0], [2.0, 2.0, 5.0], [0.0, 0.0, 3.0], [7.0, 7.0, 7.0]] {
            let matrix = turn * DMat3::from_diagonal(DVec3::from_array(values)) * turn.transpose();
            let (found, axes) = principal_axes(matrix);
            let rebuilt = axes * DMat3::from_diagonal(DVec3::from_array(found)) * axes.transpose();
            assert!(rebuilt.abs_diff_eq(matrix, 1e-12), "{rebuilt} {matrix}");
            let mut sorted = found;
            sorted.sort_by(f64::total_cmp);
            assert!(sorted.iter().zip(values).all(|(a, b)| (a - b).abs() < 1e-12), "{sorted:?}");
        }
    }

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
