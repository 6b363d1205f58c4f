//! The labels that a capture itself has: the boxes of DGP, nuScenes and Waymo, and the objects of generated cities.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use scene::{BadInput, Capture, MaskBuilder, View, Zone, Zones};

use super::id_map::IdMap;
use crate::box_masks::covered;
use crate::open::{LabelledBox, Photo, Source, truth_instances};
use crate::true_boxes::{SeenObject, TrueBoxes};

/// The labels of a capture.
pub struct OwnLabels {
    capture: String,
    labels: Labels,
}

enum Labels {
    /// The objects of a generated city, the folder of its maps of instances if it has them, and the sizes of its photos.
    City(TrueBoxes, Option<PathBuf>, Vec<[u32; 2]>),
    /// The boxes that each photo may show.
    Boxes(Vec<Vec<LabelledBox>>),
}

/// The classes so far, by name.
#[derive(Default)]
struct Numbers(BTreeMap<String, u16>);

impl OwnLabels {
    /// Those of an opened capture at this path.
    ///
    /// # Errors
    /// A capture without labels, or labels that cannot be read.
    pub fn open(path: &Path, source: &Source) -> Result<Self, BadInput> {
        let capture = path.display().to_string();
        if let Some(objects) = TrueBoxes::open(path)? {
            let size = |photo: &Photo| [photo.width, photo.height];
            let sizes = source.photos.iter().map(size).collect();
            return Ok(Self { capture, labels: Labels::City(objects, truth_instances(path)?, sizes) });
        }
        let boxes: Vec<_> = source.photos.iter().map(|photo| photo.boxes.clone()).collect();
        if boxes.iter().all(Vec::is_empty) {
            let problem = "has no labels of its own: no boxes of DGP, nuScenes or Waymo, and no generated city's";
            let advice = "give --detector, or a file of boxes or a folder of label maps as --zones";
            return Err(BadInput::new(capture, problem, advice));
        }
        Ok(Self { capture, labels: Labels::Boxes(boxes) })
    }

    /// The objects as zones of the ingested capture's views: the pixels that their boxes cover, whatever hides them; of a
    /// generated city the bounds of what is visible, or the visible pixels if it has maps of instances.
    ///
    /// # Errors
    /// More than [`Zones::MAX`] objects of a photo, or maps that cannot be read.
    pub(super) fn zones(&self, capture: &Capture, progress: &dyn Fn(usize, usize)) -> Result<Zones, BadInput> {
        let (mut numbers, mut of_views) = (Numbers::default(), Vec::with_capacity(capture.views.len()));
        for (i, view) in capture.views.iter().enumerate() {
            let zones = match &self.labels {
                Labels::City(objects, instances, sizes) => {
                    let map = instances.as_ref().zip(sizes.get(i));
                    visible(view, objects, map, &mut numbers)?
                }
                Labels::Boxes(boxes) => {
                    let boxes = boxes.get(i).into_iter().flatten();
                    boxes.filter_map(|of| projected(view, of, &mut numbers)).collect()
                }
            };
            if zones.len() > Zones::MAX {
                let problem = format!("has {} labels of {}, and {} are the most", zones.len(), view.name, Zones::MAX);
                return Err(BadInput::new(&self.capture, problem, "give --detector, or a file as --zones"));
            }
            of_views.push(zones);
            progress(of_views.len(), capture.views.len());
        }
        let mut classes = vec![String::new(); numbers.0.len()];
        numbers.0.into_iter().for_each(|(name, number)| classes[usize::from(number)] = name);
        Ok(Zones { classes, of_views })
    }
}

impl Numbers {
    /// The number of a class; `None` beyond 65,536 of them.
    fn of(&mut self, class: &str) -> Option<u16> {
        if let Some(&number) = self.0.get(class) {
            return Some(number);
        }
        let number = u16::try_from(self.0.len()).ok()?;
        self.0.insert(class.to_owned(), number);
        Some(number)
    }
}

/// The visible objects of a photo of a generated city.
fn visible(
    view: &View,
    objects: &TrueBoxes,
    map: Option<(&PathBuf, &[u32; 2])>,
    numbers: &mut Numbers,
) -> Result<Vec<Zone>, BadInput> {
    let objects = objects.of_view(view).unwrap_or_default();
    let masks = match map {
        Some((folder, size)) if !objects.is_empty() => {
            let name = Path::new(&view.name).with_extension("png");
            let instances: Vec<u32> = objects.iter().map(|of| of.instance).collect();
            let map = IdMap::read(&folder.join(name), *size)?;
            Some(map.masks(&view.camera.pinhole, |id| instances.contains(&id))?)
        }
        _ => None,
    };
    let zone = |of: &SeenObject| {
        let (corners, mask) = match &masks {
            None => (of.corners, None),
            // An object may have no pixel left in a smaller photo.
            Some(masks) => masks.get(&of.instance).map(|(mask, corners)| (*corners, Some(mask.clone())))?,
        };
        let [left, top, right, bottom] = corners;
        let class = numbers.of(&of.class).filter(|_| left < right && top < bottom)?;
        Some(Zone { corners, class, score: 1.0, mask })
    };
    Ok(objects.iter().filter_map(zone).collect())
}

/// The pixels that a box covers; `None` if there are none.
fn projected(view: &View, of: &LabelledBox, numbers: &mut Numbers) -> Option<Zone> {
    let pinhole = &view.camera.pinhole;
    let mut builder = MaskBuilder::new(pinhole.width);
    covered(&of.corners, pinhole).for_each(|(row, columns)| builder.push(row, columns));
    let (mask, corners) = builder.finish()?;
    Some(Zone { corners, class: numbers.of(&of.class)?, score: 1.0, mask: Some(mask) })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use perceive::iou;

    use super::*;
    use crate::open::tests::shared;
    use crate::open::{OpenOptions, open};
    use crate::synth::{self, Settings};

    #[test]
    fn boxes_of_a_drive_cover_the_objects_that_its_photos_show() {
        let folder = tempfile::tempdir().unwrap();
        let (aerial, nuscenes, spacing) = (0.0, true, Some(12.0));
        let settings =
            Settings { aerial, nuscenes, spacing, views: 60, width: 192, height: 128, ..Settings::default() };
        synth::write(folder.path(), &settings, &|_, _, _| ()).unwrap();
        let objects = TrueBoxes::open(folder.path()).unwrap().unwrap();
        let drives = folder.path().join("nuscenes");
        let scenes: Vec<serde_json::Value> =
            serde_json::from_slice(&fs::read(drives.join("v1.0-mini/scene.json")).unwrap()).unwrap();
        let (mut found, mut all) = (0, 0);
        for scene in scenes {
            let path = drives.join(scene["name"].as_str().unwrap());
            let source = open(&path, &OpenOptions::default()).unwrap();
            let zones = OwnLabels::open(&path, &source).unwrap().zones(&source.capture, &|_, _| ()).unwrap();
            zones.check(&source.capture.views).unwrap();
            assert!(zones.classes.iter().any(|class| class == "vehicle.car"), "{:?}", zones.classes);
            for (view, zones) in source.capture.views.iter().zip(&zones.of_views) {
                let name = view.name.rsplit_once('/').unwrap().1.to_owned();
                let objects = objects.of_view(&View { name, ..view.clone() }).unwrap();
                let is_plain = |of: &&SeenObject| of.visible > 0.8 && of.class == "car";
                for object in objects.iter().filter(is_plain) {
                    all += 1;
                    found += usize::from(zones.iter().any(|zone| iou(zone.corners, object.corners) > 0.6));
                }
            }
        }
        assert!(all > 20 && 10 * found >= 9 * all, "{found} of {all}");
    }

    #[test]
    fn a_real_drive_has_its_labels() {
        let Some(path) = shared("drive_dgp_scene_01") else { return };
        let source = open(&path, &OpenOptions::default()).unwrap();
        let zones = OwnLabels::open(&path, &source).unwrap().zones(&source.capture, &|_, _| ()).unwrap();
        zones.check(&source.capture.views).unwrap();
        let car = zones.classes.iter().position(|class| class == "Car").unwrap();
        let cars = zones.of_views.iter().flatten().filter(|zone| usize::from(zone.class) == car);
        assert!(cars.count() > 50 && zones.of_views.iter().all(|zones| !zones.is_empty()));
        // A box seen from outside covers more than half of its bounds.
        assert!(zones.of_views.iter().flatten().all(|zone| {
            let [left, top, right, bottom] = zone.corners;
            zone.area() >= 0.3 * (right - left) * (bottom - top)
        }));
    }

    #[test]
    fn a_capture_without_labels_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let settings = Settings { views: 24, width: 48, height: 32, ..Settings::default() };
        synth::write(folder.path(), &settings, &|_, _, _| ()).unwrap();
        fs::remove_file(folder.path().join("manifest.json")).unwrap();
        let source = open(folder.path(), &OpenOptions::default()).unwrap();
        let line = OwnLabels::open(folder.path(), &source).err().unwrap().to_string();
        assert!(line.contains("has no labels of its own"), "{line}");
    }
}
