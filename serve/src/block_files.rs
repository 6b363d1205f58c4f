//! The splats of finished blocks as files for viewers, made on demand and kept in a temporary folder: what is made once is read from
//! the disk by all browsers.

use std::collections::VecDeque;
use std::fs;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use glam::DVec3;
use scene::{ArtefactId, BlockId, rad, spz};
use tempfile::TempDir;
use tokio::sync::Semaphore;

use crate::project::Project;

/// Bytes of files that are kept.
const BYTES_LIMIT: u64 = 4 << 30;

/// A file format of blocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Format {
    /// RAD with levels of detail.
    Rad,
    /// SPZ of version 3.
    Spz,
}

impl Format {
    pub(crate) fn of(extension: &str) -> Option<Self> {
        [Self::Rad, Self::Spz].into_iter().find(|format| format.extension() == extension)
    }

    fn extension(self) -> &'static str {
        match self {
            Self::Rad => "rad",
            Self::Spz => "spz",
        }
    }
}

/// The kept files.
#[derive(Debug)]
pub(crate) struct BlockFiles {
    folder: TempDir,
    /// Oldest first, and the sum of their sizes.
    kept: Mutex<(VecDeque<(PathBuf, u64)>, u64)>,
    /// One block is made at a time, so that training keeps its cores.
    making: Semaphore,
}

/// Splats to make a file of.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Wanted {
    pub(crate) block: BlockId,
    pub(crate) artefact: ArtefactId,
    pub(crate) backdrop: bool,
    pub(crate) format: Format,
}

impl BlockFiles {
    pub(crate) fn new() -> std::io::Result<Self> {
        Ok(Self { folder: tempfile::tempdir()?, kept: Mutex::default(), making: Semaphore::new(1) })
    }

    /// The path of a file, which is made if it is not kept. `None` if it would have no splats.
    ///
    /// # Errors
    /// Results that cannot be read, splats that the format cannot hold, a full disk.
    pub(crate) async fn path(&self, project: &Arc<Project>, wanted: Wanted) -> Result<Option<PathBuf>, String> {
        let Wanted { artefact, backdrop, format, .. } = wanted;
        // The place matters too: the same splats may be relative to another centre in another job.
        let kind = if backdrop { "backdrop" } else { "block" };
        let name = format!("{}-{artefact}-{kind}.{}", project.plan_id, format.extension());
        let path = self.folder.path().join(name);
        if path.exists() {
            return Ok(Some(path));
        }
        let Ok(_slot) = self.making.acquire().await else { return Ok(None) };
        if path.exists() {
            return Ok(Some(path));
        }
        let make = || {
            let (project, to) = (project.clone(), path.clone());
            tokio::task::spawn_blocking(move || make(&project, wanted, &to))
        };
        let mut made = make().await.map_err(|error| error.to_string())?;
        // The temporary folder may be smaller than the limit.
        if made.is_err() && self.drop_down_to(0, 0) {
            made = make().await.map_err(|error| error.to_string())?;
        }
        let bytes = made?;
        Ok(bytes.map(|bytes| {
            self.keep(path.clone(), bytes);
            path
        }))
    }

    /// Counts a new file, and removes the oldest ones beyond the limit.
    fn keep(&self, path: PathBuf, bytes: u64) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.0.push_back((path, bytes));
        kept.1 += bytes;
        drop(kept);
        self.drop_down_to(BYTES_LIMIT, 1);
    }

    /// Removes the oldest files until the rest has at most `limit` bytes or `least` files; whether any was removed.
    fn drop_down_to(&self, limit: u64, least: usize) -> bool {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let (files, sum) = &mut *kept;
        let before = files.len();
        while *sum > limit && files.len() > least {
            if let Some((oldest, bytes)) = files.pop_front() {
                *sum -= bytes;
                // It may be open in a request, which then goes on reading it.
                let _ = fs::remove_file(oldest);
            }
        }
        files.len() < before
    }
}

/// Writes the file; its size, or `None` without splats.
fn make(project: &Project, wanted: Wanted, to: &std::path::Path) -> Result<Option<u64>, String> {
    let Wanted { block, artefact, backdrop, format } = wanted;
    let splats = project.splats(block, artefact, backdrop)?;
    if splats.is_empty() {
        return Ok(None);
    }
    let antialiased = project.plan.settings.antialiased;
    let bytes = match format {
        // The splats are relative to the centre already.
        Format::Rad => rad::write(&splats, DVec3::ZERO, None).map_err(|error| error.to_string())?,
        Format::Spz => spz::write(&splats, antialiased, spz::Version::V3).map_err(|error| error.to_string())?,
    };
    store::file::save(to, &bytes).map_err(|error| error.to_string())?;
    Ok(Some(bytes.len() as u64))
}
