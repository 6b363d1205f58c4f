//! Reads the files of networks.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use perceive::Detector;
use perceive::aligned::{Aligned, Weights};
use scene::{ArtefactId, BadInput};

use crate::aligned::AlignedLoss;

/// Networks that are used here have 4 to 60 MB.
const FILE_LIMIT: u64 = 1 << 30;
/// Model cards have a kilobyte.
const CARD_LIMIT: u64 = 1 << 16;

/// The bytes of a network's file.
///
/// # Errors
/// A file that cannot be read or is too large.
pub(crate) fn read_network(path: &Path, advice: &'static str) -> Result<Vec<u8>, BadInput> {
    read(path, FILE_LIMIT, advice)
}

/// A detector's ONNX file with the model card of its name and the extension `toml`, if there is one beside it.
pub struct DetectorFile {
    /// The path, as messages name it.
    pub name: String,
    /// The bytes of the ONNX file.
    pub onnx: Vec<u8>,
    /// The text of the card.
    pub card: Option<String>,
}

impl DetectorFile {
    /// Reads both files.
    ///
    /// # Errors
    /// A file that cannot be read or is too large.
    pub fn read(path: &Path) -> Result<Self, BadInput> {
        let onnx = read_network(path, "give a detector in an ONNX file")?;
        let beside = path.with_extension("toml");
        let card = if beside.is_file() {
            let advice = "correct this model card or remove it";
            let text = String::from_utf8(read(&beside, CARD_LIMIT, advice)?);
            Some(text.map_err(|_| BadInput::new(beside.display().to_string(), "is not text", advice))?)
        } else {
            None
        };
        Ok(Self { name: path.display().to_string(), onnx, card })
    }

    /// The artefact of the network and its card, as a plan names it.
    pub fn artefact(&self) -> Vec<u8> {
        dataset::networks::to_frame(&self.onnx, self.card.as_deref())
    }
}

/// Loads a detector from an ONNX file, with the model card beside it.
///
/// # Errors
/// A file that cannot be read, or a network that is not a detector whose output is understood.
pub fn load_detector(path: &Path) -> Result<Detector, BadInput> {
    load_identified_detector(path).map(|(detector, _)| detector)
}

/// As [`load_detector`], for the perception-aligned loss.
///
/// # Errors
/// As [`load_detector`], or a network without a gradient.
pub fn load_aligned(path: &Path) -> Result<AlignedLoss, BadInput> {
    let DetectorFile { name, onnx, card } = DetectorFile::read(path)?;
    Aligned::new(&name, &onnx, card.as_deref(), Weights::default()).map(AlignedLoss::new)
}

/// As [`load_detector`], with the id of its [artefact](DetectorFile::artefact).
///
/// # Errors
/// As [`load_detector`].
pub fn load_identified_detector(path: &Path) -> Result<(Detector, ArtefactId), BadInput> {
    let file = DetectorFile::read(path)?;
    let id = ArtefactId::of(&file.artefact());
    let DetectorFile { name, onnx, card } = file;
    Ok((Detector::load(&name, onnx, card.as_deref())?, id))
}

fn read(path: &Path, limit: u64, advice: &'static str) -> Result<Vec<u8>, BadInput> {
    let bad = |problem: String| BadInput::new(path.display().to_string(), problem, advice);
    let mut bytes = Vec::new();
    let opened = File::open(path).map(|opened| opened.take(limit + 1));
    opened
        .and_then(|mut opened| opened.read_to_end(&mut bytes))
        .map_err(|error| bad(format!("cannot be read ({error})")))?;
    if bytes.len() as u64 > limit {
        return Err(bad(format!("is larger than {} kB", limit >> 10)));
    }
    Ok(bytes)
}
