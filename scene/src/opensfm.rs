//! Reads the `reconstruction.json` of OpenSfM and OpenDroneMap: cameras, shots and points.
//!
//! Image coordinates are in units of the longer side, from the image's centre. A shot's rotation is an axis-angle
//! vector, and its pose is camera_from_world in OpenCV axes. The world is metres east, north and up of `reference_lla`.
//! A file may hold several reconstructions in different worlds; the one with the most shots is read.
//!
//! Sources: OpenSfM, "Reconstruction format" and `opensfm/src/geometry/camera_*.h`.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};
use serde::Deserialize;

use crate::camera::{CameraModel, Rigid};
use crate::capture::GeoOrigin;
use crate::error::CodecError;

/// A lens model and its image size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SfmCamera {
    /// Lens model, in pixels of an image of this size.
    pub model: CameraModel,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
}

/// A posed image.
#[derive(Debug, Clone, PartialEq)]
pub struct Shot {
    /// Name of the image.
    pub name: String,
    /// Its camera.
    pub camera: SfmCamera,
    /// Pose: OpenCV camera axes from world axes.
    pub camera_from_world: Rigid,
}

/// The largest reconstruction of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Sfm {
    /// Shots by name; at least one.
    pub shots: Vec<Shot>,
    /// World positions, in the lexical order of their ids.
    pub positions: Vec<DVec3>,
    /// sRGB colours.
    pub colours: Vec<[u8; 3]>,
    /// Geographic position of the world's origin.
    pub origin: Option<GeoOrigin>,
    /// Names of the shots of the other reconstructions.
    pub others: Vec<String>,
}

#[derive(Deserialize)]
struct File {
    cameras: BTreeMap<String, FileCamera>,
    shots: BTreeMap<String, FileShot>,
    #[serde(default)]
    points: BTreeMap<String, FilePoint>,
    reference_lla: Option<Reference>,
}

#[derive(Deserialize)]
struct Reference {
    latitude: f64,
    longitude: f64,
    altitude: f64,
}

#[derive(Deserialize)]
struct FileShot {
    camera: String,
    rotation: [f64; 3],
    translation: [f64; 3],
}

#[derive(Deserialize)]
struct FilePoint {
    coordinates: [f64; 3],
    #[serde(default = "grey")]
    color: [f64; 3],
}

fn grey() -> [f64; 3] {
    [128.0; 3]
}

#[derive(Deserialize)]
struct FileCamera {
    #[serde(default = "perspective")]
    projection_type: String,
    width: f64,
    height: f64,
    focal: Option<f64>,
    focal_x: Option<f64>,
    focal_y: Option<f64>,
    #[serde(default)]
    c_x: f64,
    #[serde(default)]
    c_y: f64,
    #[serde(default)]
    k1: f64,
    #[serde(default)]
    k2: f64,
    #[serde(default)]
    k3: f64,
    #[serde(default)]
    k4: f64,
    #[serde(default)]
    p1: f64,
    #[serde(default)]
    p2: f64,
}

fn perspective() -> String {
    "perspective".into()
}

/// Reads the reconstruction with the most shots.
///
/// # Errors
/// Malformed JSON, no shots, a shot without its camera, an unsupported projection, numbers out of range.
pub fn read(bytes: &[u8]) -> Result<Sfm, CodecError> {
    let files: Vec<File> =
        serde_json::from_slice(bytes).map_err(|e| CodecError::new(format!("reconstruction.json: {e}")))?;
    let largest = files.iter().enumerate().rev().max_by_key(|(_, file)| file.shots.len()).map(|(i, _)| i);
    let mut others = Vec::new();
    let mut read = None;
    for (i, file) in files.into_iter().enumerate() {
        if Some(i) == largest && !file.shots.is_empty() {
            read = Some(reconstruction(file)?);
        } else {
            others.extend(file.shots.into_keys());
        }
    }
    let (shots, (positions, colours), origin) =
        read.ok_or_else(|| CodecError::new("reconstruction.json has no shots"))?;
    Ok(Sfm { shots, positions, colours, origin, others })
}

type Points = (Vec<DVec3>, Vec<[u8; 3]>);

fn reconstruction(file: File) -> Result<(Vec<Shot>, Points, Option<GeoOrigin>), CodecError> {
    let named = |what: &str, name: &str, problem: &str| {
        CodecError::new(format!("{what} '{}' {problem}", name.escape_debug().take(120).collect::<String>()))
    };
    let mut cameras = BTreeMap::new();
    for (name, camera) in &file.cameras {
        cameras.insert(name.as_str(), lens(camera).map_err(|problem| named("camera", name, &problem))?);
    }
    let mut shots = Vec::with_capacity(file.shots.len());
    for (name, shot) in file.shots {
        let camera = *(cameras.get(shot.camera.as_str()))
            .ok_or_else(|| named("shot", &name, "refers to a camera that does not exist"))?;
        let rotation = DQuat::from_scaled_axis(DVec3::from_array(shot.rotation)).normalize();
        let camera_from_world = Rigid { rotation, translation: DVec3::from_array(shot.translation) };
        if !camera_from_world.is_sane() {
            return Err(named("shot", &name, "has a pose that is not finite"));
        }
        shots.push(Shot { name, camera, camera_from_world });
    }
    let (mut positions, mut colours) = (Vec::with_capacity(file.points.len()), Vec::with_capacity(file.points.len()));
    for (name, point) in &file.points {
        let position = DVec3::from_array(point.coordinates);
        if !position.is_finite() {
            return Err(named("point", name, "has a position that is not finite"));
        }
        positions.push(position);
        colours.push(point.color.map(|channel| channel.round().clamp(0.0, 255.0) as u8));
    }
    let origin = file.reference_lla.map(|at| GeoOrigin {
        latitude_degrees: at.latitude,
        longitude_degrees: at.longitude,
        altitude_metres: at.altitude,
    });
    // OpenSfM writes zeros where it has no GPS.
    let origin = origin.filter(|at| [at.latitude_degrees, at.longitude_degrees, at.altitude_metres] != [0.0; 3]);
    if origin.is_some_and(|at| {
        !(at.latitude_degrees.abs() <= 90.0 && at.longitude_degrees.abs() <= 360.0 && at.altitude_metres.abs() < 1e6)
    }) {
        return Err(CodecError::new("reference_lla has no latitude, longitude and altitude in range"));
    }
    Ok((shots, (positions, colours), origin))
}

fn lens(camera: &FileCamera) -> Result<SfmCamera, String> {
    let side = |pixels: f64| (1.0..=f64::from(u32::MAX)).contains(&pixels).then_some(pixels.round() as u32);
    let (Some(width), Some(height)) = (side(camera.width), side(camera.height)) else {
        return Err(format!("has {}×{} pixels", camera.width, camera.height));
    };
    let unit = f64::from(width.max(height));
    let [Some(fx), Some(fy)] = [camera.focal_x, camera.focal_y].map(|f| f.or(camera.focal)) else {
        return Err("has no focal length".into());
    };
    let (fx, fy) = (fx * unit, fy * unit);
    let (cx, cy) = (camera.c_x * unit + 0.5 * f64::from(width), camera.c_y * unit + 0.5 * f64::from(height));
    let FileCamera { k1, k2, k3, k4, p1, p2, .. } = *camera;
    let model = match camera.projection_type.as_str() {
        "perspective" | "radial" | "simple_radial" => CameraModel::OpenCv([fx, fy, cx, cy, k1, k2, 0.0, 0.0]),
        "brown" => CameraModel::FullOpenCv([fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]),
        "fisheye" => CameraModel::OpenCvFisheye([fx, fy, cx, cy, k1, k2, 0.0, 0.0]),
        "fisheye_opencv" => CameraModel::OpenCvFisheye([fx, fy, cx, cy, k1, k2, k3, k4]),
        other => {
            let other: String = other.escape_debug().take(40).collect();
            return Err(format!("has projection '{other}', which is not supported: undistort the images first"));
        }
    };
    let finite = model.focal_and_centre().iter().chain(&model.distortion()).all(|v| v.is_finite());
    if !finite || fx <= 0.0 || fy <= 0.0 {
        return Err("has parameters that are not finite, or a focal length that is not positive".into());
    }
    Ok(SfmCamera { model, width, height })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec2;

    const FILE: &str = r#"[
      {"cameras": {}, "shots": {}, "points": {}},
      {"cameras": {
         "v2 a": {"projection_type": "perspective", "width": 4000, "height": 3000, "focal": 0.85, "k1": -0.1, "k2": 0.01},
         "v2 b": {"projection_type": "brown", "width": 3000, "height": 4000, "focal_x": 0.8, "focal_y": 0.81,
                  "c_x": 0.01, "c_y": -0.02, "k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.001, "p2": 0.002},
         "v2 c": {"projection_type": "fisheye", "width": 4000, "height": 4000, "focal": 0.3, "k1": 0.1, "k2": 0.2}},
       "shots": {
         "b.jpg": {"camera": "v2 b", "rotation": [0, 0, 1.5707963267948966], "translation": [1, 2, 3], "gps_dop": 5},
         "a.jpg": {"camera": "v2 a", "rotation": [0, 0, 0], "translation": [0, 0, 10], "orientation": 1}},
       "points": {"7": {"color": [255, 0, 12.4], "coordinates": [1, 2, 3]}, "10": {"coordinates": [4, 5, 6]}},
       "reference_lla": {"latitude": 47.5, "longitude": 8.5, "altitude": 400}},
      {"cameras": {}, "shots": {"z.jpg": {"camera": "", "rotation": [0, 0, 0], "translation": [0, 0, 0]}}}]"#;

    #[test]
    fn the_largest_reconstruction_is_read() {
        let sfm = read(FILE.as_bytes()).unwrap();
        assert_eq!(sfm.others, ["z.jpg"]);
        assert_eq!(sfm.shots.iter().map(|shot| shot.name.as_str()).collect::<Vec<_>>(), ["a.jpg", "b.jpg"]);
        let [a, b] = [&sfm.shots[0], &sfm.shots[1]];
        assert_eq!(a.camera.model, CameraModel::OpenCv([3400.0, 3400.0, 2000.0, 1500.0, -0.1, 0.01, 0.0, 0.0]));
        let brown = [3200.0, 3240.0, 1540.0, 1920.0, 0.1, 0.2, 0.001, 0.002, 0.3, 0.0, 0.0, 0.0];
        assert_eq!(b.camera.model, CameraModel::FullOpenCv(brown));
        // A quarter turn about z takes x to y.
        assert!((b.camera_from_world.apply(DVec3::X) - DVec3::new(1.0, 3.0, 3.0)).length() < 1e-12);
        assert_eq!((sfm.positions[1], sfm.colours[1]), (DVec3::new(1.0, 2.0, 3.0), [255, 0, 12]));
        assert_eq!((sfm.positions[0], sfm.colours[0]), (DVec3::new(4.0, 5.0, 6.0), [128; 3]));
        assert_eq!(sfm.origin.unwrap().latitude_degrees, 47.5);
        // The optical axis is not distorted.
        assert_eq!(a.camera.model.distort(DVec2::ZERO), DVec2::ZERO);
    }

    #[test]
    fn errors_name_the_entry() {
        for (from, to, word) in [
            ("\"camera\": \"v2 b\"", "\"camera\": \"v2 d\"", "b.jpg"),
            ("fisheye", "spherical", "spherical"),
            ("\"width\": 4000, \"height\": 3000", "\"width\": 0, \"height\": 3000", "v2 a"),
            ("\"focal\": 0.85", "\"focal\": -0.85", "v2 a"),
            ("\"focal\": 0.85", "\"fokal\": -0.85", "v2 a"),
            ("47.5", "97.5", "reference_lla"),
            ("[4, 5, 6]", "[4, 5]", "reconstruction.json"),
            ("[4, 5, 6]", "[4, 5, 1e999]", "reconstruction.json"),
            ("[0, 0, 10]", "[0, 1e308, 1e999]", "reconstruction.json"),
        ] {
            let error = read(FILE.replacen(from, to, 1).as_bytes()).unwrap_err().to_string();
            assert!(error.contains(word) && !error.contains('\n'), "{error}");
        }
        for end in (0..FILE.len()).step_by(11) {
            assert!(read(&FILE.as_bytes()[..end]).is_err());
        }
        for bad in ["[]", "{}", "[{\"cameras\": {}, \"shots\": {}}]"] {
            assert!(read(bad.as_bytes()).is_err());
        }
    }
}
