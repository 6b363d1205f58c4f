//! Figures of the pixels that show objects which move.
//!
//! The other figures leave these pixels out where the capture has masks. Here they are those that the masks leave out within the boxes of
//! the capture's objects; without masks all pixels of the boxes.

use dataset::box_masks::covered;
use scene::{MovingObject, Pixels, View};
use serde::Serialize;
use train::metrics::psnr_of;

use crate::figures::Comparison;

/// Fewer pixels on a view give no meaningful figure.
const MIN_PIXELS: u64 = 64;

/// Figures of moving objects on the held-out views. The field names are keys of `eval/report.json`.
#[derive(Debug, Clone, Serialize)]
pub struct MovingFigures {
    /// Views that show at least 64 pixels of moving objects.
    pub views: usize,
    /// Pixels of moving objects on all of them.
    pub pixels: u64,
    /// Mean over these views of the PSNR of these pixels (PSNR*), dB.
    pub psnr: Option<f64>,
    /// PSNR of whole pictures, masked pixels included, mean over all held-out views, dB.
    pub whole_psnr: Option<f64>,
    /// Of each object that is seen.
    pub objects: Vec<ObjectFigures>,
}

/// Figures of one object.
#[derive(Debug, Clone, Serialize)]
pub struct ObjectFigures {
    /// Its name.
    pub id: String,
    /// As the capture names it.
    pub class: String,
    /// Views that show at least 64 of its pixels.
    pub views: usize,
    /// Its pixels on them.
    pub pixels: u64,
    /// PSNR over all of these pixels, dB.
    pub psnr: f64,
}

/// Sums of squared errors and pixels.
#[derive(Clone, Copy, Default)]
struct Sum {
    squares: f64,
    pixels: u64,
    views: usize,
}

/// Measures views one by one.
pub(crate) struct MovingMeter<'a> {
    objects: &'a [MovingObject],
    of_objects: Vec<Sum>,
    views: Vec<f64>,
    pixels: u64,
    whole: Vec<f64>,
}

impl<'a> MovingMeter<'a> {
    /// `None` if nothing of the capture moves.
    pub(crate) fn new(objects: &'a [MovingObject]) -> Option<Self> {
        let of_objects = vec![Sum::default(); objects.len()];
        (!objects.is_empty()).then(|| Self { objects, of_objects, views: Vec::new(), pixels: 0, whole: Vec::new() })
    }

    pub(crate) fn add(&mut self, view: &View, photo: &Pixels, compared: &Comparison) {
        let area = photo.area();
        let square = |i: usize| {
            (0..3).map(|c| f64::from(compared.render[c * area + i] - compared.truth[c * area + i]).powi(2)).sum::<f64>()
        };
        let whole: f64 = (0..area).map(square).sum();
        self.whole.push(psnr_of(whole / (3 * area.max(1)) as f64));
        let Some(seconds) = view.seconds else { return };
        let mut counted = vec![false; area];
        let mut all = Sum::default();
        for (object, sum) in self.objects.iter().zip(&mut self.of_objects) {
            let Some(pose) = object.pose(seconds) else { continue };
            let camera_from_object = view.camera.camera_from_world.after(&pose);
            let corners = object.pixel_box().map(|corner| camera_from_object.apply(corner));
            let mut own = Sum::default();
            for (row, columns) in covered(&corners, &view.camera.pinhole) {
                for i in columns.map(|column| row as usize * photo.width as usize + column as usize) {
                    if photo.mask.as_ref().is_some_and(|mask| mask[i] >= 128) {
                        continue;
                    }
                    let square = square(i);
                    (own.squares, own.pixels) = (own.squares + square, own.pixels + 1);
                    if !std::mem::replace(&mut counted[i], true) {
                        (all.squares, all.pixels) = (all.squares + square, all.pixels + 1);
                    }
                }
            }
            if own.pixels >= MIN_PIXELS {
                let Sum { squares, pixels, views } = *sum;
                *sum = Sum { squares: squares + own.squares, pixels: pixels + own.pixels, views: views + 1 };
            }
        }
        if all.pixels >= MIN_PIXELS {
            self.views.push(psnr_of(all.squares / (3 * all.pixels) as f64));
            self.pixels += all.pixels;
        }
    }

    pub(crate) fn figures(self) -> MovingFigures {
        let mean = |values: &[f64]| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
        let of = |(object, sum): (&MovingObject, Sum)| {
            (sum.views > 0).then(|| ObjectFigures {
                id: object.id.clone(),
                class: object.class.clone(),
                views: sum.views,
                pixels: sum.pixels,
                psnr: psnr_of(sum.squares / (3 * sum.pixels) as f64),
            })
        };
        MovingFigures {
            views: self.views.len(),
            pixels: self.pixels,
            psnr: mean(&self.views),
            whole_psnr: mean(&self.whole),
            objects: self.objects.iter().zip(self.of_objects).filter_map(of).collect(),
        }
    }
}
