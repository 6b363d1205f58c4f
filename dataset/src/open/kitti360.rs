//! Parses KITTI-360 in its own layout: rectified photos of the two front cameras, poses of the vehicle, and Velodyne scans as
//! initial points. RawPoints are grey, because scans have no colour.
//!
//! ```text
//! calibration/{perspective,calib_cam_to_pose,calib_cam_to_velo}.txt
//! data_poses/DRIVE/poses.txt                                  (or cam0_to_world.txt, for camera 00 alone)
//! data_2d_raw/DRIVE/image_0{0,1}/data_rect/FRAME.png          (or below data_2d_rect)
//! data_3d_raw/DRIVE/velodyne_points/data/FRAME.bin
//! ```

use std::collections::BTreeMap;
use std::path::PathBuf;

use glam::DVec3;
use rayon::prelude::*;
use scene::kitti360::{self, KittiCamera};
use scene::transforms::Intrinsics;
use scene::{BadInput, CodecError, Rigid, SparsePoints};

use super::files::{self, CaptureRoot};
use super::parsed::{OpenOptions, ParsedCapture, ParsedSweep, PosedImage, RawPoints};
use crate::lidar::PointFormat;

/// Approximate maximum of initial points.
const MAX_POINTS: u64 = 400_000;
/// Maximum of scans read, evenly spread.
const MAX_SCANS: usize = 1000;
/// The largest scan file: ten times a revolution of the scanner.
const MAX_SCAN_BYTES: u64 = 32 << 20;
/// Range of points kept, metres. Nearer points lie on the vehicle, farther ones are sparse.
const RANGE_METRES: std::ops::Range<f64> = 3.0..80.0;

/// Whether the capture has the layout of the data set.
pub(super) fn is_present(root: &CaptureRoot) -> bool {
    root.file("calibration/perspective.txt").is_some() && root.path("data_poses").is_dir()
}

/// Parses calibration, poses and scans.
pub(super) fn read(root: &CaptureRoot, options: &OpenOptions) -> Result<ParsedCapture, BadInput> {
    let cameras = load(root, "calibration/perspective.txt", kitti360::read_perspective)?;
    let imu_from_cameras = match root.file("calibration/calib_cam_to_pose.txt") {
        Some(_) => load(root, "calibration/calib_cam_to_pose.txt", kitti360::read_cam_to_pose)?,
        None => BTreeMap::new(),
    };
    let (mut images, mut scans) = (Vec::new(), Vec::new());
    for drive in drives(root)? {
        let pose_file = ["poses.txt", "cam0_to_world.txt"].map(|name| format!("data_poses/{drive}/{name}"));
        let [poses, first_camera] = pose_file.map(|name| root.file(&name).is_some().then_some(name));
        // World from each camera after rectification, and world from the vehicle.
        let mut tracks: BTreeMap<&str, BTreeMap<u32, Rigid>> = BTreeMap::new();
        let mut vehicle = BTreeMap::new();
        if let Some(name) = poses.filter(|_| !imu_from_cameras.is_empty()) {
            vehicle = load(root, &name, kitti360::read_poses)?;
            for (camera, KittiCamera { rectified_from_camera, .. }) in &cameras {
                let Some(imu_from_camera) = imu_from_cameras.get(camera) else { continue };
                let imu_from_rectified = imu_from_camera.compose(&rectified_from_camera.inverse());
                let track = vehicle.iter().map(|(&frame, pose)| (frame, pose.compose(&imu_from_rectified)));
                tracks.insert(camera, track.collect());
            }
        } else if let Some(name) = first_camera {
            tracks.insert("image_00", load(root, &name, kitti360::read_poses)?);
        }
        // The images of each frame.
        let mut seen: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        for (camera, track) in tracks {
            let Some(lens) = cameras.get(camera) else { continue };
            let folders = [
                format!("data_2d_raw/{drive}/{camera}/data_rect"),
                format!("data_2d_rect/{drive}/{camera}/data_rect"),
                format!("data_2d_rect/{drive}/{camera}"),
            ];
            let existing = folders.iter().find(|folder| root.path(folder).is_dir());
            let Some(folder) = existing.or(folders.first().filter(|_| options.cameras_only)) else { continue };
            for (frame, world_from_camera) in track {
                let file = format!("{folder}/{frame:010}.png");
                if root.file(&file).is_some() {
                    seen.entry(frame).or_default().push(images.len() as u32);
                }
                images.push(PosedImage {
                    row: None,
                    id: images.len() as u32,
                    name: format!("{drive}/{camera}/{frame:010}.png"),
                    file,
                    mask: None,
                    depth: None,
                    intrinsics: Intrinsics::from_model(&lens.model, Some((lens.width, lens.height))),
                    camera_from_world: world_from_camera.inverse(),
                    boxes: Vec::new(),
                    seconds: None,
                });
            }
        }
        let of_frame = |(frame, images): (u32, Vec<u32>)| {
            let scan = root.file(&format!("data_3d_raw/{drive}/velodyne_points/data/{frame:010}.bin"))?;
            Some((scan, *vehicle.get(&frame)?, images))
        };
        scans.extend(seen.into_iter().filter_map(of_frame));
    }
    if images.is_empty() {
        let problem = "has no drive with poses and rectified photos";
        let advice = "put data_poses/DRIVE/poses.txt and data_2d_raw/DRIVE/image_00/data_rect there";
        return Err(BadInput::new(root.to_string(), problem, advice));
    }
    let imu_from_first = imu_from_cameras.get("image_00").filter(|_| !scans.is_empty() && !options.cameras_only);
    let Some(imu_from_camera) = imu_from_first.filter(|_| root.file("calibration/calib_cam_to_velo.txt").is_some())
    else {
        return Ok(ParsedCapture::new("kitti360", images, RawPoints::default()));
    };
    let velo_from_camera = load(root, "calibration/calib_cam_to_velo.txt", kitti360::read_cam_to_velo)?;
    let imu_from_velo = imu_from_camera.compose(&velo_from_camera.inverse());
    if !options.lidar {
        return Ok(ParsedCapture::new("kitti360", images, scan_points(&scans, &imu_from_velo)?));
    }
    let sweep = |(path, world_from_imu, images): Scan| {
        let world_from_sensor = world_from_imu.compose(&imu_from_velo);
        ParsedSweep { path, format: PointFormat::Floats(4), world_from_sensor, turn: None, images }
    };
    let sweeps = scans.into_iter().map(sweep).collect();
    Ok(ParsedCapture { sweeps, ..ParsedCapture::new("kitti360", images, RawPoints::default()) })
}

/// A scan: its file, world_from_imu, and the images of its frame.
type Scan = (PathBuf, Rigid, Vec<u32>);

/// World points of the scans, thinned evenly: the initial points if the lidar is not used otherwise.
fn scan_points(scans: &[Scan], imu_from_velo: &Rigid) -> Result<RawPoints, BadInput> {
    let chosen: Vec<_> = scans.iter().step_by(scans.len().div_ceil(MAX_SCANS)).collect();
    let mut bytes = 0;
    for (path, ..) in &chosen {
        let length = path.metadata().map_or(0, |data| data.len());
        if length > MAX_SCAN_BYTES {
            return Err(BadInput::new(
                files::show(path),
                format!("has {length} bytes, too many for a scan"),
                "check it",
            ));
        }
        bytes += length;
    }
    let step = (bytes / 16).div_ceil(MAX_POINTS).max(1) as usize;
    let scan = |(path, world_from_imu, _): &&Scan| -> Result<Vec<DVec3>, BadInput> {
        let points = kitti360::read_scan(&files::read(path)?, step)
            .map_err(|e| BadInput::new(files::show(path), e.to_string(), "download the scan again"))?;
        let world_from_velo = world_from_imu.compose(imu_from_velo);
        let in_range = points.into_iter().filter(|point| RANGE_METRES.contains(&point.length()));
        Ok(in_range.map(|point| world_from_velo.apply(point)).collect())
    };
    let scanned: Vec<_> = chosen.par_iter().map(scan).collect();
    let mut positions = Vec::new();
    for points in scanned {
        positions.extend(points?);
    }
    let colours = vec![[128; 3]; positions.len()];
    Ok(RawPoints(SparsePoints { positions, colours, ..Default::default() }))
}

/// The drives with poses, sorted by name.
fn drives(root: &CaptureRoot) -> Result<Vec<String>, BadInput> {
    let folder = root.path("data_poses");
    let cannot = |e| BadInput::new(files::show(&folder), format!("cannot be read ({e})"), "check the folder");
    let entries = folder.read_dir().map_err(cannot)?;
    let mut drives: Vec<String> = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok()).collect();
    drives.sort();
    Ok(drives)
}

fn load<T>(root: &CaptureRoot, name: &str, read: fn(&[u8]) -> Result<T, CodecError>) -> Result<T, BadInput> {
    let Some(path) = root.file(name) else {
        return Err(BadInput::new(format!("{root}: {name}"), "is not there", "put it there"));
    };
    read(&files::read(&path)?).map_err(|e| BadInput::new(files::show(&path), e.to_string(), "download the file again"))
}
