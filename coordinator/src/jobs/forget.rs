//! Forgets a finished job: lists what only it refers to in the store, and removes it once that is deleted.

use cluster::{JobId, TaskState};
use proto::control_request::What;
use scene::ArtefactId;
use tonic::Status;

use super::Jobs;
use crate::garbage_collection::Garbage;

impl Jobs {
    /// The objects that only this finished job refers to, to be deleted before it is forgotten. Refused while another job runs: the
    /// inputs of a task are known here only once it is done.
    pub(crate) fn begin_collection(&mut self, id: u64) -> Result<Garbage, Status> {
        let of = JobId(id);
        let plan = self.job(of)?.origin.plan;
        if let Some(other) = self.jobs.keys().find(|other| self.scheduler.finished(**other).is_none()) {
            return Err(Status::failed_precondition(format!("job {} runs; forget job {id} when none does", other.0)));
        }
        self.check_no_collection()?;
        let mut garbage = Garbage { artefacts: self.results(of).chain([plan]).collect(), ..Garbage::default() };
        for (task, _) in self.scheduler.records(of) {
            let inputs = self.scheduler.inputs(of, task).into_iter().map(|(task, id)| (task.0, id)).collect();
            garbage.keys.insert(proto::result_key(plan, task.0, &inputs));
        }
        for (other, job) in self.jobs.iter().filter(|(other, _)| **other != of) {
            for id in self.results(*other).chain([job.origin.plan]) {
                garbage.artefacts.remove(&id);
            }
        }
        self.collecting = Some(of);
        Ok(garbage)
    }

    /// Forgets the job if its garbage was deleted. Otherwise the job stays and the request can be repeated.
    pub(crate) fn end_collection(&mut self, now: u64, id: u64, deleted: bool) -> Result<(), Status> {
        self.collecting = None;
        if deleted {
            self.control(now, id, What::Forget(proto::Forget {}))?;
            self.jobs.remove(&JobId(id));
            self.log.forget(JobId(id));
        }
        Ok(())
    }

    /// The results of a job's tasks.
    fn results(&self, job: JobId) -> impl Iterator<Item = ArtefactId> + '_ {
        self.scheduler.records(job).filter_map(|(_, record)| match record.state {
            TaskState::Done { artefact, .. } => Some(artefact),
            _ => None,
        })
    }
}
