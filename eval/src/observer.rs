//! What an evaluation needs from its caller: somewhere to report progress, and a clock.

/// CPU seconds (user and system, all threads) and wall seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Seconds {
    /// CPU seconds of the process.
    pub cpu: f64,
    /// Wall seconds.
    pub wall: f64,
}

impl Seconds {
    /// Adds the time from `start` to `end`.
    pub(crate) fn add(&mut self, start: Self, end: Self) {
        self.cpu += end.cpu - start.cpu;
        self.wall += end.wall - start.wall;
    }
}

/// Receives progress and tells the time.
pub trait Observer: Sync {
    /// `done` of `total` parts of a stage are done. `message` may be empty. Called from any thread, one call at a time.
    fn progress(&self, stage: &'static str, done: u64, total: u64, message: &str);

    /// A line that a person should read.
    fn note(&self, line: &str);

    /// Seconds since a fixed moment of the caller's choice.
    fn now(&self) -> Seconds;
}
