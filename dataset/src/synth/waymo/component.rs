//! A component of a segment: a table, written group by group.

use std::path::Path;

use glam::DMat3;
use scene::Rigid;
use scene::parquet::{Cells, Writer};
use store::file::AtomicFile;

use super::super::output::create_folder;
use super::super::settings::SynthError;
use super::segment::FOLDER;

/// The columns of a group of rows.
pub(super) type Columns = Vec<(&'static str, Cells)>;

/// A table that is being written.
pub(super) struct Component {
    file: AtomicFile,
    writer: Writer,
}

impl Component {
    /// Creates the table of a segment.
    pub(super) fn create(out: &Path, component: &str, segment: &str) -> Result<Self, SynthError> {
        let folder = out.join(FOLDER).join(component);
        create_folder(&folder)?;
        let file = AtomicFile::create(&folder.join(format!("{segment}.parquet")))?;
        Ok(Self { file, writer: Writer::default() })
    }

    /// Appends rows.
    pub(super) fn group(&mut self, columns: Columns) -> Result<(), SynthError> {
        Ok(self.file.write(&self.writer.group(columns))?)
    }

    /// Completes the table.
    pub(super) fn finish(mut self) -> Result<(), SynthError> {
        self.file.write(&self.writer.finish())?;
        Ok(self.file.commit()?)
    }

    /// Writes a table of one group.
    pub(super) fn write(out: &Path, component: &str, segment: &str, columns: Columns) -> Result<(), SynthError> {
        let mut table = Self::create(out, component, segment)?;
        table.group(columns)?;
        table.finish()
    }
}

/// The keys of rows with times in microseconds.
pub(super) fn keys(segment: &str, times: impl Iterator<Item = i64>) -> Columns {
    let times: Vec<i64> = times.collect();
    let names = vec![segment.to_owned(); times.len()];
    vec![("key.segment_context_name", Cells::Text(names)), ("key.frame_timestamp_micros", Cells::Int64(times))]
}

/// A transform as 4 × 4 numbers, row by row.
pub(super) fn matrix(pose: &Rigid) -> Vec<f64> {
    let (r, t) = (DMat3::from_quat(pose.rotation), pose.translation);
    let row = |i: usize| [r.x_axis[i], r.y_axis[i], r.z_axis[i], t[i]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]].concat()
}
