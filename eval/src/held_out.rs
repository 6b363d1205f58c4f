//! Measures some views of an ingested capture, without pictures or sheets.

use dataset::windows::WindowReader;
use render::Options;
use scene::{BadInput, Splats};
use train::Backend;

use crate::figures::{Comparison, ViewFigures};
use crate::{EvalError, Renderer};

/// The figures of these views of the reader's capture at full resolution, in order, as [`crate::evaluate`] computes them, without
/// LPIPS. `goes_on` is called after each view with the number of views done; false ends the measurement early.
///
/// # Errors
/// A view that the capture does not have, a photo that cannot be read, a renderer that fails.
pub fn figures_of_views(
    splats: &Splats,
    options: &Options,
    reader: &WindowReader,
    views: &[u32],
    backend: &Backend,
    mut goes_on: impl FnMut(usize) -> bool,
) -> Result<Vec<ViewFigures>, EvalError> {
    let mut renderer = Renderer::new(backend)?;
    let splats = renderer.upload(splats)?;
    let mut figures = Vec::with_capacity(views.len());
    for &index in views {
        let view = reader.capture().views.get(index as usize);
        let view = view.ok_or_else(|| {
            let problem = format!("asks for view {index} of {}", reader.capture().views.len());
            BadInput::new("the plan", problem, "plan the capture again")
        })?;
        let photo = reader.window(index, 0, view.camera.full())?;
        let frame = renderer.render(&splats, &view.camera, options)?;
        figures.push(Comparison::new(&view.name, &frame.colour, &photo).figures(None)?);
        if !goes_on(figures.len()) {
            break;
        }
    }
    Ok(figures)
}
