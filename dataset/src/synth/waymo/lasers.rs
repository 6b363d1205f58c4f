//! The lidar: `lidar_calibration`, `lidar` and `lidar_pose`, a range image for each sweep. The car's lidar is the top one.
//!
//! The capture's own sweeps hold each point in the sensor's axes when it was fired, so a point tells the row and the column of its
//! pixel, and the column tells when that was.

use std::f64::consts::{PI, TAU};
use std::fs;

use city::sense::Motion;
use city::sense::lidar::Lidar;
use city::sense::rig::sensor_pose_at;
use glam::{DQuat, EulerRot, Vec3};
use scene::Rigid;
use scene::parquet::Cells;
use store::file::SaveError;

use super::super::settings::SynthError;
use super::component::{Component, keys, matrix};
use super::segment::Segment;

/// `LaserName.TOP`.
const TOP: i8 = 1;
/// Sweeps of a group of rows: what is in memory at a time.
const GROUP: usize = 64;
/// Bytes of a point: x, y, z and intensity.
const POINT_BYTES: usize = 16;

/// Writes the three tables, if there are sweeps.
pub(super) fn write(segment: &Segment) -> Result<(), SynthError> {
    let turned: Vec<_> = segment.frames.iter().filter(|frame| frame.sample.turn.is_some()).collect();
    if turned.is_empty() {
        return Ok(());
    }
    let lidar = Lidar::default();
    let [height, width] = [lidar.channels as usize, lidar.columns() as usize];
    let mounted = Rigid {
        rotation: DQuat::from_rotation_z(lidar.mount.yaw_degrees.to_radians()),
        translation: lidar.mount.offset,
    };
    write_calibration(segment, &lidar, &mounted)?;
    let mut images = Component::create(segment.out, "lidar", &segment.name)?;
    let mut poses = Component::create(segment.out, "lidar_pose", &segment.name)?;
    for frames in turned.chunks(GROUP) {
        let (mut ranges, mut pixels) = (Vec::new(), Vec::new());
        for frame in frames {
            let station = frame.sample.station;
            let file = segment.out.join(format!("lidar/{}.bin", station.name));
            let points = fs::read(&file).map_err(|e| SaveError::new(&file, &e))?;
            ranges.push(range_image(&lidar, &points));
            let pose = sensor_pose_at(segment.leg, &lidar.mount, station.seconds);
            let (pose, motion) = pose.unwrap_or((Rigid::IDENTITY, Motion::STILL));
            let of_column = |column: usize| {
                let seconds = ((column as f64 + 0.5) / width as f64 - 0.5) / lidar.turns_per_second;
                vehicle(&motion.extrapolate(&pose, seconds).after(&mounted.inverse()))
            };
            let row: Vec<f32> = (0..width).flat_map(of_column).collect();
            pixels.push(row.repeat(height));
        }
        let rows = frames.len();
        let shape = |depth: i32| Cells::Int32s(vec![vec![height as i32, width as i32, depth]; rows]);
        let keys = || {
            let mut keys = keys(&segment.name, frames.iter().map(|frame| frame.time()));
            keys.push(("key.laser_name", Cells::Int8(vec![TOP; rows])));
            keys
        };
        let mut columns = keys();
        columns.extend([
            ("[LiDARComponent].range_image_return1.values", Cells::Floats(ranges)),
            ("[LiDARComponent].range_image_return1.shape", shape(4)),
            ("[LiDARComponent].range_image_return2.values", Cells::Floats(vec![Vec::new(); rows])),
            ("[LiDARComponent].range_image_return2.shape", Cells::Int32s(vec![Vec::new(); rows])),
        ]);
        images.group(columns)?;
        let mut columns = keys();
        columns.extend([
            ("[LiDARPoseComponent].range_image_return1.values", Cells::Floats(pixels)),
            ("[LiDARPoseComponent].range_image_return1.shape", shape(6)),
        ]);
        poses.group(columns)?;
    }
    images.finish()?;
    poses.finish()
}

fn write_calibration(segment: &Segment, lidar: &Lidar, mounted: &Rigid) -> Result<(), SynthError> {
    let [lowest, highest] = [lidar.lowest_degrees, lidar.highest_degrees].map(f64::to_radians);
    let beams = (0..lidar.channels).map(|channel| inclination(lidar, channel)).collect();
    let columns = vec![
        ("key.segment_context_name", Cells::Text(vec![segment.name.clone()])),
        ("key.laser_name", Cells::Int8(vec![TOP])),
        ("[LiDARCalibrationComponent].extrinsic.transform", Cells::Doubles(vec![matrix(mounted)])),
        ("[LiDARCalibrationComponent].beam_inclination.min", Cells::Double(vec![lowest])),
        ("[LiDARCalibrationComponent].beam_inclination.max", Cells::Double(vec![highest])),
        ("[LiDARCalibrationComponent].beam_inclination.values", Cells::Doubles(vec![beams])),
    ];
    Component::write(segment.out, "lidar_calibration", &segment.name, columns)
}

/// Inclination of a beam, counted from the lowest; radians.
fn inclination(lidar: &Lidar, channel: u32) -> f64 {
    let share = f64::from(channel) / f64::from(lidar.channels.max(2) - 1);
    (lidar.lowest_degrees + share * (lidar.highest_degrees - lidar.lowest_degrees)).to_radians()
}

/// The range image of a sweep: -1 where there is no return.
fn range_image(lidar: &Lidar, points: &[u8]) -> Vec<f32> {
    let [height, width] = [lidar.channels, lidar.columns()].map(f64::from);
    let [lowest, highest] = [0, lidar.channels - 1].map(|channel| inclination(lidar, channel));
    let mut image = [-1.0f32, 0.0, 0.0, 0.0].repeat(lidar.channels as usize * lidar.columns() as usize);
    for point in points.chunks_exact(POINT_BYTES) {
        let [x, y, z, intensity] =
            [0, 4, 8, 12].map(|at| f32::from_le_bytes(point[at..at + 4].try_into().expect("four bytes")));
        let place = Vec3::new(x, y, z).as_dvec3();
        let range = place.length();
        let channel = (((place.z / range.max(1e-9)).asin() - lowest) / (highest - lowest) * (height - 1.0)).round();
        let column = ((PI - place.y.atan2(place.x)) / TAU * width - 0.5).round().rem_euclid(width);
        let row = (height - 1.0 - channel).clamp(0.0, height - 1.0);
        let pixel = 4 * (row * width + column) as usize;
        image[pixel..pixel + 2].copy_from_slice(&[range as f32, intensity]);
    }
    image
}

/// Roll, pitch, yaw and place of a vehicle.
fn vehicle(world_from_vehicle: &Rigid) -> [f32; 6] {
    let (yaw, pitch, roll) = world_from_vehicle.rotation.to_euler(EulerRot::ZYX);
    let t = world_from_vehicle.translation;
    [roll, pitch, yaw, t.x, t.y, t.z].map(|value| value as f32)
}
