//! Reprojection errors of real COLMAP keypoints, through the lens model, the undistortion and the pinhole.

use std::collections::BTreeMap;

use glam::DVec2;
use scene::colmap;

use super::{opened, shared};
use crate::undistortion;

#[test]
fn points_project_to_their_real_keypoints() {
    for name in ["fox/opencv_270", "fox/pinhole_270", "street_lund", "aerial_caliterra", "building_sceaux"] {
        let Some(path) = shared(name) else { return };
        let source = opened(&path).unwrap();
        let read = |file: &str| std::fs::read(path.join("sparse/0").join(file)).unwrap();
        let points = colmap::read_points_bin(&read("points3D.bin")).unwrap();
        let positions: BTreeMap<u64, _> = points.ids.iter().copied().zip(points.positions).collect();
        let images = colmap::read_images_bin(&read("images.bin")).unwrap();
        let keypoints = colmap::read_keypoints_bin(&read("images.bin")).unwrap();
        let mut errors = Vec::new();
        for image in images {
            let i = source.capture.views.iter().position(|view| view.name == image.name).unwrap();
            let (camera, model) = (source.capture.views[i].camera, source.photos[i].model);
            let ([fx, fy, cx, cy], k) = (model.focal_and_centre(), camera.pinhole);
            for &(keypoint, point) in &keypoints[&image.id] {
                let bent = DVec2::new((keypoint.x - cx) / fx, (keypoint.y - cy) / fy);
                let ideal = undistortion::undistort(&model, bent).unwrap();
                let (pixel, depth) = camera.project(positions[&point]);
                assert!(depth > 0.0);
                errors.push(pixel.distance(DVec2::new(k.fx * ideal.x + k.cx, k.fy * ideal.y + k.cy)));
            }
        }
        errors.sort_by(f64::total_cmp);
        let at = |share: f64| errors[(share * (errors.len() - 1) as f64) as usize];
        println!("{name}: {} keypoints, median {:.3} px, 95 % within {:.3} px", errors.len(), at(0.5), at(0.95));
        assert!(errors.len() > 1000 && at(0.5) < 1.0 && at(0.95) < 2.0, "{name}: {} {}", at(0.5), at(0.95));
    }
}
