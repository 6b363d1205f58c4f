//! The truth of a photo's pixels, one file of each kind.

use std::path::Path;

use city::trace::{Frame, frame::Layer};
use image::ColorType;
use rayon::prelude::*;
use scene::npy;
use store::file::{SaveError, save};

use super::images::png;
use super::make;

/// What there is of each layer: what is seen first, and what is behind glass.
const KINDS: [&str; 4] = ["depth", "semantic", "instance", "material"];

/// Makes the folders.
pub(super) fn prepare(out: &Path) -> Result<(), SaveError> {
    make(&out.join("normals"))?;
    KINDS.iter().try_for_each(|kind| {
        make(&out.join(kind))?;
        make(&out.join("behind").join(kind))
    })
}

/// Writes the truth of a photo by its name.
pub(super) fn write(out: &Path, name: &str, frame: &Frame) -> Result<(), SaveError> {
    let normals: Vec<f32> = frame.normals.iter().flatten().copied().collect();
    let shape = [frame.height as usize, frame.width as usize, 3];
    save(&out.join(format!("normals/{name}.npy")), &npy::write_f32(&shape, &normals))?;
    layer(out, name, frame, &frame.first)?;
    layer(&out.join("behind"), name, frame, &frame.behind)
}

fn layer(out: &Path, name: &str, frame: &Frame, layer: &Layer) -> Result<(), SaveError> {
    let depth = npy::write_f32(&[frame.height as usize, frame.width as usize], &layer.depth);
    save(&out.join(format!("depth/{name}.npy")), &depth)?;
    // 24 bits in three bytes, as COCO's panoptic labels are
    let instances: Vec<u8> = layer.instance.par_iter().flat_map_iter(|i| i.to_le_bytes().into_iter().take(3)).collect();
    // 16-bit samples are taken in the machine's order
    let materials: Vec<u8> = layer.material.iter().flat_map(|row| row.to_ne_bytes()).collect();
    let path = |kind: &str| out.join(format!("{kind}/{name}.png"));
    png(&path("semantic"), &layer.semantic, frame, ColorType::L8)?;
    png(&path("instance"), &instances, frame, ColorType::Rgb8)?;
    png(&path("material"), &materials, frame, ColorType::L16)
}
