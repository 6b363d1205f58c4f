//! The labels that a capture itself has: the boxes of DGP, nuScenes and Waymo, and the objects of generated cities.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use scene::{BadInput, Capture, MaskBuilder, View, Zone, Zones};

use super::id_map::IdMap;
use crate::box_masks::covered;
use crate::open::{LabelledBox, Photo, Source, truth_instances};
use crate::true_boxes::TrueBoxes;

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
    let zone = |of: &crate::true_boxes::SeenObject| {
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
