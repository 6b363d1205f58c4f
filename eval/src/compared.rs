//! Draws what several models show of the same photos.

use blocks::Part;
use image::{RgbImage, imageops};
use model::Model;
use train::Backend;

use crate::images::{frame_image, photo_image};
use crate::{EvalError, Photos, Renderer};

/// Pixels between pictures.
const GAP: u32 = 4;
/// Bytes of decoded photos that are kept.
const CACHE_BYTES: usize = 16 << 20;

/// Held-out views, a row each, at most `rows`, evenly chosen: the photo, and what each model shows there, from left to
/// right.
///
/// # Errors
/// Photos that cannot be read.
pub fn side_by_side(photos: &Photos, models: &[&Model], rows: usize) -> Result<RgbImage, EvalError> {
    let views = photos.split.views(Part::Test);
    let reader = photos.reader(CACHE_BYTES);
    let mut renderer = Renderer::new(&Backend::Cpu)?;
    let mut drawn: Vec<Vec<RgbImage>> = Vec::new();
    for row in 0..rows.min(views.len()) {
        let index = views[(2 * row + 1) * views.len() / (2 * rows.min(views.len()))];
        let camera = photos.capture.views[index as usize].camera;
        let mut pictures = vec![photo_image(&*reader.window(index, 0, camera.full())?)];
        for model in models {
            let frame = renderer.render_once(&model.splats, &camera, &model.options())?;
            pictures.push(frame_image(frame));
        }
        drawn.push(pictures);
    }
    let row_height = |row: &Vec<RgbImage>| row.iter().map(RgbImage::height).max().unwrap_or(0) + GAP;
    let row_width = |row: &Vec<RgbImage>| row.iter().map(|picture| picture.width() + GAP).sum::<u32>();
    let width = drawn.iter().map(row_width).max().unwrap_or(1);
    let mut sheet = RgbImage::new(width, drawn.iter().map(row_height).sum::<u32>().max(1));
    let mut y = 0;
    for row in &drawn {
        let mut x = 0;
        for picture in row {
            imageops::replace(&mut sheet, picture, i64::from(x), i64::from(y));
            x += picture.width() + GAP;
        }
        y += row_height(row);
    }
    Ok(sheet)
}
