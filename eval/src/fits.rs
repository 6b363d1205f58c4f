//! Figures of a view after a fit of its pose or its exposure to the photo.
//!
//! A held-out view of a capture with pose errors, or of varying exposure, differs from its photo by more than the model's
//! error. Papers on these captures therefore fit what belongs to the single photo, and report the figures beside the plain
//! ones: the pose against the frozen model (BARF), the exposure on the left half and the error on the right (NeRF-W).

use dataset::windows::WindowReader;
use render::Options;
use scene::{Camera, Capture, Pixels, Splats};
use train::{PoseFinder, TrainView, metrics};

use crate::figures::{Comparison, ViewFigures};
use crate::{EvalError, Renderer, Uploaded};

/// What is fitted to each held-out photo for further figures.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Fits {
    /// The pose of the camera.
    pub pose: bool,
    /// The exposure: of the left half, for a figure of the right half.
    pub exposure: bool,
}

/// Measures views after fits.
pub(crate) struct Fitter<'a> {
    fits: Fits,
    poses: Option<PoseFinder<'a>>,
}

impl<'a> Fitter<'a> {
    /// For these views of a model.
    ///
    /// # Errors
    /// As [`PoseFinder::new`].
    pub(crate) fn new(
        fits: Fits,
        splats: &Splats,
        antialiased: bool,
        views: &[u32],
        reader: &'a WindowReader,
    ) -> Result<Self, EvalError> {
        let windows: Vec<TrainView> = views.iter().filter_map(|&view| window(reader.capture(), view)).collect();
        let poses = fits.pose.then(|| PoseFinder::new(splats, antialiased, &windows, reader)).transpose()?;
        Ok(Self { fits, poses })
    }

    /// Adds the figures of view `index`, whose render with the given pose is in `plain`.
    ///
    /// # Errors
    /// A photo that cannot be read, or a renderer that fails.
    pub(crate) fn add(
        &mut self,
        figures: &mut ViewFigures,
        (index, photo): (u32, &Pixels),
        plain: &Comparison,
        (renderer, splats, options): (&mut Renderer, &Uploaded, &Options),
        capture: &Capture,
    ) -> Result<(), EvalError> {
        let mut refined = None;
        if let (Some(poses), Some(view)) = (&mut self.poses, window(capture, index)) {
            let camera = Camera { camera_from_world: poses.find(&view)?, ..view.camera };
            let frame = renderer.render(splats, &camera, options)?;
            let compared = Comparison::new(plain.name, &frame.colour, photo);
            figures.psnr_refined = metrics::psnr(&compared.render, &compared.truth, compared.mask);
            refined = Some(compared);
        }
        if self.fits.exposure {
            let Comparison { render, truth, mask, width, .. } = refined.as_ref().unwrap_or(plain);
            figures.psnr_fitted = metrics::half_fitted_psnr(render, truth, *width, *mask);
        }
        Ok(())
    }
}

/// The whole photo of a view.
fn window(capture: &Capture, view: u32) -> Option<TrainView> {
    let camera = capture.views.get(view as usize)?.camera;
    Some(TrainView { view, mip: 0, rect: camera.full(), camera, camera_from_context: None })
}
