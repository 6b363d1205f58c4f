//! The photos as the training of an object that moves sees them: which pixels show it, which do not, and which are left out.
//!
//! A capture's masks leave out everything that moves. Inside an object's box they are its silhouette, unless another moving object's box
//! is there too. Pixels that the masks keep show the static scene, which is drawn as the context: there the object is not, but its
//! shadow may be.

use std::sync::Arc;

use dataset::box_masks::covered;
use dataset::windows::WindowReader;
use glam::DVec3;
use scene::{Camera, Capture, MovingObject, Pixels, Rect, Rigid};
use train::WindowSource;

/// Boxes are annotated by hand or by a tracker: an object's pixels may lie this share of its sides and these metres beside its box.
const GROWTH: f64 = 0.05;
const GROWTH_METRES: f64 = 0.1;
/// How far from the object's box its shadow is looked for, metres.
const SHADOW_METRES: f64 = 1.0;

/// In [`Pixels::silhouette`].
const THERE: u8 = 255;
const NOT_THERE: u8 = 0;
const UNKNOWN: u8 = 128;

/// Windows of one object.
pub(crate) struct Silhouettes<'a> {
    pub(crate) reader: &'a WindowReader,
    pub(crate) capture: &'a Capture,
    /// The object's place among the capture's.
    pub(crate) object: usize,
}

impl WindowSource for Silhouettes<'_> {
    fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
        let pixels = WindowSource::window(self.reader, view, mip, rect)?;
        Ok(Arc::new(self.marked(&pixels, view, mip, rect)))
    }

    fn prefetch(&self, view: u32, mip: u8, rect: Rect) {
        WindowSource::prefetch(self.reader, view, mip, rect);
    }
}

impl Silhouettes<'_> {
    /// The pixels with the object's silhouette, and with a mask that leaves out what else moves.
    fn marked(&self, pixels: &Pixels, view: u32, mip: u8, rect: Rect) -> Pixels {
        let (area, width) = (pixels.area(), pixels.width as usize);
        let mut marked = Pixels { weights: None, depth: None, ..pixels.clone() };
        let Some(seen) = self.capture.views.get(view as usize) else { return marked };
        let Some(seconds) = seen.seconds else { return marked };
        let camera = seen.camera.mip(mip).window(rect);
        let is_static = |i: usize| pixels.mask.as_ref().is_none_or(|mask| mask[i] >= 128);
        let mut own = vec![false; area];
        let mut others = vec![false; area];
        for (number, object) in self.capture.objects.iter().enumerate() {
            let Some(world_from_object) = object.pose(seconds) else { continue };
            let of = if number == self.object { &mut own } else { &mut others };
            cover(of, width, object, &world_from_object, &camera);
        }
        let shadow = self.shadow(seconds, &camera);
        let silhouette = (0..area).map(|i| match (is_static(i), own[i], others[i]) {
            (true, ..) if shadow(i) => UNKNOWN,
            (true, ..) => NOT_THERE,
            (false, true, false) => THERE,
            (false, ..) => UNKNOWN,
        });
        let silhouette: Vec<u8> = silhouette.collect();
        let mask = (0..area).map(|i| if is_static(i) || silhouette[i] == THERE { 255 } else { 0 }).collect();
        (marked.mask, marked.silhouette) = (Some(mask), Some(silhouette));
        marked
    }

    /// Whether a pixel shows the ground under and around the object.
    fn shadow(&self, seconds: f64, camera: &Camera) -> impl Fn(usize) -> bool {
        let object = &self.capture.objects[self.object];
        let pose = object.pose(seconds).map(|pose| camera.camera_from_world.after(&pose).inverse());
        let (k, low, high) = (camera.pinhole, object.low, object.high);
        move |i: usize| {
            let Some(object_from_camera) = pose else { return false };
            let (x, y) = ((i % k.width as usize) as f64 + 0.5, (i / k.width as usize) as f64 + 0.5);
            let ahead = object_from_camera.rotation * DVec3::new((x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0);
            let from = object_from_camera.translation;
            let along = (low.z - from.z) / ahead.z;
            let place = from + along * ahead;
            let inside = |axis: usize| (low[axis] - SHADOW_METRES..=high[axis] + SHADOW_METRES).contains(&place[axis]);
            along > 0.0 && inside(0) && inside(1)
        }
    }
}

/// Marks the pixels that an object's box covers.
fn cover(marks: &mut [bool], width: usize, object: &MovingObject, world_from_object: &Rigid, camera: &Camera) {
    let camera_from_object = camera.camera_from_world.after(world_from_object);
    let corners = object.corners(GROWTH, GROWTH_METRES).map(|corner| camera_from_object.apply(corner));
    for (row, columns) in covered(&corners, &camera.pinhole) {
        let start = row as usize * width;
        marks[start + columns.start as usize..start + columns.end as usize].fill(true);
    }
}

/// Places in the box of an object, in its own axes, that photos do not see through, with their colours: at most `count` of about twice as
/// many tried, in a fixed order. Where photos leave few, all of the box.
///
/// # Errors
/// A window that cannot be read.
pub(crate) fn visual_hull(
    silhouettes: &Silhouettes,
    views: &[train::TrainView],
    count: usize,
    seed: u64,
) -> Result<Vec<(DVec3, [u8; 3])>, String> {
    /// Photos that are looked at.
    const VIEWS: usize = 32;
    /// Places tried for each that is wanted.
    const TRIES: usize = 4;
    /// A place is free where more of the photos say so.
    const MAX_FREE: f64 = 0.15;
    let object = &silhouettes.capture.objects[silhouettes.object];
    let looked_at: Vec<&train::TrainView> = views.iter().step_by(views.len().div_ceil(VIEWS).max(1)).collect();
    let photos: Vec<Arc<Pixels>> =
        looked_at.iter().map(|view| silhouettes.window(view.view, view.mip, view.rect)).collect::<Result<_, _>>()?;
    let number = |i: usize, k: u64| f64::from(train::random::uniform(seed, 4 * i as u64 + k));
    let mut kept = Vec::new();
    let mut rest = Vec::new();
    for i in 0..count * TRIES {
        let place = object.low + (object.high - object.low) * DVec3::from([0, 1, 2].map(|k| number(i, k)));
        let (mut there, mut free, mut colour) = (0u32, 0u32, [0u32; 3]);
        for (view, photo) in looked_at.iter().zip(&photos) {
            let camera = view.camera.mip(view.mip).window(view.rect);
            let (pixel, depth) = camera.project(place);
            let (x, y) = (pixel.x.floor(), pixel.y.floor());
            let is_inside = x >= 0.0 && y >= 0.0 && x < f64::from(photo.width) && y < f64::from(photo.height);
            if depth <= 0.0 || !is_inside {
                continue;
            }
            let at = y as usize * photo.width as usize + x as usize;
            match photo.silhouette.as_ref().map_or(UNKNOWN, |silhouette| silhouette[at]) {
                THERE => {
                    there += 1;
                    (0..3).for_each(|c| colour[c] += u32::from(photo.rgb[c * photo.area() + at]));
                }
                NOT_THERE => free += 1,
                _ => {}
            }
        }
        let colour = colour.map(|sum| sum.checked_div(there).unwrap_or(128) as u8);
        let is_hull = there > 0 && f64::from(free) <= MAX_FREE * f64::from(there + free);
        let of = if is_hull { &mut kept } else { &mut rest };
        if of.len() < count {
            of.push((place, colour));
        }
    }
    Ok(if kept.len() * 20 >= count { kept } else { rest })
}
