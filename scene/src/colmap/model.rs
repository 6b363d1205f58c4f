//! The types of a COLMAP model, and their validation, which the binary and the text reader share.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};

use crate::camera::{CameraModel, Rigid};
use crate::error::CodecError;

/// A camera: image size and lens model.
#[derive(Debug, Clone, PartialEq)]
pub struct ColmapCamera {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Lens model with its parameters.
    pub model: CameraModel,
}

/// A registered image.
#[derive(Debug, Clone, PartialEq)]
pub struct ColmapImage {
    /// COLMAP image id.
    pub id: u32,
    /// Path below the image folder.
    pub name: String,
    /// Id of its camera.
    pub camera_id: u32,
    /// Pose: OpenCV camera axes from world axes.
    pub camera_from_world: Rigid,
}

/// Sparse points as columns.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ColmapPoints {
    /// COLMAP point ids.
    pub ids: Vec<u64>,
    /// World positions.
    pub positions: Vec<DVec3>,
    /// sRGB colours.
    pub colours: Vec<[u8; 3]>,
    /// Offsets into `track_images`: point `i` was observed in `track_images[track_start[i] .. track_start[i + 1]]`. One
    /// longer than `ids`, or empty without points.
    pub track_start: Vec<u32>,
    /// COLMAP image ids of all tracks.
    pub track_images: Vec<u32>,
}

/// A sparse model.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Reconstruction {
    /// By camera id.
    pub cameras: BTreeMap<u32, ColmapCamera>,
    /// In file order.
    pub images: Vec<ColmapImage>,
    /// Sparse points.
    pub points: ColmapPoints,
}

impl ColmapPoints {
    /// The number of points.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// True without points.
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    /// Ids of the images in which point `i` was observed.
    pub fn track(&self, i: usize) -> &[u32] {
        &self.track_images[self.track_start[i] as usize..self.track_start[i + 1] as usize]
    }

    pub(super) fn push(
        &mut self,
        id: u64,
        position: DVec3,
        colour: [u8; 3],
        track: impl Iterator<Item = u32>,
    ) -> Result<(), CodecError> {
        if !position.is_finite() {
            return Err(CodecError::new(format!("point {id} has a position that is not finite")));
        }
        if self.track_start.is_empty() {
            self.track_start.push(0);
        }
        self.ids.push(id);
        self.positions.push(position);
        self.colours.push(colour);
        self.track_images.extend(track);
        let end = u32::try_from(self.track_images.len());
        self.track_start.push(end.map_err(|_| CodecError::new("tracks have over four billion entries"))?);
        Ok(())
    }
}

/// Names of COLMAP's camera models by id (`sensor/models.h`).
pub(super) const MODELS: [&str; 12] = [
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
];

/// Number of parameters of a supported camera model.
pub(super) fn parameter_count(model: &str, camera: u32) -> Result<usize, CodecError> {
    match model {
        "SIMPLE_PINHOLE" => Ok(3),
        "PINHOLE" | "SIMPLE_RADIAL" => Ok(4),
        "RADIAL" => Ok(5),
        "SIMPLE_RADIAL_FISHEYE" => Ok(4),
        "RADIAL_FISHEYE" => Ok(5),
        "OPENCV" | "OPENCV_FISHEYE" => Ok(8),
        "FULL_OPENCV" => Ok(12),
        other => Err(CodecError::new(format!(
            "camera {camera} has lens model {}, which is not supported: undistort with `colmap image_undistorter` first",
            other.escape_debug().take(40).collect::<String>()
        ))),
    }
}

/// A camera from a model name and its parameters.
pub(super) fn camera(
    id: u32,
    model: &str,
    width: u64,
    height: u64,
    parameters: &[f64],
) -> Result<ColmapCamera, CodecError> {
    fn exactly<const N: usize>(parameters: &[f64]) -> Option<[f64; N]> {
        parameters.try_into().ok()
    }
    let wrong = |what: &str| CodecError::new(format!("camera {id} {what}"));
    if parameters.len() != parameter_count(model, id)? {
        return Err(wrong("has the wrong number of parameters for its lens model"));
    }
    let lens = match model {
        "SIMPLE_PINHOLE" => exactly(parameters).map(CameraModel::SimplePinhole),
        "PINHOLE" => exactly(parameters).map(CameraModel::Pinhole),
        "SIMPLE_RADIAL" => exactly(parameters).map(CameraModel::SimpleRadial),
        "RADIAL" => exactly(parameters).map(CameraModel::Radial),
        "OPENCV" => exactly(parameters).map(CameraModel::OpenCv),
        "OPENCV_FISHEYE" => exactly(parameters).map(CameraModel::OpenCvFisheye),
        "SIMPLE_RADIAL_FISHEYE" => {
            exactly(parameters).map(|[f, cx, cy, k]| CameraModel::OpenCvFisheye([f, f, cx, cy, k, 0.0, 0.0, 0.0]))
        }
        "RADIAL_FISHEYE" => {
            exactly(parameters).map(|[f, cx, cy, k1, k2]| CameraModel::OpenCvFisheye([f, f, cx, cy, k1, k2, 0.0, 0.0]))
        }
        _ => exactly(parameters).map(CameraModel::FullOpenCv),
    };
    let lens = lens.ok_or_else(|| wrong("has the wrong number of parameters for its lens model"))?;
    if !parameters.iter().all(|v| v.is_finite()) || lens.focal_and_centre()[..2].iter().any(|&f| f <= 0.0) {
        return Err(wrong("has parameters that are not finite, or a focal length that is not positive"));
    }
    let side = |pixels: u64| u32::try_from(pixels).ok().filter(|&pixels| pixels > 0);
    match (side(width), side(height)) {
        (Some(width), Some(height)) => Ok(ColmapCamera { width, height, model: lens }),
        _ => Err(wrong(&format!("has {width}×{height} pixels"))),
    }
}

/// Inserts a camera, refusing a second one of the same id.
pub(super) fn insert_camera(
    cameras: &mut BTreeMap<u32, ColmapCamera>,
    id: u32,
    camera: ColmapCamera,
) -> Result<(), CodecError> {
    match cameras.insert(id, camera) {
        Some(_) => Err(CodecError::new(format!("camera {id} is listed twice"))),
        None => Ok(()),
    }
}

/// An image from COLMAP's pose: qw, qx, qy, qz, tx, ty, tz.
pub(super) fn image(id: u32, pose: [f64; 7], camera_id: u32, name: &str) -> Result<ColmapImage, CodecError> {
    let [w, x, y, z, tx, ty, tz] = pose;
    let rotation = DQuat::from_xyzw(x, y, z, w);
    let translation = DVec3::new(tx, ty, tz);
    let length = rotation.length();
    let wrong =
        |what| CodecError::new(format!("image {id} ('{}') {what}", name.escape_debug().take(120).collect::<String>()));
    if name.is_empty() {
        return Err(CodecError::new(format!("image {id} has no name")));
    }
    if !translation.is_finite() || !length.is_finite() {
        return Err(wrong("has a pose that is not finite"));
    }
    if length < 1e-6 {
        return Err(wrong("has a rotation quaternion of length zero"));
    }
    let rotation = if (length - 1.0).abs() < 1e-15 { rotation } else { rotation / length };
    Ok(ColmapImage { id, name: name.to_string(), camera_id, camera_from_world: Rigid { rotation, translation } })
}

/// Refuses two images of one id.
pub(super) fn check_unique_ids(images: Vec<ColmapImage>) -> Result<Vec<ColmapImage>, CodecError> {
    let mut ids: Vec<u32> = images.iter().map(|image| image.id).collect();
    ids.sort_unstable();
    match ids.windows(2).find(|pair| pair[0] == pair[1]) {
        Some(pair) => Err(CodecError::new(format!("image {} is listed twice", pair[0]))),
        None => Ok(images),
    }
}
