//! Objects that move, placed where they are at a time.

use model::ModelObject;

use crate::EvalError;
use crate::renderer::{Held, Placed, Renderer, Uploaded};

/// Objects where their renderer reads them; those that swing are handed over anew for each time.
pub struct Composition<'a>(Vec<(&'a ModelObject, Option<Uploaded<'a>>)>);

impl<'a> Composition<'a> {
    /// Prepares objects for any number of views.
    ///
    /// # Errors
    /// Splats that do not fit the device's memory.
    pub fn new(renderer: &Renderer, objects: impl Iterator<Item = &'a ModelObject>) -> Result<Self, EvalError> {
        let prepared = |object: &'a ModelObject| {
            let stands = object.swing.is_none().then(|| renderer.upload(&object.splats)).transpose()?;
            Ok((object, stands))
        };
        objects.map(prepared).collect::<Result<_, _>>().map(Self)
    }

    /// The objects whose place is known at this time.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn at(&self, renderer: &Renderer, seconds: Option<f64>) -> Result<Vec<Placed<'_>>, EvalError> {
        let Some(seconds) = seconds else { return Ok(Vec::new()) };
        self.0.iter().filter_map(|of| placed(renderer, of, seconds).transpose()).collect()
    }

    /// Each object in its place at this time; `None` where that is not known.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub(crate) fn each(&self, renderer: &Renderer, seconds: f64) -> Result<Vec<Option<Placed<'_>>>, EvalError> {
        self.0.iter().map(|of| placed(renderer, of, seconds)).collect()
    }
}

fn placed<'a>(
    renderer: &Renderer,
    (object, stands): &'a (&ModelObject, Option<Uploaded>),
    seconds: f64,
) -> Result<Option<Placed<'a>>, EvalError> {
    let Some((world_from_object, splats)) = object.at(seconds) else { return Ok(None) };
    let splats = match stands {
        Some(uploaded) => Held::Always(uploaded),
        None => Held::Now(renderer.upload(splats)?),
    };
    Ok(Some(Placed { splats, world_from_object }))
}
