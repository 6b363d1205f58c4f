//! Measures the CPU and wall time of a task without its pauses. The only place in a worker that reads clocks.

use std::time::Instant;

/// CPU seconds (user and system, all threads) that this process has used so far.
pub fn cpu_seconds() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// CPU and wall seconds since its start, without the time inside [`Stopwatch::paused`]. The CPU time is that of the whole process:
/// with several workers in one process each sees the sum.
#[derive(Debug, Clone)]
pub struct Stopwatch {
    started: Instant,
    cpu_at_start: f64,
    paused_cpu: f64,
    paused_wall: f64,
}

impl Stopwatch {
    /// Starts.
    pub fn start() -> Self {
        Self { started: Instant::now(), cpu_at_start: cpu_seconds(), paused_cpu: 0.0, paused_wall: 0.0 }
    }

    /// CPU seconds so far.
    pub fn cpu_seconds(&self) -> f64 {
        cpu_seconds() - self.cpu_at_start - self.paused_cpu
    }

    /// Wall seconds so far.
    pub fn wall_seconds(&self) -> f64 {
        self.started.elapsed().as_secs_f64() - self.paused_wall
    }

    /// Runs `f` without counting its time.
    pub fn paused<T>(&mut self, f: impl FnOnce() -> T) -> T {
        let (cpu, wall) = (cpu_seconds(), Instant::now());
        let value = f();
        self.paused_cpu += cpu_seconds() - cpu;
        self.paused_wall += wall.elapsed().as_secs_f64();
        value
    }
}
