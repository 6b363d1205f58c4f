//! The objects that a job weighs: those of files or of the capture itself, or what a detector is to find as tasks of the job.

use std::path::Path;

use blocks::{DetectorCost, Plan, PlanSettings, PlannedTask, detect_tasks};
use dataset::open::Source;
use dataset::zones::{ZoneSource, check_detector};
use eval::DetectorFile;
use perceive::aligned::{Aligned, Weights};
use perceive::{Cost, Detector};
use scene::{ArtefactId, BadInput, Capture};
use store::BlockingStore;

use crate::args::{AlignedOptions, ZoneOptions};
use crate::captures::{find_zones, zone_source};
use crate::failure::Failure;
use crate::output::Output;

/// What the options of a job say of objects. All files are read and checked.
pub(crate) struct Objects {
    /// Where they are known from, without a detector.
    known: Option<ZoneSource>,
    /// The artefact of the detector, and what a picture costs it.
    detector: Option<(Vec<u8>, Cost)>,
    zone_weight: f64,
    aligned_weight: f64,
}

impl Objects {
    /// Reads the files for a capture, opened from this path, before any photo is read.
    ///
    /// # Errors
    /// A file that is no detector, objects that do not fit the photos, a capture without labels, a detector that cannot be run; with
    /// the perception-aligned loss a network without a gradient.
    pub(crate) fn of(
        (zones, aligned): (&ZoneOptions, &AlignedOptions),
        (capture, source): (&Path, &Source),
    ) -> Result<Self, BadInput> {
        let (mut known, mut detector) = (None, None);
        if let Some(path) = &zones.finder.zone_detector {
            let file = DetectorFile::read(path)?;
            let artefact = file.artefact();
            let DetectorFile { name, onnx, card } = file;
            if aligned.weight() > 0.0 {
                Aligned::new(&name, &onnx, card.as_deref(), Weights::default())?;
            }
            let loaded = Detector::load(&name, onnx, card.as_deref())?;
            check_detector(&loaded)?;
            detector = Some((artefact, loaded.cost()));
        } else {
            known = zone_source(&zones.finder, capture, source)?;
        }
        Ok(Self { known, detector, zone_weight: zones.weight(), aligned_weight: aligned.weight() })
    }

    /// Adds weights, detector and detection tasks to the plan of a capture.
    pub(crate) fn add_to(&self, plan: Plan, capture: &Capture) -> Plan {
        let &Self { zone_weight, aligned_weight, .. } = self;
        let is_used = zone_weight > 0.0 || aligned_weight > 0.0;
        let used = self.detector.as_ref().filter(|_| is_used);
        let tasks = used.filter(|_| zone_weight > 0.0).map(|(_, cost)| {
            let &Cost { cpu_seconds, memory_bytes } = cost;
            detect_tasks(capture, DetectorCost { cpu_seconds, memory_bytes })
        });
        Plan {
            detector: used.map(|(artefact, _)| ArtefactId::of(artefact)),
            detect_tasks: tasks.unwrap_or_default(),
            settings: PlanSettings { zone_weight, aligned_weight, ..plan.settings },
            ..plan
        }
    }

    /// Puts what the plan names into the store of the ingested capture: the detector, or the zones that are known.
    ///
    /// # Errors
    /// A failing store.
    pub(crate) fn put(
        self,
        plan: Plan,
        capture: &Capture,
        store: &BlockingStore,
        output: &Output,
    ) -> Result<Plan, Failure> {
        if let Some((artefact, _)) = self.detector.filter(|_| plan.detector.is_some()) {
            store.put(artefact)?;
        }
        let zones = self.known.map(|from| find_zones(capture, &from, store, output));
        Ok(Plan { zones: zones.transpose()?.map(|(_, id)| id), ..plan })
    }
}

/// Notes how many objects the detection tasks of a job found; `results` are those of all its tasks.
///
/// # Errors
/// A failing store, a damaged result.
pub(crate) fn note_found(
    plan: &Plan,
    capture: &Capture,
    results: &[ArtefactId],
    store: &BlockingStore,
    output: &Output,
) -> Result<(), Failure> {
    let mut parts = Vec::new();
    for (task, &id) in plan.all_tasks().zip(results) {
        let PlannedTask::Detect(task) = task else { continue };
        let damaged = |error| Failure::Work(format!("the objects {id} in {}: {error}", store.store().url()));
        parts.push((task.first, dataset::zones::objects_from_frame(&store.get(id)?).map_err(damaged)?));
    }
    if !parts.is_empty() {
        let found = dataset::zones::gathered(capture, parts).map_err(|error| Failure::Work(error.to_string()))?;
        output.note(format!("{} objects on {} photos", found.len(), found.of_views.len()));
    }
    Ok(())
}
