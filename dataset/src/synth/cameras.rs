//! Writes cameras and sparse points: the reported cameras for trainers, the true ones in `truth/`.

use std::collections::BTreeMap;
use std::path::Path;

use city::sense::Shot;
use scene::colmap::{self, ColmapCamera, ColmapImage, ColmapPoints, Reconstruction};
use scene::transforms::{self, Frame, Intrinsics, Transforms};
use scene::{Camera, CameraModel, GeoOrigin, Pinhole, SparsePoints};
use serde_json::json;
use store::file::{SaveError, save};

use super::output::create_folder;

/// Geographic origin of the city (x east, y north): open sea at the equator and the prime meridian, so that it is not mistaken
/// for a real place.
pub(super) const ORIGIN: GeoOrigin = GeoOrigin { latitude_degrees: 0.0, longitude_degrees: 0.0, altitude_metres: 0.0 };

/// Writes `sparse/0`, `transforms.json` with its point cloud, `reference_lla.json`, and `truth/` with the true cameras and the
/// shots.
pub(super) fn write(out: &Path, shots: &[Shot], points: &SparsePoints, masks: bool) -> Result<(), SaveError> {
    let sparse = out.join("sparse/0");
    create_folder(&sparse)?;
    let model = reconstruction(shots, points);
    save(&sparse.join("cameras.bin"), &colmap::write_cameras_bin(&model))?;
    save(&sparse.join("points3D.bin"), &colmap::write_points_bin(&model))?;
    save(&sparse.join("images.bin"), &colmap::write_images_bin(&model))?;

    save(&out.join("sparse_pc.ply"), &cloud(points))?;
    let reported = frames(shots, masks, |shot| shot.reported);
    save(&out.join("transforms.json"), &transforms::write(&reported))?;
    let origin = json!({
        "latitude": ORIGIN.latitude_degrees,
        "longitude": ORIGIN.longitude_degrees,
        "altitude": ORIGIN.altitude_metres,
    });
    save(&out.join("reference_lla.json"), format!("{origin}\n").as_bytes())?;

    let truth = out.join("truth");
    create_folder(&truth)?;
    let true_frames = Transforms { ply_file_path: None, ..frames(shots, masks, |shot| shot.camera) };
    save(&truth.join("transforms.json"), &transforms::write(&true_frames))?;
    let line = |shot: &Shot| serde_json::to_string(shot).expect("plain data") + "\n";
    save(&truth.join("shots.jsonl"), shots.iter().map(line).collect::<String>().as_bytes())
}

fn frames(shots: &[Shot], masks: bool, camera: impl Fn(&Shot) -> Camera) -> Transforms {
    let frame = |shot: &Shot| {
        let Camera { pinhole: k, camera_from_world } = camera(shot);
        let model = CameraModel::Pinhole([k.fx, k.fy, k.cx, k.cy]);
        Frame {
            file_path: format!("images/{}.png", shot.name),
            mask_path: masks.then(|| format!("masks/{}.png", shot.name)),
            depth_file_path: None,
            intrinsics: Intrinsics::from_model(&model, Some((k.width, k.height))),
            camera_from_world,
        }
    };
    Transforms { frames: shots.iter().map(frame).collect(), ply_file_path: Some("sparse_pc.ply".into()) }
}

/// The COLMAP model. Ids start at 1; shots with equal intrinsics share a camera.
fn reconstruction(shots: &[Shot], points: &SparsePoints) -> Reconstruction {
    let mut lenses: Vec<Pinhole> = Vec::new();
    let images = shots.iter().zip(1..).map(|(shot, id)| {
        let lens = shot.reported.pinhole;
        let at = lenses.iter().position(|&other| other == lens).unwrap_or_else(|| {
            lenses.push(lens);
            lenses.len() - 1
        });
        let camera_from_world = shot.reported.camera_from_world;
        ColmapImage { id, name: format!("{}.png", shot.name), camera_id: at as u32 + 1, camera_from_world }
    });
    let images = images.collect();
    let camera = |k: Pinhole| {
        let model = CameraModel::Pinhole([k.fx, k.fy, k.cx, k.cy]);
        ColmapCamera { width: k.width, height: k.height, model }
    };
    let cameras: BTreeMap<u32, ColmapCamera> = (1..).zip(lenses.into_iter().map(camera)).collect();
    let points = ColmapPoints {
        ids: (1..=points.len() as u64).collect(),
        positions: points.positions.clone(),
        colours: points.colours.clone(),
        track_start: points.track_start.clone(),
        track_images: points.seen_by.iter().map(|view| view + 1).collect(),
    };
    Reconstruction { cameras, images, points }
}

/// The points as binary PLY.
fn cloud(points: &SparsePoints) -> Vec<u8> {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        points.len()
    )
    .into_bytes();
    for (position, colour) in points.positions.iter().zip(&points.colours) {
        position.as_vec3().to_array().iter().for_each(|c| bytes.extend(c.to_le_bytes()));
        bytes.extend(colour);
    }
    bytes
}
