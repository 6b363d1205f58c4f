//! Reads the tables of nuScenes: JSON arrays of rows that name each other by token.
//!
//! ```text
//! scene ← sample ← sample_data → ego_pose, calibrated_sensor → sensor
//!           ↑
//!         sample_annotation → instance → category; attribute
//! ```
//!
//! A datum (a row of `sample_data`) is a photo or a sweep. `ego_pose` is world_from_vehicle at its time, `calibrated_sensor`
//! vehicle_from_sensor; cameras have OpenCV's axes and photos without distortion. Boxes are in the world: x along the length,
//! y along the width, z up. Times are microseconds, quaternions are w, x, y, z.
//!
//! The tables of the whole data set have millions of rows, so a table is read row by row, and only the rows of one scene are
//! kept.
//!
//! Source: "nuScenes schema", `docs/schema_nuscenes.md` in github.com/nutonomy/nuscenes-devkit.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::marker::PhantomData;

use glam::{DQuat, DVec3};
use serde::Deserialize;
use serde::de::{Deserializer, Error, SeqAccess, Visitor};

use crate::camera::{CameraModel, Rigid};
use crate::error::CodecError;

/// Bound of a coordinate, metres.
const MAX_METRES: f64 = 1e7;
/// Bound of a box's side, metres.
const MAX_SIDE_METRES: f64 = 1e3;
/// Bound of a time, microseconds.
const MAX_MICROSECONDS: i64 = 1 << 60;

/// A row of `sample_data`: a photo, a sweep, or a reading of a radar.
#[derive(Debug, Clone, PartialEq)]
pub struct Datum {
    /// Path of the file, relative to the data set.
    pub file: String,
    /// Width and height of a photo, else 0.
    pub size: (u32, u32),
    /// Time in microseconds.
    pub microseconds: i64,
    /// Whether it belongs to an annotated sample; otherwise it was taken between samples.
    pub is_key_frame: bool,
    /// Token of its row in `ego_pose`.
    pub ego_pose: String,
    /// Token of its row in `calibrated_sensor`.
    pub calibrated_sensor: String,
}

/// A row of `calibrated_sensor`.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedSensor {
    /// Token of its row in `sensor`.
    pub sensor: String,
    /// Mounting.
    pub vehicle_from_sensor: Rigid,
    /// The lens of a camera: a pinhole.
    pub lens: Option<CameraModel>,
}

/// A row of `sample_annotation`: a box.
#[derive(Debug, Clone, PartialEq)]
pub struct Annotation {
    /// Token of the object's row in `instance`.
    pub instance: String,
    /// Tokens of rows of `attribute`.
    pub attributes: Vec<String>,
    /// Time of its sample, microseconds.
    pub microseconds: i64,
    /// Pose of the box: x along its length, y along its width, z up.
    pub world_from_box: Rigid,
    /// Length, width and height, metres.
    pub size: DVec3,
}

#[derive(Deserialize)]
struct NameRow<'a> {
    #[serde(borrow)]
    token: Cow<'a, str>,
    #[serde(borrow)]
    name: Cow<'a, str>,
}

/// Reads `scene`, `category` or `attribute`: names by token.
///
/// # Errors
/// Not such a table.
pub fn read_names(bytes: &[u8]) -> Result<BTreeMap<String, String>, CodecError> {
    let names = rows(bytes, |row: NameRow| Ok(Some((row.token.into_owned(), row.name.into_owned()))))?;
    Ok(names.into_iter().collect())
}

#[derive(Deserialize)]
struct SampleRow<'a> {
    #[serde(borrow)]
    token: Cow<'a, str>,
    #[serde(borrow)]
    scene_token: Cow<'a, str>,
    timestamp: i64,
}

/// Reads `sample`: times of a scene's samples in microseconds, by token.
///
/// # Errors
/// Not such a table, or a time out of range.
pub fn read_samples(bytes: &[u8], scene: &str) -> Result<BTreeMap<String, i64>, CodecError> {
    let pick = |row: SampleRow| {
        let time = time(row.timestamp)?;
        Ok((row.scene_token == scene).then(|| (row.token.into_owned(), time)))
    };
    Ok(rows(bytes, pick)?.into_iter().collect())
}

#[derive(Deserialize)]
struct DatumRow<'a> {
    #[serde(borrow)]
    sample_token: Cow<'a, str>,
    #[serde(borrow)]
    ego_pose_token: Cow<'a, str>,
    #[serde(borrow)]
    calibrated_sensor_token: Cow<'a, str>,
    #[serde(borrow)]
    filename: Cow<'a, str>,
    timestamp: i64,
    is_key_frame: bool,
    #[serde(default)]
    width: Option<u32>,
    #[serde(default)]
    height: Option<u32>,
}

/// Reads `sample_data`: the data of these samples, by time.
///
/// # Errors
/// Not such a table, or a time out of range.
pub fn read_data(bytes: &[u8], samples: &BTreeMap<String, i64>) -> Result<Vec<Datum>, CodecError> {
    let pick = |row: DatumRow| {
        let microseconds = time(row.timestamp)?;
        Ok(samples.contains_key(&*row.sample_token).then(|| Datum {
            file: row.filename.into_owned(),
            size: (row.width.unwrap_or(0), row.height.unwrap_or(0)),
            microseconds,
            is_key_frame: row.is_key_frame,
            ego_pose: row.ego_pose_token.into_owned(),
            calibrated_sensor: row.calibrated_sensor_token.into_owned(),
        }))
    };
    let mut data = rows(bytes, pick)?;
    data.sort_by(|a, b| (a.microseconds, &a.file).cmp(&(b.microseconds, &b.file)));
    Ok(data)
}

#[derive(Deserialize)]
struct PoseRow<'a> {
    #[serde(borrow)]
    token: Cow<'a, str>,
    rotation: [f64; 4],
    translation: [f64; 3],
}

/// Reads `ego_pose`: world_from_vehicle of the wanted tokens.
///
/// # Errors
/// Not such a table, or a pose that is not a rotation or out of range.
pub fn read_ego_poses(bytes: &[u8], wanted: &BTreeSet<&str>) -> Result<BTreeMap<String, Rigid>, CodecError> {
    let pick = |row: PoseRow| {
        let pose = pose(row.rotation, row.translation)?;
        Ok(wanted.contains(&*row.token).then(|| (row.token.into_owned(), pose)))
    };
    Ok(rows(bytes, pick)?.into_iter().collect())
}

#[derive(Deserialize)]
struct SensorRow<'a> {
    #[serde(borrow)]
    token: Cow<'a, str>,
    #[serde(borrow)]
    modality: Cow<'a, str>,
}

/// Reads `sensor`: `camera`, `lidar` or `radar` by token.
///
/// # Errors
/// Not such a table.
pub fn read_modalities(bytes: &[u8]) -> Result<BTreeMap<String, String>, CodecError> {
    let sensors = rows(bytes, |row: SensorRow| Ok(Some((row.token.into_owned(), row.modality.into_owned()))))?;
    Ok(sensors.into_iter().collect())
}

#[derive(Deserialize)]
struct CalibratedRow<'a> {
    #[serde(borrow)]
    token: Cow<'a, str>,
    #[serde(borrow)]
    sensor_token: Cow<'a, str>,
    rotation: [f64; 4],
    translation: [f64; 3],
    camera_intrinsic: Vec<[f64; 3]>,
}

/// Reads `calibrated_sensor`, by token.
///
/// # Errors
/// Not such a table, a mounting that is not a rotation or out of range, or intrinsics that are not of a pinhole.
pub fn read_calibrated_sensors(bytes: &[u8]) -> Result<BTreeMap<String, CalibratedSensor>, CodecError> {
    let pick = |row: CalibratedRow| {
        let lens = match row.camera_intrinsic[..] {
            [] => None,
            [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]] if fx > 0.0 && fy > 0.0 => {
                Some(CameraModel::Pinhole([fx, fy, cx, cy]))
            }
            _ => return Err("has a camera_intrinsic that is not of a pinhole"),
        };
        let vehicle_from_sensor = pose(row.rotation, row.translation)?;
        let sensor = CalibratedSensor { sensor: row.sensor_token.into_owned(), vehicle_from_sensor, lens };
        Ok(Some((row.token.into_owned(), sensor)))
    };
    Ok(rows(bytes, pick)?.into_iter().collect())
}

#[derive(Deserialize)]
struct AnnotationRow<'a> {
    #[serde(borrow)]
    sample_token: Cow<'a, str>,
    #[serde(borrow)]
    instance_token: Cow<'a, str>,
    #[serde(default)]
    attribute_tokens: Vec<String>,
    rotation: [f64; 4],
    translation: [f64; 3],
    /// Width, length, height.
    size: [f64; 3],
}

/// Reads `sample_annotation`: the boxes of these samples, by time.
///
/// # Errors
/// Not such a table, a pose that is not a rotation or out of range, or a box without extent or over a kilometre long.
pub fn read_annotations(bytes: &[u8], samples: &BTreeMap<String, i64>) -> Result<Vec<Annotation>, CodecError> {
    let pick = |row: AnnotationRow| {
        let [width, length, height] = row.size;
        if !row.size.iter().all(|side| *side > 0.0 && *side < MAX_SIDE_METRES) {
            return Err("has a box without extent or over a kilometre long");
        }
        let world_from_box = pose(row.rotation, row.translation)?;
        Ok(samples.get(&*row.sample_token).map(|&microseconds| Annotation {
            instance: row.instance_token.into_owned(),
            attributes: row.attribute_tokens,
            microseconds,
            world_from_box,
            size: DVec3::new(length, width, height),
        }))
    };
    let mut boxes = rows(bytes, pick)?;
    boxes.sort_by(|a, b| (a.microseconds, &a.instance).cmp(&(b.microseconds, &b.instance)));
    Ok(boxes)
}

#[derive(Deserialize)]
struct InstanceRow<'a> {
    #[serde(borrow)]
    token: Cow<'a, str>,
    #[serde(borrow)]
    category_token: Cow<'a, str>,
}

/// Reads `instance`: tokens of rows of `category`, by token.
///
/// # Errors
/// Not such a table.
pub fn read_instances(bytes: &[u8]) -> Result<BTreeMap<String, String>, CodecError> {
    let instances =
        rows(bytes, |row: InstanceRow| Ok(Some((row.token.into_owned(), row.category_token.into_owned()))))?;
    Ok(instances.into_iter().collect())
}

fn time(microseconds: i64) -> Result<i64, &'static str> {
    let is_sane = microseconds.unsigned_abs() <= MAX_MICROSECONDS as u64;
    if is_sane { Ok(microseconds) } else { Err("has a timestamp out of range") }
}

fn pose([w, x, y, z]: [f64; 4], translation: [f64; 3]) -> Result<Rigid, &'static str> {
    let pose = Rigid { rotation: DQuat::from_xyzw(x, y, z, w), translation: translation.into() };
    if !pose.is_sane() || pose.translation.abs().max_element() > MAX_METRES {
        return Err("has a pose that is not a rotation or out of range");
    }
    Ok(Rigid { rotation: pose.rotation.normalize(), ..pose })
}

/// Reads a table row by row, and keeps what `pick` makes of the rows that it wants.
fn rows<'a, R: Deserialize<'a>, T>(
    bytes: &'a [u8],
    pick: impl FnMut(R) -> Result<Option<T>, &'static str>,
) -> Result<Vec<T>, CodecError> {
    let bad = |e: serde_json::Error| CodecError::new(format!("is not such a table of nuScenes ({e})"));
    let mut json = serde_json::Deserializer::from_slice(bytes);
    let rows = json.deserialize_seq(Picked { pick, row: PhantomData, kept: Vec::new() }).map_err(bad)?;
    json.end().map_err(bad)?;
    Ok(rows)
}

struct Picked<R, T, F> {
    pick: F,
    row: PhantomData<R>,
    kept: Vec<T>,
}

impl<'a, R: Deserialize<'a>, T, F: FnMut(R) -> Result<Option<T>, &'static str>> Visitor<'a> for Picked<R, T, F> {
    type Value = Vec<T>;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a list of rows")
    }

    fn visit_seq<S: SeqAccess<'a>>(mut self, mut table: S) -> Result<Vec<T>, S::Error> {
        while let Some(row) = table.next_element::<R>()? {
            self.kept.extend((self.pick)(row).map_err(S::Error::custom)?);
        }
        Ok(self.kept)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DATA: &str = r#"[{"token": "d", "sample_token": "s", "ego_pose_token": "e", "calibrated_sensor_token": "c",
        "filename": "samples/a.jpg", "timestamp": 7, "is_key_frame": true, "width": 16, "height": 9, "next": "", "prev": ""},
        {"token": "f", "sample_token": "other", "ego_pose_token": "e", "calibrated_sensor_token": "c",
        "filename": "sweeps/a.bin", "timestamp": 3, "is_key_frame": false}]"#;
    const POSES: &str = r#"[{"token": "e", "rotation": [0, 1, 0, 0], "translation": [1, 2, 3], "timestamp": 7},
        {"token": "x", "rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}]"#;
    const CALIBRATED: &str = r#"[{"token": "c", "sensor_token": "cam", "rotation": [1, 0, 0, 0], "translation": [0, 0, 1.5],
        "camera_intrinsic": [[50, 0, 8], [0, 51, 4.5], [0, 0, 1]]},
        {"token": "l", "sensor_token": "top", "rotation": [1, 0, 0, 0], "translation": [0, 0, 2], "camera_intrinsic": []}]"#;
    const BOXES: &str = r#"[{"token": "a", "sample_token": "s", "instance_token": "i", "attribute_tokens": ["m"],
        "visibility_token": "4", "rotation": [1, 0, 0, 0], "translation": [5, 0, 1], "size": [2, 4.5, 1.5]},
        {"token": "b", "sample_token": "other", "instance_token": "i", "rotation": [1, 0, 0, 0], "translation": [5, 0, 1],
        "size": [2, 4.5, 1.5]}]"#;

    fn samples() -> BTreeMap<String, i64> {
        let table = br#"[{"token": "s", "scene_token": "one", "timestamp": 7}, {"token": "t", "scene_token": "two", "timestamp": 9}]"#;
        read_samples(table, "one").unwrap()
    }

    #[test]
    fn rows_of_a_scene_are_read() {
        let samples = samples();
        assert_eq!(samples, BTreeMap::from([("s".into(), 7)]));
        let data = read_data(DATA.as_bytes(), &samples).unwrap();
        assert_eq!((data.len(), data[0].file.as_str(), data[0].size), (1, "samples/a.jpg", (16, 9)));
        let poses = read_ego_poses(POSES.as_bytes(), &BTreeSet::from(["e"])).unwrap();
        assert_eq!((poses.len(), poses["e"].apply(DVec3::Y)), (1, DVec3::new(1.0, 1.0, 3.0)));
        let sensors = read_calibrated_sensors(CALIBRATED.as_bytes()).unwrap();
        assert_eq!(sensors["c"].lens, Some(CameraModel::Pinhole([50.0, 51.0, 8.0, 4.5])));
        assert_eq!((sensors["l"].lens, sensors["l"].vehicle_from_sensor.translation.z), (None, 2.0));
        let boxes = read_annotations(BOXES.as_bytes(), &samples).unwrap();
        assert_eq!((boxes.len(), boxes[0].size, boxes[0].microseconds), (1, DVec3::new(4.5, 2.0, 1.5), 7));
        let names = read_names(br#"[{"token": "m", "name": "vehicle.moving", "description": ""}]"#).unwrap();
        assert_eq!(names["m"], "vehicle.moving");
        let modalities = read_modalities(br#"[{"token": "c", "channel": "CAM_FRONT", "modality": "camera"}]"#).unwrap();
        assert_eq!(modalities["c"], "camera");
        let instances = read_instances(br#"[{"token": "i", "category_token": "car", "nbr_annotations": 2}]"#).unwrap();
        assert_eq!(instances["i"], "car");
    }

    #[test]
    fn invalid_tables_are_refused() {
        let samples = samples();
        let all = |text: &str, from: &str, to: &str| text.replace(from, to).into_bytes();
        for (from, to) in [("7", "1e3"), ("7", "9000000000000000000"), ("true", "1"), ("[{", "{"), ("16", "-16")] {
            assert!(read_data(&all(DATA, from, to), &samples).is_err(), "{to}");
        }
        for (from, to) in
            [("[0, 1,", "[0, 2,"), ("[1, 2, 3]", "[1, 2]"), ("3]", "NaN]"), ("3]", "1e999]"), ("3]", "1e8]")]
        {
            assert!(read_ego_poses(&all(POSES, from, to), &BTreeSet::new()).is_err(), "{to}");
        }
        for (from, to) in [("50", "-50"), ("[50, 0,", "[50, 1,"), (", [0, 0, 1]", ""), ("1.5]", "1.5, 2]")] {
            assert!(read_calibrated_sensors(&all(CALIBRATED, from, to)).is_err(), "{to}");
        }
        for (from, to) in [("4.5", "0"), ("4.5", "-1"), ("4.5", "5000"), ("[1, 0, 0, 0]", "[0, 0, 0, 0]")] {
            assert!(read_annotations(&all(BOXES, from, to), &samples).is_err(), "{to}");
        }
        for table in [&b""[..], b"{}", b"[{}]", b"[] x", b"[{\"token\": 1}]", b"\xff"] {
            assert!(read_names(table).is_err() && read_instances(table).is_err() && read_modalities(table).is_err());
            assert!(read_samples(table, "one").is_err());
        }
        assert!(read_names(b"[]").unwrap().is_empty());
    }
}
