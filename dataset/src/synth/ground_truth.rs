//! Writes the ground truth of a photo's pixels, one file of each kind.

use std::path::Path;

use city::trace::{Frame, frame::Layer};
use image::ColorType;
use rayon::prelude::*;
use scene::npy;
use store::file::{SaveError, save};

use super::output::{create_folder, write_png};

/// Files of each layer: the first surface, and the surface behind glass.
const KINDS: [&str; 4] = ["depth", "semantic", "instance", "material"];

/// Creates the folders.
pub(super) fn create_folders(out: &Path) -> Result<(), SaveError> {
    create_folder(&out.join("normals"))?;
    KINDS.iter().try_for_each(|kind| {
        create_folder(&out.join(kind))?;
        create_folder(&out.join("behind").join(kind))
    })
}

/// Writes the ground truth of a photo.
pub(super) fn write(out: &Path, name: &str, frame: &Frame) -> Result<(), SaveError> {
    let normals: Vec<f32> = frame.normals.iter().flatten().copied().collect();
    let shape = [frame.height as usize, frame.width as usize, 3];
    save(&out.join(format!("normals/{name}.npy")), &npy::write_f32(&shape, &normals))?;
    write_layer(out, name, frame, &frame.first)?;
    write_layer(&out.join("behind"), name, frame, &frame.behind)
}

fn write_layer(out: &Path, name: &str, frame: &Frame, layer: &Layer) -> Result<(), SaveError> {
    let depth = npy::write_f32(&[frame.height as usize, frame.width as usize], &layer.depth);
    save(&out.join(format!("depth/{name}.npy")), &depth)?;
    // 24 bits in three bytes, as in COCO's panoptic labels.
    let instances: Vec<u8> = layer.instance.par_iter().flat_map_iter(|i| i.to_le_bytes().into_iter().take(3)).collect();
    // The encoder takes 16-bit samples in native byte order.
    let materials: Vec<u8> = layer.material.iter().flat_map(|row| row.to_ne_bytes()).collect();
    let path = |kind: &str| out.join(format!("{kind}/{name}.png"));
    write_png(&path("semantic"), &layer.semantic, frame, ColorType::L8)?;
    write_png(&path("instance"), &instances, frame, ColorType::Rgb8)?;
    write_png(&path("material"), &materials, frame, ColorType::L16)
}
