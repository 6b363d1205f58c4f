//! Parses a drive of the KITTI raw recordings, synchronised and rectified.
//!
//! ```text
//! DATE/calib_{cam_to_cam,velo_to_cam,imu_to_velo}.txt       see `scene::kitti_raw`
//! DATE/DATE_drive_NNNN_sync/oxts/data/FRAME.txt
//! DATE/DATE_drive_NNNN_sync/image_0{2,3}/data/FRAME.png     colour; without them image_00 and image_01, which are grey
//! DATE/DATE_drive_NNNN_sync/velodyne_points/data/FRAME.bin  optional, also for single frames
//! DATE/DATE_drive_NNNN_sync/tracklet_labels.xml             optional: annotated objects
//! DATE/DATE_drive_NNNN_sync/{oxts,image_0X}/timestamps.txt  when each frame was taken, for objects that move
//! ```
//!
//! Each drive is a capture: it is named by its own folder, or as the only one of a date or of an archive of dates.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use scene::kitti_raw::{self, Mercator, Oxts, RawCameras, Tracklet};
use scene::lidar::Turn;
use scene::transforms::Intrinsics;
use scene::{BadInput, CodecError, Rigid};

use super::annotated_boxes::{Placed, Tracks, moving};
use super::files::{self, CaptureRoot, listed};
use super::parsed::{OpenOptions, ParsedCapture, ParsedSweep, PosedImage, RawPoints};
use crate::lidar::PointFormat;

const CAMERAS: &str = "calib_cam_to_cam.txt";
/// The Velodyne turns ten times a second, counter-clockwise, and triggers the cameras when it looks ahead.
const TURN_SECONDS: f64 = 0.1;
/// Frames without a file of times are ten a second.
const FRAME_MICROSECONDS: i64 = 100_000;
/// The largest file of calibration, of oxts or of times.
const MAX_TEXT_BYTES: u64 = 1 << 20;
/// The largest file of tracklets: half a kilobyte for each object of a frame.
const MAX_TRACKLETS_BYTES: u64 = 1 << 27;

/// A drive: the folder of its date, which the paths of its files are relative to.
pub(super) struct Drive {
    date: CaptureRoot,
    name: String,
}

/// The drive of a capture.
///
/// # Errors
/// Several drives, one without calibration, or drives that are not rectified only.
pub(super) fn find(root: &CaptureRoot) -> Result<Option<Drive>, BadInput> {
    let whole = root.path("");
    if is_drive(&whole) {
        let named = whole.parent().zip(whole.file_name().and_then(|name| name.to_str()));
        let Some((date, name)) = named else { return Ok(None) };
        let drive = Drive { date: CaptureRoot::new(date)?, name: name.into() };
        if drive.date.file(CAMERAS).is_none() {
            let advice = "put the drive into the folder of its date, beside the calibration of that date";
            return Err(BadInput::new(format!("{}: {CAMERAS}", drive.date), "is not there", advice));
        }
        return Ok(Some(drive));
    }
    let is_date = root.file(CAMERAS).is_some();
    let dates = if is_date { vec![String::new()] } else { folders(&whole) };
    let with_calibration = |date: &String| is_date || root.file(&format!("{date}/{CAMERAS}")).is_some();
    let mut drives = Vec::new();
    for date in dates.into_iter().filter(with_calibration) {
        let inside = folders(&root.path(&date)).into_iter().filter(|name| is_drive(&root.path(&date).join(name)));
        drives.extend(inside.map(|name| (date.clone(), name)));
    }
    let (rectified, others): (Vec<_>, Vec<_>) = drives.into_iter().partition(|(_, name)| !name.ends_with("_extract"));
    match rectified.as_slice() {
        [] if others.is_empty() => Ok(None),
        [] => {
            let problem =
                format!("has drives that are not rectified only: {}", listed(others.iter().map(|(_, name)| name)));
            Err(BadInput::new(root.to_string(), problem, "download the synced+rectified data"))
        }
        [(date, name)] => Ok(Some(Drive { date: CaptureRoot::new(&root.path(date))?, name: name.clone() })),
        [(date, first), ..] => {
            let names = listed(rectified.iter().map(|(_, name)| name));
            let problem = format!("has {} drives, each a capture of its own: {names}", rectified.len());
            let example = Path::new(date).join(first);
            Err(BadInput::new(root.to_string(), problem, format!("name one, as in {root}/{:.100}", example.display())))
        }
    }
}

/// Whether a folder has the positions of a drive and the folder of a camera.
fn is_drive(folder: &Path) -> bool {
    let has = |name: &str| folder.join(name).is_dir();
    has("oxts/data") && (0..4).any(|camera| has(&format!("image_0{camera}")))
}

/// The folders in a folder, sorted by name.
fn folders(folder: &Path) -> Vec<String> {
    let entries = folder.read_dir().into_iter().flatten().filter_map(Result::ok);
    let mut names: Vec<String> = entries
        .filter(|entry| entry.path().is_dir())
        .filter_map(|entry| entry.file_name().into_string().ok())
        .collect();
    names.sort();
    names
}

/// Parses the drive.
pub(super) fn read(drive: Drive, options: &OpenOptions) -> Result<ParsedCapture, BadInput> {
    let Drive { date: root, name: drive } = drive;
    let RawCameras { cameras, rectified_from_camera } = parse(&root, CAMERAS, kitti_raw::read_cameras)?;
    let camera_from_velodyne = parse(&root, "calib_velo_to_cam.txt", kitti_raw::read_mounting)?;
    let velodyne_from_imu = parse(&root, "calib_imu_to_velo.txt", kitti_raw::read_mounting)?;
    let imu_from_velodyne = velodyne_from_imu.inverse();
    let first_from_imu = rectified_from_camera.compose(&camera_from_velodyne).compose(&velodyne_from_imu);
    let used = photographed(&root, &drive, options);
    if let Some(camera) = used.iter().find(|camera| !cameras.contains_key(camera)) {
        let problem = format!("has no row P_rect_0{camera}, and the drive has photos of that camera");
        return Err(BadInput::new(files::show(&root.path(CAMERAS)), problem, "download the calibration again"));
    }

    let (mut images, mut sweeps, mut world) = (Vec::new(), Vec::new(), None);
    // Of each frame, and of each image.
    let (mut velodynes, mut taken) = (BTreeMap::new(), Vec::new());
    for frame in frames(&root, &drive) {
        let oxts = parse(&root, &format!("{drive}/oxts/data/{frame}.txt"), kitti_raw::read_oxts)?;
        let (_, projection) = world.get_or_insert_with(|| (oxts.place, Mercator::new(&oxts.place)));
        let world_from_imu = projection.world_from_imu(&oxts);
        if !world_from_imu.is_sane() {
            let file = root.path(&format!("{drive}/oxts/data/{frame}.txt"));
            let problem = "has a position too far from that of the first frame";
            return Err(BadInput::new(files::show(&file), problem, "download the file again"));
        }
        let world_from_velodyne = world_from_imu.compose(&imu_from_velodyne);
        velodynes.insert(frame.clone(), world_from_velodyne);
        let first = images.len() as u32;
        for (number, lens) in cameras.iter().filter(|(number, _)| used.contains(number)) {
            // Drives are also shared with JPEG instead of PNG.
            let file = format!("{drive}/image_0{number}/data/{frame}");
            let Some((file, extension)) = existing(&root, &file).or(options.cameras_only.then_some((file, "png")))
            else {
                continue;
            };
            taken.push((*number, frame.clone()));
            images.push(PosedImage {
                row: None,
                id: images.len() as u32,
                name: format!("image_0{number}/{frame}.{extension}"),
                file,
                mask: None,
                depth: None,
                intrinsics: Intrinsics::from_model(&lens.model, Some((lens.width, lens.height))),
                camera_from_world: lens.from_first.compose(&first_from_imu).after(&world_from_imu.inverse()),
                boxes: Vec::new(),
                seconds: None,
            });
        }
        let sweep = root.file(&format!("{drive}/velodyne_points/data/{frame}.bin")).filter(|_| options.lidar);
        if let Some(path) = sweep {
            let world_from_sensor = world_from_velodyne;
            let turn = Some(turn(&oxts, &world_from_imu, &world_from_sensor));
            let images = (first..images.len() as u32).collect();
            sweeps.push(ParsedSweep { path, format: PointFormat::Floats(4), world_from_sensor, turn, images });
        }
    }
    if images.is_empty() {
        let problem = "has no photo of a frame with a position";
        let advice = "put image_02/data and oxts/data there, with frames named as 0000000000.png and 0000000000.txt";
        return Err(BadInput::new(format!("{root}/{drive}"), problem, advice));
    }
    let labelled = Labelled::read(&root, &drive, &velodynes, &used)?;
    for (image, (camera, frame)) in images.iter_mut().zip(&taken) {
        let Some(microseconds) = labelled.times[camera].of(frame) else { continue };
        let lens = &cameras[camera];
        let size = Some((lens.width, lens.height));
        image.boxes = labelled.tracks.seen(microseconds, &image.camera_from_world, &lens.model, size);
        image.seconds = labelled.tracks.seconds(microseconds);
    }
    let origin = world.map(|(place, _)| place);
    Ok(ParsedCapture {
        origin,
        objects: labelled.tracks.objects(),
        labels: labelled.labels,
        sweeps,
        root: Some(root),
        ..ParsedCapture::new("kitti-raw", images, RawPoints::default())
    })
}

/// When the frames of a sensor were taken, microseconds since 1970.
struct Times(Option<Vec<i64>>);

impl Times {
    /// Of `DRIVE/SENSOR/timestamps.txt`, where there is one.
    fn read(root: &CaptureRoot, drive: &str, sensor: &str) -> Result<Option<Self>, BadInput> {
        let name = format!("{drive}/{sensor}/timestamps.txt");
        let is_there = root.file(&name).is_some();
        is_there.then(|| parse(root, &name, kitti_raw::read_times).map(|times| Self(Some(times)))).transpose()
    }

    /// Of a frame by its name; `None` if the file has no line for it.
    fn of(&self, frame: &str) -> Option<i64> {
        let number: i64 = frame.parse().ok()?;
        match &self.0 {
            Some(times) => times.get(usize::try_from(number).ok()?).copied(),
            None => Some(FRAME_MICROSECONDS * number),
        }
    }
}

/// The annotated objects of a drive.
struct Labelled {
    tracks: Tracks,
    /// Number of boxes by class.
    labels: BTreeMap<String, usize>,
    /// Of the used cameras.
    times: BTreeMap<u8, Times>,
}

impl Labelled {
    /// Reads the tracklets, if there are any; `velodynes` are world_from_velodyne by frame.
    fn read(
        root: &CaptureRoot,
        drive: &str,
        velodynes: &BTreeMap<String, Rigid>,
        cameras: &[u8],
    ) -> Result<Self, BadInput> {
        let name = format!("{drive}/tracklet_labels.xml");
        let tracklets = match root.file(&name) {
            Some(_) => parse_up_to(MAX_TRACKLETS_BYTES, root, &name, kitti_raw::read_tracklets)?,
            None => Vec::new(),
        };
        let of_oxts = Times::read(root, drive, "oxts")?;
        let mut times = BTreeMap::new();
        for camera in cameras {
            let own = Times::read(root, drive, &format!("image_0{camera}"))?;
            let of_oxts = || Times(of_oxts.as_ref().and_then(|times| times.0.clone()));
            times.insert(*camera, own.unwrap_or_else(of_oxts));
        }
        let of_boxes = of_oxts.unwrap_or(Times(None));
        let mut placed = Vec::new();
        for (number, Tracklet { class, size, first_frame, poses }) in tracklets.iter().enumerate() {
            for (frame, pose) in (u64::from(*first_frame)..).zip(poses) {
                let frame = format!("{frame:010}");
                let Some(world_from_velodyne) = velodynes.get(&frame) else { continue };
                let Some(microseconds) = of_boxes.of(&frame) else { continue };
                let world_from_box = world_from_velodyne.compose(pose);
                placed.push((number, class.as_str(), Placed { microseconds, world_from_box, size: *size }));
            }
        }
        let mut labels = BTreeMap::new();
        placed.iter().for_each(|(_, class, _)| *labels.entry((*class).to_owned()).or_insert(0) += 1);
        let moving: BTreeSet<usize> =
            moving(placed.iter().map(|(number, _, found)| (*number, found.world_from_box.translation)));
        let tracks = Tracks::new(placed.into_iter(), |number| moving.contains(number));
        Ok(Self { tracks, labels, times })
    }
}

/// The cameras with photos: those in colour, or the grey ones.
fn photographed(root: &CaptureRoot, drive: &str, options: &OpenOptions) -> Vec<u8> {
    let has = |camera: &u8| root.path(&format!("{drive}/image_0{camera}/data")).is_dir();
    let [colour, grey] = [[2, 3], [0, 1]].map(|pair| pair.into_iter().filter(has).collect::<Vec<u8>>());
    match (colour.is_empty(), grey.is_empty()) {
        (true, true) if options.cameras_only => vec![2, 3],
        (true, _) => grey,
        _ => colour,
    }
}

/// Names of the frames with positions: ten digits each, sorted.
fn frames(root: &CaptureRoot, drive: &str) -> Vec<String> {
    let entries = root.path(&format!("{drive}/oxts/data")).read_dir().into_iter().flatten();
    let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
    let mut frames: Vec<String> = names.filter_map(|name| Some(name.strip_suffix(".txt")?.to_owned())).collect();
    frames.retain(|frame| frame.len() == 10 && frame.bytes().all(|byte| byte.is_ascii_digit()));
    frames.sort();
    frames
}

/// A photo's file and extension, `None` if there is none.
fn existing(root: &CaptureRoot, stem: &str) -> Option<(String, &'static str)> {
    let files = ["png", "jpg"].into_iter().map(|extension| (format!("{stem}.{extension}"), extension));
    files.into_iter().find(|(file, _)| root.file(file).is_some())
}

/// The Velodyne's motion. Its points are as they were measured while it turned, as the data set's readme says.
fn turn(oxts: &Oxts, world_from_imu: &Rigid, world_from_sensor: &Rigid) -> Turn {
    let spin = world_from_imu.rotation * oxts.spin;
    let arm = world_from_sensor.translation - world_from_imu.translation;
    Turn { seconds: TURN_SECONDS, clockwise: false, velocity: oxts.velocity + spin.cross(arm), spin }
}

fn parse<T>(root: &CaptureRoot, name: &str, read: fn(&[u8]) -> Result<T, CodecError>) -> Result<T, BadInput> {
    parse_up_to(MAX_TEXT_BYTES, root, name, read)
}

/// Parses a file of at most so many bytes.
fn parse_up_to<T>(
    limit: u64,
    root: &CaptureRoot,
    name: &str,
    read: fn(&[u8]) -> Result<T, CodecError>,
) -> Result<T, BadInput> {
    let missing = || BadInput::new(format!("{root}: {name}"), "is not there", "put it there");
    let path = root.file(name).ok_or_else(missing)?;
    let bad = |problem: String| BadInput::new(files::show(&path), problem, "download the file again");
    if path.metadata().is_ok_and(|data| data.len() > limit) {
        return Err(bad(format!("is larger than {} MB, the limit for such a file", limit >> 20)));
    }
    read(&files::read(&path)?).map_err(|e| bad(e.to_string()))
}
