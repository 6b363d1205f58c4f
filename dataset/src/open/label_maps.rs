//! Finds the label maps of photos, images whose pixels have the ids of what a segmentation tool saw there:
//!
//! ```text
//! FOLDER/NAME.png          NAME with the photo's extension or without
//! FOLDER/classes.json      which ids are objects, or classes.txt; optional
//! ```

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use scene::BadInput;

use super::Source;
use super::files::{self, CaptureRoot};

/// The largest file of classes.
const MAX_CLASSES_BYTES: u64 = 1 << 20;
/// The files that may name classes, the first that exists counts.
const CLASSES: [&str; 2] = ["classes.json", "classes.txt"];

/// The label maps of a capture's photos.
pub(crate) struct LabelMapFiles {
    /// For each photo its map, if it has one. Each is as large as its photo.
    pub(crate) of_photos: Vec<Option<PathBuf>>,
    /// The file of classes and its text, if there is one.
    pub(crate) classes: Option<(PathBuf, String)>,
}

impl LabelMapFiles {
    /// Finds the maps in a folder.
    ///
    /// # Errors
    /// A folder without a map of any photo, a map of another size than its photo, or classes that cannot be read.
    pub(crate) fn find(folder: &Path, source: &Source) -> Result<Self, BadInput> {
        let root = CaptureRoot::new(folder)?;
        let mut of_photos = Vec::with_capacity(source.photos.len());
        for (view, photo) in source.capture.views.iter().zip(&source.photos) {
            let name = view.name.strip_prefix("images/").unwrap_or(&view.name);
            let names = [format!("{}.png", files::stem(&view.name)), format!("{name}.png")];
            let map = names.iter().find_map(|name| root.file(name));
            if let Some(path) = &map {
                let (width, height) = files::image_size(path)?;
                if (width, height) != (photo.width, photo.height) {
                    let of_photo = format!("{}×{}", photo.width, photo.height);
                    let problem = format!("has {width}×{height} pixels, its photo {of_photo}");
                    return Err(BadInput::new(files::show(path), problem, "label the photos at their own size"));
                }
            }
            of_photos.push(map);
        }
        if of_photos.iter().all(Option::is_none) {
            let example = source.capture.views.first().map_or("", |view| files::stem(&view.name));
            let advice = format!("name the label maps like the photos, such as {example}.png");
            return Err(BadInput::new(files::show(folder), "has no label map of any photo of the capture", advice));
        }
        let classes = CLASSES.iter().find_map(|name| root.file(name)).map(text).transpose()?;
        Ok(Self { of_photos, classes })
    }
}

fn text(path: PathBuf) -> Result<(PathBuf, String), BadInput> {
    let mut text = String::new();
    let read = File::open(&path).and_then(|file| file.take(MAX_CLASSES_BYTES + 1).read_to_string(&mut text));
    let problem = match read {
        Err(error) => format!("cannot be read ({error})"),
        Ok(_) if text.len() as u64 > MAX_CLASSES_BYTES => format!("is larger than {} MB", MAX_CLASSES_BYTES >> 20),
        Ok(_) => return Ok((path, text)),
    };
    Err(BadInput::new(files::show(&path), problem, "give a line ID NAME for each class"))
}
