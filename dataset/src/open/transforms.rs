//! A `transforms.json` of nerfstudio or instant-ngp, or the `transforms_train.json` of captures that come in splits.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use scene::{BadInput, SparsePoints, ply, transforms};

use super::colmap;
use super::files::{self, Found, Root};
use super::{Contents, OpenOptions, Points, Posed};

/// Point clouds that tools leave beside the file.
const CLOUDS: [&str; 2] = ["sparse_pc.ply", "points3D.ply"];

/// The splits of a capture, whose views plat holds out by its own rule.
const SPLITS: [&str; 3] = ["transforms_train.json", "transforms_val.json", "transforms_test.json"];

/// The files of a capture: `transforms.json`, or its splits where there is one for training; none if it is no such
/// capture.
pub(super) fn find(root: &Root) -> Vec<PathBuf> {
    match root.file("transforms.json") {
        Some(path) => vec![path],
        None if root.file(SPLITS[0]).is_some() => SPLITS.iter().filter_map(|name| root.file(name)).collect(),
        None => Vec::new(),
    }
}

/// Reads the files and the points that belong to them. A frame that several have is that of the first.
pub(super) fn read(root: &Root, paths: &[PathBuf]) -> Result<Contents, BadInput> {
    let advice = "correct the file or export it again";
    let (mut posed, mut names, mut cloud) = (Vec::new(), BTreeSet::new(), None);
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
            posed.push(Posed {
                id: posed.len() as u32,
                file: name.clone(),
                name,
                mask: frame.mask_path,
                intrinsics: frame.intrinsics,
                camera_from_world: frame.camera_from_world,
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
            Points(SparsePoints { positions, colours, ..Default::default() })
        }
        None => beside(root, &posed)?,
    };
    Ok(Contents { format: "transforms", posed, points, origin: None, left_out: Vec::new() })
}

/// The points of a COLMAP model beside the file, if its images lie where the frames do: many exporters move the world.
fn beside(root: &Root, posed: &[Posed]) -> Result<Points, BadInput> {
    let Some(folder) = colmap::find(root, &["sparse/0"]) else { return Ok(Points::default()) };
    let Contents { posed: images, mut points, .. } = colmap::read(root, &folder, &OpenOptions::default())?;
    let by_name: BTreeMap<&str, &Posed> =
        posed.iter().map(|frame| (frame.name.strip_prefix("images/").unwrap_or(&frame.name), frame)).collect();
    let mut ids = BTreeMap::new();
    for image in &images {
        let Some(frame) = by_name.get(image.name.as_str()) else { continue };
        let (a, b) = (image.camera_from_world, frame.camera_from_world);
        let near = 1e-3 * a.translation.length().max(1.0);
        if a.rotation.dot(b.rotation).abs() < 1.0 - 1e-6 || (a.translation - b.translation).length() > near {
            return Ok(Points::default());
        }
        ids.insert(image.id, frame.id);
    }
    if ids.is_empty() {
        return Ok(Points::default());
    }
    // Images without a frame get an id that no frame has, and drop from the tracks later.
    points.0.seen_by.iter_mut().for_each(|id| *id = ids.get(id).copied().unwrap_or(u32::MAX));
    Ok(points)
}
