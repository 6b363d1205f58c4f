//! Reads what a task takes from other tasks: blocks, and the objects on photos.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use blocks::{CONCURRENT_FETCHES, Plan, PlannedTask, Task};
use bytes::Bytes;
use dataset::byte_lru::ByteLru;
use model::ModelObject;
use scene::frame::{self, TrainingInfo};
use scene::{ArtefactId, BlockId, Capture, Splats, Zones};
use store::BlockingStore;

use crate::recompute::recompute;
use crate::task::{Execute, ExecuteError, Flow, Report, Reporter, TaskOrder};

/// Results as they are stored, of which the last are kept in memory.
pub(crate) struct KeptResults(Mutex<ByteLru<ArtefactId, Bytes>>);

impl KeptResults {
    /// Keeps at most this many bytes.
    pub(crate) fn new(bytes: usize) -> Self {
        Self(Mutex::new(ByteLru::new(bytes)))
    }

    /// The results of these ids; `None` for those that the store has lost or has damaged.
    fn get_all(&self, store: &BlockingStore, ids: &[ArtefactId]) -> Result<Vec<Option<Bytes>>, ExecuteError> {
        let mut found: Vec<Option<Bytes>> = ids.iter().map(|id| self.kept().get(id).cloned()).collect();
        let missing: Vec<usize> = (0..ids.len()).filter(|&i| found[i].is_none()).collect();
        let wanted: Vec<ArtefactId> = missing.iter().map(|&i| ids[i]).collect();
        for (i, bytes) in missing.into_iter().zip(store.get_all_or_discard(&wanted)?) {
            bytes.iter().for_each(|bytes| self.kept().insert_if_absent(ids[i], bytes.clone(), bytes.len()));
            found[i] = bytes;
        }
        Ok(found)
    }

    fn kept(&self) -> MutexGuard<'_, ByteLru<ArtefactId, Bytes>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The results that an order names. Lost ones are computed again.
pub(crate) struct Inputs<'a> {
    pub(crate) executor: &'a dyn Execute,
    pub(crate) store: &'a BlockingStore,
    pub(crate) kept: &'a KeptResults,
    pub(crate) plan: &'a Plan,
    pub(crate) order: &'a TaskOrder,
}

impl Inputs<'_> {
    /// Fetches the blocks that a task reads, in order, and hands them to `take` one by one.
    ///
    /// # Errors
    /// A failing store, a result that the order does not name, or one that cannot be computed again.
    pub(crate) fn blocks(
        &self,
        task: PlannedTask,
        report: &mut Reporter,
        mut take: impl FnMut(BlockId, Splats, TrainingInfo),
    ) -> Result<(), ExecuteError> {
        let index = |block| {
            let missing = || ExecuteError::work(format!("the plan has no task of block {block}"));
            self.plan.index(block).ok_or_else(missing)
        };
        let tasks: Vec<u32> = self.plan.inputs(task).into_iter().map(index).collect::<Result<_, _>>()?;
        self.for_each(&tasks, report, |of, bytes, report| {
            let Some(PlannedTask::Train(of)) = self.plan.planned(of) else { return Ok(()) };
            let (splats, training) = frame::decode_result(&bytes).map_err(ExecuteError::work)?;
            take(of.block, splats, training);
            // A training task reads a few blocks, an evaluation all of them.
            if let PlannedTask::Evaluate(_) = task
                && report(Report { steps: task.steps(), loss: f64::NAN, ..Report::default() }) == Flow::Stop
            {
                return Err(ExecuteError::work("stopped while reading the model, as requested"));
            }
            Ok(())
        })
    }

    /// The objects on the photos of a block, if they count more than their surroundings.
    ///
    /// # Errors
    /// As [`Inputs::blocks`], or zones of another capture.
    pub(crate) fn zones(
        &self,
        task: &Task,
        capture: &Capture,
        report: &mut Reporter,
    ) -> Result<Option<Arc<Zones>>, ExecuteError> {
        let plan = self.plan;
        if plan.settings.zone_weight == 0.0 {
            return Ok(None);
        }
        if let Some(id) = plan.zones {
            return Ok(Some(Arc::new(dataset::zones::load(self.store, id, capture)?)));
        }
        if plan.detect_tasks.is_empty() {
            return Ok(None);
        }
        let mut parts = Vec::new();
        self.for_each(&plan.detections(PlannedTask::Train(task)), report, |of, bytes, _| {
            let Some(PlannedTask::Detect(of)) = plan.planned(of) else { return Ok(()) };
            parts.push((of.first, dataset::zones::objects_from_frame(&bytes).map_err(ExecuteError::work)?));
            Ok(())
        })?;
        Ok(Some(Arc::new(dataset::zones::gathered(capture, parts).map_err(ExecuteError::work)?)))
    }

    /// The objects that move which a task draws.
    ///
    /// # Errors
    /// As [`Inputs::blocks`], or tasks of another capture.
    pub(crate) fn objects(
        &self,
        task: PlannedTask,
        capture: &Capture,
        report: &mut Reporter,
    ) -> Result<Vec<ModelObject>, ExecuteError> {
        let tasks: Vec<u32> = self.plan.objects(task).collect();
        let mut objects = Vec::new();
        self.for_each(&tasks, report, |of, bytes, _| {
            let Some(PlannedTask::Object(of)) = self.plan.planned(of) else { return Ok(()) };
            let missing = || ExecuteError::work(format!("the capture has no object {}", of.object));
            let about = capture.objects.get(of.object as usize).ok_or_else(missing)?;
            let (about, splats, swing) = scene::objects::from_frame(&bytes, about).map_err(ExecuteError::work)?;
            objects.push(ModelObject { about, splats, swing });
            Ok(())
        })?;
        Ok(objects)
    }

    /// Fetches the results of tasks, some at a time, and hands them to `take` in order.
    fn for_each(
        &self,
        tasks: &[u32],
        report: &mut Reporter,
        mut take: impl FnMut(u32, Bytes, &mut Reporter) -> Result<(), ExecuteError>,
    ) -> Result<(), ExecuteError> {
        let result = |task: &u32| {
            let missing = || ExecuteError::work(format!("the grant does not name the result of task {task}"));
            self.order.inputs.get(task).copied().ok_or_else(missing)
        };
        for tasks in tasks.chunks(CONCURRENT_FETCHES) {
            let ids: Vec<ArtefactId> = tasks.iter().map(result).collect::<Result<_, _>>()?;
            let found = self.kept.get_all(self.store, &ids)?;
            for ((&task, id), found) in tasks.iter().zip(ids).zip(found) {
                let bytes = match found {
                    Some(bytes) => bytes,
                    None => recompute(self.executor, self.store, self.plan, self.order, (task, id), report)?,
                };
                take(task, bytes, report)?;
            }
        }
        Ok(())
    }
}
