//! Reads and writes the `transforms.json` of nerfstudio and instant-ngp: posed images of perspective and fisheye
//! cameras.
//!
//! A frame's `transform_matrix` is world_from_camera in OpenGL axes (x right, y up, z backward); plat uses OpenCV
//! camera_from_world. `applied_transform` is ignored: nerfstudio has applied it to both the frames and the points of
//! `ply_file_path`. Intrinsics are at the top level, in a frame, or both (the frame's take precedence).
//! File paths are not checked here: the caller that opens them confines them to the capture.
//!
//! Sources: nerfstudio, "Data conventions"; instant-ngp, `nerf_loader`.

use std::f64::consts::PI;

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::camera::{CameraModel, Rigid};
use crate::error::CodecError;

/// Largest cosine between two columns of a rotation.
const MAX_COSINE: f64 = 1e-3;

/// A `transforms.json`.
#[derive(Debug, Clone, PartialEq)]
pub struct Transforms {
    /// Frames in the file's order; at least one.
    pub frames: Vec<Frame>,
    /// A point cloud in the same world as the frames.
    pub ply_file_path: Option<String>,
}

/// One posed image.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Path of the image as in the file: relative to the file's folder, sometimes without extension.
    pub file_path: String,
    /// Path of the mask as in the file.
    pub mask_path: Option<String>,
    /// Path of the depth map as in the file.
    pub depth_file_path: Option<String>,
    /// Intrinsics as far as the file has them.
    pub intrinsics: Intrinsics,
    /// Pose: OpenCV camera axes from world axes.
    pub camera_from_world: Rigid,
}

/// Intrinsics of a frame as far as the file has them. [`Intrinsics::model`] completes them from the image's size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Width and height in pixels, if the file has them. All values in pixels refer to an image of this size.
    pub size: Option<(u32, u32)>,
    /// Horizontal and vertical focal length. At least one is given; pixels are square if the other is missing.
    pub focal: [Option<Focal>; 2],
    /// Principal point in pixels; missing coordinates are the image's centre.
    pub centre: [Option<f64>; 2],
    /// Coefficients in the order of [`CameraModel::distortion`].
    pub distortion: [f64; 8],
    /// True for [`CameraModel::OpenCvFisheye`], false for perspective lenses.
    pub fisheye: bool,
}

/// A focal length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Focal {
    /// In pixels (`fl_x`, `fl_y`).
    Pixels(f64),
    /// The full field of view in radians (`camera_angle_x`, `camera_angle_y`).
    Angle(f64),
}

impl Focal {
    fn pixels(self, side: u32) -> f64 {
        match self {
            Self::Pixels(focal) => focal,
            Self::Angle(angle) => 0.5 * f64::from(side) / (0.5 * angle).tan(),
        }
    }
}

impl Intrinsics {
    /// The intrinsics of a camera model.
    pub fn from_model(model: &CameraModel, size: Option<(u32, u32)>) -> Self {
        let [fx, fy, cx, cy] = model.focal_and_centre();
        Self {
            size,
            focal: [Some(Focal::Pixels(fx)), Some(Focal::Pixels(fy))],
            centre: [Some(cx), Some(cy)],
            distortion: model.distortion(),
            fisheye: model.is_fisheye(),
        }
    }

    /// The camera model for an image of this width and height in pixels, which should equal [`Intrinsics::size`] if
    /// that is given: nothing is scaled.
    pub fn model(&self, width: u32, height: u32) -> CameraModel {
        let [fx, fy] = [self.focal[0].map(|f| f.pixels(width)), self.focal[1].map(|f| f.pixels(height))];
        // `read` refuses files without any focal length; intrinsics built by hand get NaN.
        let (fx, fy) = (fx.or(fy).unwrap_or(f64::NAN), fy.or(fx).unwrap_or(f64::NAN));
        let cx = self.centre[0].unwrap_or(0.5 * f64::from(width));
        let cy = self.centre[1].unwrap_or(0.5 * f64::from(height));
        match self.distortion {
            [k1, k2, k3, k4, ..] if self.fisheye => CameraModel::OpenCvFisheye([fx, fy, cx, cy, k1, k2, k3, k4]),
            [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0] => CameraModel::Pinhole([fx, fy, cx, cy]),
            [k1, k2, p1, p2, 0.0, 0.0, 0.0, 0.0] => CameraModel::OpenCv([fx, fy, cx, cy, k1, k2, p1, p2]),
            [k1, k2, p1, p2, k3, k4, k5, k6] => {
                CameraModel::FullOpenCv([fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6])
            }
        }
    }
}

/// Decodes a `transforms.json`.
///
/// # Errors
/// Malformed JSON, no frames, an unsupported lens model, intrinsics without a focal length or out of range, or a
/// `transform_matrix` whose 3×3 part is not a rotation times a scale. The scale is dropped.
pub fn read(bytes: &[u8]) -> Result<Transforms, CodecError> {
    let file: File = serde_json::from_slice(bytes).map_err(|e| CodecError::new(e.to_string()))?;
    if file.frames.is_empty() {
        return Err(CodecError::new("has no frames"));
    }
    let shared = file.lens();
    let mut frames = Vec::with_capacity(file.frames.len());
    for frame in file.frames {
        let named = |problem: String| {
            let name: String = frame.file_path.chars().take(120).collect();
            CodecError::new(format!("frame {name:?}: {problem}"))
        };
        let intrinsics = frame.lens().or(&shared).resolve().map_err(named)?;
        let camera_from_world = pose(&frame.transform_matrix).map_err(named)?;
        let FileFrame { file_path, mask_path, depth_file_path, .. } = frame;
        frames.push(Frame { file_path, mask_path, depth_file_path, intrinsics, camera_from_world });
    }
    Ok(Transforms { frames, ply_file_path: file.ply_file_path })
}

/// Encodes a `transforms.json` with all intrinsics in the frames. Numbers that are not finite become `null`, which
/// [`read`] refuses or treats as missing.
pub fn write(transforms: &Transforms) -> Vec<u8> {
    let frames = transforms.frames.iter().map(|frame| {
        let paths = (frame.file_path.clone(), frame.mask_path.clone(), frame.depth_file_path.clone());
        FileFrame::new(paths, Lens::of(&frame.intrinsics), matrix(&frame.camera_from_world))
    });
    let file = File::new(Lens::default(), transforms.ply_file_path.clone(), frames.collect());
    serde_json::to_vec_pretty(&file).expect("text and numbers always serialise")
}

/// OpenCV camera_from_world from the rows of an OpenGL world_from_camera.
fn pose(rows: &[[f64; 4]]) -> Result<Rigid, String> {
    let (rows, last) = match rows {
        [a, b, c] => ([a, b, c], &[0.0, 0.0, 0.0, 1.0]),
        [a, b, c, last] => ([a, b, c], last),
        _ => return Err(format!("transform_matrix has {} rows, not 4", rows.len())),
    };
    if last.iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(a, b)| (a - b).abs() > 1e-6) {
        return Err("transform_matrix does not end in 0 0 0 1".into());
    }
    let column = |k: usize| DVec3::new(rows[0][k], rows[1][k], rows[2][k]);
    let [Some(x), Some(y), Some(z)] = [column(0), column(1), column(2)].map(DVec3::try_normalize) else {
        return Err("transform_matrix has an axis of length zero".into());
    };
    let cosine = x.dot(y).abs().max(y.dot(z).abs()).max(z.dot(x).abs());
    if cosine > MAX_COSINE || x.cross(y).dot(z) < 0.0 {
        return Err("transform_matrix is not a rotation: its axes are not orthogonal or not right-handed".into());
    }
    let rotation = DQuat::from_mat3(&DMat3::from_cols(x, -y, -z)).normalize();
    let camera_from_world = Rigid { rotation, translation: column(3) }.inverse();
    if !camera_from_world.is_sane() {
        return Err("transform_matrix has numbers that are not finite".into());
    }
    Ok(camera_from_world)
}

/// Rows of the OpenGL world_from_camera, from an OpenCV camera_from_world.
fn matrix(camera_from_world: &Rigid) -> Vec<[f64; 4]> {
    let world_from_camera = camera_from_world.inverse();
    let axes = DMat3::from_quat(world_from_camera.rotation);
    let (x, y, z, centre) = (axes.x_axis, -axes.y_axis, -axes.z_axis, world_from_camera.translation);
    let mut rows: Vec<_> = (0..3).map(|k| [x[k], y[k], z[k], centre[k]]).collect();
    rows.push([0.0, 0.0, 0.0, 1.0]);
    rows
}

/// Defines the JSON objects of the file and of its frames, which share the keys of [`Lens`]. `serde(flatten)` would
/// buffer every unknown value, at many times its size in the file.
macro_rules! lens {
    ($($field:ident: $type:ty),* $(,)?) => {
        /// The file as JSON.
        #[derive(Serialize, Deserialize)]
        struct File {
            $(#[serde(skip_serializing_if = "Option::is_none")] $field: Option<$type>,)*
            #[serde(skip_serializing_if = "Option::is_none")]
            ply_file_path: Option<String>,
            frames: Vec<FileFrame>,
        }

        #[derive(Serialize, Deserialize)]
        struct FileFrame {
            file_path: String,
            #[serde(skip_serializing_if = "Option::is_none")]
            mask_path: Option<String>,
            #[serde(skip_serializing_if = "Option::is_none")]
            depth_file_path: Option<String>,
            $(#[serde(skip_serializing_if = "Option::is_none")] $field: Option<$type>,)*
            transform_matrix: Vec<[f64; 4]>,
        }

        /// The keys that a frame shares with the top of the file.
        #[derive(Default, Clone)]
        struct Lens {
            $($field: Option<$type>,)*
        }

        impl File {
            fn new(lens: Lens, ply_file_path: Option<String>, frames: Vec<FileFrame>) -> Self {
                Self { $($field: lens.$field,)* ply_file_path, frames }
            }

            fn lens(&self) -> Lens {
                Lens { $($field: self.$field.clone(),)* }
            }
        }

        impl FileFrame {
            fn new(
                (file_path, mask_path, depth_file_path): (String, Option<String>, Option<String>),
                lens: Lens,
                transform_matrix: Vec<[f64; 4]>,
            ) -> Self {
                Self { file_path, mask_path, depth_file_path, $($field: lens.$field,)* transform_matrix }
            }

            fn lens(&self) -> Lens {
                Lens { $($field: self.$field.clone(),)* }
            }
        }

        impl Lens {
            /// These keys, completed from `shared`.
            fn or(&self, shared: &Self) -> Self {
                let mut both = Self { $($field: self.$field.clone().or_else(|| shared.$field.clone()),)* };
                // A frame's angle takes precedence over the file's focal length, as either determines it.
                if self.fl_x.is_none() && self.camera_angle_x.is_some() {
                    both.fl_x = None;
                }
                if self.fl_y.is_none() && self.camera_angle_y.is_some() {
                    both.fl_y = None;
                }
                both
            }
        }
    };
}

lens! {
    camera_model: String, is_fisheye: bool, w: f64, h: f64, fl_x: f64, fl_y: f64, camera_angle_x: f64,
    camera_angle_y: f64, cx: f64, cy: f64, k1: f64, k2: f64, p1: f64, p2: f64, k3: f64, k4: f64, k5: f64, k6: f64,
}

impl Lens {
    fn of(intrinsics: &Intrinsics) -> Self {
        let pixels = |focal| if let Some(Focal::Pixels(f)) = focal { Some(f) } else { None };
        let angle = |focal| if let Some(Focal::Angle(a)) = focal { Some(a) } else { None };
        let [fx, fy] = intrinsics.focal;
        let mut distortion = intrinsics.distortion;
        let model = match distortion {
            [k1, k2, k3, k4, ..] if intrinsics.fisheye => {
                distortion = [k1, k2, 0.0, 0.0, k3, k4, 0.0, 0.0];
                "OPENCV_FISHEYE"
            }
            [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0] => "PINHOLE",
            [.., 0.0, 0.0, 0.0] => "OPENCV",
            _ => "FULL_OPENCV",
        };
        let [k1, k2, p1, p2, k3, k4, k5, k6] = distortion.map(|k| (k != 0.0).then_some(k));
        Self {
            camera_model: Some(model.into()),
            is_fisheye: None,
            w: intrinsics.size.map(|(w, _)| w.into()),
            h: intrinsics.size.map(|(_, h)| h.into()),
            fl_x: pixels(fx),
            fl_y: pixels(fy),
            camera_angle_x: angle(fx),
            camera_angle_y: angle(fy),
            cx: intrinsics.centre[0],
            cy: intrinsics.centre[1],
            k1,
            k2,
            p1,
            p2,
            k3,
            k4,
            k5,
            k6,
        }
    }

    fn resolve(&self) -> Result<Intrinsics, String> {
        const PERSPECTIVE: [&str; 6] =
            ["PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"];
        let model = self.camera_model.as_deref().unwrap_or("OPENCV");
        // instant-ngp has a flag instead of a model name.
        let fisheye = self.is_fisheye == Some(true) || model == "OPENCV_FISHEYE";
        if !fisheye && !PERSPECTIVE.contains(&model) {
            let model: String = model.chars().take(40).collect();
            return Err(format!("camera model {model:?} is not supported; undistort the images first"));
        }
        let side = |key: &str, value: Option<f64>| match value {
            Some(v) if !(v >= 1.0 && v <= f64::from(u32::MAX) && v.fract() == 0.0) => {
                Err(format!("'{key}' is {v}, not a number of pixels"))
            }
            value => Ok(value.map(|v| v as u32)),
        };
        let size = side("w", self.w)?.zip(side("h", self.h)?);
        let focal = |axis: &str, length: Option<f64>, angle: Option<f64>| match (length, angle) {
            (Some(f), _) if f.is_finite() && f > 0.0 => Ok(Some(Focal::Pixels(f))),
            (Some(f), _) => Err(format!("'fl_{axis}' is {f}, not a focal length")),
            (None, Some(a)) if a > 0.0 && a < PI => Ok(Some(Focal::Angle(a))),
            (None, Some(a)) => Err(format!("'camera_angle_{axis}' is {a}, not between 0 and π")),
            (None, None) => Ok(None),
        };
        let focal = [focal("x", self.fl_x, self.camera_angle_x)?, focal("y", self.fl_y, self.camera_angle_y)?];
        if focal == [None, None] {
            return Err("neither 'fl_x' nor 'camera_angle_x'".into());
        }
        let mut distortion =
            [self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6].map(Option::unwrap_or_default);
        // k4 is the coefficient of r⁸ in nerfstudio and of the denominator in OpenCV. Without a model name it is
        // ambiguous.
        if fisheye {
            let [k1, k2, _, _, k3, k4, ..] = distortion;
            distortion = [k1, k2, k3, k4, 0.0, 0.0, 0.0, 0.0];
        } else if model != "FULL_OPENCV" && distortion[5..].iter().any(|&k| k != 0.0) {
            return Err(
                "'k4' and above are supported only with camera_model FULL_OPENCV; undistort the images first".into()
            );
        }
        let centre = [self.cx, self.cy];
        if !distortion.iter().chain(centre.iter().flatten()).all(|v| v.is_finite()) {
            return Err("intrinsics that are not finite".into());
        }
        Ok(Intrinsics { size, focal, centre, distortion, fisheye })
    }
}

#[cfg(test)]
mod tests;
