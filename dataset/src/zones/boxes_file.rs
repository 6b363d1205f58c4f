//! Boxes in COCO's layout (<https://cocodataset.org/#format-data>), which labelling tools export: `images` (`id`,
//! `file_name`, `width`, `height`), `annotations` (`image_id`, `category_id`, `bbox`: left, top, width, height in pixels,
//! and `score` where a detector wrote them) and `categories` (`id`, `name`).

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::Read;
use std::path::Path;

use scene::{BadInput, Capture, Zone, Zones};
use serde::Deserialize;

/// Largest file of boxes that is read.
const MAX_BYTES: u64 = 256 << 20;
const ADVICE: &str = "give boxes in COCO's layout: images, annotations with bbox, categories";

/// A file of boxes.
#[derive(Debug)]
pub struct BoxesFile {
    file: String,
    boxes: Boxes,
}

#[derive(Debug, Deserialize)]
struct Boxes {
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
    bbox: [f64; 4],
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

impl BoxesFile {
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
        let boxes = serde_json::from_slice(&bytes).map_err(|error| bad(format!("has no boxes to use ({error})")))?;
        Ok(Self { file, boxes })
    }

    /// The boxes as zones of a capture's views, at the size of their mip 0. Images that the capture does not have are left
    /// out.
    ///
    /// # Errors
    /// No image of the capture, a box outside its image, more than [`Zones::MAX`] of an image, or an unknown category.
    pub fn zones(&self, capture: &Capture) -> Result<Zones, BadInput> {
        let bad = |problem: String| BadInput::new(self.file.clone(), problem, ADVICE);
        let views = &capture.views;
        if let Some(empty) = self.boxes.images.iter().find(|image| image.width == 0 || image.height == 0) {
            return Err(bad(format!("gives {:?} no pixels", empty.file_name)));
        }
        let by_name: BTreeMap<&str, usize> = views.iter().map(|view| view.name.as_str()).zip(0..).collect();
        let of_image = |image: &Image| by_name.get(image.file_name.trim_start_matches("./")).copied();
        let images: BTreeMap<i64, (&Image, usize)> =
            self.boxes.images.iter().filter_map(|image| Some((image.id, (image, of_image(image)?)))).collect();
        if images.is_empty() {
            let first =
                self.boxes.images.first().map_or(String::new(), |image| format!(" (such as {:?})", image.file_name));
            let example = views.first().map_or("", |view| view.name.as_str());
            return Err(bad(format!("names no photo of the capture{first}; theirs are like {example:?}")));
        }
        let known: BTreeMap<i64, usize> = self.boxes.categories.iter().map(|c| c.id).zip(0..).collect();
        if known.len() > usize::from(u16::MAX) {
            return Err(bad(format!("has {} categories, and {} are the most", known.len(), u16::MAX)));
        }
        let all: BTreeSet<i64> = self.boxes.images.iter().map(|image| image.id).collect();
        let mut of_views = vec![Vec::new(); views.len()];
        for Annotation { image_id, category_id, bbox: [left, top, width, height], score } in &self.boxes.annotations {
            let Some(&(image, view)) = images.get(image_id) else {
                if all.contains(image_id) {
                    continue;
                }
                return Err(bad(format!("has a box of image {image_id}, which it does not list")));
            };
            let Some(&class) = known.get(category_id) else {
                return Err(bad(format!("has a box of category {category_id}, which it does not list")));
            };
            let size = [f64::from(image.width), f64::from(image.height)];
            // A pixel of tolerance: tools round.
            let inside = |from: f64, side: f64, all: f64| from >= -1.0 && side > 0.0 && from + side <= all + 1.0;
            if !inside(*left, *width, size[0]) || !inside(*top, *height, size[1]) || !(0.0..=1.0).contains(score) {
                let name = &image.file_name;
                return Err(bad(format!(
                    "has a box {left}, {top}, {width}, {height} of score {score} outside {name:?}"
                )));
            }
            let k = views[view].camera.pinhole;
            let scale = [f64::from(k.width) / size[0], f64::from(k.height) / size[1]];
            let x = |x: f64| (x * scale[0]).clamp(0.0, f64::from(k.width)) as f32;
            let y = |y: f64| (y * scale[1]).clamp(0.0, f64::from(k.height)) as f32;
            let corners = [x(*left), y(*top), x(left + width), y(top + height)];
            if corners[0] >= corners[2] || corners[1] >= corners[3] {
                continue;
            }
            if of_views[view].len() == Zones::MAX {
                return Err(bad(format!("has more than {} boxes of {:?}", Zones::MAX, image.file_name)));
            }
            of_views[view].push(Zone { corners, class: class as u16, score: *score });
        }
        let classes = self.boxes.categories.iter().map(|category| category.name.clone()).collect();
        Ok(Zones { classes, of_views })
    }
}
