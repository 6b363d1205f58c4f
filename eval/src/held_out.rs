//! Measures some views of an ingested capture, without pictures or sheets.

use dataset::windows::WindowReader;
use model::ModelObject;
use render::Options;
use scene::{BadInput, Splats};
use train::Backend;

use crate::composition::Composition;
use crate::figures::{Comparison, ViewFigures};
use crate::fits::{Fits, Fitter};
use crate::{EvalError, Renderer};

/// The figures of these views of the reader's capture at full resolution, in order, as [`crate::evaluate`] computes them, without
/// LPIPS. Objects that move are drawn where they were. `goes_on` is called after each view with the number of views done; false ends the measurement early.
///
/// # Errors
/// A view that the capture does not have, a photo that cannot be read, a renderer that fails.
pub fn figures_of_views(
    splats: &Splats,
    objects: &[ModelObject],
    options: &Options,
    reader: &WindowReader,
    views: &[u32],
    backend: &Backend,
    fits: Fits,
    mut goes_on: impl FnMut(usize) -> bool,
) -> Result<Vec<ViewFigures>, EvalError> {
    let mut renderer = Renderer::new(backend)?;
    let mut fitter = Fitter::new(fits, splats, options.antialiased, views, reader)?;
    let splats = renderer.upload(splats)?;
    let objects = Composition::new(&renderer, objects.iter())?;
    let mut figures = Vec::with_capacity(views.len());
    for &index in views {
        let view = reader.capture().views.get(index as usize);
        let view = view.ok_or_else(|| {
            let problem = format!("asks for view {index} of {}", reader.capture().views.len());
            BadInput::new("the plan", problem, "plan the capture again")
        })?;
        let photo = reader.window(index, 0, view.camera.full())?;
        let placed = objects.at(&renderer, view.seconds)?;
        let frame = renderer.compose(&splats, &placed, &view.camera, options)?;
        let compared = Comparison::new(&view.name, &frame.colour, &photo);
        let mut of_view = compared.figures(None)?;
        let rendering = (&mut renderer, &splats, options);
        fitter.add(&mut of_view, (index, &photo), &compared, rendering, reader.capture())?;
        figures.push(of_view);
        if !goes_on(figures.len()) {
            break;
        }
    }
    Ok(figures)
}
