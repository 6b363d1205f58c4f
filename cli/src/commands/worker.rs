//! `plat worker`: trains blocks for a coordinator, until it is told to stop. Then it leaves a checkpoint of the block in
//! hand, gives the task back and goes; any worker goes on from there.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use scene::BadInput;
use serde::Serialize;
use tokio_util::sync::CancellationToken;
use worker::WorkerError;
use worker::execute::{BlockTrainer, Shared, TrainerOptions};
use worker::metrics::Measured;

use crate::args::WorkerArgs;
use crate::commands::train::compute_on;
use crate::failure::Failure;
use crate::output::Output;
use crate::remote::{access, runtime, shared_store};
use crate::signals::until_told;
use crate::told::Metrics;

#[derive(Serialize)]
struct Worked {
    command: &'static str,
    name: String,
    backend: String,
    threads: u32,
    /// What it may take; 0 where nothing bounds it.
    memory_bytes: u64,
    /// Tasks that it finished.
    done: u64,
    /// Tasks that it found finished, or begun with a checkpoint.
    resumed: u32,
    /// User and system time of this process.
    cpu_seconds: f64,
    /// What it read from the store.
    bytes_read: u64,
    /// What it wrote to the store.
    bytes_written: u64,
    /// What of the reading was for windows of photos, in tasks that ended.
    window_bytes_read: u64,
    /// The part of it that the windows' own pixels take of their tiles.
    window_bytes_used: u64,
}

pub(crate) fn run(args: &WorkerArgs, output: &Output) -> Result<(), Failure> {
    let access = access(&args.connection)?;
    let name = name_of(args)?;
    let backend = compute_on(args.backend)?;
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
        let told = tokio::spawn(until_told(stop.clone()));
        let shared = Arc::new(Shared::default());
        // Told before there is a coordinator: that none is there is worth knowing.
        let metrics = Metrics::listen(&args.told).await?;
        let _told = metrics.tell(output, |registry| shared.metrics.register(registry));
        let worker = worker::Options {
            coordinator_url: url.clone(),
            access,
            worker_id: worked.name.clone(),
            backend: worked.backend.clone(),
            memory_bytes,
        };
        if let Some(about) = worker::greet(&worker, &stop).await.map_err(of_worker)? {
            let store = shared_store(&about.store_url).await?.metered();
            let options = TrainerOptions {
                threads: threads as usize,
                eval_every: 0,
                cache_bytes: (args.cache as usize) << 20,
                memory_bytes,
                resume: true,
                checkpoint_seconds: args.checkpoint_every,
            };
            shared.metrics.moves_from_and_to(store.clone());
            let trainer = BlockTrainer::new(store.blocking(), options, shared.clone(), backend);
            let measured = Measured::new(trainer.map_err(Failure::Work)?, shared.metrics.clone());
            output.note(format!("{} works for {url}: {} on {threads} threads", worked.name, worked.backend));
            worker::run(worker, Arc::new(measured), stop).await.map_err(of_worker)?;
            worked.done = shared.metrics.done();
            worked.cpu_seconds = worker::clock::cpu_seconds();
            let traffic = store.traffic();
            (worked.bytes_read, worked.bytes_written) = (traffic.read, traffic.written);
            (worked.window_bytes_read, worked.window_bytes_used) = shared.metrics.window_bytes();
            worked.resumed = shared.resumed.load(Ordering::Relaxed);
        }
        told.abort();
        Ok::<(), Failure>(())
    })?;
    let text = format!("{} left after {} tasks, {} of them resumed", worked.name, worked.done, worked.resumed);
    output.result(&worked, &text)
}

/// What the worker may take, bytes; 0 where nothing bounds it.
fn memory_of(args: &WorkerArgs) -> Result<u64, Failure> {
    /// What the program takes before it has a block.
    const LEAST_MIB: u64 = 16;
    let Some(mebibytes) = args.memory.0 else { return Ok(worker::room::bytes().unwrap_or(0)) };
    if !(LEAST_MIB..1 << 40).contains(&mebibytes) {
        let what = format!("{mebibytes} MiB are not what a worker can do with");
        return Err(BadInput::new("--memory", what, format!("give {LEAST_MIB} or more, or auto")).into());
    }
    Ok(mebibytes << 20)
}

/// The worker's name: the one asked for, else the machine's and the process's number.
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

fn of_worker(error: WorkerError) -> Failure {
    match error {
        WorkerError::Input(error) => error.into(),
        WorkerError::Refused(_) => Failure::Input(error.to_string()),
    }
}
