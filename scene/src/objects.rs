//! Objects that move as rigid bodies, their paths, and the JSON that captures and models keep them in.
//!
//! ```text
//! {"tracks": [{"id": "160", "class": "car", "low": [x, y, z], "high": [x, y, z],
//!              "poses": [[seconds, [x, y, z], [x, y, z, w]], …]}, …],
//!  "seconds": {"cam0/000.png": 0.0, …}}
//! ```
//! `poses` are world_from_object with a quaternion; `low` and `high` the corners of its box in its own axes (x ahead, y left, z up),
//! metres. `seconds` are the times of the photos, on the clock of the poses. `plat synth` writes `instance`, a number, for `id`.
//! `positions`, as `[seconds, [x, y, z]]`, may stand for `poses` where rotations are not known ([`read_positions`]).

use std::collections::{BTreeMap, BTreeSet};

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::camera::Rigid;
use crate::error::CodecError;
use crate::frame::{self, Kind};
use crate::splats::Splats;
use crate::swing::Swing;

/// A trained object. The header is [`Header`], the bulk a frame of its splats, in its own axes, and one of their swing if they do.
pub const OBJECT: Kind = Kind(*b"movo", 2);

/// An object keeps its first and its last pose for this long before and after, seconds. nuScenes annotates every half second.
const ALONE_SECONDS: f64 = 0.3;
/// How far pixels and splats of an object may lie beside its box: a share of its sides, and metres.
const MARGIN_SHARE: f64 = 0.05;
const PIXEL_MARGIN_METRES: f64 = 0.1;
const SPLAT_MARGIN_METRES: f64 = 0.3;
/// An object that moves faster between two poses jumps, metres per second: 540 km/h.
const MAX_SPEED: f64 = 150.0;
/// Positions of a box that was annotated by hand or by a tracker jitter, metres.
const JITTER_METRES: f64 = 2.0;
/// The longest side of a box, metres.
const MAX_SIDE_METRES: f64 = 200.0;
/// The maximum number of objects, and of poses of all of them.
const MAX_OBJECTS: usize = 1 << 16;
const MAX_POSES: usize = 1 << 24;
const MAX_NAME_BYTES: usize = 64;

/// Where an object is at a time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PathPose {
    /// Seconds on the clock of the capture.
    pub seconds: f64,
    /// The object's pose.
    pub world_from_object: Rigid,
}

/// An object that moves as a rigid body.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MovingObject {
    /// Its name: letters, digits, `-` and `_`, as files are named after it.
    pub id: String,
    /// As the capture names it.
    pub class: String,
    /// The lower corner of its box in its own axes, metres.
    pub low: DVec3,
    /// The upper corner.
    pub high: DVec3,
    /// Its path, by time.
    pub path: Vec<PathPose>,
}

impl MovingObject {
    /// Where it is at a time: straight and by slerp between two poses, and for a third of a second before its first and after its
    /// last; `None` where that is unknown.
    pub fn pose(&self, seconds: f64) -> Option<Rigid> {
        let after = self.path.partition_point(|pose| pose.seconds < seconds);
        let near =
            |pose: &PathPose| ((pose.seconds - seconds).abs() <= ALONE_SECONDS).then_some(pose.world_from_object);
        match (after.checked_sub(1).and_then(|i| self.path.get(i)), self.path.get(after)) {
            (Some(a), Some(b)) => {
                let share = (seconds - a.seconds) / (b.seconds - a.seconds).max(f64::MIN_POSITIVE);
                Some(a.world_from_object.between(&b.world_from_object, share))
            }
            (a, b) => a.and_then(near).or_else(|| b.and_then(near)),
        }
    }

    /// Its path where the object moves, at these times in seconds (ascending), by these motions in its own axes: between two times by
    /// what lies between them, before the first as then, after the last as then. It has a pose wherever the given path has one, and
    /// at the times of motions within it: one beyond its end would keep the object there for longer than it was given.
    pub fn moved(&self, motions: &[(f64, Rigid)]) -> Vec<PathPose> {
        if motions.is_empty() {
            return self.path.clone();
        }
        let given = self.path.iter().map(|pose| pose.seconds);
        let is_within = |seconds: &f64| {
            self.path.first().is_some_and(|first| first.seconds <= *seconds)
                && self.path.last().is_some_and(|last| *seconds <= last.seconds)
        };
        let between = motions.iter().map(|(seconds, _)| *seconds).filter(is_within);
        let mut times: Vec<f64> = given.chain(between).collect();
        times.sort_unstable_by(f64::total_cmp);
        times.dedup();
        let pose = |seconds: f64| {
            let world_from_object = self.pose(seconds)?.after(&motion_at(motions, seconds));
            Some(PathPose { seconds, world_from_object })
        };
        times.into_iter().filter_map(pose).collect()
    }

    /// The corners of the box in its own axes that its pixels lie in, numbered by the bits of their signs along x, y and z. Boxes are
    /// annotated by hand or by a tracker, and the object's outline may lie beside its box.
    pub fn pixel_box(&self) -> [DVec3; 8] {
        self.corners(MARGIN_SHARE, PIXEL_MARGIN_METRES)
    }

    /// As [`pixel_box`](Self::pixel_box), of the box that its splats lie in.
    pub fn splat_box(&self) -> [DVec3; 8] {
        self.corners(MARGIN_SHARE, SPLAT_MARGIN_METRES)
    }

    /// The corners of its box, farther from its centre by a share of its sides and this many metres.
    fn corners(&self, share: f64, metres: f64) -> [DVec3; 8] {
        let (centre, half) = (0.5 * (self.low + self.high), 0.5 * (self.high - self.low));
        let half = half * (1.0 + share) + metres;
        std::array::from_fn(|i| {
            let side = |bit: usize| if i & bit == 0 { -1.0 } else { 1.0 };
            centre + half * DVec3::new(side(1), side(2), side(4))
        })
    }

    /// Checks what other functions rely on. Objects come from files, so every number is untrusted.
    ///
    /// # Errors
    /// The first thing that is wrong.
    pub fn check(&self) -> Result<(), CodecError> {
        let bad = |problem: &str| Err(CodecError::new(format!("object {:?} {problem}", self.id)));
        if !is_name(&self.id) {
            return bad("has a name that is not 1 to 64 letters, digits, - or _");
        }
        if self.class.is_empty() || self.class.len() > MAX_NAME_BYTES || self.class.chars().any(char::is_control) {
            return bad("has no class, or one that is too long");
        }
        let side = self.high - self.low;
        if !side.is_finite() || side.min_element() <= 0.0 || side.max_element() > MAX_SIDE_METRES {
            return bad("has a box of no size, or one of over 200 m");
        }
        let is_sane = |pose: &PathPose| pose.seconds.is_finite() && pose.world_from_object.is_sane();
        if self.path.is_empty() || !self.path.iter().all(is_sane) {
            return bad("has no pose, or one that is not finite or not a rotation");
        }
        for pair in self.path.windows(2) {
            let (from, to) = (&pair[0], &pair[1]);
            if to.seconds <= from.seconds {
                return bad("has poses that are not in the order of time");
            }
            let metres = from.world_from_object.translation.distance(to.world_from_object.translation);
            if metres > MAX_SPEED * (to.seconds - from.seconds) + JITTER_METRES {
                let (at, until) = (from.seconds, to.seconds);
                return bad(&format!("jumps {metres:.1} m between {at} and {until} s"));
            }
        }
        Ok(())
    }
}

/// The motion at a time.
fn motion_at(motions: &[(f64, Rigid)], seconds: f64) -> Rigid {
    let after = motions.partition_point(|(at, _)| *at < seconds);
    match (after.checked_sub(1).and_then(|i| motions.get(i)), motions.get(after)) {
        (Some((from, a)), Some((to, b))) => a.between(b, (seconds - from) / (to - from).max(f64::MIN_POSITIVE)),
        (a, b) => a.or(b).map_or(Rigid::IDENTITY, |(_, motion)| *motion),
    }
}

#[derive(Serialize, Deserialize)]
struct Header {
    path: Vec<PathPose>,
    /// Length of the frame of its splats; what follows is that of their swing.
    splats_bytes: u64,
}

/// Encodes a trained object.
pub fn to_frame(path: &[PathPose], splats: &Splats, swing: Option<&Swing>) -> Vec<u8> {
    let mut bulk = frame::encode_splats(splats);
    let header = Header { path: path.to_vec(), splats_bytes: bulk.len() as u64 };
    bulk.extend(swing.map_or(Vec::new(), Swing::to_frame));
    frame::encode(OBJECT, &header, &bulk)
}

/// Decodes a trained object of which all else is known.
///
/// # Errors
/// As [`frame::decode`], splats, a swing or a path that are wrong.
pub fn from_frame(bytes: &[u8], about: &MovingObject) -> Result<(MovingObject, Splats, Option<Swing>), CodecError> {
    let (Header { path, splats_bytes }, bulk): (Header, _) = frame::decode(OBJECT, bytes)?;
    let object = MovingObject { path, ..about.clone() };
    object.check()?;
    let (splats, swing) = (usize::try_from(splats_bytes).ok().and_then(|at| bulk.split_at_checked(at)))
        .ok_or_else(|| CodecError::new("object is cut short"))?;
    let splats = frame::decode_splats(splats)?;
    let swing = (!swing.is_empty()).then(|| Swing::from_frame(swing, splats.len())).transpose()?;
    Ok((object, splats, swing))
}

/// Whether a text can name an object: 1 to 64 letters, digits, `-` and `_`.
pub fn is_name(text: &str) -> bool {
    let is_named = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    !text.is_empty() && text.len() <= MAX_NAME_BYTES && text.chars().all(is_named)
}

/// Checks objects of one capture or model.
///
/// # Errors
/// The first one that is wrong, or two of one name.
pub fn check_all(objects: &[MovingObject]) -> Result<(), CodecError> {
    if objects.len() > MAX_OBJECTS || objects.iter().map(|of| of.path.len()).sum::<usize>() > MAX_POSES {
        return Err(CodecError::new(format!("more than {MAX_OBJECTS} objects, or {MAX_POSES} poses of all")));
    }
    let mut names = BTreeSet::new();
    for object in objects {
        object.check()?;
        if !names.insert(&object.id) {
            return Err(CodecError::new(format!("two objects are named {:?}", object.id)));
        }
    }
    Ok(())
}

/// Objects, and when photos were taken.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Tracks {
    /// The objects.
    pub objects: Vec<MovingObject>,
    /// The time of each photo, seconds, by its name.
    pub seconds: BTreeMap<String, f64>,
}

#[derive(Serialize, Deserialize)]
struct File {
    tracks: Vec<Track>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    seconds: BTreeMap<String, f64>,
}

#[derive(Serialize, Deserialize)]
struct Track {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    id: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    instance: Option<u32>,
    class: String,
    low: [f64; 3],
    high: [f64; 3],
    #[serde(default)]
    poses: Vec<(f64, [f64; 3], [f64; 4])>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    positions: Vec<(f64, [f64; 3])>,
}

/// Decodes objects and the times of photos, in the order of the objects' names.
///
/// # Errors
/// Malformed JSON, or objects that [`check_all`] refuses.
pub fn read(bytes: &[u8]) -> Result<Tracks, CodecError> {
    let file: File = serde_json::from_slice(bytes).map_err(|error| CodecError::new(error.to_string()))?;
    if let Some(track) = file.tracks.iter().find(|track| !track.positions.is_empty()) {
        let id = track.id.as_deref().unwrap_or_default();
        return Err(CodecError::new(format!("object {id:?} has positions instead of poses; see plat objects pose")));
    }
    tracks(file)
}

/// As [`read`], of objects whose rotations are not known: one with `positions` has none in its path (the identity).
///
/// # Errors
/// As [`read`], or an object with both.
pub fn read_positions(bytes: &[u8]) -> Result<Tracks, CodecError> {
    let mut file: File = serde_json::from_slice(bytes).map_err(|error| CodecError::new(error.to_string()))?;
    for track in &mut file.tracks {
        if !track.poses.is_empty() && !track.positions.is_empty() {
            let id = track.id.as_deref().unwrap_or_default();
            return Err(CodecError::new(format!("object {id:?} has poses and positions")));
        }
        let still = DQuat::IDENTITY.to_array();
        track.poses.extend(track.positions.drain(..).map(|(seconds, place)| (seconds, place, still)));
    }
    tracks(file)
}

fn tracks(file: File) -> Result<Tracks, CodecError> {
    let object = |track: Track| {
        let id = track.id.or_else(|| track.instance.map(|number| number.to_string())).unwrap_or_default();
        let pose = |(seconds, translation, rotation): (f64, [f64; 3], [f64; 4])| {
            let (translation, rotation) = (DVec3::from(translation), DQuat::from_array(rotation));
            // Files round quaternions. What is right to the last digits stays as it is, so that a file that is written again is the
            // same; what is not near a rotation is left for the check.
            let is_rounded = (1e-12..1e-2).contains(&(rotation.length() - 1.0).abs());
            let rotation = if is_rounded { rotation.normalize() } else { rotation };
            PathPose { seconds, world_from_object: Rigid { rotation, translation } }
        };
        let path = track.poses.into_iter().map(pose).collect();
        MovingObject { id, class: track.class, low: track.low.into(), high: track.high.into(), path }
    };
    let mut objects: Vec<MovingObject> = file.tracks.into_iter().map(object).collect();
    objects.sort_by(|a, b| a.id.cmp(&b.id));
    check_all(&objects)?;
    if let Some((name, _)) = file.seconds.iter().find(|(_, seconds)| !seconds.is_finite()) {
        return Err(CodecError::new(format!("the time of {name:?} is not finite")));
    }
    Ok(Tracks { objects, seconds: file.seconds })
}

/// Encodes objects and the times of photos.
pub fn write(tracks: &Tracks) -> Vec<u8> {
    let track = |object: &MovingObject| Track {
        id: Some(object.id.clone()),
        instance: None,
        class: object.class.clone(),
        low: object.low.to_array(),
        high: object.high.to_array(),
        poses: (object.path.iter())
            .map(|PathPose { seconds, world_from_object: at }| {
                (*seconds, at.translation.to_array(), at.rotation.to_array())
            })
            .collect(),
        positions: Vec::new(),
    };
    let file = File { tracks: tracks.objects.iter().map(track).collect(), seconds: tracks.seconds.clone() };
    let mut bytes = serde_json::to_vec(&file).expect("numbers and texts are JSON");
    bytes.push(b'\n');
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn car() -> MovingObject {
        let pose = |seconds: f64, x: f64, turn: f64| PathPose {
            seconds,
            world_from_object: Rigid { rotation: DQuat::from_rotation_z(turn), translation: DVec3::new(x, 2.0, 0.0) },
        };
        MovingObject {
            id: "car-1".into(),
            class: "car".into(),
            low: DVec3::new(-2.0, -1.0, 0.0),
            high: DVec3::new(2.0, 1.0, 1.5),
            path: vec![pose(1.0, 0.0, 0.0), pose(2.0, 10.0, 0.2), pose(5.0, 30.0, 0.4), pose(5.5, 31.0, 0.4)],
        }
    }

    #[test]
    fn a_path_is_followed_between_its_poses_and_ends_with_them() {
        let car = car();
        let x = |seconds: f64| car.pose(seconds).map(|pose| pose.translation.x);
        assert_eq!([x(1.0), x(1.25), x(2.0), x(5.25)], [Some(0.0), Some(2.5), Some(10.0), Some(30.5)]);
        assert_eq!([x(0.8), x(3.5), x(5.7)], [Some(0.0), Some(20.0), Some(31.0)]);
        assert_eq!([x(0.5), x(6.0), x(f64::NAN)], [None; 3]);
        let turned = car.pose(1.5).unwrap().rotation * DVec3::X;
        assert!((turned.y.atan2(turned.x) - 0.1).abs() < 1e-9);
    }

    #[test]
    fn a_refined_path_has_the_motions_and_what_lies_between_them() {
        let car = car();
        let along = |x: f64| Rigid { translation: DVec3::new(x, 0.0, 0.0), ..Rigid::IDENTITY };
        let moved = car.moved(&[(1.0, along(0.5)), (1.5, along(1.0)), (5.2, along(0.0)), (9.0, along(7.0))]);
        // Nothing is known at 9 s, so there is no pose; the motion after 5.2 s is on its way there.
        assert_eq!(moved.iter().map(|pose| pose.seconds).collect::<Vec<_>>(), [1.0, 1.5, 2.0, 5.0, 5.2, 5.5]);
        let by = |i: usize| {
            let (given, refined) = (car.pose(moved[i].seconds).unwrap(), moved[i].world_from_object);
            given.inverse().after(&refined)
        };
        for (i, x) in [0.5, 1.0, 1.0 - 0.5 / 3.7, 0.2 / 3.7, 0.0, 7.0 * 0.3 / 3.8].into_iter().enumerate() {
            assert!((by(i).translation - DVec3::new(x, 0.0, 0.0)).length() < 1e-9, "{i}: {:?}", by(i));
        }
        assert_eq!(car.moved(&[]), car.path);
        // A photo a moment before the first pose and one after the last: the ends of the path stay where they are in time.
        let ends = car.moved(&[(0.8, along(0.5)), (5.7, along(0.5))]);
        assert_eq!(ends.iter().map(|pose| pose.seconds).collect::<Vec<_>>(), [1.0, 2.0, 5.0, 5.5]);
        assert!((ends[0].world_from_object.translation.x - 0.5).abs() < 1e-9);
    }

    #[test]
    fn a_trained_object_survives_its_frame_and_a_wrong_one_is_refused() {
        let car = car();
        let mut splats = Splats::new(1);
        splats.push(&crate::Splat::round(glam::Vec3::ONE, -2.0, glam::Vec3::splat(0.4), 0.3));
        let swing = Swing { stride_metres: 1.4, amplitudes: vec![[0.1; crate::swing::NUMBERS]] };
        for swing in [None, Some(&swing)] {
            let bytes = to_frame(&car.path[..2], &splats, swing);
            let (about, read, swings) = from_frame(&bytes, &car).unwrap();
            assert_eq!((&about.path[..], &about.id, read), (&car.path[..2], &car.id, splats.clone()));
            assert_eq!(swings.as_ref(), swing);
            for at in 0..bytes.len() {
                let mut damaged = bytes.clone();
                damaged[at] ^= 0x20;
                assert!(from_frame(&damaged, &car).is_err(), "flip at {at} was not detected");
            }
        }
        let two = Swing { amplitudes: vec![[0.1; crate::swing::NUMBERS]; 2], ..swing };
        assert!(from_frame(&to_frame(&car.path, &splats, Some(&two)), &car).unwrap_err().0.contains("another number"));
        let cut = frame::encode(OBJECT, &Header { path: car.path.clone(), splats_bytes: u64::MAX }, b"splats");
        assert!(from_frame(&cut, &car).unwrap_err().0.contains("cut short"));
        let mut jumps = car.path.clone();
        jumps[1].world_from_object.translation.x = 1e4;
        assert!(from_frame(&to_frame(&jumps, &splats, None), &car).unwrap_err().0.contains("jumps"));
        assert!(from_frame(&to_frame(&[], &splats, None), &car).is_err());
        assert!(from_frame(&frame::encode(OBJECT, &car.path, b"no splats"), &car).is_err());
    }

    #[test]
    fn corners_grow_from_the_centre() {
        let corners = car().corners(0.1, 0.2);
        assert!((corners[0] - DVec3::new(-2.4, -1.3, -0.275)).length() < 1e-9);
        assert!((corners[7] - DVec3::new(2.4, 1.3, 1.775)).length() < 1e-9);
        assert_eq!(corners[1].x, corners[7].x);
    }

    #[test]
    fn tracks_survive_their_file() {
        let seconds = BTreeMap::from([("a.png".to_owned(), 1.5), ("b/c.jpg".to_owned(), -2.25)]);
        let tracks = Tracks { objects: vec![car(), MovingObject { id: "z".into(), ..car() }], seconds };
        let read_back = read(&write(&tracks)).unwrap();
        assert_eq!(read_back.seconds, tracks.seconds);
        assert_eq!(read_back.objects.len(), 2);
        for (a, b) in read_back.objects.iter().zip(&tracks.objects) {
            assert_eq!((&a.id, &a.class, a.low, a.high), (&b.id, &b.class, b.low, b.high));
            let pose = |of: &MovingObject| of.pose(1.75).unwrap().apply(DVec3::ONE);
            assert!((pose(a) - pose(b)).length() < 1e-9);
        }
        // As plat synth writes it.
        let text = r#"{"about": "…", "tracks": [{"asset": "van", "instance": 7, "class": "car", "low": [0, 0, 0],
            "high": [4, 2, 1.5], "poses": [[0.5, [1, 2, 3], [0.0, 0.0, 0.707107, 0.707107]]]}]}"#;
        assert_eq!(read(text.as_bytes()).unwrap().objects[0].id, "7");
    }

    #[test]
    fn positions_stand_for_poses_only_where_they_may() {
        let text = r#"{"tracks": [{"id": "a", "class": "car", "low": [0, 0, 0], "high": [4, 2, 1.5],
            "positions": [[0.5, [1, 2, 3]], [1, [2, 2, 3]]]}], "seconds": {"x.png": 0.7}}"#;
        let found = read_positions(text.as_bytes()).unwrap();
        let path = &found.objects[0].path;
        assert_eq!((path.len(), path[1].seconds, path[1].world_from_object.translation.x), (2, 1.0, 2.0));
        assert_eq!(found.seconds.len(), 1);
        assert!(read(text.as_bytes()).unwrap_err().to_string().contains("positions"));
        let both = text.replace("\"class\"", "\"poses\": [[0, [0, 0, 0], [0, 0, 0, 1]]], \"class\"");
        assert!(read_positions(both.as_bytes()).unwrap_err().to_string().contains("poses and positions"));
        let jumps = text.replace("[2, 2, 3]", "[500, 2, 3]");
        assert!(read_positions(jumps.as_bytes()).unwrap_err().to_string().contains("jumps"));
        let posed = write(&Tracks { objects: vec![car()], ..Tracks::default() });
        assert_eq!(read_positions(&posed), read(&posed));
    }

    #[test]
    fn wrong_objects_are_refused_by_name() {
        type Change = (fn(&mut MovingObject), &'static str);
        let changes: [Change; 12] = [
            (|o| o.id = "../x".into(), "name"),
            (|o| o.id.clear(), "name"),
            (|o| o.class.clear(), "class"),
            (|o| o.class = "a\nb".into(), "class"),
            (|o| o.high.z = o.low.z, "no size"),
            (|o| o.high.x = f64::INFINITY, "no size"),
            (|o| o.path.clear(), "no pose"),
            (|o| o.path[1].world_from_object.translation.y = f64::NAN, "not finite"),
            (|o| o.path[1].world_from_object.rotation = DQuat::from_xyzw(0.0, 0.0, 0.0, 2.0), "not a rotation"),
            (|o| o.path[1].seconds = 1.0, "order of time"),
            (|o| o.path[1].seconds = f64::NAN, "not finite"),
            (|o| o.path[1].world_from_object.translation.x = 500.0, "jumps 500.0 m between 1 and 2 s"),
        ];
        for (change, problem) in changes {
            let mut object = car();
            change(&mut object);
            let error = object.check().unwrap_err().to_string();
            assert!(error.contains(problem), "{error}");
        }
        let twice = check_all(&[car(), car()]).unwrap_err().to_string();
        assert!(twice.contains("two objects are named \"car-1\""), "{twice}");
        let late = Tracks { seconds: BTreeMap::from([("a".to_owned(), 1.0)]), ..Tracks::default() };
        assert!(read(&write(&late)).is_ok() && read(b"{\"tracks\": 3}").is_err());
    }
}
