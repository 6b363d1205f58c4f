//! Parses a segment of the Waymo Open Dataset, Perception, version 2: photos of all cameras, range images of all lasers, boxes.
//!
//! ```text
//! camera_image/SEGMENT.parquet, camera_calibration/SEGMENT.parquet
//! lidar/SEGMENT.parquet, lidar_calibration/..., vehicle_pose/..., lidar_pose/...     optional: sweeps
//! lidar_box/SEGMENT.parquet, vehicle_pose/...                                        optional: boxes
//! ```
//!
//! The folders may also lie below `training/`, `validation/` or `testing/`. Each segment is a capture. Of several, one is named
//! after the folder: `FOLDER/SEGMENT`. A view is named `CAMERA/TIME.jpg`, as no photo is a file. `scene::waymo` describes the
//! tables.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use scene::parquet::Table;
use scene::transforms::Intrinsics;
use scene::waymo::{self, PIXEL_POSES, RANGES, WaymoPhoto, WaymoTurn};
use scene::{BadInput, CodecError, Rigid};

use super::annotated_boxes::{Placed, Tracks, moving};
use super::files::{CaptureRoot, listed};
use super::parsed::{OpenOptions, ParsedCapture, ParsedSweep, PosedImage, RawPoints};
use crate::lidar::{PointFormat, RangeImage};
use crate::tables::{self, TableFile};

/// Folders that the components may lie in.
const SPLITS: [&str; 4] = ["", "training/", "validation/", "testing/"];
const PHOTOS: &str = "camera_image";
const CALIBRATION: &str = "camera_calibration";

/// The folder of a data set and the name of a segment, if the path is `FOLDER/SEGMENT`, which is no folder itself.
pub(super) fn named_segment(path: &Path) -> Option<(&Path, &str)> {
    let (folder, segment) = (path.parent()?, path.file_name()?.to_str()?);
    let root = CaptureRoot::new(folder).ok().filter(|_| !path.exists())?;
    is_present(&root).then_some((folder, segment))
}

/// Whether there is a data set.
pub(super) fn is_present(root: &CaptureRoot) -> bool {
    !segments(root).is_empty()
}

/// Names of the segments with the folders of their components.
fn segments(root: &CaptureRoot) -> BTreeMap<String, &'static str> {
    let mut segments = BTreeMap::new();
    for split in SPLITS.into_iter().filter(|split| root.path(&format!("{split}{CALIBRATION}")).is_dir()) {
        let entries = root.path(&format!("{split}{PHOTOS}")).read_dir().into_iter().flatten();
        let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        for name in names.filter_map(|name| Some(name.strip_suffix(".parquet")?.to_owned())) {
            segments.entry(name).or_insert(split);
        }
    }
    segments
}

/// Parses the segment of this name, or the only one.
pub(super) fn read(
    root: &CaptureRoot,
    segment: Option<&str>,
    options: &OpenOptions,
) -> Result<ParsedCapture, BadInput> {
    let segment = choose(root, segment)?;
    let photos = segment.read(PHOTOS, waymo::read_photos)?;
    let vehicles = segment.find("vehicle_pose").map(|_| segment.read("vehicle_pose", waymo::read_vehicle_poses));
    let vehicles = vehicles.transpose()?;
    let (labels, tracks) = segment.boxes(vehicles.as_ref())?;
    let images = segment.images(&photos, &tracks)?;
    let sweeps = match segment.find("lidar") {
        Some(_) if options.lidar => segment.sweeps(&photos, vehicles.as_ref())?,
        _ => Vec::new(),
    };
    Ok(ParsedCapture {
        labels,
        sweeps,
        objects: tracks.objects(),
        ..ParsedCapture::new("waymo", images, RawPoints::default())
    })
}

fn choose<'a>(root: &'a CaptureRoot, wanted: Option<&str>) -> Result<Segment<'a>, BadInput> {
    let segments = segments(root);
    let listed = listed(segments.keys());
    let mut names = segments.keys();
    let chosen = match (wanted, names.next()) {
        (Some(name), _) => name.strip_suffix(".parquet").unwrap_or(name),
        (None, Some(first)) if segments.len() > 1 => {
            let problem = format!("has {} segments, each a capture of its own: {listed}", segments.len());
            return Err(BadInput::new(root.to_string(), problem, format!("name one, as in {root}/{first:.80}")));
        }
        (None, first) => first.map_or("", String::as_str),
    };
    let Some(split) = segments.get(chosen) else {
        let problem = format!("has no segment {chosen:.100}");
        return Err(BadInput::new(root.to_string(), problem, format!("name one that it has: {listed}")));
    };
    Ok(Segment { root, split, name: chosen.to_owned() })
}

/// A segment: a file for each component.
struct Segment<'a> {
    root: &'a CaptureRoot,
    split: &'static str,
    name: String,
}

impl Segment<'_> {
    /// Path of a component's file, relative to the capture.
    fn file(&self, component: &str) -> String {
        format!("{}{component}/{}.parquet", self.split, self.name)
    }

    fn find(&self, component: &str) -> Option<PathBuf> {
        self.root.file(&self.file(component))
    }

    /// A component, read by this codec.
    fn read<T>(
        &self,
        component: &str,
        read: impl FnOnce(&Table<TableFile>) -> Result<T, CodecError>,
    ) -> Result<T, BadInput> {
        let missing = || {
            let name = format!("{}: {}", self.root, self.file(component));
            BadInput::new(name, "is not there", "download this component of the segment too")
        };
        let path = self.find(component).ok_or_else(missing)?;
        read(&tables::open(&path)?).map_err(|e| tables::bad(&path, &e))
    }

    /// What is wrong with a component.
    fn bad(&self, component: &str, problem: String) -> BadInput {
        tables::bad(&self.root.path(&self.file(component)), &CodecError::new(problem))
    }

    fn images(&self, photos: &[WaymoPhoto], tracks: &Tracks) -> Result<Vec<PosedImage>, BadInput> {
        let cameras = self.read(CALIBRATION, waymo::read_cameras)?;
        if photos.is_empty() {
            return Err(self.bad(PHOTOS, "has no photo".into()));
        }
        let image = |(id, photo): (u32, &WaymoPhoto)| {
            let lacks =
                || self.bad(PHOTOS, format!("has a photo of camera {}, which its calibration lacks", photo.camera));
            let camera = cameras.get(&photo.camera).ok_or_else(lacks)?;
            let name = usize::try_from(photo.camera - 1).ok().and_then(|number| waymo::CAMERAS.get(number));
            let name = name.map_or_else(|| format!("CAMERA_{}", photo.camera), |name| (*name).to_owned());
            let camera_from_world = photo.world_from_vehicle.after(&camera.vehicle_from_camera).inverse();
            let size = Some((camera.width, camera.height));
            // A lens with distortion sees more than its focal length says.
            let seen = size.filter(|_| !camera.lens.is_distorted());
            Ok(PosedImage {
                id,
                name: format!("{name}/{}.jpg", photo.frame),
                file: self.file(PHOTOS),
                row: Some(photo.row),
                mask: None,
                depth: None,
                intrinsics: Intrinsics::from_model(&camera.lens, size),
                camera_from_world,
                boxes: tracks.seen(photo.microseconds, &camera_from_world, &camera.lens, seen),
                seconds: tracks.seconds(photo.microseconds),
            })
        };
        (0..).zip(photos).map(image).collect()
    }

    /// Number of boxes by class, and their tracks.
    fn boxes(&self, vehicles: Option<&BTreeMap<i64, Rigid>>) -> Result<(BTreeMap<String, usize>, Tracks), BadInput> {
        let (mut labels, mut placed) = (BTreeMap::new(), Vec::new());
        if let (Some(_), Some(vehicles)) = (self.find("lidar_box"), vehicles) {
            for found in self.read("lidar_box", waymo::read_boxes)? {
                let vehicle = self.vehicle("lidar_box", vehicles, found.frame)?;
                let world_from_box = vehicle.after(&found.vehicle_from_box);
                *labels.entry(found.class.to_owned()).or_default() += 1;
                let placed_box = Placed { microseconds: found.frame, world_from_box, size: found.size };
                placed.push((found.object, found.class, placed_box));
            }
        }
        placed.sort_by_key(|(.., found)| found.microseconds);
        let places = placed.iter().map(|(object, _, found)| (object.as_str(), found.world_from_box.translation));
        let moving = moving(places);
        let boxes = placed.iter().map(|(object, class, found)| (object.as_str(), &**class, *found));
        Ok((labels, Tracks::new(boxes, |object| moving.contains(object))))
    }

    /// A sweep of each laser for each frame: it belongs to the photos of the frame.
    fn sweeps(
        &self,
        photos: &[WaymoPhoto],
        vehicles: Option<&BTreeMap<i64, Rigid>>,
    ) -> Result<Vec<ParsedSweep>, BadInput> {
        let lasers = self.read("lidar_calibration", waymo::read_lasers)?;
        let vehicles =
            vehicles.map_or_else(|| self.read("vehicle_pose", waymo::read_vehicle_poses), |all| Ok(all.clone()))?;
        let turns = self.read("lidar", |table| waymo::read_turns(table, RANGES, 4))?;
        let poses = match self.find("lidar_pose") {
            Some(path) => Some((path, self.read("lidar_pose", |table| waymo::read_turns(table, PIXEL_POSES, 6))?)),
            None => None,
        };
        let lengths = |turns: &[WaymoTurn]| turns.iter().map(WaymoTurn::length).collect::<Arc<[u32]>>();
        let pose_lengths = poses.as_ref().map(|(_, poses)| lengths(poses));
        let mut pose_of: BTreeMap<(i64, i64), (u64, [u32; 3])> = BTreeMap::new();
        for (row, turn) in (0..).zip(poses.iter().flat_map(|(_, poses)| poses)).filter(|(_, turn)| turn.length() > 0) {
            pose_of.insert((turn.frame, turn.laser), (row, turn.shape));
        }
        let mut taken: BTreeMap<i64, Vec<u32>> = BTreeMap::new();
        (0..).zip(photos).for_each(|(id, photo)| taken.entry(photo.frame).or_default().push(id));

        let (all, mut sweeps) = (lengths(&turns), Vec::new());
        let path = self.root.path(&self.file("lidar"));
        for (row, turn) in (0..).zip(&turns).filter(|(_, turn)| turn.length() > 0) {
            let lacks =
                || self.bad("lidar", format!("has a range image of laser {}, which its calibration lacks", turn.laser));
            let laser = lasers.get(&turn.laser).ok_or_else(lacks)?;
            let world_from_vehicle = *self.vehicle("lidar", &vehicles, turn.frame)?;
            let pose = pose_of.get(&(turn.frame, turn.laser));
            if let Some((row, shape)) = pose.filter(|(_, shape)| shape[..2] != turn.shape[..2]) {
                let problem =
                    format!("has in row {row} poses of shape {shape:?} for a range image of shape {:?}", turn.shape);
                return Err(self.bad("lidar_pose", problem));
            }
            let poses = pose.zip(poses.as_ref()).zip(pose_lengths.as_ref());
            let poses = poses.map(|(((row, _), (path, _)), lengths)| (path.clone(), *row, Arc::clone(lengths)));
            let world_from_sensor = world_from_vehicle.after(&laser.vehicle_from_laser);
            let (lengths, laser) = (Arc::clone(&all), laser.clone());
            let image = RangeImage { row, lengths, shape: turn.shape, laser, poses, world_from_vehicle };
            sweeps.push(ParsedSweep {
                path: path.clone(),
                format: PointFormat::RangeImage(Box::new(image)),
                world_from_sensor,
                turn: None,
                images: taken.get(&turn.frame).cloned().unwrap_or_default(),
            });
        }
        if !sweeps.is_empty() && sweeps.iter().all(|sweep| sweep.images.is_empty()) {
            let problem = "has no range image of a frame with a photo, so that its timestamps cannot be right";
            return Err(self.bad("lidar", problem.into()));
        }
        Ok(sweeps)
    }

    /// The vehicle's pose of a frame that a component names.
    fn vehicle<'v>(
        &self,
        component: &str,
        vehicles: &'v BTreeMap<i64, Rigid>,
        frame: i64,
    ) -> Result<&'v Rigid, BadInput> {
        let lacks = || self.bad(component, format!("has a row of the time {frame}, at which vehicle_pose has none"));
        vehicles.get(&frame).ok_or_else(lacks)
    }
}
