//! Reads the components of a segment of the Waymo Open Dataset (Perception, version 2): tables in Parquet that share keys.
//!
//! | component | row | columns used |
//! |---|---|---|
//! | `camera_calibration` | a camera | pinhole with k1, k2, p1, p2, k3; vehicle_from_camera; size |
//! | `camera_image` | a photo | JPEG; world_from_vehicle when it was taken |
//! | `vehicle_pose` | a frame | world_from_vehicle |
//! | `lidar_calibration` | a laser | vehicle_from_laser; inclinations of its beams |
//! | `lidar`, `lidar_pose` | a turn | range image; world_from_vehicle of each of its pixels (the top laser) |
//! | `lidar_box` | an object in a frame | box in the vehicle's axes, class |
//!
//! Vehicle, lasers and cameras have x ahead, y left, z up; transforms are 4 × 4, row by row. A range image is height × width × 4
//! (range in metres, intensity, elongation, no-label zone): its rows are beams, the highest first, its columns go clockwise from
//! the rear. Pixels are counted from the photo's left edge. Photos are as they come from a rolling shutter.
//!
//! Source: `waymo_open_dataset/v2/perception` in github.com/waymo-research/waymo-open-dataset.

use std::collections::BTreeMap;
use std::f64::consts::{FRAC_PI_2, PI};

use glam::{DMat3, DQuat, DVec3, EulerRot};

use crate::camera::{CameraModel, Rigid};
use crate::error::CodecError;
use crate::kitti360::rigid;
use crate::parquet::{Source, Table};

/// The column of a component's photos.
pub const IMAGE: &str = "[CameraImageComponent].image";
/// The column of the range images of `lidar`, first returns.
pub const RANGES: &str = "[LiDARComponent].range_image_return1.values";
/// The column of the poses of `lidar_pose`.
pub const PIXEL_POSES: &str = "[LiDARPoseComponent].range_image_return1.values";

/// Names of the cameras, from number 1 on.
pub const CAMERAS: [&str; 5] = ["FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT"];
/// Names of the classes of boxes, from number 0 on.
pub const CLASSES: [&str; 5] = ["unknown", "vehicle", "pedestrian", "sign", "cyclist"];

/// Bound of a coordinate, metres.
const MAX_METRES: f64 = 1e7;
/// Bound of a box's side, metres.
const MAX_SIDE_METRES: f64 = 1e3;
/// Bound of a time, microseconds.
const MAX_MICROSECONDS: i64 = 1 << 60;
/// Longest side of a photo, pixels.
const MAX_PIXELS: i64 = 65_535;
/// Most numbers of a range image.
const MAX_IMAGE: u64 = 1 << 22;
/// A photo whose own time is farther from its frame's has the time of its frame, microseconds.
const SAME_MICROSECONDS: f64 = 500_000.0;

/// Calibration of a camera.
#[derive(Debug, Clone, PartialEq)]
pub struct WaymoCamera {
    /// The lens, for the photo's pixels.
    pub lens: CameraModel,
    /// Width of a photo, pixels.
    pub width: u32,
    /// Height of a photo, pixels.
    pub height: u32,
    /// Mounting: camera with OpenCV's axes.
    pub vehicle_from_camera: Rigid,
}

/// A row of `camera_image`.
#[derive(Debug, Clone, PartialEq)]
pub struct WaymoPhoto {
    /// Number of the row.
    pub row: u64,
    /// Time of its frame, microseconds.
    pub frame: i64,
    /// When it was taken, microseconds.
    pub microseconds: i64,
    /// Number of its camera.
    pub camera: i64,
    /// The vehicle when it was taken.
    pub world_from_vehicle: Rigid,
}

/// Calibration of a laser.
#[derive(Debug, Clone, PartialEq)]
pub struct WaymoLaser {
    /// Mounting: x ahead, y left, z up.
    pub vehicle_from_laser: Rigid,
    /// Inclinations of the beams in radians, the lowest first; empty if they are spread evenly.
    pub inclinations: Vec<f64>,
    /// The range of inclinations that beams spread evenly cover.
    pub range: [f64; 2],
}

/// A row of `lidar` or `lidar_pose`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WaymoTurn {
    /// Time of its frame, microseconds.
    pub frame: i64,
    /// Number of its laser.
    pub laser: i64,
    /// Height, width and depth of its image; zeros without one.
    pub shape: [u32; 3],
}

impl WaymoTurn {
    /// Number of values of its image.
    pub fn length(&self) -> u32 {
        self.shape.iter().product()
    }
}

/// A row of `lidar_box`.
#[derive(Debug, Clone, PartialEq)]
pub struct WaymoBox {
    /// Time of its frame, microseconds.
    pub frame: i64,
    /// The object.
    pub object: String,
    /// Its class, one of [`CLASSES`].
    pub class: &'static str,
    /// Pose in the vehicle's axes of its frame: x along its length, z up.
    pub vehicle_from_box: Rigid,
    /// Length, width and height, metres.
    pub size: DVec3,
}

/// A return of a laser.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WaymoReturn {
    /// World metres.
    pub place: DVec3,
    /// Distance from the laser, metres.
    pub range: f32,
    /// Intensity as the data set has it, without a unit.
    pub intensity: f32,
}

/// Reads `camera_calibration`: cameras by number.
///
/// # Errors
/// Not such a table, a mounting that is not a rotation or out of range, or intrinsics or a size out of range.
pub fn read_cameras(table: &Table<impl Source>) -> Result<BTreeMap<i64, WaymoCamera>, CodecError> {
    let column = |name: &str| format!("[CameraCalibrationComponent].{name}");
    let numbers = table.integers("key.camera_name")?;
    let mut intrinsics = Vec::new();
    for name in ["f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3"] {
        intrinsics.push(table.numbers(&column(&format!("intrinsic.{name}")))?);
    }
    let mounted = transforms(table, &column("extrinsic.transform"))?;
    let [widths, heights] = [table.integers(&column("width"))?, table.integers(&column("height"))?];
    let mut cameras = BTreeMap::new();
    for (row, number) in numbers.into_iter().enumerate() {
        let values: [f64; 9] = std::array::from_fn(|i| intrinsics[i][row]);
        let [fx, fy, cx, cy, k1, k2, p1, p2, k3] = values;
        let size = [widths[row], heights[row]];
        let is_sane = values.iter().all(|v| v.is_finite() && v.abs() < 1e6) && fx > 0.0 && fy > 0.0;
        if !is_sane || !size.iter().all(|side| (1..=MAX_PIXELS).contains(side)) {
            return Err(CodecError::new(format!("has intrinsics or a size out of range, of camera {number}")));
        }
        let lens = match [k1, k2, p1, p2, k3] {
            [0.0, 0.0, 0.0, 0.0, 0.0] => CameraModel::Pinhole([fx, fy, cx, cy]),
            _ => CameraModel::FullOpenCv([fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]),
        };
        let vehicle_from_camera = mounted[row].after(&camera_from_opencv());
        let [width, height] = size.map(|side| side as u32);
        cameras.insert(number, WaymoCamera { lens, width, height, vehicle_from_camera });
    }
    Ok(cameras)
}

/// Axes of Waymo's cameras (x ahead, y left, z up) from OpenCV's (x right, y down, z ahead).
pub fn camera_from_opencv() -> Rigid {
    let axes = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    Rigid { rotation: DQuat::from_mat3(&axes), translation: DVec3::ZERO }
}

/// Reads `camera_image` without its photos, in the table's order.
///
/// # Errors
/// Not such a table, a time out of range, or a pose that is not a rotation or out of range.
pub fn read_photos(table: &Table<impl Source>) -> Result<Vec<WaymoPhoto>, CodecError> {
    let cameras = table.integers("key.camera_name")?;
    let poses = transforms(table, "[CameraImageComponent].pose.transform")?;
    let own = "[CameraImageComponent].pose_timestamp";
    let own = table.has(own).then(|| table.numbers(own)).transpose()?;
    let photo = |(row, (frame, (camera, world_from_vehicle))): (usize, (i64, (i64, Rigid)))| {
        // Seconds, in the clock of the frames.
        let own = own.as_ref().map(|times| times[row] * 1e6 - frame as f64);
        let delay = own.filter(|delay| delay.abs() < SAME_MICROSECONDS).unwrap_or(0.0);
        WaymoPhoto { row: row as u64, frame, microseconds: frame + delay.round() as i64, camera, world_from_vehicle }
    };
    Ok(frames(table)?.into_iter().zip(cameras.into_iter().zip(poses)).enumerate().map(photo).collect())
}

/// Reads `vehicle_pose`: world_from_vehicle by time of the frame in microseconds.
///
/// # Errors
/// Not such a table, a time out of range, or a pose that is not a rotation or out of range.
pub fn read_vehicle_poses(table: &Table<impl Source>) -> Result<BTreeMap<i64, Rigid>, CodecError> {
    let poses = transforms(table, "[VehiclePoseComponent].world_from_vehicle.transform")?;
    Ok(frames(table)?.into_iter().zip(poses).collect())
}

/// Reads `lidar_calibration`: lasers by number.
///
/// # Errors
/// Not such a table, a mounting that is not a rotation or out of range, or inclinations that are not angles.
pub fn read_lasers(table: &Table<impl Source>) -> Result<BTreeMap<i64, WaymoLaser>, CodecError> {
    let column = |name: &str| format!("[LiDARCalibrationComponent].{name}");
    let numbers = table.integers("key.laser_name")?;
    let mounted = transforms(table, &column("extrinsic.transform"))?;
    let values = table.lists(&column("beam_inclination.values"))?;
    let [lowest, highest] =
        [table.numbers(&column("beam_inclination.min"))?, table.numbers(&column("beam_inclination.max"))?];
    let mut lasers = BTreeMap::new();
    for (row, (number, inclinations)) in numbers.into_iter().zip(values).enumerate() {
        let range = [lowest[row], highest[row]];
        let used = if inclinations.is_empty() { &range[..] } else { &inclinations };
        if !used.iter().all(|angle| angle.abs() <= FRAC_PI_2) {
            return Err(CodecError::new(format!("has inclinations that are not angles, of laser {number}")));
        }
        lasers.insert(number, WaymoLaser { vehicle_from_laser: mounted[row], inclinations, range });
    }
    Ok(lasers)
}

/// Reads `lidar` (4 values a pixel) or `lidar_pose` (6) without the images, in the table's order.
///
/// # Errors
/// Not such a table, a time out of range, or a shape that is not of such an image.
pub fn read_turns(table: &Table<impl Source>, values: &str, depth: u32) -> Result<Vec<WaymoTurn>, CodecError> {
    let lasers = table.integers("key.laser_name")?;
    let shapes = table.lists(&values.replace(".values", ".shape"))?;
    let turn = |(row, (frame, (laser, shape))): (usize, (i64, (i64, Vec<f64>)))| {
        let wrong = || CodecError::new(format!("has in row {row} a shape that is not height × width × {depth}"));
        let shape: [u32; 3] = match shape[..] {
            [] => [0; 3],
            [height, width, d] if d == f64::from(depth) && height >= 1.0 && width >= 1.0 => {
                if height * width * d > MAX_IMAGE as f64 {
                    return Err(wrong());
                }
                [height as u32, width as u32, depth]
            }
            _ => return Err(wrong()),
        };
        Ok(WaymoTurn { frame, laser, shape })
    };
    frames(table)?.into_iter().zip(lasers.into_iter().zip(shapes)).enumerate().map(turn).collect()
}

/// Reads `lidar_box`, in the table's order.
///
/// # Errors
/// Not such a table, a time out of range, a place that is not finite, or a box without extent or over a kilometre long.
pub fn read_boxes(table: &Table<impl Source>) -> Result<Vec<WaymoBox>, CodecError> {
    let column = |name: &str| format!("[LiDARBoxComponent].{name}");
    let objects = table.texts("key.laser_object_id")?;
    let classes = table.integers(&column("type"))?;
    let mut numbers = Vec::new();
    for name in ["center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading"] {
        numbers.push(table.numbers(&column(&format!("box.{name}")))?);
    }
    let mut boxes = Vec::new();
    for (row, (frame, object)) in frames(table)?.into_iter().zip(objects).enumerate() {
        let values: [f64; 7] = std::array::from_fn(|i| numbers[i][row]);
        let [x, y, z, length, width, height, heading] = values;
        let is_sane = values.iter().all(|v| v.is_finite() && v.abs() < MAX_METRES);
        if !is_sane || ![length, width, height].iter().all(|side| *side > 0.0 && *side < MAX_SIDE_METRES) {
            return Err(CodecError::new(format!("has in row {row} a box without extent, or out of range")));
        }
        let class = usize::try_from(classes[row]).ok().and_then(|class| CLASSES.get(class)).unwrap_or(&CLASSES[0]);
        let rotation = DQuat::from_rotation_z(heading);
        let vehicle_from_box = Rigid { rotation, translation: DVec3::new(x, y, z) };
        boxes.push(WaymoBox { frame, object, class, vehicle_from_box, size: DVec3::new(length, width, height) });
    }
    Ok(boxes)
}

/// The returns of a range image: `ranges` has four values a pixel, `poses`, if there are any, six: roll, pitch, yaw in radians
/// and the place in metres of the vehicle when it measured the pixel. Without them the vehicle stands at `world_from_vehicle`.
///
/// # Errors
/// Another number of beams than the laser has, of values than the shape says, or a pose that is not finite.
pub fn returns(
    ranges: &[f32],
    [height, width, _]: [u32; 3],
    laser: &WaymoLaser,
    poses: Option<&[f32]>,
    world_from_vehicle: &Rigid,
) -> Result<Vec<WaymoReturn>, CodecError> {
    let beams = laser.inclinations.len();
    if beams > 0 && beams != height as usize {
        return Err(CodecError::new(format!("has a range image of {height} rows, and its laser has {beams} beams")));
    }
    let pixels = height as usize * width as usize;
    if ranges.len() != 4 * pixels || poses.is_some_and(|poses| poses.len() != 6 * pixels) {
        return Err(CodecError::new("has a range image or poses of another size than its shape says"));
    }
    // The turn of the mounting is taken out of the columns, which are counted from the vehicle's rear.
    let ahead = laser.vehicle_from_laser.rotation * DVec3::X;
    let mounted = ahead.y.atan2(ahead.x);
    let mut returns = Vec::new();
    for (pixel, values) in ranges.chunks_exact(4).enumerate() {
        let &[range, intensity, ..] = values else { continue };
        if !range.is_finite() || range <= 0.0 {
            continue;
        }
        let (row, column) = (pixel / width as usize, pixel % width as usize);
        let inclination = laser.inclination(row, height as usize);
        let azimuth = PI - 2.0 * PI * (column as f64 + 0.5) / f64::from(width) - mounted;
        let direction =
            DVec3::new(azimuth.cos() * inclination.cos(), azimuth.sin() * inclination.cos(), inclination.sin());
        let point = laser.vehicle_from_laser.apply(direction * f64::from(range));
        let place = match poses.map(|poses| &poses[6 * pixel..6 * pixel + 6]) {
            Some(&[roll, pitch, yaw, x, y, z]) => {
                let rotation = DQuat::from_euler(EulerRot::ZYX, yaw.into(), pitch.into(), roll.into());
                rotation * point + DVec3::new(x.into(), y.into(), z.into())
            }
            _ => world_from_vehicle.apply(point),
        };
        if !place.is_finite() {
            return Err(CodecError::new(format!("has in a range image a pose that is not finite, of pixel {pixel}")));
        }
        returns.push(WaymoReturn { place, range, intensity });
    }
    Ok(returns)
}

impl WaymoLaser {
    /// The inclination of a row of its images, which have this many; radians.
    fn inclination(&self, row: usize, rows: usize) -> f64 {
        let from_below = rows - 1 - row;
        let [lowest, highest] = self.range;
        let even = lowest + (highest - lowest) * (from_below as f64 + 0.5) / rows as f64;
        self.inclinations.get(from_below).copied().unwrap_or(even)
    }
}

/// Times of the rows' frames, microseconds.
fn frames(table: &Table<impl Source>) -> Result<Vec<i64>, CodecError> {
    let frames = table.integers("key.frame_timestamp_micros")?;
    match frames.iter().find(|time| time.unsigned_abs() > MAX_MICROSECONDS as u64) {
        Some(_) => Err(CodecError::new("has a timestamp out of range")),
        None => Ok(frames),
    }
}

/// A column of transforms.
fn transforms(table: &Table<impl Source>, column: &str) -> Result<Vec<Rigid>, CodecError> {
    let transform = |(row, values): (usize, Vec<f64>)| {
        let rows = values.first_chunk::<12>().filter(|_| values.get(12..) == Some(&[0.0, 0.0, 0.0, 1.0]));
        let pose = rows.and_then(rigid).filter(|pose| pose.translation.abs().max_element() <= MAX_METRES);
        let wrong = || CodecError::new(format!("has in row {row} of {column} no rotation, or one out of range"));
        pose.ok_or_else(wrong)
    };
    table.lists(column)?.into_iter().enumerate().map(transform).collect()
}
