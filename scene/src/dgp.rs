//! Reads scenes of DGP, the Dataset Governance Policy of Toyota Research Institute: `scene_*.json`, calibrations, boxes and
//! ontologies.
//!
//! A datum is a photo or a sweep with its pose, world_from_sensor; cameras have OpenCV's axes. A sample groups the data taken at
//! about the same time and names the calibration of their sensors.
//!
//! Source: the protocol buffers of github.com/TRI-ML/dgp (`scene.proto`, `sample.proto`, `geometry.proto`, `annotations.proto`),
//! of which the files are the JSON.

use std::collections::BTreeMap;
use std::time::UNIX_EPOCH;

use glam::{DQuat, DVec3};
use serde::Deserialize;

use crate::camera::{CameraModel, Rigid};
use crate::error::CodecError;

/// A scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Groups of data, in order.
    pub samples: Vec<Sample>,
}

/// Data taken at about the same time.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// Name of the calibration: `calibration/KEY.json`.
    pub calibration: String,
    /// Photos.
    pub photos: Vec<Datum>,
    /// Sweeps of lidars.
    pub sweeps: Vec<Datum>,
}

/// A photo or a sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct Datum {
    /// Name of its sensor.
    pub sensor: String,
    /// Path of the file, relative to the scene.
    pub file: String,
    /// When it was taken, microseconds since 1970; `None` without a time.
    pub microseconds: Option<i64>,
    /// Width and height of a photo, 0 for a sweep.
    pub size: (u32, u32),
    /// Pose.
    pub world_from_sensor: Rigid,
    /// Paths of annotations, by kind.
    pub annotations: Vec<String>,
}

/// An annotated box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoxAnnotation {
    /// Class, as in the ontology.
    pub class: i64,
    /// The object; the same in all data that show it.
    pub instance: i64,
    /// Pose of the box in its sensor's axes: x along its length, y along its width, z up.
    pub sensor_from_box: Rigid,
    /// Length, width and height, metres.
    pub size: DVec3,
}

#[derive(Deserialize)]
struct SceneFile {
    data: Vec<DatumEntry>,
    samples: Vec<SampleEntry>,
}

#[derive(Deserialize)]
struct SampleEntry {
    calibration_key: String,
    datum_keys: Vec<String>,
}

#[derive(Deserialize)]
struct DatumEntry {
    key: String,
    id: DatumId,
    datum: DatumKind,
}

#[derive(Deserialize)]
struct DatumId {
    name: String,
    /// RFC 3339.
    #[serde(default)]
    timestamp: String,
}

impl DatumId {
    fn microseconds(&self) -> Option<i64> {
        let since = humantime::parse_rfc3339(&self.timestamp).ok()?.duration_since(UNIX_EPOCH).ok()?;
        since.as_micros().try_into().ok()
    }
}

#[derive(Deserialize)]
struct DatumKind {
    image: Option<FileEntry>,
    point_cloud: Option<FileEntry>,
}

#[derive(Deserialize)]
struct FileEntry {
    filename: String,
    pose: PoseEntry,
    #[serde(default)]
    width: u32,
    #[serde(default)]
    height: u32,
    #[serde(default)]
    annotations: BTreeMap<String, String>,
}

#[derive(Deserialize)]
struct PoseEntry {
    rotation: RotationEntry,
    translation: TranslationEntry,
}

/// The JSON of protocol buffers leaves out zeros.
#[derive(Deserialize)]
#[serde(default)]
#[derive(Default)]
struct RotationEntry {
    qw: f64,
    qx: f64,
    qy: f64,
    qz: f64,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct TranslationEntry {
    x: f64,
    y: f64,
    z: f64,
}

impl PoseEntry {
    fn rigid(&self) -> Option<Rigid> {
        let RotationEntry { qw, qx, qy, qz } = self.rotation;
        let TranslationEntry { x, y, z } = self.translation;
        let rotation = DQuat::from_xyzw(qx, qy, qz, qw);
        let pose = Rigid { rotation, translation: DVec3::new(x, y, z) };
        pose.is_sane().then(|| Rigid { rotation: rotation.normalize(), ..pose })
    }
}

/// Reads a `scene_*.json`.
///
/// # Errors
/// Not such JSON, a pose that is not finite or not a rotation, a sample with a datum that is not there, or no photo.
pub fn read_scene(bytes: &[u8]) -> Result<Scene, CodecError> {
    let file: SceneFile =
        serde_json::from_slice(bytes).map_err(|e| CodecError::new(format!("is not a scene of DGP ({e})")))?;
    let data: BTreeMap<&str, &DatumEntry> = file.data.iter().map(|datum| (datum.key.as_str(), datum)).collect();
    let mut samples = Vec::new();
    for entry in &file.samples {
        let mut sample = Sample { calibration: entry.calibration_key.clone(), photos: Vec::new(), sweeps: Vec::new() };
        for key in &entry.datum_keys {
            let missing = || CodecError::new(format!("has a sample with the datum {key:.40}, which is not there"));
            let datum = data.get(key.as_str()).ok_or_else(missing)?;
            let (found, list) = match &datum.datum {
                DatumKind { image: Some(image), .. } => (image, &mut sample.photos),
                DatumKind { point_cloud: Some(cloud), .. } => (cloud, &mut sample.sweeps),
                _ => continue,
            };
            let bad_pose = || {
                CodecError::new(format!("has {:.100} with a pose that is not finite or not a rotation", found.filename))
            };
            list.push(Datum {
                sensor: datum.id.name.clone(),
                file: found.filename.clone(),
                microseconds: datum.id.microseconds(),
                size: (found.width, found.height),
                world_from_sensor: found.pose.rigid().ok_or_else(bad_pose)?,
                annotations: found.annotations.values().cloned().collect(),
            });
        }
        samples.push(sample);
    }
    match samples.iter().any(|sample| !sample.photos.is_empty()) {
        true => Ok(Scene { samples }),
        false => Err(CodecError::new("has no photo")),
    }
}

#[derive(Deserialize)]
struct CalibrationFile {
    names: Vec<String>,
    intrinsics: Vec<IntrinsicsEntry>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct IntrinsicsEntry {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    skew: f64,
    fov: f64,
    k1: f64,
    k2: f64,
    k3: f64,
    k4: f64,
    k5: f64,
    k6: f64,
    p1: f64,
    p2: f64,
}

/// Reads a calibration: the lenses of cameras by name. Sensors without a focal length are not cameras.
///
/// # Errors
/// Not such JSON, or a lens of another model than OpenCV's rational one.
pub fn read_calibration(bytes: &[u8]) -> Result<BTreeMap<String, CameraModel>, CodecError> {
    let file: CalibrationFile =
        serde_json::from_slice(bytes).map_err(|e| CodecError::new(format!("is not a calibration of DGP ({e})")))?;
    let mut lenses = BTreeMap::new();
    for (name, i) in file.names.into_iter().zip(&file.intrinsics).filter(|(_, i)| i.fx != 0.0 || i.fy != 0.0) {
        if i.skew != 0.0 || i.fov != 0.0 {
            return Err(CodecError::new(format!(
                "has {name:.100} with skew or a fisheye lens, which are not supported"
            )));
        }
        let model = CameraModel::FullOpenCv([i.fx, i.fy, i.cx, i.cy, i.k1, i.k2, i.p1, i.p2, i.k3, i.k4, i.k5, i.k6]);
        let finite = model.focal_and_centre().iter().chain(&model.distortion()).all(|v| v.is_finite());
        if !finite || i.fx <= 0.0 || i.fy <= 0.0 {
            return Err(CodecError::new(format!("has {name:.100} without positive, finite focal lengths")));
        }
        let model = if model.is_distorted() { model } else { CameraModel::Pinhole([i.fx, i.fy, i.cx, i.cy]) };
        lenses.insert(name, model);
    }
    Ok(lenses)
}

#[derive(Deserialize)]
struct BoxesFile {
    #[serde(default)]
    annotations: Vec<BoxEntry>,
}

#[derive(Deserialize)]
struct BoxEntry {
    #[serde(default)]
    class_id: i64,
    #[serde(default)]
    instance_id: serde_json::Value,
    #[serde(rename = "box")]
    shape: ShapeEntry,
}

#[derive(Deserialize)]
struct ShapeEntry {
    pose: PoseEntry,
    length: f64,
    width: f64,
    height: f64,
}

/// Farthest box from its sensor, and the longest side of one, metres.
const MAX_BOX_METRES: f64 = 1000.0;

/// Reads the boxes annotated in a photo or a sweep.
///
/// # Errors
/// Not such JSON, or a box without a rotation, with sides that are not positive, or over a kilometre away or long.
pub fn read_boxes(bytes: &[u8]) -> Result<Vec<BoxAnnotation>, CodecError> {
    let file: BoxesFile = serde_json::from_slice(bytes)
        .map_err(|e| CodecError::new(format!("is not a list of 3D boxes of DGP ({e})")))?;
    let read = |entry: &BoxEntry| {
        let ShapeEntry { pose, length, width, height } = &entry.shape;
        let (pose, size) = (pose.rigid()?, DVec3::new(*length, *width, *height));
        let sane = size.min_element() > 0.0
            && size.max_element() <= MAX_BOX_METRES
            && pose.translation.length() <= MAX_BOX_METRES;
        // Protocol buffers write 64-bit integers as text, older files as numbers.
        let instance = match &entry.instance_id {
            serde_json::Value::String(text) => text.parse().unwrap_or(0),
            value => value.as_i64().unwrap_or(0),
        };
        sane.then_some(BoxAnnotation { class: entry.class_id, instance, sensor_from_box: pose, size })
    };
    let boxes: Option<Vec<_>> = file.annotations.iter().map(read).collect();
    boxes.ok_or_else(|| CodecError::new("has a box outside of the scene: over 1 km away or long, flat, or not turned"))
}

#[derive(Deserialize)]
struct OntologyFile {
    items: Vec<OntologyItem>,
}

#[derive(Deserialize)]
struct OntologyItem {
    #[serde(default)]
    id: i64,
    name: String,
}

/// Reads an ontology: names of classes by number.
///
/// # Errors
/// Not such JSON.
pub fn read_ontology(bytes: &[u8]) -> Result<BTreeMap<i64, String>, CodecError> {
    let file: OntologyFile =
        serde_json::from_slice(bytes).map_err(|e| CodecError::new(format!("is not an ontology of DGP ({e})")))?;
    Ok(file.items.into_iter().map(|item| (item.id, item.name)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    const POSE: &str = r#"{"rotation": {"qw": 1.0}, "translation": {"x": 3.0, "z": -1.5}}"#;

    fn scene() -> String {
        format!(
            r#"{{"samples": [{{"calibration_key": "c", "datum_keys": ["a", "b", "d"]}}], "data": [
            {{"key": "a", "id": {{"name": "LIDAR"}}, "datum": {{"point_cloud": {{"filename": "a.npz", "pose": {POSE}}}}}}},
            {{"key": "b", "id": {{"name": "CAM"}}, "datum": {{"image": {{"filename": "b.jpg", "width": 40, "height": 30,
              "annotations": {{"1": "boxes.json"}}, "pose": {POSE}}}}}}},
            {{"key": "d", "id": {{"name": "AGENT"}}, "datum": {{}}}}]}}"#
        )
    }

    #[test]
    fn scenes_are_read_and_refused() {
        let found = read_scene(scene().as_bytes()).unwrap();
        let [sample] = &found.samples[..] else { panic!("{found:?}") };
        let (photo, sweep) = (&sample.photos[0], &sample.sweeps[0]);
        assert_eq!((photo.sensor.as_str(), photo.size, photo.annotations.len()), ("CAM", (40, 30), 1));
        assert_eq!((sweep.file.as_str(), sweep.world_from_sensor.translation.z), ("a.npz", -1.5));
        for (from, to) in
            [("1.0", "2.0"), ("3.0", "1e999"), ("\"b\", ", "\"e\", "), ("\"image\"", "\"radar\""), ("[", "")]
        {
            assert!(read_scene(scene().replacen(from, to, 1).as_bytes()).is_err(), "{to}");
        }
    }

    #[test]
    fn calibrations_boxes_and_ontologies_are_read_and_refused() {
        let lens =
            r#"{"names": ["LIDAR", "CAM"], "intrinsics": [{}, {"fx": 50, "fy": 51, "cx": 20, "cy": 15, "k1": 0.1}]}"#;
        let lenses = read_calibration(lens.as_bytes()).unwrap();
        assert_eq!((lenses.len(), lenses["CAM"].focal_and_centre()), (1, [50.0, 51.0, 20.0, 15.0]));
        assert!(lenses["CAM"].is_distorted());
        assert!(read_calibration(lens.replace("k1", "skew").as_bytes()).is_err());
        assert!(read_calibration(lens.replace("51", "-51").as_bytes()).is_err());
        let boxes = format!(
            r#"{{"annotations": [{{"class_id": 2, "instance_id": "77", "box": {{"length": 4, "width": 2, "height": 1.5,
            "pose": {POSE}}}}}, {{"instance_id": 5, "box": {{"length": 1, "width": 1, "height": 1, "pose": {POSE}}}}}]}}"#
        );
        let found = read_boxes(boxes.as_bytes()).unwrap();
        assert_eq!((found[0].class, found[0].instance, found[1].instance), (2, 77, 5));
        assert_eq!((found[0].size, read_boxes(b"{}").unwrap().len()), (DVec3::new(4.0, 2.0, 1.5), 0));
        for (from, to) in
            [("3.0", "3e5"), ("1.5", "0"), ("\"qw\": 1.0", "\"qw\": 0"), ("\"length\": 4", "\"length\": 4e9")]
        {
            assert!(read_boxes(boxes.replacen(from, to, 1).as_bytes()).is_err(), "{to}");
        }
        let ontology = read_ontology(br#"{"items": [{"name": "Car"}, {"id": 3, "name": "Bus"}]}"#).unwrap();
        assert_eq!((ontology[&0].as_str(), ontology[&3].as_str()), ("Car", "Bus"));
        assert!(read_ontology(b"[]").is_err());
    }
}
