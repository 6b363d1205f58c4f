//! A folder of label maps: for each photo a PNG as large as it, whose pixels have the ids of what a segmentation tool saw
//! there, as Cityscapes' `instanceIds` have them: class × 1000 + number for an object, and the class alone for pixels of
//! no single one, which become one zone.

use std::path::{Path, PathBuf};

use scene::{BadInput, Capture, Pinhole, Zone, Zones};

use super::classes::Classes;
use super::id_map::IdMap;
use crate::ingest::{LastUndistorter, undistorter};
use crate::open::{LabelMapFiles, Photo, Source};

/// The label maps of a capture's photos.
pub struct LabelMaps {
    folder: String,
    classes: Classes,
    /// For each view its map, its photo, and the camera that the photo becomes.
    views: Vec<(Option<PathBuf>, Photo, Pinhole)>,
}

impl LabelMaps {
    /// Finds the maps of a capture's photos in a folder, and reads which ids are objects. No map is decoded.
    ///
    /// # Errors
    /// A folder without a map of any photo, a map of another size than its photo, or classes that cannot be read.
    pub fn open(folder: &Path, source: &Source) -> Result<Self, BadInput> {
        let files = LabelMapFiles::find(folder, source)?;
        let classes = files.classes.map(|(path, text)| Classes::read(&path, &text)).transpose()?.unwrap_or_default();
        let pinholes = source.capture.views.iter().map(|view| view.camera.pinhole);
        let photos = source.photos.iter().map(|photo| Photo { boxes: Vec::new(), ..photo.clone() });
        let views = files.of_photos.into_iter().zip(photos).zip(pinholes);
        let views = views.map(|((file, photo), pinhole)| (file, photo, pinhole)).collect();
        Ok(Self { folder: folder.display().to_string(), classes, views })
    }

    /// The objects as zones of the ingested capture's views, without lens distortion, as masks of photos are.
    ///
    /// # Errors
    /// A damaged map, one of more than [`Zones::MAX`] objects, or maps without any object.
    pub(super) fn zones(&self, capture: &Capture, progress: &dyn Fn(usize, usize)) -> Result<Zones, BadInput> {
        if self.views.len() != capture.views.len() {
            return Err(BadInput::new(&self.folder, "is of another capture", "open the capture again"));
        }
        let (mut of_views, mut last): (Vec<_>, LastUndistorter) = (Vec::with_capacity(self.views.len()), None);
        for (view, (file, photo, ideal)) in capture.views.iter().zip(&self.views) {
            let zones = match file {
                None => Vec::new(),
                Some(file) => {
                    let map = IdMap::read(file, [photo.width, photo.height])?;
                    let map = map.undistorted(undistorter(photo, *ideal, &mut last)?);
                    let masks = map.masks(&view.camera.pinhole, |id| self.classes.class_of(id).is_some())?;
                    let zones = masks.into_iter().filter_map(|(id, (mask, corners))| {
                        Some(Zone { corners, class: self.classes.class_of(id)?, score: 1.0, mask: Some(mask) })
                    });
                    zones.collect()
                }
            };
            of_views.push(zones);
            progress(of_views.len(), self.views.len());
        }
        let names = self.classes.names();
        if of_views.iter().all(Vec::is_empty) {
            let problem = format!("shows no object of the classes {}", names.join(", "));
            let advice = "list the ids that are objects in its classes.json or classes.txt";
            return Err(BadInput::new(&self.folder, problem, advice));
        }
        Ok(Zones { classes: names, of_views })
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use image::{GrayImage, Luma, RgbImage};
    use serde_json::json;
    use store::Store;

    use super::super::photos::{reader, whole};
    use super::*;
    use crate::ingest::{IngestOptions, ingest};
    use crate::open::{OpenOptions, open};

    #[test]
    fn labels_are_undistorted_as_masks_are() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let frame = |name: &str, x: f64| {
            let pose = [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
            json!({"file_path": name, "transform_matrix": pose})
        };
        let lens = json!({"w": 80, "h": 60, "fl_x": 60, "fl_y": 60, "cx": 40, "cy": 30, "k1": -0.2, "k2": 0.05,
            "frames": [frame("a.png", 0.0), frame("b.png", 0.1)]});
        fs::write(at("transforms.json"), lens.to_string()).unwrap();
        fs::create_dir(at("maps")).unwrap();
        fs::create_dir(at("masks")).unwrap();
        RgbImage::new(80, 60).save(at("a.png")).unwrap();
        RgbImage::new(80, 60).save(at("b.png")).unwrap();
        let is_object = |x: u32, y: u32| x * x + 3 * y * y > 2000 && (x / 8 + y / 8).is_multiple_of(2);
        let image = |value: u8| GrayImage::from_fn(80, 60, |x, y| Luma([if is_object(x, y) { value } else { 0 }]));
        image(255).save(at("masks/a.png")).unwrap();
        image(26).save(at("maps/a.png")).unwrap();

        let source = open(folder.path(), &OpenOptions::default()).unwrap();
        let store = Store::open("memory://").unwrap().blocking();
        let maps = LabelMaps::open(&at("maps"), &source).unwrap();
        let capture = ingest(&source, &store, &IngestOptions { downscale: 1, threads: 1 }, &|_, _| ()).unwrap().capture;
        assert_ne!(capture.views[0].camera.pinhole.width, 80, "the lens distorts");
        let zones = maps.zones(&capture, &|_, _| ()).unwrap();
        zones.check(&capture.views).unwrap();
        let ([zone], []) = (zones.of(0), zones.of(1)) else { panic!("{zones:?}") };
        assert_eq!(zones.classes[usize::from(zone.class)], "car");
        let photo = whole(&reader(&capture, &store), 0).unwrap();
        let mut shown = vec![0; photo.area()];
        for (y, x) in zone.mask.iter().flat_map(|mask| mask.spans(photo.width)) {
            shown[(y * photo.width) as usize..][x.start as usize..x.end as usize].fill(255);
        }
        assert!(Some(shown) == photo.mask && zone.area() > 500.0);
    }
}
