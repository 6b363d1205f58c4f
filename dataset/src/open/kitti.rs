//! Parses a sequence of the KITTI odometry benchmark or of SemanticKITTI.
//!
//! ```text
//! calib.txt, poses.txt                  of the sequence; the folder may also hold sequences/NN/ and poses/NN.txt, for one NN
//! image_2/FRAME.png, image_3/           colour photos; without them image_0/ and image_1/, which are grey
//! velodyne/FRAME.bin                    optional: sweeps, each corrected for the car's motion
//! ```

use std::path::Path;

use scene::kitti::{self, Calibration};
use scene::transforms::Intrinsics;
use scene::{BadInput, CodecError, Rigid};

use super::files::{self, CaptureRoot};
use super::parsed::{OpenOptions, ParsedCapture, ParsedSweep, PosedImage, RawPoints};
use crate::lidar::PointFormat;

/// Paths of a sequence, relative to the capture.
pub(super) struct Sequence {
    /// Empty, or ending in `/`.
    folder: String,
    poses: String,
}

/// The sequence of a capture.
///
/// # Errors
/// Several sequences, or one without poses.
pub(super) fn find(root: &CaptureRoot) -> Result<Option<Sequence>, BadInput> {
    let folders = root.path("sequences").read_dir().into_iter().flatten();
    let mut names: Vec<String> = folders.filter_map(|entry| entry.ok()?.file_name().into_string().ok()).collect();
    names.retain(|name| root.file(&format!("sequences/{name}/calib.txt")).is_some());
    names.sort();
    let (folder, poses) = match names.as_slice() {
        [] => (String::new(), vec!["poses.txt".to_string()]),
        [name] => {
            (format!("sequences/{name}/"), vec![format!("sequences/{name}/poses.txt"), format!("poses/{name}.txt")])
        }
        _ => {
            let problem = format!("has {} sequences, each with a world of its own", names.len());
            return Err(BadInput::new(root.to_string(), problem, "give a folder with one sequence and its poses.txt"));
        }
    };
    if root.file(&format!("{folder}calib.txt")).is_none()
        || !root.path(&format!("{folder}velodyne")).is_dir() && photos(root, &folder).is_empty()
    {
        return Ok(None);
    }
    match poses.into_iter().find(|name| root.file(name).is_some()) {
        Some(poses) => Ok(Some(Sequence { folder, poses })),
        None => {
            let advice = "put the sequence's poses there, such as those of the benchmark or of SemanticKITTI";
            Err(BadInput::new(format!("{root}: {folder}poses.txt"), "is not there", advice))
        }
    }
}

/// The cameras with photos: the colour ones, or the grey ones.
fn photos(root: &CaptureRoot, folder: &str) -> Vec<u8> {
    let has = |camera: &u8| root.path(&format!("{folder}image_{camera}")).is_dir();
    let colour: Vec<u8> = [2, 3].into_iter().filter(has).collect();
    if colour.is_empty() { [0, 1].into_iter().filter(has).collect() } else { colour }
}

/// Parses the sequence.
pub(super) fn read(root: &CaptureRoot, of: &Sequence, options: &OpenOptions) -> Result<ParsedCapture, BadInput> {
    let Sequence { folder, poses } = of;
    let Calibration { cameras, camera_from_velodyne } =
        parse(root, &format!("{folder}calib.txt"), kitti::read_calibration)?;
    let poses = parse(root, poses, kitti::read_poses)?;
    let (mut images, mut sweeps) = (Vec::new(), Vec::new());
    for (frame, world_from_first) in poses.iter().enumerate() {
        let first = images.len() as u32;
        for camera in photos(root, folder) {
            let Some((model, from_first)) = cameras.get(&camera) else { continue };
            let name = format!("image_{camera}/{frame:06}.png");
            let file = format!("{folder}{name}");
            // Excerpts have photos of some frames only.
            if root.file(&file).is_none() && !options.cameras_only {
                continue;
            }
            images.push(PosedImage {
                row: None,
                id: images.len() as u32,
                name,
                file,
                mask: None,
                depth: None,
                intrinsics: Intrinsics::from_model(model, None),
                camera_from_world: from_first.compose(&world_from_first.inverse()),
                boxes: Vec::new(),
                seconds: None,
            });
        }
        let sweep = root.file(&format!("{folder}velodyne/{frame:06}.bin")).filter(|_| options.lidar);
        if let (Some(path), Some(from_velodyne)) = (sweep, camera_from_velodyne) {
            let world_from_sensor: Rigid = world_from_first.compose(&from_velodyne);
            let images = (first..images.len() as u32).collect();
            sweeps.push(ParsedSweep { path, format: PointFormat::Floats(4), world_from_sensor, turn: None, images });
        }
    }
    if images.is_empty() {
        let advice = "put image_2 there, with frames named as 000000.png";
        return Err(BadInput::new(format!("{root}: {folder}"), "has no photo of a frame with a pose", advice));
    }
    Ok(ParsedCapture { sweeps, ..ParsedCapture::new("kitti", images, RawPoints::default()) })
}

fn parse<T>(root: &CaptureRoot, name: &str, read: fn(&[u8]) -> Result<T, CodecError>) -> Result<T, BadInput> {
    let path =
        root.file(name).ok_or_else(|| BadInput::new(format!("{root}: {name}"), "is not there", "put it there"))?;
    let bad = |path: &Path, e: CodecError| BadInput::new(files::show(path), e.to_string(), "download the file again");
    read(&files::read(&path)?).map_err(|e| bad(&path, e))
}
