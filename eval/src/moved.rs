//! Whether detectors find the objects of a model where it puts them anew: on frames that nobody photographed.
//!
//! An object's true box is that of the pixels to which its splats in its own box give half of the colour or more, so what stands
//! before it counts, and its shadow does not. Detections that touch no such box are left out: they are of things that stand.

use model::{Model, ModelObject};
use perceive::tracking::Kind;
use perceive::{Boxes, Detection, Detector, Picture, Precision, TrueBox, precision};
use render::Options;
use scene::{Camera, MovingObject};
use serde::Serialize;
use train::Backend;

use crate::composition::Composition;
use crate::detections::LEAST_SCORE;
use crate::images::{colour_image, photo_image};
use crate::judges::file_name;
use crate::renderer::{Held, Placed, Renderer, Uploaded};
use crate::{EvalError, Observer, Photos};

/// Bytes of decoded photos that are kept.
const CACHE_BYTES: usize = 16 << 20;
/// Least height of a box that counts, pixels.
const LEAST_HEIGHT: f32 = 20.0;
/// Least share of an object that has to be visible for it to count.
const LEAST_VISIBLE: f32 = 0.5;
/// A pixel shows an object if at least this share of its colour is the object's.
const SHOWN: f32 = 0.5;

/// What detectors find of objects that were moved. The field names are keys of `eval/report.json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MovedReport {
    /// How much later the objects are where they were moved to, on their own paths.
    pub seconds: f64,
    /// Held-out views that show an object, at either time.
    pub views: usize,
    /// By detector.
    pub detectors: Vec<MovedFigures>,
}

/// What a detector finds of objects that move.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MovedFigures {
    /// The network's file, without its folder.
    pub detector: String,
    /// On photos.
    pub photos: FoundObjects,
    /// On renders with the objects where they are on the photos.
    pub renders: FoundObjects,
    /// On renders with the objects moved.
    pub moved: FoundObjects,
}

/// Detections of objects against where they are.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FoundObjects {
    /// Objects that count: of a class that the detector knows, 20 pixels high, at least half of them visible.
    pub boxes: u64,
    /// Of the detections that touch objects.
    #[serde(flatten)]
    pub precision: Precision,
}

/// Draws the held-out views as they are and with all objects `seconds` later on their paths, and looks for these on both and on the
/// photos.
///
/// # Errors
/// Photos that cannot be read, a renderer that fails, a network that cannot be run.
pub fn moved(
    model: &Model,
    photos: &Photos,
    backend: &Backend,
    detectors: &[Detector],
    seconds: f64,
    observer: &dyn Observer,
) -> Result<MovedReport, EvalError> {
    let held_out = photos.split.held_out();
    let reader = photos.reader(CACHE_BYTES);
    let mut renderer = Renderer::new(backend)?;
    let without_shadows: Vec<ModelObject> = model.objects.iter().map(in_own_box).collect();
    let mut scene = Scene {
        fixed: renderer.upload(&model.splats)?,
        objects: Composition::new(&renderer, model.objects.iter())?,
        silhouettes: &without_shadows,
        about: model.objects.iter().map(|object| &object.about).collect(),
        options: model.options(),
        renderer: &mut renderer,
    };
    let mut found: Vec<[Vec<Boxes>; 3]> = detectors.iter().map(|_| Default::default()).collect();
    let mut views = 0;
    for (i, &index) in held_out.iter().enumerate() {
        observer.progress("objects moved", i as u64 + 1, held_out.len() as u64, "");
        let view = &photos.capture.views[index as usize];
        let Some(taken) = view.seconds else { continue };
        let [there, later] = [taken, taken + seconds].map(|time| scene.shown(&view.camera, time));
        let (there, later) = (there?, later?);
        if there.is_empty() && later.is_empty() {
            continue;
        }
        views += 1;
        let photo = photo_image(&*reader.window(index, 0, view.camera.full())?).into_raw();
        let pictures = [photo, scene.picture(&view.camera, taken)?, scene.picture(&view.camera, taken + seconds)?];
        for (detector, found) in detectors.iter().zip(&mut found) {
            for ((rgb, shown), boxes) in pictures.iter().zip([&there, &there, &later]).zip(found) {
                let [width, height] = [view.camera.pinhole.width, view.camera.pinhole.height].map(|side| side as usize);
                let least = LEAST_SCORE.min(detector.card().score);
                let found = detector.detect(&Picture { rgb, width, height }, least)?;
                boxes.push(boxes_of(shown, found, &detector.card().classes));
            }
        }
    }
    let of = |boxes: &Vec<Boxes>| FoundObjects {
        boxes: boxes.iter().flat_map(|of| &of.truth).filter(|of| of.counts).count() as u64,
        precision: precision(&boxes.iter().collect::<Vec<_>>()),
    };
    let figures = detectors.iter().zip(&found).map(|(detector, [photos, renders, moved])| MovedFigures {
        detector: file_name(detector),
        photos: of(photos),
        renders: of(renders),
        moved: of(moved),
    });
    Ok(MovedReport { seconds, views, detectors: figures.collect() })
}

/// The object without the splats of its shadow.
fn in_own_box(object: &ModelObject) -> ModelObject {
    let [low, .., high] = object.about.splat_box();
    let is_inside = |i: &u32| {
        let place = object.splats.mean(*i as usize).as_dvec3();
        place.cmpge(low).all() && place.cmple(high).all()
    };
    let inside: Vec<u32> = (0..object.splats.len() as u32).filter(is_inside).collect();
    let swing = object.swing.as_ref().map(|swing| swing.select(&inside));
    ModelObject { about: object.about.clone(), splats: object.splats.select(&inside), swing }
}

/// An object on a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Shown {
    kind: Kind,
    corners: [f32; 4],
    counts: bool,
}

/// The model where its renderer reads it.
struct Scene<'a> {
    renderer: &'a mut Renderer,
    fixed: Uploaded<'a>,
    objects: Composition<'a>,
    /// The objects without their shadows.
    silhouettes: &'a [ModelObject],
    about: Vec<&'a MovingObject>,
    options: Options,
}

impl Scene<'_> {
    /// The objects that a view shows at a time.
    fn shown(&mut self, camera: &Camera, seconds: f64) -> Result<Vec<Shown>, EvalError> {
        let Self { renderer, fixed, objects, silhouettes, about, .. } = self;
        let options = Options { extras: true, ..self.options };
        let mut shown = Vec::new();
        for (number, silhouette) in silhouettes.iter().enumerate() {
            let Some((kind, (pose, splats))) = Kind::of_class(&about[number].class).zip(silhouette.at(seconds)) else {
                continue;
            };
            let silhouette = &renderer.upload(splats)?;
            // In the object's axes its splats are the trainable ones, whose opacity has a plane of its own, and all else is placed.
            let own = Camera { camera_from_world: camera.camera_from_world.after(&pose), ..*camera };
            let alone = renderer.compose(silhouette, &[], &own, &options)?;
            if bounds(&alone.trainable_alpha, alone.width).is_none() {
                continue;
            }
            let whole: f32 = alone.trainable_alpha.iter().sum();
            let object_from_world = pose.inverse();
            let others = objects.each(renderer, seconds)?.into_iter().enumerate().filter(|(other, _)| *other != number);
            let others = others.filter_map(|(_, placed)| {
                let placed = placed?;
                let world_from_object = object_from_world.after(&placed.world_from_object);
                Some(Placed { world_from_object, ..placed })
            });
            let scene = Placed { splats: Held::Always(fixed), world_from_object: object_from_world };
            let placed: Vec<Placed> = others.chain([scene]).collect();
            let frame = renderer.compose(silhouette, &placed, &own, &options)?;
            let visible: f32 = frame.trainable_alpha.iter().sum();
            let Some(corners) = bounds(&frame.trainable_alpha, frame.width) else { continue };
            let counts = corners[3] - corners[1] >= LEAST_HEIGHT && visible >= LEAST_VISIBLE * whole;
            shown.push(Shown { kind, corners, counts });
        }
        Ok(shown)
    }

    /// The view with all objects where they are at a time: three bytes a pixel.
    fn picture(&mut self, camera: &Camera, seconds: f64) -> Result<Vec<u8>, EvalError> {
        let placed = self.objects.at(self.renderer, Some(seconds))?;
        let frame = self.renderer.compose(&self.fixed, &placed, camera, &self.options)?;
        Ok(colour_image(&frame.colour, frame.width, frame.height).into_raw())
    }
}

/// The box of the pixels that show an object: left, top, right, bottom.
fn bounds(visible: &[f32], width: usize) -> Option<[f32; 4]> {
    let places = visible.iter().enumerate().filter(|(_, alpha)| **alpha >= SHOWN);
    let corners = places.fold(None, |corners: Option<[usize; 4]>, (i, _)| {
        let (x, y) = (i % width, i / width);
        let [left, top, right, bottom] = corners.unwrap_or([x, y, x, y]);
        Some([left.min(x), top.min(y), right.max(x), bottom.max(y)])
    });
    corners.map(|[left, top, right, bottom]| [left, top, right + 1, bottom + 1].map(|side| side as f32))
}

/// What is there, and what was found of it, by kinds: data sets name classes differently.
fn boxes_of(shown: &[Shown], found: Vec<Detection>, classes: &[String]) -> Boxes {
    let known = |kind: Kind| classes.iter().any(|class| Kind::of_class(class) == Some(kind));
    let truth = shown.iter().filter(|of| known(of.kind));
    let truth = truth.map(|of| TrueBox { class: of.kind as usize, corners: of.corners, counts: of.counts });
    let touches = |a: [f32; 4], b: [f32; 4]| a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
    let of_objects = found.into_iter().filter_map(|of| {
        let kind = Kind::of_class(classes.get(of.class)?)?;
        let is_of_one = shown.iter().any(|shown| touches(shown.corners, of.corners));
        is_of_one.then_some(Detection { class: kind as usize, ..of })
    });
    Boxes { truth: truth.collect(), found: of_objects.collect(), least_height: LEAST_HEIGHT }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_found_is_compared_by_kinds_and_only_where_objects_are() {
        let classes = ["truck", "pedestrian", "sofa", "car"].map(str::to_owned);
        let shown = |kind, left: f32| Shown { kind, corners: [left, 0.0, left + 20.0, 40.0], counts: true };
        let found = |class, left: f32| Detection { class, score: 0.5, corners: [left, 0.0, left + 20.0, 40.0] };
        let all = [shown(Kind::Person, 0.0), shown(Kind::Car, 100.0), shown(Kind::Bus, 200.0)];
        // Of the bus the detector knows nothing; a sofa does not move, and the car at 400 stands.
        let boxes = boxes_of(&all, vec![found(1, 0.0), found(3, 102.0), found(2, 0.0), found(3, 400.0)], &classes);
        assert_eq!((boxes.truth.len(), boxes.found.len()), (2, 2));
        assert_eq!(precision(&[&boxes]).map50, Some(1.0));
    }

    #[test]
    fn a_box_bounds_the_pixels_of_an_object() {
        let mut visible = vec![0.4; 60];
        (visible[23], visible[34]) = (0.5, 0.9);
        assert_eq!(bounds(&visible, 10), Some([3.0, 2.0, 5.0, 4.0]));
        assert_eq!(bounds(&[0.1; 6], 3), None);
    }
}
