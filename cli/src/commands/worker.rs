//! `plat worker`: trains blocks for a coordinator until it is stopped. Then it writes a checkpoint of its block and returns the task;
//! any worker can resume it.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use scene::BadInput;
use serde::Serialize;
use tokio_util::sync::CancellationToken;
use worker::WorkerError;
use worker::metrics::CountedExecutor;
use worker::{PlanExecutor, Shared, TrainerOptions};

use crate::args::WorkerArgs;
use crate::backend;
use crate::failure::Failure;
use crate::output::Output;
use crate::remote::{access, runtime, shared_store};
use crate::signals::until_signalled;
use crate::telemetry_setup::MetricsListener;

#[derive(Serialize)]
struct Worked {
    command: &'static str,
    name: String,
    backend: String,
    threads: u32,
    /// Memory budget; 0 = unlimited.
    memory_bytes: u64,
    /// Finished tasks.
    done: u64,
    /// Tasks that were found finished, or resumed from a checkpoint.
    resumed: u32,
    /// User and system time of this process.
    cpu_seconds: f64,
    /// Read from the store.
    bytes_read: u64,
    /// Written to the store.
    bytes_written: u64,
    /// Read for photo windows, in tasks that ended.
    window_bytes_read: u64,
    /// Share of that for pixels inside the windows; the rest of each tile is outside.
    window_bytes_used: u64,
}

pub(crate) fn run(args: &WorkerArgs, output: &Output) -> Result<(), Failure> {
    let access = access(&args.connection)?;
    let name = name_of(args)?;
    let backend = backend::open(args.backend)?;
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
    let threads = args.threads.0.unwrap_or(cores).max(1);
    let memory_bytes = memory_of(args)?;
    let mut worked = Worked {
        command: "worker",
        name,
        backend: backend.name(),
        threads,
        memory_bytes,
        done: 0,
        resumed: 0,
        cpu_seconds: 0.0,
        bytes_read: 0,
        bytes_written: 0,
        window_bytes_read: 0,
        window_bytes_used: 0,
    };
    let url = &args.connection.coordinator;
    let runtime = runtime()?;
    runtime.block_on(async {
        let stop = CancellationToken::new();
        let signals = tokio::spawn(until_signalled(stop.clone()));
        let shared = Arc::new(Shared::default());
        // Served before the coordinator is found, so that waiting for one is visible.
        let metrics = MetricsListener::bind(&args.telemetry).await?;
        let _served = metrics.serve(output, |registry| shared.metrics.register(registry));
        let worker = worker::Options {
            coordinator_url: url.clone(),
            access,
            worker_id: worked.name.clone(),
            backend: worked.backend.clone(),
            memory_bytes,
        };
        if let Some(about) = worker::greet(&worker, &stop).await.map_err(worker_failure)? {
            let store = shared_store(&about.store_url).await?.metered();
            let options = TrainerOptions {
                threads: threads as usize,
                eval_every: 0,
                cache_bytes: (args.cache as usize) << 20,
                memory_bytes,
                resume: true,
                checkpoint_seconds: args.checkpoint_every,
            };
            shared.metrics.export_traffic_of(store.clone());
            let trainer = PlanExecutor::new(store.blocking(), options, shared.clone(), backend);
            let measured = CountedExecutor::new(trainer.map_err(Failure::Work)?, shared.metrics.clone());
            output.note(format!("worker {} for {url}: {} on {threads} threads", worked.name, worked.backend));
            worker::run(worker, Arc::new(measured), stop).await.map_err(worker_failure)?;
            worked.done = shared.metrics.tasks_done();
            worked.cpu_seconds = worker::clock::cpu_seconds();
            let traffic = store.traffic();
            (worked.bytes_read, worked.bytes_written) = (traffic.read, traffic.written);
            (worked.window_bytes_read, worked.window_bytes_used) = shared.metrics.window_bytes();
            worked.resumed = shared.resumed.load(Ordering::Relaxed);
        }
        signals.abort();
        Ok::<(), Failure>(())
    })?;
    let text =
        format!("worker {} stopped after {} tasks, {} of them resumed", worked.name, worked.done, worked.resumed);
    output.result(&worked, &text)
}

/// The memory budget, bytes; 0 = unlimited.
fn memory_of(args: &WorkerArgs) -> Result<u64, Failure> {
    /// Memory of the program without a block.
    const MIN_MIB: u64 = 16;
    let Some(mebibytes) = args.memory.0 else { return Ok(worker::memory_budget::total_bytes().unwrap_or(0)) };
    if !(MIN_MIB..1 << 40).contains(&mebibytes) {
        let what = format!("{mebibytes} MiB is out of range");
        return Err(BadInput::new("--memory", what, format!("give {MIN_MIB} or more, or auto")).into());
    }
    Ok(mebibytes << 20)
}

/// The worker's name: the given one, else host name and process id.
fn name_of(args: &WorkerArgs) -> Result<String, Failure> {
    if let Some(name) = &args.name {
        let refused = |status: tonic::Status| {
            BadInput::new("--name", format!("'{name}': {}", status.message()), "choose another")
        };
        proto::check_name("worker", name).map_err(refused)?;
        return Ok(name.clone());
    }
    let machine = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let machine: String = machine.chars().filter(char::is_ascii_graphic).take(64).collect();
    let machine = if machine.is_empty() { "worker" } else { &machine };
    Ok(format!("{machine}-{}", std::process::id()))
}

fn worker_failure(error: WorkerError) -> Failure {
    match error {
        WorkerError::Input(error) => error.into(),
        WorkerError::Refused(_) => Failure::Input(error.to_string()),
    }
}
