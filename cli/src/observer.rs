//! Gives evaluations the terminal's progress bars and the process's clock.

use eval::{Observer, Seconds};

use crate::clock::Stopwatch;
use crate::output::{Output, Stages};

/// Passes progress on to an [`Output`].
pub(crate) struct OutputObserver<'a> {
    output: &'a Output,
    stages: Stages,
    clock: Stopwatch,
}

impl<'a> OutputObserver<'a> {
    pub(crate) fn new(output: &'a Output) -> Self {
        Self { output, stages: output.stages(), clock: Stopwatch::start() }
    }
}

impl Observer for OutputObserver<'_> {
    fn progress(&self, stage: &'static str, done: u64, total: u64, message: &str) {
        self.stages.at(stage, done, total, message);
    }

    fn note(&self, line: &str) {
        self.output.note(line);
    }

    fn now(&self) -> Seconds {
        Seconds { cpu: self.clock.cpu_seconds(), wall: self.clock.wall_seconds() }
    }
}
