//! Boxes and masks in COCO's layout (<https://cocodataset.org/#format-data>), which labelling and segmentation tools
//! export: `images` (`id`, `file_name`, `width`, `height`), `annotations` (`image_id`, `category_id`, `bbox`: left, top,
//! width, height in pixels, `segmentation`: polygons or run lengths, one of both at least, and `score` where a network
//! wrote them) and `categories` (`id`, `name`).

mod segmentation;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::Read;
use std::path::Path;

use scene::{BadInput, Capture, Zone, ZoneMask, Zones};
use serde::Deserialize;

use self::segmentation::Segmentation;

/// Largest file that is read.
const MAX_BYTES: u64 = 256 << 20;
/// Longest side of an image, pixels: the limit of JPEG.
const MAX_SIDE: u32 = 65_535;
const ADVICE: &str = "give objects in COCO's layout: images, annotations with bbox or segmentation, categories";

/// A file of objects.
#[derive(Debug)]
pub struct CocoFile {
    file: String,
    objects: Objects,
}

#[derive(Debug, Deserialize)]
struct Objects {
    images: Vec<Image>,
    annotations: Vec<Annotation>,
    categories: Vec<Category>,
}

#[derive(Debug, Deserialize)]
struct Image {
    id: i64,
    file_name: String,
    width: u32,
    height: u32,
}

#[derive(Debug, Deserialize)]
struct Annotation {
    image_id: i64,
    category_id: i64,
    bbox: Option<[f64; 4]>,
    segmentation: Option<Segmentation>,
    #[serde(default = "sure")]
    score: f32,
}

#[derive(Debug, Deserialize)]
struct Category {
    id: i64,
    name: String,
}

/// The score of a box that a person drew.
fn sure() -> f32 {
    1.0
}

impl CocoFile {
    /// Reads a file.
    ///
    /// # Errors
    /// A file that cannot be read, is too large, or is no such JSON.
    pub fn read(path: &Path) -> Result<Self, BadInput> {
        let file = path.display().to_string();
        let bad = |problem: String| BadInput::new(file.clone(), problem, ADVICE);
        let mut bytes = Vec::new();
        let opened = File::open(path).and_then(|opened| opened.take(MAX_BYTES + 1).read_to_end(&mut bytes));
        opened.map_err(|error| bad(format!("cannot be read ({error})")))?;
        if bytes.len() as u64 > MAX_BYTES {
            return Err(bad(format!("is larger than {} MB", MAX_BYTES >> 20)));
        }
        let objects =
            serde_json::from_slice(&bytes).map_err(|error| bad(format!("has no objects to use ({error})")))?;
        Ok(Self { file, objects })
    }

    /// The objects as zones of a capture's views, at the size of their mip 0. Images that the capture does not have are
    /// left out, and objects without a pixel.
    ///
    /// # Errors
    /// No image of the capture, an object outside its image, more than [`Zones::MAX`] of an image, an unknown category, or
    /// damaged run lengths.
    pub fn zones(&self, capture: &Capture) -> Result<Zones, BadInput> {
        let bad = |problem: String| BadInput::new(self.file.clone(), problem, ADVICE);
        let views = &capture.views;
        let has_no_size =
            |image: &&Image| image.width.min(image.height) == 0 || image.width.max(image.height) > MAX_SIDE;
        if let Some(Image { file_name, width, height, .. }) = self.objects.images.iter().find(has_no_size) {
            return Err(bad(format!("gives {file_name:?} {width}×{height} pixels: none, or over {MAX_SIDE} a side")));
        }
        let by_name: BTreeMap<&str, usize> = views.iter().map(|view| view.name.as_str()).zip(0..).collect();
        let of_image = |image: &Image| by_name.get(image.file_name.trim_start_matches("./")).copied();
        let images: BTreeMap<i64, (&Image, usize)> =
            self.objects.images.iter().filter_map(|image| Some((image.id, (image, of_image(image)?)))).collect();
        if images.is_empty() {
            let first =
                self.objects.images.first().map_or(String::new(), |image| format!(" (such as {:?})", image.file_name));
            let example = views.first().map_or("", |view| view.name.as_str());
            return Err(bad(format!("names no photo of the capture{first}; theirs are like {example:?}")));
        }
        let known: BTreeMap<i64, usize> = self.objects.categories.iter().map(|c| c.id).zip(0..).collect();
        if known.len() > usize::from(u16::MAX) {
            return Err(bad(format!("has {} categories, and {} are the most", known.len(), u16::MAX)));
        }
        let all: BTreeSet<i64> = self.objects.images.iter().map(|image| image.id).collect();
        let mut of_views = vec![Vec::new(); views.len()];
        for annotation in &self.objects.annotations {
            let Annotation { image_id, category_id, score, .. } = annotation;
            let Some(&(image, view)) = images.get(image_id) else {
                if all.contains(image_id) {
                    continue;
                }
                return Err(bad(format!("has an object of image {image_id}, which it does not list")));
            };
            let Some(&class) = known.get(category_id) else {
                return Err(bad(format!("has an object of category {category_id}, which it does not list")));
            };
            if !(0.0..=1.0).contains(score) {
                return Err(bad(format!("has an object of {:?} of score {score}, outside 0 to 1", image.file_name)));
            }
            let k = views[view].camera.pinhole;
            let Some((corners, mask)) = placed(annotation, image, [k.width, k.height]).map_err(bad)? else { continue };
            if of_views[view].len() == Zones::MAX {
                return Err(bad(format!("has more than {} objects of {:?}", Zones::MAX, image.file_name)));
            }
            of_views[view].push(Zone { corners, class: class as u16, score: *score, mask });
        }
        let classes = self.objects.categories.iter().map(|category| category.name.clone()).collect();
        Ok(Zones { classes, of_views })
    }
}

/// The corners of an object, and its mask if it has one.
type Placed = ([f32; 4], Option<ZoneMask>);

/// An object in a photo of this size; `None` if no pixel is left. An error says what the file has.
fn placed(of: &Annotation, image: &Image, photo: [u32; 2]) -> Result<Option<Placed>, String> {
    let size = [image.width, image.height];
    let name = &image.file_name;
    let boxed = of.bbox.map(|bbox| corners(bbox, size, photo).ok_or(bbox)).transpose().map_err(|bbox| {
        let [left, top, width, height] = bbox;
        format!("has a box {left}, {top}, {width}, {height} outside {name:?}")
    })?;
    let pixels = of.segmentation.as_ref().filter(|of| !of.is_empty());
    if let Some(segmentation) = pixels {
        let found = segmentation.mask(size, photo);
        let found = found.map_err(|error| format!("has an object of {name:?} that {error}"))?;
        return Ok(found.map(|(mask, corners)| (corners, Some(mask))));
    }
    let boxed = boxed.ok_or_else(|| format!("has an object of {name:?} with neither bbox nor segmentation"))?;
    let [left, top, right, bottom] = boxed;
    Ok((left < right && top < bottom).then_some((boxed, None)))
}

/// The corners of a box in a photo of this size; `None` if it lies outside its image.
fn corners([left, top, width, height]: [f64; 4], size: [u32; 2], photo: [u32; 2]) -> Option<[f32; 4]> {
    let ([w, h], [columns, rows]) = (size.map(f64::from), photo.map(f64::from));
    // A pixel of tolerance: tools round.
    let inside = |from: f64, side: f64, all: f64| from >= -1.0 && side > 0.0 && from + side <= all + 1.0;
    let x = |x: f64| (x * columns / w).clamp(0.0, columns) as f32;
    let y = |y: f64| (y * rows / h).clamp(0.0, rows) as f32;
    let corners = [x(left), y(top), x(left + width), y(top + height)];
    (inside(left, width, w) && inside(top, height, h)).then_some(corners)
}
