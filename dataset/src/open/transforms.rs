//! A `transforms.json` of nerfstudio or instant-ngp.

use std::path::Path;

use scene::{BadInput, SparsePoints, ply, transforms};

use super::colmap;
use super::files::{self, Found, Root};
use super::{OpenOptions, Points, Posed};

/// Point clouds that tools leave beside the file.
const CLOUDS: [&str; 2] = ["sparse_pc.ply", "points3D.ply"];

/// Reads the file and the points that belong to it.
pub(super) fn read(root: &Root, path: &Path) -> Result<(&'static str, Vec<Posed>, Points), BadInput> {
    let advice = "correct the file or export it again";
    let file =
        transforms::read(&files::read(path)?).map_err(|e| BadInput::new(files::show(path), e.to_string(), advice))?;
    let posed: Vec<Posed> = file
        .frames
        .into_iter()
        .zip(0..)
        .map(|(frame, id)| {
            let name = frame.file_path.trim_start_matches("./").to_string();
            Posed {
                id,
                file: name.clone(),
                name,
                mask: frame.mask_path,
                intrinsics: frame.intrinsics,
                camera_from_world: frame.camera_from_world,
            }
        })
        .collect();
    let cloud = match &file.ply_file_path {
        Some(name) => match root.image(name)? {
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
    Ok(("transforms", posed, points))
}

/// The points of a COLMAP model beside the file, if its images lie where the frames do: many exporters move the world.
fn beside(root: &Root, posed: &[Posed]) -> Result<Points, BadInput> {
    let Some(folder) = colmap::find(root, &["sparse/0"]) else { return Ok(Points::default()) };
    let (_, images, mut points) = colmap::read(root, &folder, &OpenOptions::default())?;
    let by_name: std::collections::BTreeMap<&str, &Posed> =
        posed.iter().map(|frame| (frame.name.strip_prefix("images/").unwrap_or(&frame.name), frame)).collect();
    let mut ids = std::collections::BTreeMap::new();
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
