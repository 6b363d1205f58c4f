//! Reads the figures of other trainers: `bench/reference/*.json`, one file per trainer, with its source.

use std::fs;
use std::path::Path;

use scene::BadInput;
use serde::Deserialize;

use crate::{CurvePoint, ResultLine, files};

/// A file: figures of one version of one trainer on one machine.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reference {
    /// Name of the trainer in chart and table.
    pub trainer: String,
    /// Release or commit.
    pub version: String,
    /// The machine, see [`crate::machine`]; for published figures as the authors describe it.
    pub machine: String,
    /// Backend.
    pub backend: String,
    /// Who measured the figures and where they are published.
    pub source: String,
    /// The runs.
    pub runs: Vec<Run>,
}

/// A run of another trainer. Figures that were not measured are absent.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Run {
    /// As [`ResultLine::scene`].
    pub scene: String,
    /// Divisor of the photos' size.
    pub downscale: u32,
    /// The command.
    pub command: String,
    /// Its seed.
    pub seed: Option<u64>,
    /// User and system time of training, seconds.
    pub cpu_seconds: f64,
    /// Wall time of training, seconds.
    pub wall_seconds: Option<f64>,
    /// PSNR over held-out views, dB.
    pub psnr: f64,
    /// SSIM over held-out views, 0..1.
    pub ssim: Option<f64>,
    /// LPIPS over held-out views.
    pub lpips: Option<f64>,
    /// SSIMULACRA2 over held-out views.
    pub perceptual: Option<f64>,
    /// Final number of splats.
    pub splats: Option<u64>,
    /// Largest resident memory, bytes.
    pub peak_memory_bytes: Option<u64>,
    /// Held-out PSNR during training, in order of time.
    #[serde(default)]
    pub curve: Vec<CurvePoint>,
}

impl Reference {
    /// The runs as result lines; unlike plat's own they have a source.
    pub fn lines(&self) -> Vec<ResultLine> {
        let line = |run: &Run| ResultLine {
            label: self.trainer.clone(),
            commit: self.version.clone(),
            machine: self.machine.clone(),
            scene: run.scene.clone(),
            downscale: run.downscale,
            backend: self.backend.clone(),
            workers: 1,
            wall_seconds: run.wall_seconds,
            cpu_seconds: run.cpu_seconds,
            psnr: run.psnr,
            ssim: run.ssim,
            lpips: run.lpips,
            perceptual: run.perceptual,
            splats: run.splats,
            peak_memory_bytes: run.peak_memory_bytes,
            seed: run.seed,
            command: run.command.clone(),
            curve: run.curve.clone(),
            source: Some(self.source.clone()),
            ..ResultLine::default()
        };
        self.runs.iter().map(line).collect()
    }
}

/// The lines of all of a folder's references, files in name order.
///
/// # Errors
/// A folder or a file that cannot be read, or a file that is not a reference.
pub fn read_references(folder: &Path) -> Result<Vec<ResultLine>, BadInput> {
    let mut lines = Vec::new();
    for path in files(folder, "json")? {
        let bad =
            |what: String| BadInput::new(path.display().to_string(), what, "use the format of the other files there");
        let text = fs::read_to_string(&path).map_err(|e| bad(format!("cannot be read: {e}")))?;
        let reference: Reference =
            serde_json::from_str(&text).map_err(|e| bad(format!("is not a reference of a trainer: {e}")))?;
        lines.extend(reference.lines());
    }
    Ok(lines)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes;

    #[test]
    fn the_stored_references_read() {
        let lines = read_references(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/reference"))).unwrap();
        let opensplat: Vec<&ResultLine> = lines.iter().filter(|line| line.label == "OpenSplat").collect();
        assert_eq!(scenes(opensplat.iter().copied()), ["fox", "aerial_caliterra", "street_lund", "building_sceaux"]);
        assert!(lines.iter().all(|line| line.source.is_some() && line.cpu_seconds > 0.0));
        let to = |line: usize, psnr: f64| opensplat[line].cpu_seconds_to(psnr);
        assert_eq!([to(0, 24.44), to(0, 26.84), to(1, 29.56)], [Some(365.0), Some(724.0), Some(164.0)]);
        assert_eq!((opensplat[0].curve.len(), opensplat[0].seed), (13, Some(42)));
    }

    #[test]
    fn a_file_that_is_not_a_reference_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("other.json");
        for text in ["", "{}", "[1]", "{\"trainer\": \"a\", \"speed\": 9}"] {
            fs::write(&path, text).unwrap();
            let error = read_references(folder.path()).unwrap_err().to_string();
            assert!(error.contains("other.json") && error.lines().count() == 1, "{error}");
        }
        fs::write(folder.path().join("notes.txt"), "notes").unwrap();
        fs::remove_file(&path).unwrap();
        assert_eq!(read_references(folder.path()).unwrap(), []);
    }
}
