//! Renders views on the CPU or on a GPU behind one interface.

use std::borrow::Cow;

#[cfg(feature = "gpu")]
use render::gpu::GpuSplats;
use render::{Frame, Options, Part, cpu};
use scene::{Camera, Rigid, Splats};
use train::Backend;

use crate::EvalError;

/// What a caller of [`Renderer`] did wrong.
#[cfg(feature = "gpu")]
const OTHER_BACKEND: &str = "splats were uploaded to another backend";

/// A renderer of one backend. Keeps its buffers between views.
pub struct Renderer(Inner);

enum Inner {
    Cpu(Box<cpu::Renderer>),
    #[cfg(feature = "gpu")]
    Gpu(Box<gpu::Renderer>),
}

/// Splats where their renderer reads them: in place on the CPU, a copy in device memory on a GPU.
pub struct Uploaded<'a>(Place<'a>);

/// An object at a time: its splats, and where it is.
pub struct Placed<'a> {
    pub(crate) splats: Held<'a>,
    pub(crate) world_from_object: Rigid,
}

/// Splats of an object: the same at all times, or as they are at one.
pub(crate) enum Held<'a> {
    Always(&'a Uploaded<'a>),
    Now(Uploaded<'a>),
}

impl<'a> Held<'a> {
    fn place(&self) -> &Place<'a> {
        match self {
            Self::Always(uploaded) => &uploaded.0,
            Self::Now(uploaded) => &uploaded.0,
        }
    }
}

enum Place<'a> {
    Cpu(Cow<'a, Splats>),
    #[cfg(feature = "gpu")]
    Gpu(Box<GpuSplats>),
}

impl Renderer {
    /// A renderer of this backend.
    ///
    /// # Errors
    /// A GPU on which the kernels cannot be created.
    pub fn new(backend: &Backend) -> Result<Self, EvalError> {
        Ok(Self(match backend {
            Backend::Cpu => Inner::Cpu(Box::default()),
            #[cfg(feature = "gpu")]
            Backend::Gpu(gpu) => Inner::Gpu(Box::new(gpu::Renderer::new(gpu)?)),
        }))
    }

    /// The backend's name with its instruction set or adapter, as in a plan.
    pub fn name(&self) -> String {
        match &self.0 {
            Inner::Cpu(renderer) => renderer.name(),
            #[cfg(feature = "gpu")]
            Inner::Gpu(gpu) => gpu.name(),
        }
    }

    /// Prepares splats for any number of views.
    ///
    /// # Errors
    /// Splats that do not fit the device's memory.
    pub fn upload<'a>(&self, splats: impl Into<Cow<'a, Splats>>) -> Result<Uploaded<'a>, EvalError> {
        let splats = splats.into();
        Ok(Uploaded(match &self.0 {
            Inner::Cpu(_) => Place::Cpu(splats),
            #[cfg(feature = "gpu")]
            Inner::Gpu(gpu) => Place::Gpu(Box::new(gpu.upload(&splats)?)),
        }))
    }

    /// Renders a view. Both backends give all planes of [`Frame`].
    ///
    /// # Errors
    /// A device that fails or has too little memory.
    ///
    /// # Panics
    /// If the splats were uploaded to a renderer of another backend.
    pub fn render(&mut self, splats: &Uploaded, camera: &Camera, options: &Options) -> Result<&Frame, EvalError> {
        self.compose(splats, &[], camera, options)
    }

    /// As [`render`](Self::render), with objects in their places.
    ///
    /// # Errors
    /// As `render`.
    ///
    /// # Panics
    /// As `render`.
    pub fn compose(
        &mut self,
        splats: &Uploaded,
        objects: &[Placed],
        camera: &Camera,
        options: &Options,
    ) -> Result<&Frame, EvalError> {
        let pose = |object: &Placed| camera.camera_from_world.after(&object.world_from_object);
        match (&mut self.0, &splats.0) {
            (Inner::Cpu(renderer), Place::Cpu(splats)) => {
                let parts = objects.iter().map(|object| match object.splats.place() {
                    Place::Cpu(splats) => Part { splats, camera_from_part: Some(pose(object)) },
                    #[cfg(feature = "gpu")]
                    Place::Gpu(_) => panic!("{OTHER_BACKEND}"),
                });
                let parts: Vec<Part> = parts.collect();
                Ok(renderer.forward(splats, &parts, camera, options))
            }
            #[cfg(feature = "gpu")]
            (Inner::Gpu(gpu), Place::Gpu(splats)) => {
                let parts = objects.iter().map(|object| match object.splats.place() {
                    Place::Gpu(splats) => (&**splats, [pose(object)]),
                    Place::Cpu(_) => panic!("{OTHER_BACKEND}"),
                });
                let parts: Vec<(&GpuSplats, [Rigid; 1])> = parts.collect();
                gpu.render(splats, &parts, camera, options)
            }
            #[cfg(feature = "gpu")]
            _ => panic!("{OTHER_BACKEND}"),
        }
    }

    /// Renders one view of splats that are not kept on the device.
    ///
    /// # Errors
    /// As [`upload`](Self::upload) and [`render`](Self::render).
    pub fn render_once(&mut self, splats: &Splats, camera: &Camera, options: &Options) -> Result<&Frame, EvalError> {
        let uploaded = self.upload(splats)?;
        self.render(&uploaded, camera, options)
    }
}

#[cfg(feature = "gpu")]
mod gpu {
    use std::sync::Arc;

    use render::gpu::{Gpu, GpuError, GpuPart, GpuRenderer, GpuSplats};
    use render::{Frame, Options};
    use scene::{Camera, Rigid, Splats};

    use crate::EvalError;

    pub(super) struct Renderer {
        gpu: Arc<Gpu>,
        renderer: GpuRenderer,
        frame: Frame,
    }

    impl Renderer {
        pub(super) fn new(gpu: &Arc<Gpu>) -> Result<Self, EvalError> {
            let renderer = GpuRenderer::new(gpu.clone()).map_err(failed)?;
            Ok(Self { gpu: gpu.clone(), renderer, frame: Frame::default() })
        }

        pub(super) fn name(&self) -> String {
            self.renderer.name()
        }

        pub(super) fn upload(&self, splats: &Splats) -> Result<GpuSplats, EvalError> {
            GpuSplats::upload(&self.gpu, splats, 0).map_err(failed)
        }

        pub(super) fn render(
            &mut self,
            splats: &GpuSplats,
            parts: &[(&GpuSplats, [Rigid; 1])],
            camera: &Camera,
            options: &Options,
        ) -> Result<&Frame, EvalError> {
            let parts: Vec<GpuPart> =
                parts.iter().map(|(splats, pose)| GpuPart { splats, cameras_from_part: Some(pose) }).collect();
            self.frame = self.renderer.draw(splats, &parts, camera, options).map_err(failed)?;
            Ok(&self.frame)
        }
    }

    fn failed(error: GpuError) -> EvalError {
        EvalError::Renderer(error.to_string())
    }
}
