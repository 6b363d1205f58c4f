//! What is known of one job: its tasks, their attempts and curves.

use std::sync::Arc;

use blocks::PlannedTask;
use proto::{LogKind, LogLine, Outcome, Report, StatusReply, TaskChanged, TaskState};

use scene::ArtefactId;

use crate::project::Project;
use crate::views::{Attempt, AttemptEnd, Counts, Curve, Fleet, JobState, Phase, QualityCurve, TaskChange, Tasks};
use crate::{curve::CurveLog, views};

/// Points of [`views::Fleet`].
const FLEET_POINTS: usize = 32;
/// Attempts that are kept of a task.
const ATTEMPTS_LIMIT: usize = 64;
/// Points of the job's curve of quality.
const QUALITY_LIMIT: usize = 2048;
/// By how much less and more than proportionally the rest of a job may take: the range in which the bench's jobs ended (decision 0054).
const ETA_RANGE: [f64; 2] = [0.7, 1.45];
/// Share of the work before which no time is predicted.
const ETA_SHARE: f64 = 0.02;
/// Age of a status at most.
const STATUS_AGE_MILLIS: u64 = 2000;
/// Area of a halo with its core, relative to the core's.
const HALO_AREA: f64 = blocks::ground::HALO_SCALE * blocks::ground::HALO_SCALE;

/// One task.
#[derive(Debug, Clone)]
pub(crate) struct TaskRecord {
    pub(crate) state: TaskState,
    pub(crate) artefact: Vec<u8>,
    permille: u16,
    splats: u64,
    loss: Option<f64>,
    speed: Option<f64>,
    worker: String,
    attempt: u32,
    pub(crate) attempts: Vec<Attempt>,
    curve: CurveLog,
    /// CPU seconds of attempts before the current one.
    earlier_cpu_seconds: f64,
}

impl Default for TaskRecord {
    fn default() -> Self {
        Self {
            state: TaskState::Waiting,
            artefact: Vec::new(),
            permille: 0,
            splats: 0,
            loss: None,
            speed: None,
            worker: String::new(),
            attempt: 0,
            attempts: Vec::new(),
            curve: CurveLog::default(),
            earlier_cpu_seconds: 0.0,
        }
    }
}

impl TaskRecord {
    fn letter(&self) -> char {
        match self.state {
            TaskState::Waiting => 'w',
            TaskState::Ready => 'r',
            TaskState::Leased => 'l',
            TaskState::Done => 'd',
            TaskState::Failed => 'f',
            TaskState::Quarantined => 'q',
        }
    }

    fn change(&self, task: u32, psnr: Option<f64>) -> TaskChange {
        TaskChange {
            task,
            state: self.letter(),
            permille: self.permille,
            splats: self.splats,
            loss: self.loss,
            speed: self.speed,
            worker: self.worker.clone(),
            attempt: self.attempt,
            psnr,
        }
    }

    /// The attempt of this number, new if it is not known.
    fn attempt(&mut self, number: u32, worker: &str, unix_ms: u64) -> &mut Attempt {
        let at = match self.attempts.iter().position(|attempt| attempt.number == number) {
            Some(at) => at,
            None => {
                if self.attempts.len() >= ATTEMPTS_LIMIT {
                    self.attempts.remove(0);
                }
                self.attempts.push(Attempt {
                    number,
                    worker: worker.into(),
                    began_unix_ms: unix_ms,
                    ended_unix_ms: None,
                    end: AttemptEnd::Running,
                    reason: String::new(),
                });
                self.attempts.len() - 1
            }
        };
        &mut self.attempts[at]
    }

    fn end_attempts(&mut self, unix_ms: u64, end: AttemptEnd, reason: &str) {
        for attempt in self.attempts.iter_mut().filter(|attempt| attempt.end == AttemptEnd::Running) {
            (attempt.end, attempt.ended_unix_ms, attempt.reason) = (end, Some(unix_ms), reason.into());
        }
    }

    fn cpu_seconds(&self) -> f64 {
        self.earlier_cpu_seconds + self.curve.last().map_or(0.0, |point| point.cpu_seconds)
    }
}

/// One job.
#[derive(Debug)]
pub(crate) struct JobRecord {
    pub(crate) id: u64,
    pub(crate) project: Arc<Project>,
    pub(crate) tasks: Vec<TaskRecord>,
    pub(crate) outcome: Option<Outcome>,
    paused: bool,
    priority: u32,
    weight: u32,
    pub(crate) started_unix_ms: Option<u64>,
    pub(crate) ended_unix_ms: Option<u64>,
    /// Whether results are still being written after the last task.
    pub(crate) merging: bool,
    pub(crate) quality: QualityCurve,
    pub(crate) psnr: Option<f64>,
    pub(crate) ssim: Option<f64>,
    pub(crate) perceptual: Option<f64>,
    /// CPU seconds, and splats of the merged model, where a report has them.
    pub(crate) cpu_seconds: Option<f64>,
    pub(crate) merged_splats: Option<u64>,
    /// Time and work of the first report that this server saw: what was done before took an unknown time.
    work_since: Option<(u64, f64)>,
}

impl JobRecord {
    pub(crate) fn new(id: u64, project: Arc<Project>) -> Self {
        Self {
            id,
            tasks: vec![TaskRecord::default(); project.plan.len()],
            project,
            outcome: None,
            paused: false,
            priority: 0,
            weight: 1,
            started_unix_ms: None,
            ended_unix_ms: None,
            merging: false,
            quality: QualityCurve::default(),
            psnr: None,
            ssim: None,
            perceptual: None,
            cpu_seconds: None,
            merged_splats: None,
            work_since: None,
        }
    }

    /// Takes over the header of a status; whether anything changed.
    pub(crate) fn set_status(&mut self, now: u64, status: &StatusReply) -> bool {
        let new = (status.paused, status.priority, status.weight);
        // A job that has ended runs again once one of its tasks is retried. The status may be older than the end.
        let runs_again = status.outcome.is_none()
            && self.outcome.is_some()
            && self.ended_unix_ms.is_some_and(|ended| now > ended + STATUS_AGE_MILLIS);
        if runs_again {
            (self.outcome, self.ended_unix_ms, self.work_since) = (None, None, None);
        }
        let is_new = runs_again || new != (self.paused, self.priority, self.weight);
        (self.paused, self.priority, self.weight) = new;
        is_new
    }

    /// Applies a change of a task.
    pub(crate) fn change(&mut self, now: u64, changed: &TaskChanged) {
        let Some(task) = self.tasks.get_mut(changed.task as usize) else { return };
        task.state = changed.state();
        match changed.state() {
            TaskState::Leased => {
                if task.attempt != changed.attempt {
                    (task.permille, task.speed) = (0, None);
                }
                (task.attempt, task.worker) = (changed.attempt, changed.worker.clone());
                task.attempt(changed.attempt, &changed.worker, now);
                self.started_unix_ms.get_or_insert(now);
            }
            TaskState::Done => {
                (task.permille, task.artefact) = (1000, changed.artefact.clone());
                task.end_attempts(now, AttemptEnd::Done, "");
                task.speed = None;
            }
            TaskState::Failed | TaskState::Quarantined => {
                task.end_attempts(now, AttemptEnd::Failed, &proto::one_line(&changed.message));
                task.speed = None;
            }
            TaskState::Waiting | TaskState::Ready => (task.permille, task.speed) = (0, None),
        }
    }

    /// Applies a report of an attempt.
    pub(crate) fn report(&mut self, now: u64, task: u32, attempt: u32, report: &Report) {
        let work = self.work_done();
        let Some(record) = self.tasks.get_mut(task as usize) else { return };
        if let Some(last) = record.curve.last() {
            if last.attempt != attempt {
                record.earlier_cpu_seconds += last.cpu_seconds;
            } else if report.wall_seconds > last.wall_seconds && report.step > last.step {
                record.speed = Some((report.step - last.step) as f64 / (report.wall_seconds - last.wall_seconds));
            }
        }
        let share = report.step.saturating_mul(1000).checked_div(report.steps).unwrap_or(0);
        (record.permille, record.splats, record.loss) = (share.min(1000) as u16, report.splats, report.loss);
        record.curve.push(attempt, report);
        if let Some(psnr) = report.psnr {
            self.psnr = Some(psnr);
            if self.quality.psnr.len() < QUALITY_LIMIT {
                let cpu_seconds = self.tasks.iter().map(TaskRecord::cpu_seconds).sum();
                let began = *self.started_unix_ms.get_or_insert(now);
                self.quality.cpu_seconds.push(cpu_seconds);
                self.quality.wall_seconds.push(now.saturating_sub(began) as f64 / 1e3);
                self.quality.psnr.push(psnr);
                self.quality.splats.push(report.merged_splats);
            }
        }
        self.work_since.get_or_insert((now, work));
    }

    /// Applies a line of the log, which tells when attempts began, how they ended and why.
    pub(crate) fn log(&mut self, unix_ms: u64, line: &LogLine) {
        let Some(task) = line.task else {
            if line.what.starts_with("submitted") {
                self.started_unix_ms = Some(unix_ms);
            }
            return;
        };
        let Some(record) = self.tasks.get_mut(task as usize) else { return };
        match line.kind() {
            LogKind::Granted => {
                let attempt = record.attempt(line.attempt, &line.worker, unix_ms);
                (attempt.began_unix_ms, attempt.worker) = (unix_ms, line.worker.clone());
            }
            LogKind::Ended | LogKind::Stopped => {
                let end = if line.kind() == LogKind::Ended { AttemptEnd::Failed } else { AttemptEnd::Revoked };
                let attempt = record.attempt(line.attempt, &line.worker, unix_ms);
                (attempt.end, attempt.ended_unix_ms, attempt.reason) = (end, Some(unix_ms), line.what.clone());
            }
            LogKind::Done => record.end_attempts(unix_ms, AttemptEnd::Done, ""),
            LogKind::Delayed => record.end_attempts(unix_ms, AttemptEnd::Lost, "no heartbeat until the lease expired"),
            LogKind::Ready => record.end_attempts(unix_ms, AttemptEnd::Revoked, "given back"),
            LogKind::Failed | LogKind::Quarantined => record.end_attempts(unix_ms, AttemptEnd::Failed, &line.what),
            LogKind::Other => {}
        }
    }

    /// Work that is done, and all work, in the planner's unit of cost.
    fn work_done(&self) -> f64 {
        let parts = self.project.work.iter().zip(&self.tasks);
        parts.map(|(work, task)| work * f64::from(task.permille) / 1000.0).sum()
    }

    fn eta(&self, now: u64) -> (Option<[f64; 2]>, String) {
        let all: f64 = self.project.work.iter().sum();
        let done = self.work_done();
        if self.outcome.is_some() {
            return (None, String::new());
        }
        if self.paused {
            return (None, "the job is paused".into());
        }
        let Some((since, before)) = self.work_since else {
            return (None, "no block has reported progress yet".into());
        };
        let (seen, left) = (done - before, (all - done).max(0.0));
        if seen < ETA_SHARE * all {
            return (None, format!("known once {:.0} % of the work has been seen", 100.0 * ETA_SHARE));
        }
        let seconds = now.saturating_sub(since) as f64 / 1e3 * left / seen;
        let share = left / all.max(f64::MIN_POSITIVE);
        let range = ETA_RANGE.map(|factor| seconds * (1.0 + (factor - 1.0) * share.sqrt()));
        (Some(range), "from the work done so far at its present speed".into())
    }

    fn counts(&self) -> Counts {
        let mut counts = Counts::default();
        for task in &self.tasks {
            match task.state {
                TaskState::Waiting => counts.waiting += 1,
                TaskState::Ready => counts.ready += 1,
                TaskState::Leased => counts.leased += 1,
                TaskState::Done => counts.done += 1,
                TaskState::Failed => counts.failed += 1,
                TaskState::Quarantined => counts.quarantined += 1,
            }
        }
        counts
    }

    /// Splats of the merged model. Until they are counted an estimate: of the finest blocks that are finished or running, each for the
    /// share of its halo that its core takes, and for the quarters that no finer one replaces.
    fn splats(&self) -> u64 {
        if let Some(counted) = self.merged_splats {
            return counted;
        }
        let shown = |task: usize| self.tasks[task].splats > 0;
        let part = |task: usize| {
            let replaced = self.project.children[task].iter().filter(|&&child| shown(child as usize)).count();
            let is_root = self.project.plan.tasks[task].block.level == 0;
            let core = if is_root { 1.0 } else { 1.0 / HALO_AREA };
            self.tasks[task].splats as f64 * core * (4 - replaced.min(4)) as f64 / 4.0
        };
        (0..self.project.blocks()).map(part).sum::<f64>() as u64
    }

    pub(crate) fn view(&self, now: u64) -> views::Job {
        let counts = self.counts();
        let (blocks, plan) = (self.project.blocks(), &self.project.plan);
        let objects = &self.tasks[plan.first_object()..];
        let is_trained = self.tasks[..blocks].iter().chain(objects).all(|task| task.state == TaskState::Done);
        let state = match self.outcome {
            Some(Outcome::Done) => JobState::Done,
            Some(Outcome::Incomplete) => JobState::Incomplete,
            Some(Outcome::Cancelled) => JobState::Cancelled,
            None if self.paused => JobState::Paused,
            None => JobState::Running,
        };
        let detections = &self.tasks[plan.first_detection()..plan.first_object()];
        let photos = plan.detect_tasks.iter().map(|task| u64::from(task.count));
        let photos_done = photos.clone().zip(detections).map(|(count, task)| count * u64::from(task.permille) / 1000);
        let is_waiting = |task: &TaskRecord| matches!(task.state, TaskState::Waiting | TaskState::Ready);
        let is_detecting =
            detections.iter().any(|task| task.state != TaskState::Done) && self.tasks[..blocks].iter().all(is_waiting);
        let phase = match self.outcome {
            _ if self.merging => Phase::Merge,
            Some(_) => Phase::Done,
            None if is_detecting => Phase::Detect,
            None if is_trained => Phase::Evaluate,
            None => Phase::Train,
        };
        let (eta_seconds, eta_note) = self.eta(now);
        let steps = plan.tasks.iter().map(|task| u64::from(task.steps));
        let steps_done = steps.clone().zip(&self.tasks).map(|(steps, task)| steps * u64::from(task.permille) / 1000);
        views::Job {
            id: self.id,
            name: self.project.name.clone(),
            plan: self.project.plan_id.to_string(),
            state,
            phase,
            backend: plan.backend.clone(),
            priority: self.priority,
            weight: self.weight,
            blocks,
            evaluations: plan.eval_tasks.len(),
            detections: plan.detect_tasks.len(),
            objects: plan.object_tasks.len(),
            levels: plan.levels + 1,
            counts,
            started_unix_ms: self.started_unix_ms,
            ended_unix_ms: self.ended_unix_ms,
            steps_done: steps_done.sum(),
            steps_all: steps.sum(),
            photos_done: photos_done.sum(),
            photos_all: photos.sum(),
            splats: self.splats(),
            cpu_seconds: self.cpu_seconds.unwrap_or_else(|| self.tasks.iter().map(TaskRecord::cpu_seconds).sum()),
            eta_seconds,
            eta_note,
            psnr: self.psnr,
            ssim: self.ssim,
            perceptual: self.perceptual,
            model: self.tasks[..blocks].iter().any(|task| task.state == TaskState::Done),
        }
    }

    /// The result of a finished task.
    pub(crate) fn artefact_of(&self, task: u32) -> Option<ArtefactId> {
        let record = self.tasks.get(task as usize).filter(|record| record.state == TaskState::Done)?;
        Some(ArtefactId(record.artefact.as_slice().try_into().ok()?))
    }

    /// The finished block that has this result.
    pub(crate) fn task_of_artefact(&self, artefact: &[u8]) -> Option<u32> {
        let blocks = &self.tasks[..self.project.blocks()];
        let is_it = |record: &TaskRecord| record.state == TaskState::Done && record.artefact == artefact;
        blocks.iter().position(is_it).map(|task| task as u32)
    }

    /// The result and the splats of a finished block.
    pub(crate) fn finished(&self, task: u32) -> Option<(String, u64)> {
        Some((self.artefact_of(task)?.to_string(), self.tasks.get(task as usize)?.splats))
    }

    pub(crate) fn task_change(&self, task: u32) -> Option<TaskChange> {
        let psnr = self.project.block_psnr(task as usize);
        self.tasks.get(task as usize).map(|record| record.change(task, psnr))
    }

    pub(crate) fn tasks_view(&self, seq: u64) -> Tasks {
        let mut view = Tasks { seq, ..Tasks::default() };
        for (task, record) in self.tasks.iter().enumerate() {
            view.state.push(record.letter());
            view.progress.push(record.permille);
            view.splats.push(record.splats);
            view.loss.push(record.loss);
            view.speed.push(record.speed);
            view.worker.push(record.worker.clone());
            view.attempt.push(record.attempt);
            view.psnr.push(self.project.block_psnr(task));
        }
        view
    }

    /// One task in full; `None` if the job has no such task.
    pub(crate) fn task_view(&self, task: u32) -> Option<views::Task> {
        let record = self.tasks.get(task as usize)?;
        let about = self.project.about(task);
        Some(views::Task {
            task,
            block: about.block.map(|block| block.to_string()),
            kind: match self.project.plan.planned(task) {
                Some(PlannedTask::Evaluate(_)) => "evaluate",
                Some(PlannedTask::Detect(_)) => "detect",
                Some(PlannedTask::Object(_)) => "object",
                Some(PlannedTask::Train(_)) | None => "train",
            },
            state: record.letter(),
            steps: about.steps,
            budget: about.budget,
            rho_metres: about.rho_metres,
            memory_bytes: about.memory_bytes,
            parent: about.parent,
            attempts: record.attempts.clone(),
            curve: record.curve.view(),
            fleet: about.block.map_or_else(Fleet::default, |block| self.fleet(block.level)),
            psnr: self.project.block_psnr(task as usize),
            neighbours: about.neighbours,
        })
    }

    /// Percentiles over the blocks of a level.
    fn fleet(&self, level: u8) -> Fleet {
        let of_level = self.project.plan.tasks.iter().zip(&self.tasks).filter(|(task, _)| task.block.level == level);
        let curves: Vec<Curve> = of_level.map(|(_, record)| record.curve.view()).collect();
        crate::curve::fleet(&curves, FLEET_POINTS)
    }

    /// Forgets when attempts began and ended: a folder does not say.
    pub(crate) fn set_attempts_unknown(&mut self) {
        self.tasks.iter_mut().for_each(|task| task.attempts.clear());
    }

    /// Sets what a finished block is known by from its folder.
    pub(crate) fn set_done(&mut self, task: usize, artefact: Vec<u8>, splats: Option<u64>) {
        if let Some(record) = self.tasks.get_mut(task) {
            (record.state, record.permille, record.artefact) = (TaskState::Done, 1000, artefact);
            if let Some(splats) = splats {
                record.splats = splats;
            }
        }
    }
}
