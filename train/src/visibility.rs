//! Finds the windows that each splat is visible in, and the finest pixel that covers it.

use rayon::prelude::*;
use scene::{Splats, column};

use crate::view::TrainView;

/// Splats per parallel job: their means stay in the L1 cache while all windows are tested.
const CHUNK: usize = 1024;

/// The finest pixel at a splat's centre over all windows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FinestPixel {
    /// Area of the pixel at the splat's depth, m². Infinite where no window contains the splat's centre.
    pub area: f32,
    /// Share of that area beyond a pixel of mip 0: 1 - 4^-mip.
    pub coarse_share: f32,
}

impl FinestPixel {
    /// True if any window contains the splat's centre.
    pub fn is_visible(&self) -> bool {
        self.area < f32::INFINITY
    }
}

/// For every splat, the finest pixel over the windows, each enlarged by `margin` times its size on every side.
pub fn finest_pixels(splats: &Splats, views: &[TrainView], margin: f32) -> Vec<FinestPixel> {
    let windows: Vec<Window> = views.iter().map(|view| Window::of(view, margin)).collect();
    let columns = splats.columns();
    let mean = [column::MEAN, column::MEAN + 1, column::MEAN + 2].map(|c| columns[c].as_slice());
    let chunks = (0..splats.len().div_ceil(CHUNK)).into_par_iter();
    chunks
        .flat_map_iter(|chunk| {
            let rows = chunk * CHUNK..splats.len().min((chunk + 1) * CHUNK);
            let (mut area, mut coarse_share) = (vec![f32::INFINITY; rows.len()], vec![0.0; rows.len()]);
            for window in &windows {
                window.update(mean.map(|column| &column[rows.clone()]), &mut area, &mut coarse_share);
            }
            area.into_iter().zip(coarse_share).map(|(area, coarse_share)| FinestPixel { area, coarse_share })
        })
        .collect()
}

/// A window's camera in f32, prepared for the inside test.
struct Window {
    centre: [f32; 3],
    /// Rows are the camera's axes in world coordinates.
    rotation: [[f32; 3]; 3],
    focal: [f32; 2],
    /// Left and right, top and bottom edge, in pixels from the principal point.
    edges: [[f32; 2]; 2],
    coarse_share: f32,
}

impl Window {
    fn of(view: &TrainView, margin: f32) -> Self {
        let camera = view.camera.mip(view.mip).window(view.rect);
        let (k, rotation) = (&camera.pinhole, camera.rotation());
        let edges = |size: u32, centre: f64| {
            let more = margin * size as f32;
            [-more - centre as f32, size as f32 + more - centre as f32]
        };
        Self {
            centre: camera.centre().as_vec3().to_array(),
            rotation: [0, 1, 2].map(|row| rotation.row(row).as_vec3().to_array()),
            focal: [k.fx as f32, k.fy as f32],
            edges: [edges(k.width, k.cx), edges(k.height, k.cy)],
            coarse_share: 1.0 - 0.25f32.powi(i32::from(view.mip)),
        }
    }

    /// Updates the splats at which this window's pixel is the finest so far. Branch-free, so that the compiler
    /// vectorises it.
    fn update(&self, [x, y, z]: [&[f32]; 3], area: &mut [f32], coarse_share: &mut [f32]) {
        let [cx, cy, cz] = self.centre;
        let [right, down, forward] = self.rotation;
        let [[left_edge, right_edge], [top_edge, bottom_edge]] = self.edges;
        let per_depth = 1.0 / (self.focal[0] * self.focal[1]);
        for ((((&x, &y), &z), area), coarse_share) in x.iter().zip(y).zip(z).zip(area).zip(coarse_share) {
            let (x, y, z) = (x - cx, y - cy, z - cz);
            let along = |axis: [f32; 3]| axis[0] * x + axis[1] * y + axis[2] * z;
            let (u, v, depth) = (self.focal[0] * along(right), self.focal[1] * along(down), along(forward));
            let inside = (depth > 0.0)
                & (u >= left_edge * depth)
                & (u < right_edge * depth)
                & (v >= top_edge * depth)
                & (v < bottom_edge * depth);
            let here = depth * depth * per_depth;
            let finer = inside & (here < *area);
            *area = if finer { here } else { *area };
            *coarse_share = if finer { self.coarse_share } else { *coarse_share };
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3, Vec3};
    use scene::{Camera, Pinhole, Rect, Rigid, Splat};

    use super::*;

    #[test]
    fn visibility_agrees_with_camera_projection() {
        let pinhole = Pinhole { width: 200, height: 160, fx: 150.0, fy: 140.0, cx: 97.0, cy: 85.0 };
        let turned = |k: f64| Rigid {
            rotation: DQuat::from_euler(glam::EulerRot::XYZ, 0.3 * k, 1.1 * k, -0.2 * k),
            translation: DVec3::new(k, -2.0 * k, 3.0),
        };
        let views: Vec<TrainView> = (0..6)
            .map(|k| TrainView {
                view: k,
                mip: (k % 3) as u8,
                rect: Rect { x: 5, y: 3, width: 30, height: 31 },
                camera: Camera { pinhole, camera_from_world: turned(f64::from(k)) },
                camera_from_context: None,
            })
            .collect();
        let mut splats = Splats::new(0);
        for i in 0..3000 {
            let coordinate = |k: i32| ((i * (7919 + 613 * k)) % 2003) as f32 * 0.01 - 10.0;
            splats.push(&Splat::round(Vec3::new(coordinate(0), coordinate(1), coordinate(2)), 0.0, Vec3::ONE, 0.5));
        }
        for margin in [0.0, 0.2] {
            let found = finest_pixels(&splats, &views, margin);
            let (mut visible, mut near_an_edge) = (0, 0);
            for (i, found) in found.iter().enumerate() {
                let mut best = (f64::INFINITY, 0.0);
                let mut is_ambiguous = false;
                for view in &views {
                    let camera = view.camera.mip(view.mip).window(view.rect);
                    let (pixel, depth) = camera.project(splats.mean(i).as_dvec3());
                    let distance = |v: f64, size: u32| {
                        let more = f64::from(margin) * f64::from(size);
                        (v + more).min(f64::from(size) + more - v)
                    };
                    let inset = distance(pixel.x, view.rect.width).min(distance(pixel.y, view.rect.height));
                    is_ambiguous |= depth > 0.0 && inset.abs() < 1e-2;
                    let area = depth * depth / (camera.pinhole.fx * camera.pinhole.fy);
                    if depth > 0.0 && inset >= 0.0 && area < best.0 {
                        best = (area, 1.0 - 0.25f64.powi(i32::from(view.mip)));
                    }
                }
                if is_ambiguous {
                    near_an_edge += 1;
                    continue;
                }
                assert_eq!(found.is_visible(), best.0.is_finite(), "splat {i}");
                if found.is_visible() {
                    visible += 1;
                    assert!((f64::from(found.area) / best.0 - 1.0).abs() < 1e-3, "splat {i}");
                    assert!((f64::from(found.coarse_share) - best.1).abs() < 1e-6, "splat {i}");
                }
            }
            assert!(visible > 100 && visible < 2500 && near_an_edge < 20, "{visible} {near_an_edge}");
        }
    }
}
