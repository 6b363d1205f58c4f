//! Objects that move, placed where they are at a time.

use model::ModelObject;
use scene::MovingObject;

use crate::EvalError;
use crate::renderer::{Placed, Renderer, Uploaded};

/// Objects where their renderer reads them.
pub struct Composition<'a>(Vec<(&'a MovingObject, Uploaded<'a>)>);

impl<'a> Composition<'a> {
    /// Prepares objects for any number of views.
    ///
    /// # Errors
    /// Splats that do not fit the device's memory.
    pub fn new(renderer: &Renderer, objects: impl Iterator<Item = &'a ModelObject>) -> Result<Self, EvalError> {
        let uploaded = objects.map(|object| Ok((&object.about, renderer.upload(&object.splats)?)));
        uploaded.collect::<Result<_, _>>().map(Self)
    }

    /// The objects whose place is known at this time.
    pub fn at(&self, seconds: Option<f64>) -> Vec<Placed<'_>> {
        let Some(seconds) = seconds else { return Vec::new() };
        let placed = self
            .0
            .iter()
            .filter_map(|(about, splats)| Some(Placed { splats, world_from_object: about.pose(seconds)? }));
        placed.collect()
    }
}
