//! The photos that a model is measured on.

use std::sync::Arc;

use blocks::Split;
use dataset::ingest::{IngestOptions, ingest};
use dataset::open::Source;
use dataset::windows::WindowReader;
use model::Model;
use scene::{ArtefactId, Capture, Poses, Zones};
use store::{BlockingStore, Store};
use tempfile::TempDir;

use crate::{EvalError, Observer};

/// How to read a capture's photos; what is not given is taken from the model's training.
#[derive(Debug, Clone, Copy, Default)]
pub struct PhotoOptions<'a> {
    /// URL of the store for ingested photos; by default the model's own if it still exists, else a temporary one.
    pub store: Option<&'a str>,
    /// Divisor of the photos' size.
    pub downscale: Option<u32>,
    /// Every how many views one is held out.
    pub test_every: Option<u32>,
    /// Width of the stretches of streets of which some are held out, metres; 0: none.
    pub test_stretches: Option<f64>,
    /// Uses a temporary store by default, even if the model's own still exists: the photos are not the model's.
    pub leaves_store_of_model: bool,
}

/// An ingested capture.
#[derive(Debug)]
pub struct Photos {
    /// The capture; its views have mips.
    pub capture: Arc<Capture>,
    /// The store that holds its photos.
    pub store: BlockingStore,
    /// Id of the ingested capture; `None` where the caller does not know it.
    pub id: Option<ArtefactId>,
    /// Which views are held out.
    pub split: Split,
    /// Divisor of the photos' size.
    pub downscale: u32,
    /// The objects on the photos, if anyone looked for them, and the additional weight of their pixels.
    pub zones: Option<(Arc<Zones>, f32)>,
    /// A temporary store, deleted with this value.
    _temporary: Option<TempDir>,
}

impl Photos {
    /// Photos that were ingested before.
    pub fn ingested(capture: Capture, store: BlockingStore, split: Split, downscale: u32) -> Self {
        Self { capture: Arc::new(capture), store, id: None, split, downscale, zones: None, _temporary: None }
    }

    /// Ingests the photos of a capture.
    ///
    /// # Errors
    /// A store that fails, or photos that cannot be used.
    pub fn ingest(
        model: &Model,
        source: &Source,
        options: &PhotoOptions,
        observer: &dyn Observer,
    ) -> Result<Self, EvalError> {
        let (store, temporary) = open_store(model, options)?;
        let store = store.blocking();
        let downscale = options.downscale.unwrap_or(model.downscale());
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        let report = |done: usize, total: usize| observer.progress("photos", done as u64, total as u64, "");
        let ingested = ingest(source, &store, &IngestOptions { downscale, threads }, &report)?;
        let split = model.split(&ingested.capture, options.test_every, options.test_stretches);
        Ok(Self {
            capture: Arc::new(ingested.capture),
            store,
            id: Some(ingested.id),
            split,
            downscale,
            zones: None,
            _temporary: temporary,
        })
    }

    /// Whether these are the photos that a model was trained on. Only then its exposures and refined cameras are theirs.
    ///
    /// # Errors
    /// A trained model whose plan cannot be read.
    pub(crate) fn are_of(&self, model: &Model) -> Result<bool, EvalError> {
        match &model.trained {
            Some((_, out)) => Ok(self.id.is_some() && model::capture_of(out)? == self.id),
            None => Ok(false),
        }
    }

    /// The photos with their cameras as training found them, if a model was trained on them with refined cameras.
    ///
    /// # Errors
    /// A trained model whose plan cannot be read.
    pub fn with_cameras_of(self, model: &Model, observer: &dyn Observer) -> Result<Self, EvalError> {
        let Some(poses) = &model.poses else { return Ok(self) };
        if !self.are_of(model)? {
            observer.note("the model was trained on other photos: its refined cameras are left out");
            return Ok(self);
        }
        Ok(self.corrected_by(poses))
    }

    /// The photos with these cameras.
    #[must_use]
    pub fn corrected_by(self, poses: &Poses) -> Self {
        Self { capture: Arc::new(poses.in_capture(&self.capture)), ..self }
    }

    /// A reader of the photos that keeps this many bytes of them decoded.
    pub(crate) fn reader(&self, cache_bytes: usize) -> WindowReader {
        WindowReader::new(self.capture.clone(), self.store.clone(), cache_bytes)
    }

    /// As [`reader`](Self::reader), with the weights of the zones if there are any.
    pub(crate) fn weighted_reader(&self, cache_bytes: usize) -> WindowReader {
        let reader = self.reader(cache_bytes);
        match &self.zones {
            Some((zones, weight)) => reader.with_zones(zones.clone(), *weight),
            None => reader,
        }
    }
}

fn open_store(model: &Model, options: &PhotoOptions) -> Result<(Store, Option<TempDir>), EvalError> {
    let trained = model.trained.as_ref().filter(|_| !options.leaves_store_of_model);
    let own = trained.map(|(_, out)| out.join("store")).filter(|store| store.is_dir());
    match (options.store, own) {
        (Some(url), _) => Ok((Store::open(url)?, None)),
        (None, Some(own)) => Ok((Store::open(&own.display().to_string())?, None)),
        (None, None) => {
            let folder = tempfile::tempdir().map_err(EvalError::NoTemporaryFolder)?;
            Ok((Store::open(&folder.path().display().to_string())?, Some(folder)))
        }
    }
}
