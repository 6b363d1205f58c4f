//! Writes the updates of a job to `metrics.jsonl`, shows progress, and adds up times.

use std::fs::File;
use std::path::{Path, PathBuf};

use bench::{CurvePoint, ReportLine};
use blocks::Plan;
use proto::watch_event::Event;
use proto::{TaskChanged, TaskState};
use scene::BlockId;
use store::file::{SaveError, append};

use crate::clock::Stopwatch;
use crate::failure::{Failure, cannot};
use crate::output::Stages;

/// Progress and time of a task's current attempt.
#[derive(Debug, Clone, Default)]
struct Spent {
    attempt: u32,
    /// Optimiser steps, scaled to the planned ones, as a time limit may leave fewer; views of other tasks.
    step: u64,
    cpu_seconds: f64,
    wall_seconds: f64,
}

/// Times of a job, and its held-out PSNR during training.
#[derive(Debug, Default)]
pub(crate) struct Totals {
    pub(crate) cpu_seconds: f64,
    pub(crate) wall_seconds: f64,
    pub(crate) last_psnr: Option<f64>,
    pub(crate) curve: Vec<CurvePoint>,
}

/// Logs the updates of a job.
///
/// Logged times run from the start of the command: work before the job, finished tasks, and the current task, without evaluation. With
/// several workers tasks overlap and share one CPU clock; then the times are those of the process at the update, with evaluation.
pub(crate) struct MetricsLog {
    path: PathBuf,
    file: File,
    /// Block and planned steps of each task that trains one: the first tasks.
    planned: Vec<(BlockId, u32)>,
    /// Of all tasks.
    tasks: Vec<Spent>,
    workers: u32,
    /// Since the start of the command.
    clock: Stopwatch,
    /// CPU and wall seconds before the job and of failed attempts.
    before: (f64, f64),
    progress: Stages,
    totals: Totals,
    done: usize,
    /// Number of held-out views that evaluation tasks measure.
    measured_views: u64,
    /// The first detection task, and the number of views that those tasks look at.
    detection: (usize, u64),
    /// The first task of an object that moves, and the steps of all of them.
    objects: (usize, u64),
    /// CPU and wall seconds when the first evaluation task began. Evaluation does not count.
    trained_at: Option<(f64, f64)>,
    failed: Option<Failure>,
}

impl MetricsLog {
    /// Creates the file for the job of this plan. `clock` has run since the start of the command.
    pub(crate) fn create(
        path: &Path,
        plan: &Plan,
        workers: u32,
        clock: Stopwatch,
        progress: Stages,
    ) -> Result<Self, Failure> {
        Ok(Self {
            path: path.to_path_buf(),
            file: File::create(path).map_err(cannot("written", path))?,
            planned: plan.tasks.iter().map(|task| (task.block, task.steps)).collect(),
            tasks: vec![Spent::default(); plan.len()],
            workers,
            before: (clock.cpu_seconds(), clock.wall_seconds()),
            clock,
            progress,
            totals: Totals::default(),
            done: 0,
            measured_views: plan.eval_tasks.iter().map(|task| task.views.len() as u64).sum(),
            detection: (plan.first_detection(), plan.detect_tasks.iter().map(|task| u64::from(task.count)).sum()),
            objects: (plan.first_object(), plan.object_tasks.iter().map(|task| u64::from(task.steps)).sum()),
            trained_at: None,
            failed: None,
        })
    }

    /// Logs an update. A line that cannot be written fails [`close`](Self::close), not the job.
    pub(crate) fn update(&mut self, update: &Event) {
        match update {
            Event::Changed(changed) => {
                if changed.task as usize >= self.objects.0 {
                    return self.object_changed(changed);
                }
                if changed.task as usize >= self.detection.0 {
                    return self.detection_changed(changed);
                }
                let Some((block, _)) = self.planned.get(changed.task as usize) else {
                    return self.evaluation_changed(changed);
                };
                match changed.state() {
                    TaskState::Done => {
                        self.done += 1;
                        if self.planned.len() > 1 {
                            self.progress.note(format!("block {block} done, {} of {}", self.done, self.planned.len()));
                        }
                    }
                    TaskState::Failed | TaskState::Quarantined => {
                        self.progress.note(format!("block {block} failed: {}", proto::one_line(&changed.message)));
                    }
                    TaskState::Waiting | TaskState::Ready | TaskState::Leased => {}
                }
            }
            Event::Reported(reported) => {
                if let Some(report) = &reported.report {
                    self.report(reported.task as usize, reported.attempt, report);
                }
            }
            Event::Finished(_) => {}
        }
    }

    /// Evaluation tasks begin after training.
    fn evaluation_changed(&mut self, changed: &TaskChanged) {
        match changed.state() {
            TaskState::Leased if self.trained_at.is_none() => self.trained_at = Some(self.clocks()),
            TaskState::Failed | TaskState::Quarantined => {
                self.progress.note(format!("evaluation failed: {}", proto::one_line(&changed.message)));
            }
            TaskState::Waiting | TaskState::Ready | TaskState::Leased | TaskState::Done => {}
        }
    }

    /// Detection tasks come before the blocks of their views.
    fn detection_changed(&mut self, changed: &TaskChanged) {
        if let TaskState::Failed | TaskState::Quarantined = changed.state() {
            self.progress.note(format!("looking for objects failed: {}", proto::one_line(&changed.message)));
        }
    }

    /// Tasks of objects that move come after the blocks around their paths.
    fn object_changed(&mut self, changed: &TaskChanged) {
        if let TaskState::Failed | TaskState::Quarantined = changed.state() {
            let (number, why) = (changed.task as usize - self.objects.0, proto::one_line(&changed.message));
            self.progress.note(format!("object {number} that moves failed: {why}"));
        }
    }

    /// Takes over progress and times of a task; false if there is no such task.
    fn spend(&mut self, task: usize, spent: Spent) -> bool {
        let Some(before) = self.tasks.get_mut(task) else { return false };
        if before.attempt != spent.attempt {
            self.before.0 += before.cpu_seconds;
            self.before.1 += before.wall_seconds;
        }
        *before = spent;
        true
    }

    fn report(&mut self, task: usize, attempt: u32, report: &proto::Report) {
        let &proto::Report { step, cpu_seconds, wall_seconds, .. } = report;
        let (first_detection, looked_at) = self.detection;
        let (first_object, trained) = self.objects;
        let Some(&(block, planned)) = self.planned.get(task) else {
            let done = |tasks: &[Spent]| tasks.iter().map(|spent| spent.step).sum();
            if task < first_detection {
                // Evaluation is not logged: its figures are those of the finished model.
                self.spend(task, Spent { attempt, step, ..Spent::default() });
                let measured = done(&self.tasks[self.planned.len()..first_detection]);
                self.progress.at("evaluating", measured, self.measured_views, "");
            } else if self.spend(task, Spent { attempt, step, cpu_seconds, wall_seconds }) {
                if task >= first_object {
                    // Objects begin when the blocks around their paths are done; the bar is theirs when all blocks are.
                    if self.done == self.planned.len() {
                        self.progress.at("moving objects", done(&self.tasks[first_object..]), trained, "");
                    }
                } else if !self.is_training() {
                    self.progress.at("objects", done(&self.tasks[first_detection..first_object]), looked_at, "");
                }
            }
            return;
        };
        let share = report.step as f64 / report.steps.max(1) as f64;
        let step = (share * f64::from(planned)) as u64;
        self.spend(task, Spent { attempt, step, cpu_seconds, wall_seconds });
        let (cpu_seconds, wall_seconds) = self.clocks();
        let line = ReportLine {
            task: block.to_string(),
            attempt,
            step: report.step,
            steps: report.steps,
            cpu_seconds,
            wall_seconds,
            splats: report.splats,
            loss: report.loss,
            psnr: report.psnr,
            merged_splats: report.merged_splats,
            aligned_loss: report.aligned_loss,
            aligned_cpu_ms: report.aligned_cpu_seconds.map(|seconds| 1e3 * seconds),
        };
        if let Some(psnr) = report.psnr {
            self.totals.last_psnr = Some(psnr);
            self.totals.curve.push(CurvePoint { cpu_seconds, psnr, splats: report.merged_splats });
        }
        if self.failed.is_none() {
            let written = serde_json::to_string(&line).map_err(std::io::Error::from);
            let written = written.and_then(|text| append(&mut self.file, (text + "\n").as_bytes()));
            self.failed = written.err().map(|error| SaveError::new(&self.path, &error).into());
        }
        let psnr = self.totals.last_psnr.map_or(String::new(), |psnr| format!(", {psnr:.2} dB"));
        let message = format!("block {}, {} splats{psnr}", line.task, report.splats);
        let done = self.tasks[..self.planned.len()].iter().map(|spent| spent.step).sum();
        let all = self.planned.iter().map(|(_, steps)| u64::from(*steps)).sum();
        self.progress.at("training", done, all, &message);
    }

    /// Whether a block has reported.
    fn is_training(&self) -> bool {
        self.tasks[..self.planned.len()].iter().any(|spent| spent.attempt > 0)
    }

    /// CPU and wall seconds since the start of the command.
    fn clocks(&self) -> (f64, f64) {
        if let Some(trained_at) = self.trained_at {
            return trained_at;
        }
        if self.workers > 1 {
            return (self.clock.cpu_seconds(), self.clock.wall_seconds());
        }
        let sum = |of: fn(&Spent) -> f64| self.tasks.iter().map(of).sum::<f64>();
        (self.before.0 + sum(|spent| spent.cpu_seconds), self.before.1 + sum(|spent| spent.wall_seconds))
    }

    /// The job's totals.
    ///
    /// # Errors
    /// The first line that could not be written.
    pub(crate) fn close(self) -> Result<Totals, Failure> {
        let (cpu_seconds, wall_seconds) = self.clocks();
        match self.failed {
            Some(failure) => Err(failure),
            None => Ok(Totals { cpu_seconds, wall_seconds, ..self.totals }),
        }
    }
}
