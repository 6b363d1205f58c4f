//! Cameras and photos: `camera_calibration` and `camera_image`.

use std::fs;
use std::path::Path;

use city::sense::Shot;
use city::sense::rig::Mount;
use image::codecs::jpeg::JpegEncoder;
use rayon::prelude::*;
use scene::Rigid;
use scene::parquet::Cells;
use scene::waymo::{CAMERAS, camera_from_opencv};
use store::file::SaveError;

use super::super::nuscenes::vehicle_from_camera;
use super::super::settings::SynthError;
use super::component::{Columns, Component, keys, matrix};
use super::segment::{Frame, START_SECONDS, Segment};

/// Photos of a group of rows: what is in memory at a time.
const GROUP: usize = 64;
const QUALITY: u8 = 95;
/// `RollingShutterReadOutDirection.GLOBAL_SHUTTER`.
const GLOBAL_SHUTTER: i8 = 5;

/// A camera of the data set.
pub(super) struct Camera {
    number: i8,
    mount: Mount,
}

/// The cameras that the data set has a number for.
pub(super) fn cameras(mounts: &[Mount]) -> Vec<Camera> {
    let camera = |mount: &Mount| {
        let name = match mount.name.as_str() {
            "left" | "right" => format!("SIDE_{}", mount.name.to_uppercase()),
            other => other.replace('-', "_").to_uppercase(),
        };
        let number = CAMERAS.iter().position(|other| *other == name)? as i8 + 1;
        Some(Camera { number, mount: mount.clone() })
    };
    mounts.iter().filter_map(camera).collect()
}

/// Writes both tables, unless there is no photo; returns whether there is one.
pub(super) fn write<'a>(segment: &Segment<'a>, cameras: &[Camera]) -> Result<bool, SynthError> {
    let taken = segment.frames.iter().flat_map(|frame| frame.sample.photos.iter().map(move |shot| (frame, *shot)));
    let row = |(frame, shot): (&Frame, &'a Shot)| {
        let name = shot.sensor.strip_prefix("street-")?;
        Some((frame.time(), cameras.iter().find(|camera| camera.mount.name == name)?, shot))
    };
    let rows: Vec<(i64, &Camera, &Shot)> = taken.filter_map(row).collect();
    let Some((_, _, first)) = rows.first() else { return Ok(false) };
    write_calibration(segment, cameras, first)?;
    let mut table = Component::create(segment.out, "camera_image", &segment.name)?;
    for rows in rows.chunks(GROUP) {
        table.group(group(segment, rows)?)?;
    }
    table.finish()?;
    Ok(true)
}

fn write_calibration(segment: &Segment, cameras: &[Camera], shot: &Shot) -> Result<(), SynthError> {
    let (k, rows) = (shot.reported.pinhole, cameras.len());
    let all = |value: f64| Cells::Double(vec![value; rows]);
    let mounted = |camera: &Camera| matrix(&vehicle_from_camera(&camera.mount).after(&camera_from_opencv().inverse()));
    let columns = vec![
        ("key.segment_context_name", Cells::Text(vec![segment.name.clone(); rows])),
        ("key.camera_name", Cells::Int8(cameras.iter().map(|camera| camera.number).collect())),
        ("[CameraCalibrationComponent].intrinsic.f_u", all(k.fx)),
        ("[CameraCalibrationComponent].intrinsic.f_v", all(k.fy)),
        ("[CameraCalibrationComponent].intrinsic.c_u", all(k.cx)),
        ("[CameraCalibrationComponent].intrinsic.c_v", all(k.cy)),
        ("[CameraCalibrationComponent].intrinsic.k1", all(0.0)),
        ("[CameraCalibrationComponent].intrinsic.k2", all(0.0)),
        ("[CameraCalibrationComponent].intrinsic.p1", all(0.0)),
        ("[CameraCalibrationComponent].intrinsic.p2", all(0.0)),
        ("[CameraCalibrationComponent].intrinsic.k3", all(0.0)),
        ("[CameraCalibrationComponent].extrinsic.transform", Cells::Doubles(cameras.iter().map(mounted).collect())),
        ("[CameraCalibrationComponent].width", Cells::Int32(vec![k.width as i32; rows])),
        ("[CameraCalibrationComponent].height", Cells::Int32(vec![k.height as i32; rows])),
        ("[CameraCalibrationComponent].rolling_shutter_direction", Cells::Int8(vec![GLOBAL_SHUTTER; rows])),
    ];
    Component::write(segment.out, "camera_calibration", &segment.name, columns)
}

fn group(segment: &Segment, rows: &[(i64, &Camera, &Shot)]) -> Result<Columns, SynthError> {
    let photos: Vec<_> = rows.par_iter().map(|(_, _, shot)| jpeg(segment.out, shot)).collect();
    let photos = photos.into_iter().collect::<Result<Vec<_>, _>>()?;
    let vehicle = |&(_, camera, shot): &(i64, &Camera, &Shot)| -> Vec<f64> {
        let world_from_camera: Rigid = shot.reported.camera_from_world.inverse();
        matrix(&world_from_camera.after(&vehicle_from_camera(&camera.mount).inverse()))
    };
    let doubles = |value: &dyn Fn(&Shot) -> f64| Cells::Double(rows.iter().map(|(.., shot)| value(shot)).collect());
    let floats =
        |value: &dyn Fn(&Shot) -> f64| Cells::Float(rows.iter().map(|(.., shot)| value(shot) as f32).collect());
    let seconds = |shot: &Shot| START_SECONDS as f64 + shot.seconds;
    let mut columns = keys(&segment.name, rows.iter().map(|(time, ..)| *time));
    columns.extend([
        ("key.camera_name", Cells::Int8(rows.iter().map(|(_, camera, _)| camera.number).collect())),
        ("[CameraImageComponent].image", Cells::Bytes(photos)),
        ("[CameraImageComponent].pose.transform", Cells::Doubles(rows.iter().map(vehicle).collect())),
        ("[CameraImageComponent].velocity.linear_velocity.x", floats(&|shot| shot.motion.velocity.x)),
        ("[CameraImageComponent].velocity.linear_velocity.y", floats(&|shot| shot.motion.velocity.y)),
        ("[CameraImageComponent].velocity.linear_velocity.z", floats(&|shot| shot.motion.velocity.z)),
        ("[CameraImageComponent].velocity.angular_velocity.x", doubles(&|shot| shot.motion.spin.x)),
        ("[CameraImageComponent].velocity.angular_velocity.y", doubles(&|shot| shot.motion.spin.y)),
        ("[CameraImageComponent].velocity.angular_velocity.z", doubles(&|shot| shot.motion.spin.z)),
        ("[CameraImageComponent].pose_timestamp", doubles(&seconds)),
        ("[CameraImageComponent].rolling_shutter_params.shutter", doubles(&|_| 0.0)),
        ("[CameraImageComponent].rolling_shutter_params.camera_trigger_time", doubles(&seconds)),
        ("[CameraImageComponent].rolling_shutter_params.camera_readout_done_time", doubles(&seconds)),
    ]);
    Ok(columns)
}

/// The photo of a shot as JPEG.
fn jpeg(out: &Path, shot: &Shot) -> Result<Vec<u8>, SaveError> {
    let from = out.join(format!("images/{}.png", shot.name));
    let png = fs::read(&from).map_err(|e| SaveError::new(&from, &e))?;
    let photo = image::load_from_memory(&png).map_err(|e| SaveError::new(&from, &e))?.into_rgb8();
    let mut bytes = Vec::new();
    photo
        .write_with_encoder(JpegEncoder::new_with_quality(&mut bytes, QUALITY))
        .map_err(|e| SaveError::new(&from, &e))?;
    Ok(bytes)
}
