//! The bounding box of a block's content and its projection into a view.

use glam::{DVec2, DVec3};
use scene::{BlockId, Camera, Capture};

use crate::ground::{Ground, quantile};

/// The bounding box of a block's core and of the heights of its sparse points.
pub(crate) struct BlockBox {
    /// World metres. Bit 0 of the index selects x, bit 1 y, bit 2 z (ground axes).
    corners: [DVec3; 8],
}

impl BlockBox {
    /// The box over the core and the height range of these points. A core at the scene's rim is extended to its points,
    /// because its ownership is unbounded there.
    pub(crate) fn new(capture: &Capture, ground: &Ground, block: BlockId, points: impl Iterator<Item = u32>) -> Self {
        let mut indices: Vec<u32> = points.collect();
        indices.sort_unstable();
        indices.dedup();
        let places: Vec<DVec3> =
            indices.iter().map(|&i| ground.from_world(capture.points.positions[i as usize])).collect();
        let axis = |k: usize| places.iter().map(|p| p[k]).collect::<Vec<f64>>();
        let (mut x, mut y, mut z) = (axis(0), axis(1), axis(2));
        let (core, halo) = (ground.core(block), ground.halo(block));
        let reach = |values: &mut [f64], k: usize| {
            let low = if halo.min[k].is_finite() { core.min[k] } else { core.min[k].min(quantile(values, 0.01)) };
            let high = if halo.max[k].is_finite() { core.max[k] } else { core.max[k].max(quantile(values, 0.99)) };
            [low, high]
        };
        let (x, y) = (reach(&mut x, 0), reach(&mut y, 1));
        let (low, high) = (quantile(&mut z, 0.01), quantile(&mut z, 0.99));
        let pad = 0.1 * (high - low) + 0.02 * ground.core_edge_metres(block.level);
        let z = [low - pad, high + pad];
        let corner = |i: usize| ground.to_world(DVec3::new(x[i & 1], y[i >> 1 & 1], z[i >> 2]));
        Self { corners: [0, 1, 2, 3, 4, 5, 6, 7].map(corner) }
    }

    /// Lower and upper bounds of the box in the image, pixels of mip 0; `None` when it lies outside.
    ///
    /// Each face is clipped to the camera's frustum before projection (Sutherland & Hodgman 1974). The bounds are
    /// therefore tight for a box that crosses the image border, and valid for a camera inside the box.
    pub(crate) fn project(&self, camera: &Camera, near_metres: f64) -> Option<(DVec2, DVec2)> {
        let k = &camera.pinhole;
        let (width, height) = (f64::from(k.width), f64::from(k.height));
        // A point is inside where `normal · point >= offset`.
        let frustum = [
            (DVec3::Z, near_metres),
            (DVec3::new(k.fx, 0.0, k.cx), 0.0),
            (DVec3::new(-k.fx, 0.0, width - k.cx), 0.0),
            (DVec3::new(0.0, k.fy, k.cy), 0.0),
            (DVec3::new(0.0, -k.fy, height - k.cy), 0.0),
        ];
        let corners = self.corners.map(|c| camera.camera_from_world.apply(c));
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for face in FACES {
            let mut polygon: Vec<DVec3> = face.map(|i| corners[i]).to_vec();
            for (normal, offset) in frustum {
                polygon = clip(&polygon, normal, offset);
            }
            for p in polygon {
                let pixel = DVec2::new(k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy);
                (low, high) = (low.min(pixel), high.max(pixel));
            }
        }
        (low.is_finite() && high.is_finite() && near_metres > 0.0).then_some((low, high))
    }
}

/// Corner indices of the six faces, each in cyclic order.
const FACES: [[usize; 4]; 6] = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];

/// The part of a convex polygon where `normal · point >= offset`.
fn clip(polygon: &[DVec3], normal: DVec3, offset: f64) -> Vec<DVec3> {
    let mut kept = Vec::with_capacity(polygon.len() + 1);
    for (i, &a) in polygon.iter().enumerate() {
        let b = polygon[(i + 1) % polygon.len()];
        let (from, to) = (normal.dot(a) - offset, normal.dot(b) - offset);
        if from >= 0.0 {
            kept.push(a);
        }
        if (from >= 0.0) != (to >= 0.0) {
            kept.push(a.lerp(b, from / (from - to)));
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::look_at;

    #[test]
    fn the_box_is_clipped_to_the_frustum() {
        let corners = [0, 1, 2, 3, 4, 5, 6, 7usize]
            .map(|i| DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64) * 2.0 - 1.0);
        let block_box = BlockBox { corners };
        let size = DVec2::new(640.0, 480.0);
        let close = |a: (DVec2, DVec2), low: DVec2, high: DVec2| {
            assert!((a.0 - low).length() < 1e-6 && (a.1 - high).length() < 1e-6, "{a:?}");
        };
        // A camera inside the box or on its face sees it in the whole image.
        for eye in [DVec3::ZERO, DVec3::new(-1.0, 0.0, 0.0)] {
            close(block_box.project(&look_at(eye, DVec3::X * 9.0, DVec3::Z), 0.01).unwrap(), DVec2::ZERO, size);
        }
        // From outside: the near face, 2 m wide at 9 m.
        let half = 500.0 / 9.0;
        let afar = block_box.project(&look_at(DVec3::X * -10.0, DVec3::ZERO, DVec3::Z), 0.01).unwrap();
        close(afar, size * 0.5 - half, size * 0.5 + half);
        // A box behind the camera is not visible.
        assert!(block_box.project(&look_at(DVec3::X * -10.0, DVec3::X * -20.0, DVec3::Z), 0.01).is_none());
    }
}
