//! Which objects the photos of a generated city show, and where: what detections can be compared with.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use glam::{DQuat, DVec3};
use scene::transforms::{self, Frame};
use scene::{BadInput, Camera, Pinhole, View};
use serde::Deserialize;

use crate::open::truth_boxes;

/// A line of `boxes3d.json` is a photo; one with 1,000 objects has 300 kB.
const LINE_BYTES: u64 = 1 << 26;
/// Nothing nearer can be projected, metres.
const NEAR: f64 = 0.05;

/// An object in a photo.
#[derive(Debug, Clone, PartialEq)]
pub struct SeenObject {
    /// Its number, that of its pixels in the maps of instances.
    pub instance: u32,
    /// As `plat synth` names it: `car`, `person`, `rider` …
    pub class: String,
    /// Left, top, right, bottom of its visible pixels, in pixels of the view.
    pub corners: [f32; 4],
    /// Area of these bounds over that of the whole object's, 0..1: less than 1 where others or the photo's edge hide
    /// it, 0 if it reaches behind the camera. The whole object's are those of its box in the world, so an object that
    /// nothing hides has a little less than 1.
    pub visible: f32,
}

/// The objects of all photos.
#[derive(Debug)]
pub struct TrueBoxes {
    /// By photo, with its size.
    photos: BTreeMap<String, (Pinhole, Vec<SeenObject>)>,
}

/// A line of `boxes3d.json`.
#[derive(Deserialize)]
struct Line {
    image: String,
    boxes: Vec<Object>,
}

#[derive(Deserialize)]
struct Object {
    instance: u32,
    class: String,
    centre: DVec3,
    size: DVec3,
    rotation: DQuat,
    box2d: [u32; 4],
}

impl TrueBoxes {
    /// Reads the true boxes of the capture at this path; `None` unless `plat synth` wrote it.
    ///
    /// # Errors
    /// A path that is no capture, or files that cannot be read.
    pub fn open(path: &Path) -> Result<Option<Self>, BadInput> {
        let Some([boxes, cameras]) = truth_boxes(path)? else { return Ok(None) };
        let bad = |file: &Path, problem: String| {
            BadInput::new(file.display().to_string(), problem, "write the capture again with plat synth")
        };
        let bytes = std::fs::read(&cameras).map_err(|error| bad(&cameras, format!("cannot be read ({error})")))?;
        let frames = transforms::read(&bytes).map_err(|error| bad(&cameras, error.to_string()))?.frames;
        let cameras: BTreeMap<String, Camera> =
            frames.iter().filter_map(|frame| Some((frame.file_path.clone(), camera(frame)?))).collect();
        let mut photos = BTreeMap::new();
        let mut reader =
            BufReader::new(File::open(&boxes).map_err(|error| bad(&boxes, format!("cannot be read ({error})")))?);
        let mut line = String::new();
        while {
            line.clear();
            let read = reader.by_ref().take(LINE_BYTES).read_line(&mut line);
            read.map_err(|error| bad(&boxes, format!("cannot be read ({error})")))? > 0
        } {
            // The first and the last line hold the list.
            let text = line.trim_end().trim_end_matches(',');
            if !text.starts_with("{\"boxes\"") && !text.starts_with("{\"image\"") {
                continue;
            }
            let Line { image, boxes: objects } =
                serde_json::from_str(text).map_err(|error| bad(&boxes, format!("has a damaged line ({error})")))?;
            let Some(camera) = cameras.get(&image) else {
                return Err(bad(&boxes, format!("has a photo {image:?} that has no true camera")));
            };
            let objects = objects.into_iter().map(|of| seen(of, camera)).collect();
            photos.insert(image.strip_prefix("images/").unwrap_or(&image).to_owned(), (camera.pinhole, objects));
        }
        if photos.is_empty() {
            return Err(bad(&boxes, "has no line of a photo".to_owned()));
        }
        Ok(Some(Self { photos }))
    }

    /// The objects of a view, whose photo may have been ingested at a smaller size; `None` if it has another name or
    /// shape.
    pub fn of_view(&self, view: &View) -> Option<Vec<SeenObject>> {
        let (whole, objects) = self.photos.get(&view.name)?;
        let Pinhole { width, height, .. } = view.camera.pinhole;
        let downscale = whole.width.checked_div(width)?;
        let fits = downscale > 0 && [whole.width / downscale, whole.height / downscale] == [width, height];
        let scaled = |of: &SeenObject| {
            let [left, top, right, bottom] = of.corners.map(|corner| corner / downscale as f32);
            let corners = [left, top, right.min(width as f32), bottom.min(height as f32)];
            SeenObject { corners, ..of.clone() }
        };
        fits.then(|| objects.iter().map(scaled).collect())
    }
}

/// The camera of a frame that `plat synth` wrote: all of its intrinsics, no distortion.
fn camera(frame: &Frame) -> Option<Camera> {
    let (width, height) = frame.intrinsics.size?;
    let [fx, fy, cx, cy] = frame.intrinsics.model(width, height).focal_and_centre();
    let pinhole = Pinhole { width, height, fx, fy, cx, cy };
    Some(Camera { pinhole, camera_from_world: frame.camera_from_world })
}

fn seen(Object { instance, class, centre, size, rotation, box2d }: Object, camera: &Camera) -> SeenObject {
    let corners = box2d.map(|side| side as f32);
    let area = |[left, top, right, bottom]: [f64; 4]| (right - left).max(0.0) * (bottom - top).max(0.0);
    let mut whole = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
    let mut is_ahead = true;
    for corner in 0..8 {
        let side = |axis: u32| if corner >> axis & 1 == 0 { -0.5 } else { 0.5 };
        let (pixel, depth) = camera.project(centre + rotation * (size * DVec3::new(side(0), side(1), side(2))));
        is_ahead &= depth > NEAR;
        whole = [whole[0].min(pixel.x), whole[1].min(pixel.y), whole[2].max(pixel.x), whole[3].max(pixel.y)];
    }
    let visible = if is_ahead { area(box2d.map(f64::from)) / area(whole) } else { 0.0 };
    // An object without extent has no share.
    let visible = if visible.is_finite() { visible.clamp(0.0, 1.0) as f32 } else { 0.0 };
    SeenObject { instance, class, corners, visible }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::open::{OpenOptions, open};
    use crate::synth::{self, Settings};

    #[test]
    fn a_city_tells_its_objects_and_other_captures_tell_none() {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path().join("city");
        let settings = Settings { views: 8, width: 96, height: 64, aerial: 0.0, ..Settings::default() };
        synth::write(&at, &settings, &|_, _, _| ()).unwrap();
        let truth = TrueBoxes::open(&at).unwrap().unwrap();
        assert_eq!(truth.photos.len(), 8);
        let views = open(&at, &OpenOptions::default()).unwrap().capture.views;
        let all: Vec<SeenObject> = views.iter().flat_map(|view| truth.of_view(view).unwrap()).collect();
        assert!(all.iter().any(|of| of.class == "car") && all.iter().any(|of| of.visible > 0.6), "{all:?}");
        assert!(all.iter().any(|of| of.visible < 0.4), "something hides something");
        for of in &all {
            let [left, top, right, bottom] = of.corners;
            assert!(left < right && right <= 96.0 && top < bottom && bottom <= 64.0, "{of:?}");
        }
        // Half the size, another name, another shape.
        let mut view = views[0].clone();
        let whole = truth.of_view(&view).unwrap();
        (view.camera.pinhole.width, view.camera.pinhole.height) = (48, 32);
        let half = truth.of_view(&view).unwrap();
        assert!(whole.iter().zip(&half).all(|(a, b)| a.corners == b.corners.map(|side| 2.0 * side)));
        view.camera.pinhole.height = 30;
        assert_eq!(truth.of_view(&view), None);
        view.name = "other.png".into();
        assert_eq!(truth.of_view(&view), None);

        let text = std::fs::read_to_string(at.join("boxes3d.json")).unwrap();
        std::fs::write(at.join("boxes3d.json"), text.replace("\"class\"", "\"klass\"")).unwrap();
        assert!(TrueBoxes::open(&at).unwrap_err().to_string().contains("damaged line"));
        std::fs::remove_file(at.join("boxes3d.json")).unwrap();
        assert!(TrueBoxes::open(&at).unwrap().is_none());
        assert!(TrueBoxes::open(&folder.path().join("none")).is_err());
    }

    #[test]
    fn an_object_is_visible_by_the_share_of_its_bounds() {
        // A cube of 2 m whose front is 9 m ahead of a camera of 90 pixels' focal length: 20 × 20 pixels.
        let pinhole = Pinhole { width: 100, height: 100, fx: 90.0, fy: 90.0, cx: 50.0, cy: 50.0 };
        let camera = Camera { pinhole, camera_from_world: scene::Rigid::IDENTITY };
        let cube = |z: f64, box2d: [u32; 4]| {
            let (centre, size, rotation) = (DVec3::new(0.0, 0.0, z), DVec3::splat(2.0), DQuat::IDENTITY);
            seen(Object { instance: 1, class: "car".into(), centre, size, rotation, box2d }, &camera).visible
        };
        assert_eq!([cube(10.0, [40, 40, 60, 60]), cube(10.0, [40, 40, 60, 50])], [1.0, 0.5]);
        assert_eq!([cube(0.5, [0, 0, 100, 100]), cube(10.0, [40, 40, 40, 40])], [0.0, 0.0]);
    }
}
