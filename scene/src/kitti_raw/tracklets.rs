//! Reads `tracklet_labels.xml`: the boxes of annotated objects, frame by frame.
//!
//! Source: the development kit of KITTI's raw data (`readTracklets.m`, `tracklets.h`). The file is an archive of Boost: elements
//! `tracklets/item` with `objectType`, `h`, `w`, `l` in metres, `first_frame`, and `poses/item` with `tx` to `tz` and `rx` to `rz` in
//! the axes of the Velodyne of each frame.

use glam::{DQuat, DVec3, EulerRot};
use serde::Deserialize;

use crate::camera::Rigid;
use crate::error::CodecError;

/// The maximum number of objects, and of poses of all of them.
const MAX_TRACKLETS: usize = 1 << 16;
const MAX_POSES: usize = 1 << 22;
/// The longest side of a box, and its farthest place from the scanner, metres.
const MAX_SIDE_METRES: f64 = 200.0;
const MAX_RANGE_METRES: f64 = 1000.0;

/// An annotated object.
#[derive(Debug, Clone, PartialEq)]
pub struct Tracklet {
    /// `Car`, `Van`, `Truck`, `Pedestrian`, `Person (sitting)`, `Cyclist`, `Tram` or `Misc`.
    pub class: String,
    /// Length, width and height of its box, metres.
    pub size: DVec3,
    /// The number of the frame of its first pose.
    pub first_frame: u32,
    /// The Velodyne from the middle of its box, in each frame from the first. The box's x is ahead, y left, z up.
    pub poses: Vec<Rigid>,
}

#[derive(Deserialize)]
struct Archive {
    tracklets: Items<Item>,
}

#[derive(Deserialize)]
struct Items<T> {
    #[serde(rename = "item", default = "Vec::new")]
    items: Vec<T>,
}

#[derive(Deserialize)]
struct Item {
    #[serde(rename = "objectType")]
    object_type: String,
    h: f64,
    w: f64,
    l: f64,
    first_frame: u32,
    poses: Items<Pose>,
}

#[derive(Deserialize)]
struct Pose {
    tx: f64,
    ty: f64,
    tz: f64,
    rx: f64,
    ry: f64,
    rz: f64,
}

/// Decodes the file.
///
/// # Errors
/// Malformed XML, an element that is missing or no number, values out of range, too many objects or poses.
pub fn read_tracklets(bytes: &[u8]) -> Result<Vec<Tracklet>, CodecError> {
    // It quotes the file.
    let plain = |c: char| if c.is_control() { ' ' } else { c };
    let bad =
        |error: quick_xml::DeError| CodecError::new(error.to_string().chars().map(plain).take(200).collect::<String>());
    let Archive { tracklets } = quick_xml::de::from_reader(bytes).map_err(bad)?;
    let items = tracklets.items;
    let poses: usize = items.iter().map(|item| item.poses.items.len()).sum();
    if items.len() > MAX_TRACKLETS || poses > MAX_POSES {
        return Err(CodecError::new(format!("more than {MAX_TRACKLETS} objects, or {MAX_POSES} poses of all")));
    }
    items.into_iter().zip(0..).map(|(item, number)| tracklet(item, number)).collect()
}

fn tracklet(item: Item, number: usize) -> Result<Tracklet, CodecError> {
    let bad = |problem: &str| CodecError::new(format!("item {number} {problem}"));
    let Item { object_type: class, h, w, l, first_frame, poses } = item;
    if class.is_empty() || class.len() > 64 || class.chars().any(char::is_control) {
        return Err(bad("has no objectType, or one that is too long"));
    }
    let size = DVec3::new(l, w, h);
    if !size.is_finite() || size.min_element() <= 0.0 || size.max_element() > MAX_SIDE_METRES {
        return Err(bad("has a box of no size, or one of over 200 m"));
    }
    let pose = |Pose { tx, ty, tz, rx, ry, rz }: Pose| {
        // The file has the middle of the lower side.
        let rotation = DQuat::from_euler(EulerRot::ZYX, rz, ry, rx);
        let translation = DVec3::new(tx, ty, tz) + rotation * (0.5 * h * DVec3::Z);
        let is_sane = rotation.is_finite() && translation.is_finite() && translation.length() < MAX_RANGE_METRES;
        is_sane.then_some(Rigid { rotation: rotation.normalize(), translation })
    };
    let poses: Option<Vec<Rigid>> = poses.items.into_iter().map(pose).collect();
    let poses = poses.ok_or_else(|| bad("has a pose that is not finite, or a kilometre away"))?;
    Ok(Tracklet { class, size, first_frame, poses })
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAR: &str = "<?xml version=\"1.0\" encoding=\"UTF-8\" standalone=\"yes\" ?>\n<!DOCTYPE boost_serialization>\n\
        <boost_serialization signature=\"serialization::archive\" version=\"9\">\n\
        <tracklets class_id=\"0\" tracking_level=\"0\" version=\"0\">\n<count>1</count>\n<item_version>1</item_version>\n\
        <item class_id=\"1\" tracking_level=\"0\" version=\"1\">\n<objectType>Car</objectType>\n<h>1.5</h><w>1.75</w><l>4</l>\n\
        <first_frame>3</first_frame>\n<poses class_id=\"2\" tracking_level=\"0\" version=\"0\">\n<count>2</count>\n\
        <item_version>2</item_version>\n\
        <item class_id=\"3\" tracking_level=\"0\" version=\"2\"><tx>10</tx><ty>-2</ty><tz>-1.6</tz><rx>0</rx><ry>0</ry>\
        <rz>1.5707963267948966</rz><state>2</state><occlusion>0</occlusion><truncation>0</truncation></item>\n\
        <item><tx>11</tx><ty>-2</ty><tz>-1.6</tz><rx>0</rx><ry>0</ry><rz>0</rz><state>2</state></item>\n\
        </poses>\n<finished>1</finished>\n</item>\n</tracklets>\n</boost_serialization>\n";

    #[test]
    fn an_object_has_its_box_in_each_frame() {
        let found = read_tracklets(CAR.as_bytes()).unwrap();
        let [car] = &found[..] else { panic!("{found:?}") };
        assert_eq!((car.class.as_str(), car.size, car.first_frame), ("Car", DVec3::new(4.0, 1.75, 1.5), 3));
        assert_eq!(car.poses.len(), 2);
        // Its front is to the left of the scanner.
        let front = car.poses[0].apply(DVec3::new(2.0, 0.0, 0.75));
        assert!(front.distance(DVec3::new(10.0, 0.0, -0.1)) < 1e-9, "{front}");
        assert!(car.poses[1].translation.distance(DVec3::new(11.0, -2.0, -0.85)) < 1e-9);
        let none =
            read_tracklets(b"<boost_serialization><tracklets><count>0</count></tracklets></boost_serialization>");
        assert_eq!(none.unwrap(), []);
    }

    #[test]
    fn damaged_files_are_refused_in_one_line() {
        for (from, to, says) in [
            ("<h>1.5</h>", "", "`h`"),
            ("<h>1.5</h>", "<h>tall</h>", "f64"),
            ("<h>1.5</h>", "<h>0</h>", "no size"),
            ("<l>4</l>", "<l>201</l>", "200 m"),
            ("<l>4</l>", "<l>nan</l>", "no size"),
            ("<tx>10</tx>", "<tx>inf</tx>", "item 0 has a pose"),
            ("<tx>10</tx>", "<tx>1e4</tx>", "kilometre"),
            ("<rz>0</rz>", "<rz>NaN</rz>", "not finite"),
            ("<first_frame>3", "<first_frame>-3", "invalid"),
            ("Car", "", "objectType"),
            ("</tracklets>", "", ""),
            ("tracklets", "things", "tracklets"),
        ] {
            assert!(CAR.contains(from));
            let error = read_tracklets(CAR.replace(from, to).as_bytes()).unwrap_err().to_string();
            assert!(error.contains(says) && !error.contains(char::is_control), "{from} {to}: {error}");
        }
        let quoted =
            read_tracklets(CAR.replace("</objectType>", "</object\u{1}Type>").as_bytes()).unwrap_err().to_string();
        assert!(!quoted.contains(char::is_control), "{quoted}");
        assert!(read_tracklets(b"").is_err() && read_tracklets(&[0xff, 0xfe, 0x00]).is_err());
    }
}
