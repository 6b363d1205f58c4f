//! Keeps the value that was loaded last: most consecutive tasks are of the same job.

use std::sync::{Mutex, PoisonError};

use scene::ArtefactId;

/// A value and the artefact that it was loaded from.
pub(crate) struct Latest<T>(Mutex<Option<(ArtefactId, T)>>);

impl<T> Default for Latest<T> {
    fn default() -> Self {
        Self(Mutex::new(None))
    }
}

impl<T: Clone> Latest<T> {
    /// The value of this artefact, loaded unless it was loaded last.
    ///
    /// # Errors
    /// That of loading it.
    pub(crate) fn get<E>(&self, id: ArtefactId, load: impl FnOnce() -> Result<T, E>) -> Result<T, E> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((of, value)) = &*kept
            && *of == id
        {
            return Ok(value.clone());
        }
        // Dropped first, so that two are never in memory together.
        *kept = None;
        let value = load()?;
        *kept = Some((id, value.clone()));
        Ok(value)
    }
}
