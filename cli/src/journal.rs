//! The news of a job as `metrics.jsonl`, progress and clocks.

use std::fs::File;
use std::path::{Path, PathBuf};

use bench::CurvePoint;
use blocks::Plan;
use proto::TaskState;
use proto::watch_event::Event as News;
use scene::BlockId;
use serde::Serialize;
use store::file::{SaveError, append};

use crate::clock::Stopwatch;
use crate::failure::{Failure, cannot};
use crate::output::Progress;

/// A line of `metrics.jsonl`.
#[derive(Debug, Serialize)]
struct Line {
    task: String,
    attempt: u32,
    step: u64,
    steps: u64,
    cpu_seconds: f64,
    wall_seconds: f64,
    splats: u64,
    loss: Option<f64>,
    /// dB of the merged model so far over the job's test views, where it was measured.
    psnr: Option<f64>,
    /// Splats of what was measured.
    merged_splats: Option<u64>,
}

/// What a task has taken so far.
#[derive(Debug, Clone, Default)]
struct Spent {
    attempt: u32,
    /// Of the planned steps; a cap in time may leave fewer to take.
    step: u64,
    cpu_seconds: f64,
    wall_seconds: f64,
}

/// What a job took, and what it was worth on the way.
#[derive(Debug, Default)]
pub(crate) struct Total {
    pub(crate) cpu_seconds: f64,
    pub(crate) wall_seconds: f64,
    pub(crate) last_psnr: Option<f64>,
    pub(crate) curve: Vec<CurvePoint>,
}

/// Writes the news of a job down.
///
/// Clocks run from the start of the program's work: what came before the job, what tasks took before, and the task so
/// far, evaluation left out. With several workers tasks overlap and a task cannot tell its CPU time from others';
/// then they are the process's clocks at the arrival of the news, evaluation included.
pub(crate) struct Journal<'a> {
    path: PathBuf,
    file: File,
    /// Each task's block and steps as planned.
    planned: Vec<(BlockId, u32)>,
    tasks: Vec<Spent>,
    workers: u32,
    /// Since the start of the program's work.
    clock: Stopwatch,
    /// What came before the job and attempts that failed.
    before: (f64, f64),
    progress: &'a Progress,
    total: Total,
    done: usize,
    failed: Option<Failure>,
}

impl<'a> Journal<'a> {
    /// A new file for the news of this plan's job; `clock` has run since the start.
    pub(crate) fn create(
        path: &Path,
        plan: &Plan,
        workers: u32,
        clock: Stopwatch,
        progress: &'a Progress,
    ) -> Result<Self, Failure> {
        Ok(Self {
            path: path.to_path_buf(),
            file: File::create(path).map_err(cannot("written", path))?,
            planned: plan.tasks.iter().map(|task| (task.block, task.steps)).collect(),
            tasks: vec![Spent::default(); plan.tasks.len()],
            workers,
            before: (clock.cpu_seconds(), clock.wall_seconds()),
            clock,
            progress,
            total: Total::default(),
            done: 0,
            failed: None,
        })
    }

    /// Notes a piece of news. A disk that refuses a line is told at the end: the work goes on.
    pub(crate) fn note(&mut self, news: &News) {
        match news {
            News::Changed(changed) => {
                let Some((block, _)) = self.planned.get(changed.task as usize) else { return };
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
            News::Reported(reported) => {
                if let Some(report) = &reported.report {
                    self.report(reported.task as usize, reported.attempt, report);
                }
            }
            News::Finished(_) => {}
        }
    }

    fn report(&mut self, task: usize, attempt: u32, report: &proto::Report) {
        let Some(spent) = self.tasks.get_mut(task) else { return };
        if spent.attempt != attempt {
            self.before.0 += spent.cpu_seconds;
            self.before.1 += spent.wall_seconds;
        }
        let (block, planned) = self.planned[task];
        let share = report.step as f64 / report.steps.max(1) as f64;
        let step = (share * f64::from(planned)) as u64;
        *spent = Spent { attempt, step, cpu_seconds: report.cpu_seconds, wall_seconds: report.wall_seconds };
        let (cpu_seconds, wall_seconds) = self.clocks();
        let line = Line {
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
        };
        if let Some(psnr) = report.psnr {
            self.total.last_psnr = Some(psnr);
            self.total.curve.push(CurvePoint { cpu_seconds, psnr, splats: report.merged_splats });
        }
        if self.failed.is_none() {
            let written = serde_json::to_string(&line).map_err(std::io::Error::from);
            let written = written.and_then(|text| append(&mut self.file, (text + "\n").as_bytes()));
            self.failed = written.err().map(|error| SaveError::new(&self.path, &error).into());
        }
        let psnr = self.total.last_psnr.map_or(String::new(), |psnr| format!(", {psnr:.2} dB"));
        let message = format!("block {}, {} splats{psnr}", line.task, report.splats);
        self.progress.at(self.tasks.iter().map(|spent| spent.step).sum(), message);
    }

    /// CPU and wall seconds since the start.
    fn clocks(&self) -> (f64, f64) {
        if self.workers > 1 {
            return (self.clock.cpu_seconds(), self.clock.wall_seconds());
        }
        let sum = |of: fn(&Spent) -> f64| self.tasks.iter().map(of).sum::<f64>();
        (self.before.0 + sum(|spent| spent.cpu_seconds), self.before.1 + sum(|spent| spent.wall_seconds))
    }

    /// What the job took.
    ///
    /// # Errors
    /// The first line that could not be written.
    pub(crate) fn close(self) -> Result<Total, Failure> {
        let (cpu_seconds, wall_seconds) = self.clocks();
        match self.failed {
            Some(failure) => Err(failure),
            None => Ok(Total { cpu_seconds, wall_seconds, ..self.total }),
        }
    }
}
