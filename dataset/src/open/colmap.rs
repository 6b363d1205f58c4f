//! Parses a COLMAP model, binary or text.

use std::path::Path;

use scene::colmap::{self, ColmapPoints};
use scene::transforms::Intrinsics;
use scene::{BadInput, CodecError, SparsePoints};

use super::files::{self, CaptureRoot};
use super::parsed::{OpenOptions, ParsedCapture, PosedImage, RawPoints};

/// The first of these folders with a model.
pub(super) fn find(root: &CaptureRoot, folders: &[&str]) -> Option<String> {
    let has = |folder: &str, extension: &str| {
        ["cameras", "images"].iter().all(|name| root.file(&format!("{folder}/{name}.{extension}")).is_some())
    };
    folders.iter().find(|folder| has(folder, "bin") || has(folder, "txt")).map(ToString::to_string)
}

/// Parses the model of a folder found by [`find`].
pub(super) fn read(root: &CaptureRoot, folder: &str, options: &OpenOptions) -> Result<ParsedCapture, BadInput> {
    let has_bin = ["cameras", "images"].iter().all(|name| root.file(&format!("{folder}/{name}.bin")).is_some());
    let cameras = load(root, folder, "cameras", has_bin, colmap::read_cameras_bin, colmap::read_cameras_txt)?;
    let images = load(root, folder, "images", has_bin, colmap::read_images_bin, colmap::read_images_txt)?;
    let has_points = ["bin", "txt"].iter().any(|end| root.file(&format!("{folder}/points3D.{end}")).is_some());
    let points = if has_points {
        load(root, folder, "points3D", has_bin, colmap::read_points_bin, colmap::read_points_txt)?
    } else {
        ColmapPoints::default()
    };
    let photos = match &options.images {
        Some(folder) => format!("{}/", folder.trim_end_matches('/')),
        None if root.path("images").is_dir() => "images/".to_string(),
        None => String::new(),
    };
    let images = images.into_iter().map(|image| {
        let camera = cameras.get(&image.camera_id).ok_or_else(|| {
            let problem = format!("has image {} with camera {}, which is not there", image.name, image.camera_id);
            BadInput::new(format!("{root}: {folder}"), problem, "export the model again")
        })?;
        let size = Some((camera.width, camera.height));
        Ok(PosedImage {
            row: None,
            id: image.id,
            file: format!("{photos}{}", image.name),
            name: image.name,
            mask: None,
            depth: None,
            intrinsics: Intrinsics::from_model(&camera.model, size),
            camera_from_world: image.camera_from_world,
            boxes: Vec::new(),
            seconds: None,
        })
    });
    let images = images.collect::<Result<Vec<_>, BadInput>>()?;
    if images.is_empty() {
        return Err(BadInput::new(format!("{root}: {folder}"), "has no images", "give a model with registered images"));
    }
    let ColmapPoints { positions, colours, track_start, track_images, .. } = points;
    let points = RawPoints(SparsePoints { positions, colours, track_start, seen_by: track_images, measured: 0 });
    Ok(ParsedCapture::new("colmap", images, points))
}

type Codec<T> = fn(&[u8]) -> Result<T, CodecError>;

fn load<T>(
    root: &CaptureRoot,
    folder: &str,
    name: &str,
    bin: bool,
    read: Codec<T>,
    read_text: Codec<T>,
) -> Result<T, BadInput> {
    let decode = |path: &Path, codec: Codec<T>| {
        codec(&files::read(path)?)
            .map_err(|e| BadInput::new(files::show(path), e.to_string(), "correct or export the model again"))
    };
    if bin && let Some(path) = root.file(&format!("{folder}/{name}.bin")) {
        return decode(&path, read);
    }
    match root.file(&format!("{folder}/{name}.txt")) {
        Some(path) => decode(&path, read_text),
        None => Err(BadInput::new(format!("{root}: {folder}"), format!("has no {name}"), "export the model again")),
    }
}
