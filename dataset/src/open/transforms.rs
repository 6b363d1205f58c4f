//! Parses a `transforms.json` of nerfstudio or instant-ngp, or the `transforms_{train,val,test}.json` of captures in splits.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use scene::{BadInput, SparsePoints, ply, transforms};

use super::colmap;
use super::files::{self, CaptureRoot, Found};
use super::parsed::{OpenOptions, ParsedCapture, PosedImage, RawPoints};

/// Point clouds that tools write beside the file.
const CLOUDS: [&str; 2] = ["sparse_pc.ply", "points3D.ply"];

/// The splits of a capture. They are merged: plat holds out test views by its own rule.
const SPLITS: [&str; 3] = ["transforms_train.json", "transforms_val.json", "transforms_test.json"];

/// The files of a capture: `transforms.json`, or its splits if there is one for training. Empty if there are neither.
pub(super) fn find(root: &CaptureRoot) -> Vec<PathBuf> {
    match root.file("transforms.json") {
        Some(path) => vec![path],
        None if root.file(SPLITS[0]).is_some() => SPLITS.iter().filter_map(|name| root.file(name)).collect(),
        None => Vec::new(),
    }
}

/// Parses the files and their point cloud. A frame in several files is taken from the first.
pub(super) fn read(root: &CaptureRoot, paths: &[PathBuf]) -> Result<ParsedCapture, BadInput> {
    let advice = "correct the file or export it again";
    let (mut images, mut names, mut cloud) = (Vec::new(), BTreeSet::new(), None);
    for path in paths {
        let file = transforms::read(&files::read(path)?)
            .map_err(|e| BadInput::new(files::show(path), e.to_string(), advice))?;
        cloud = cloud.or(file.ply_file_path.map(|name| (path, name)));
        let earlier = names.clone();
        for frame in file.frames {
            let name = frame.file_path.trim_start_matches("./").to_string();
            if earlier.contains(&name) {
                continue;
            }
            names.insert(name.clone());
            images.push(PosedImage {
                row: None,
                id: images.len() as u32,
                file: name.clone(),
                name,
                mask: frame.mask_path,
                depth: frame.depth_file_path,
                intrinsics: frame.intrinsics,
                camera_from_world: frame.camera_from_world,
                boxes: Vec::new(),
                seconds: None,
            });
        }
    }
    let cloud = match cloud {
        Some((path, name)) => match root.image(&name)? {
            Found::File(path) => Some(path),
            Found::Missing => {
                let problem = format!("names the points {name}, which are not there");
                return Err(BadInput::new(files::show(path), problem, "put the file there"));
            }
        },
        None => CLOUDS.iter().find_map(|name| root.file(name)),
    };
    let points = match cloud {
        Some(path) => {
            let (positions, colours) = ply::read_points(&files::read(&path)?)
                .map_err(|e| BadInput::new(files::show(&path), e.to_string(), "export the point cloud again"))?;
            RawPoints(SparsePoints { positions, colours, ..Default::default() })
        }
        None => colmap_points(root, &images)?,
    };
    Ok(ParsedCapture::new("transforms", images, points))
}

/// The points of a COLMAP model beside the file, if its poses equal those of the frames: many exporters transform the world.
fn colmap_points(root: &CaptureRoot, frames: &[PosedImage]) -> Result<RawPoints, BadInput> {
    let Some(folder) = colmap::find(root, &["sparse/0"]) else { return Ok(RawPoints::default()) };
    let ParsedCapture { images, mut points, .. } = colmap::read(root, &folder, &OpenOptions::default())?;
    let by_name: BTreeMap<&str, &PosedImage> =
        frames.iter().map(|frame| (frame.name.strip_prefix("images/").unwrap_or(&frame.name), frame)).collect();
    let mut ids = BTreeMap::new();
    for image in &images {
        let Some(frame) = by_name.get(image.name.as_str()) else { continue };
        let (a, b) = (image.camera_from_world, frame.camera_from_world);
        let tolerance = 1e-3 * a.translation.length().max(1.0);
        if a.rotation.dot(b.rotation).abs() < 1.0 - 1e-6 || (a.translation - b.translation).length() > tolerance {
            return Ok(RawPoints::default());
        }
        ids.insert(image.id, frame.id);
    }
    if ids.is_empty() {
        return Ok(RawPoints::default());
    }
    // Images without a frame get an id that no frame has, so that they are dropped from the tracks.
    points.0.seen_by.iter_mut().for_each(|id| *id = ids.get(id).copied().unwrap_or(u32::MAX));
    Ok(points)
}
