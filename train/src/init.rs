//! The first splats: one for every sparse point, as large as the gap to its neighbours.

use glam::Vec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use scene::{SparsePoints, Splat, Splats};

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
