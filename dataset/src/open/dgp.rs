//! Parses a scene of DGP: photos and sweeps with poses, and boxes of objects in each photo.
//!
//! ```text
//! scene_HASH.json                       data, samples
//! calibration/KEY.json                  lenses
//! rgb/CAMERA/TIME.jpg                   as the scene says
//! point_cloud/LIDAR/TIME.npz            as the scene says; array `data`, N × 4 or more: x, y, z
//! bounding_box_3d/CAMERA/TIME.json      as the scene says; optional
//! ontology/KEY.json                     names of classes; optional
//! ```
//!
//! A sweep gives depths to the photos of its sample. Objects that move between samples are left out of the photos.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use scene::dgp::{self, BoxAnnotation, Datum, Scene};
use scene::transforms::Intrinsics;
use scene::{BadInput, CameraModel, CodecError, Rigid};

use super::annotated_boxes::{Placed, Tracks, corners, moving};
use super::files::{self, CaptureRoot, Found};
use super::parsed::{LabelledBox, OpenOptions, ParsedCapture, ParsedSweep, PosedImage, RawPoints};
use crate::lidar::PointFormat;

/// The scene's file.
pub(super) fn find(root: &CaptureRoot) -> Option<PathBuf> {
    let entries = root.path("").read_dir().ok()?;
    let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
    let scene = names.filter(|name| name.starts_with("scene_") && name.ends_with(".json")).min()?;
    (root.path("calibration").is_dir()).then(|| root.file(&scene))?
}

/// Parses the scene.
pub(super) fn read(root: &CaptureRoot, path: &Path, options: &OpenOptions) -> Result<ParsedCapture, BadInput> {
    let Scene { samples } = parse(path, dgp::read_scene)?;
    let mut lenses: BTreeMap<String, BTreeMap<String, CameraModel>> = BTreeMap::new();
    let (mut images, mut sweeps, mut boxes, mut times) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for sample in samples {
        if !lenses.contains_key(&sample.calibration) {
            let name = format!("calibration/{}.json", sample.calibration);
            lenses.insert(sample.calibration.clone(), parse(&named(root, path, &name)?, dgp::read_calibration)?);
        }
        let first = images.len() as u32;
        for photo in &sample.photos {
            let model = lenses[&sample.calibration].get(&photo.sensor).ok_or_else(|| {
                let problem = format!("has photos of {}, which its calibration lacks", photo.sensor);
                BadInput::new(files::show(path), problem, "correct the file or download the scene again")
            })?;
            let id = images.len() as u32;
            for found in annotated(root, path, photo)? {
                boxes.push((id, photo.world_from_sensor, photo.microseconds, found));
            }
            images.push(PosedImage {
                row: None,
                id,
                name: photo.file.clone(),
                file: photo.file.clone(),
                mask: None,
                depth: None,
                intrinsics: Intrinsics::from_model(model, Some(photo.size).filter(|size| size.0 > 0)),
                camera_from_world: photo.world_from_sensor.inverse(),
                boxes: Vec::new(),
                seconds: None,
            });
            times.push(photo.microseconds);
        }
        for sweep in sample.sweeps.iter().filter(|_| options.lidar) {
            sweeps.push(ParsedSweep {
                path: named(root, path, &sweep.file)?,
                format: PointFormat::Npz,
                turn: None,
                world_from_sensor: sweep.world_from_sensor,
                images: (first..images.len() as u32).collect(),
            });
        }
    }
    let places =
        boxes.iter().map(|(_, pose, _, found)| (found.instance, pose.apply(found.sensor_from_box.translation)));
    let moving = moving(places);
    let (names, mut labels) = (class_names(root)?, BTreeMap::new());
    let class_of =
        |found: &BoxAnnotation| names.get(&found.class).cloned().unwrap_or_else(|| format!("class {}", found.class));
    let tracks = tracks(&boxes, class_of, |object| moving.contains(object));
    for (image, time) in images.iter_mut().zip(&times) {
        image.seconds = time.and_then(|microseconds| tracks.seconds(microseconds));
    }
    for (image, _, _, found) in &boxes {
        let class = class_of(found);
        *labels.entry(class.clone()).or_default() += 1;
        let (moves, corners) = (moving.contains(&found.instance), corners(&found.sensor_from_box, found.size));
        images[*image as usize].boxes.push(LabelledBox { class, moves, corners });
    }
    let objects = tracks.objects();
    Ok(ParsedCapture { labels, sweeps, objects, ..ParsedCapture::new("dgp", images, RawPoints::default()) })
}

/// The paths of annotated objects. Several photos of a time show an object; the first of them tells where it is.
fn tracks(
    boxes: &[(u32, Rigid, Option<i64>, BoxAnnotation)],
    class_of: impl Fn(&BoxAnnotation) -> String,
    moves: impl Fn(&i64) -> bool,
) -> Tracks {
    let mut placed: Vec<(i64, String, Placed)> = (boxes.iter())
        .filter_map(|(_, world_from_sensor, microseconds, found)| {
            let world_from_box = world_from_sensor.after(&found.sensor_from_box);
            let placed = Placed { microseconds: (*microseconds)?, world_from_box, size: found.size };
            Some((found.instance, class_of(found), placed))
        })
        .collect();
    placed.sort_by_key(|(.., found)| found.microseconds);
    Tracks::new(placed.iter().map(|(object, class, found)| (*object, class.as_str(), *found)), moves)
}

/// The names of the classes of boxes, by number.
fn class_names(root: &CaptureRoot) -> Result<BTreeMap<i64, String>, BadInput> {
    let mut names = BTreeMap::new();
    let entries = root.path("ontology").read_dir().into_iter().flatten();
    let mut files: Vec<String> = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok()).collect();
    files.sort();
    for name in files.iter().filter(|name| name.ends_with(".json")) {
        if let Some(path) = root.file(&format!("ontology/{name}")) {
            names.extend(parse(&path, dgp::read_ontology)?);
        }
    }
    Ok(names)
}

/// The 3D boxes annotated in a photo, if there are any.
fn annotated(root: &CaptureRoot, scene: &Path, photo: &Datum) -> Result<Vec<BoxAnnotation>, BadInput> {
    let names = photo.annotations.iter().filter(|name| name.contains("bounding_box_3d"));
    let mut boxes = Vec::new();
    for name in names {
        boxes.extend(parse(&named(root, scene, name)?, dgp::read_boxes)?);
    }
    Ok(boxes)
}

/// A file that the scene names.
fn named(root: &CaptureRoot, scene: &Path, name: &str) -> Result<PathBuf, BadInput> {
    match root.image(name)? {
        Found::File(path) => Ok(path),
        Found::Missing => {
            let problem = format!("names {name}, which is not there");
            Err(BadInput::new(files::show(scene), problem, "put the file there"))
        }
    }
}

fn parse<T>(path: &Path, read: fn(&[u8]) -> Result<T, CodecError>) -> Result<T, BadInput> {
    read(&files::read(path)?)
        .map_err(|e| BadInput::new(files::show(path), e.to_string(), "correct the file or download the scene again"))
}
