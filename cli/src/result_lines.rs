//! Appends runs to `bench/results/plat.jsonl`.

use std::path::{Path, PathBuf};

use bench::{CurvePoint, ResultLine, append};

use crate::failure::{Failure, make_folder};
use crate::run_record::{Record, invocation};

/// The file of plat's own runs.
pub(crate) const RUNS: &str = "plat.jsonl";

/// The result line of a run. Its curve ends with the merged model after all work.
pub(crate) fn line_of(label: &str, record: &Record, mut curve: Vec<CurvePoint>) -> ResultLine {
    if let (Some(cpu_seconds), Some(psnr)) = (record.cpu_seconds, record.psnr) {
        curve.pop();
        curve.push(CurvePoint { cpu_seconds, psnr, splats: Some(record.splats) });
    }
    record.line(label, invocation(), curve)
}

/// Appends a run's line to the file of runs in this folder; returns the file's path.
pub(crate) fn append_run(results: &Path, line: &ResultLine) -> Result<PathBuf, Failure> {
    let file = results.join(RUNS);
    make_folder(results)?;
    append(&file, line)?;
    Ok(file)
}
