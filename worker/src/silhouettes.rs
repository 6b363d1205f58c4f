//! The photos as the training of an object that moves sees them: which pixels show it, which do not, and which are left out.
//!
//! A capture's masks leave out everything that moves. Inside an object's box they are its silhouette, unless another moving object's box
//! is there too. Pixels that the masks keep show the static scene, which is drawn as the context: there the object is not, but its
//! shadow may be.

use std::collections::BTreeSet;
use std::sync::Arc;

use dataset::box_masks::covered;
use glam::DVec3;
use scene::{Camera, Capture, MovingObject, Pixels, Rect, Rigid};
use train::WindowSource;

/// How far from the object's box its shadow is looked for, metres.
pub(crate) const SHADOW_METRES: f64 = 1.0;

/// In [`Pixels::silhouette`].
const THERE: u8 = 255;
const NOT_THERE: u8 = 0;
const UNKNOWN: u8 = 128;

/// Windows of one object.
pub(crate) struct Silhouettes<'a> {
    /// The photos as the capture has them.
    pub(crate) photos: &'a dyn WindowSource,
    pub(crate) capture: &'a Capture,
    /// The object's place among the capture's.
    pub(crate) object: usize,
}

impl WindowSource for Silhouettes<'_> {
    fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
        let pixels = self.photos.window(view, mip, rect)?;
        Ok(Arc::new(self.marked(&pixels, view, mip, rect)))
    }

    fn prefetch(&self, view: u32, mip: u8, rect: Rect) {
        self.photos.prefetch(view, mip, rect);
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

    /// The views whose windows show the object in at least so many rows of pixels.
    ///
    /// # Errors
    /// A window that cannot be read.
    pub(crate) fn showing(&self, views: &[train::TrainView], rows: usize) -> Result<BTreeSet<u32>, String> {
        let mut showing = BTreeSet::new();
        for (view, next) in views.iter().zip(views.iter().skip(1).map(Some).chain([None])) {
            next.iter().for_each(|next| self.prefetch(next.view, next.mip, next.rect));
            let pixels = self.window(view.view, view.mip, view.rect)?;
            let of_rows = pixels.silhouette.iter().flat_map(|of| of.chunks(pixels.width.max(1) as usize));
            if of_rows.filter(|row| row.contains(&THERE)).count() >= rows {
                showing.insert(view.view);
            }
        }
        Ok(showing)
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
    let corners = object.pixel_box().map(|corner| camera_from_object.apply(corner));
    for (row, columns) in covered(&corners, &camera.pinhole) {
        let start = row as usize * width;
        marks[start + columns.start as usize..start + columns.end as usize].fill(true);
    }
}

/// Places in the box of an object, in its own axes, that photos do not see through, with the mean colours of the photos: at most `count`, in
/// a fixed order. Where photos leave few, places of the whole box.
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

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use scene::{PathPose, Pinhole, View};
    use train::TrainView;

    use super::*;

    const SIDE: u32 = 64;

    /// Photos of one colour; a pixel is masked where `moving` says so.
    struct Photos<'a> {
        capture: &'a Capture,
        moving: &'a (dyn Fn(usize, f64, f64) -> bool + Sync),
    }

    impl WindowSource for Photos<'_> {
        fn window(&self, view: u32, _: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
            let area = rect.area() as usize;
            let k = self.capture.views[view as usize].camera.pinhole;
            let moves = |i: usize| {
                let (x, y) = ((i % rect.width as usize) as f64 + 0.5, (i / rect.width as usize) as f64 + 0.5);
                (self.moving)(view as usize, (x - k.cx) / k.fx, (y - k.cy) / k.fy)
            };
            let mask = (0..area).map(|i| if moves(i) { 0 } else { 255 }).collect();
            let rgb = (0..3 * area).map(|i| [200, 100, 50][i / area]).collect();
            Ok(Arc::new(Pixels { width: rect.width, height: rect.height, rgb, mask: Some(mask), ..Pixels::default() }))
        }
    }

    /// A box of 2 m that stands still at this place, z up as in the world.
    fn still(id: &str, place: DVec3) -> MovingObject {
        let world_from_object = Rigid { rotation: DQuat::IDENTITY, translation: place };
        MovingObject {
            id: id.into(),
            class: "box".into(),
            low: DVec3::new(-1.0, -1.0, -1.0),
            high: DVec3::ONE,
            path: vec![PathPose { seconds: 0.0, world_from_object }],
        }
    }

    /// A camera 10 m from the origin at this angle, that looks at it; z is up.
    fn camera(angle: f64) -> Camera {
        let back = DQuat::from_rotation_z(angle) * DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2);
        let rotation = back.inverse();
        let eye = back * DVec3::new(0.0, 0.0, -10.0);
        let pinhole = Pinhole { width: SIDE, height: SIDE, fx: 160.0, fy: 160.0, cx: 32.0, cy: 32.0 };
        Camera { pinhole, camera_from_world: Rigid { rotation, translation: -(rotation * eye) } }
    }

    fn capture(angles: &[f64], objects: Vec<MovingObject>) -> Capture {
        let view = |(i, angle): (usize, &f64)| View {
            name: format!("{i}.png"),
            camera: camera(*angle),
            mips: Vec::new(),
            masked: true,
            depth: None,
            seconds: Some(0.1),
        };
        Capture { views: angles.iter().enumerate().map(view).collect(), objects, ..Capture::default() }
    }

    #[test]
    fn a_mask_in_the_box_is_the_silhouette_unless_another_box_is_there() {
        // The other one is 0.8 m to the right.
        let capture = capture(&[0.0], vec![still("a", DVec3::ZERO), still("b", DVec3::new(1.6, 0.0, 0.0))]);
        // All above the middle moves, and left of the box as well.
        let photos = Photos { capture: &capture, moving: &|_, _, y| y < 0.0 };
        let rect = capture.views[0].camera.full();
        let seen = Silhouettes { photos: &photos, capture: &capture, object: 0 }.window(0, 0, rect).unwrap();
        let at = |x: u32, y: u32| {
            let i = (y * SIDE + x) as usize;
            [seen.silhouette.as_ref().unwrap()[i], seen.mask.as_ref().unwrap()[i]]
        };
        // The near face covers 14 to 50; the other box begins at 40.
        assert_eq!([at(20, 25), at(45, 25)], [[THERE, 255], [UNKNOWN, 0]]);
        assert_eq!([at(5, 25), at(60, 25)], [[UNKNOWN, 0]; 2], "outside of its box something else moves");
        assert_eq!(at(20, 40), [NOT_THERE, 255], "the static scene");
        // The ground under the box, and a metre around it: 1 m below the camera's height, 8 to 12 m away.
        assert_eq!([at(32, 50), at(32, 63)], [[UNKNOWN, 255], [NOT_THERE, 255]]);
        assert_eq!(seen.rgb, WindowSource::window(&photos, 0, 0, rect).unwrap().rgb);
    }

    #[test]
    fn the_hull_is_what_photos_do_not_see_through() {
        let angles: Vec<f64> = (0..12).map(|i| f64::from(i) * 0.5).collect();
        let capture = capture(&angles, vec![still("a", DVec3::ZERO)]);
        let views: Vec<TrainView> = (capture.views.iter().enumerate())
            .map(|(i, view)| TrainView {
                view: i as u32,
                mip: 0,
                rect: view.camera.full(),
                camera: view.camera,
                camera_from_context: Some(view.camera.camera_from_world),
            })
            .collect();
        // A post of 0.4 m radius in the box of 2 m.
        let hull = |moving: &(dyn Fn(usize, f64, f64) -> bool + Sync)| {
            let photos = Photos { capture: &capture, moving };
            visual_hull(&Silhouettes { photos: &photos, capture: &capture, object: 0 }, &views, 400, 7).unwrap()
        };
        let post = hull(&|_, x, _| x.abs() < 0.04);
        assert!(post.len() > 20, "{}", post.len());
        // Near the ground nothing is known to be free, as there may be a shadow.
        for (place, colour) in post.iter().filter(|(place, _)| place.z > -0.4) {
            assert!(place.truncate().length() < 0.55 && *colour == [200, 100, 50], "{place} {colour:?}");
        }
        // Where nothing moves, there is no hull; where everything does, the box is full.
        assert_eq!([hull(&|_, _, _| false).len(), hull(&|_, _, _| true).len()], [400, 400]);
        assert_eq!(hull(&|_, x, _| x.abs() < 0.04), post);
        // The post is 20 pixels high in every other photo, and hidden in the others.
        let moving = |view: usize, x: f64, y: f64| view.is_multiple_of(2) && x.abs() < 0.04 && y.abs() < 0.0625;
        let photos = Photos { capture: &capture, moving: &moving };
        let silhouettes = Silhouettes { photos: &photos, capture: &capture, object: 0 };
        assert_eq!(silhouettes.showing(&views, 20).unwrap().into_iter().collect::<Vec<u32>>(), [0, 2, 4, 6, 8, 10]);
        assert!(silhouettes.showing(&views, 21).unwrap().is_empty());
    }
}
