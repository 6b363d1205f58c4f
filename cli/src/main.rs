//! `plat`, the command line program.
//!
//! Parses the command line and runs the command. Exit codes: 0 done, 1 the work failed, 2 bad usage or bad input. Results go to stdout,
//! everything else to stderr.

mod ablation_variants;
mod args;
mod backend;
mod captures;
mod clock;
mod commands;
mod config;
mod dashboard;
mod eval_report;
mod eval_results;
mod failure;
mod film;
mod live_status;
mod metrics_log;
mod objects;
mod observer;
mod output;
mod planning;
mod remote;
mod result_lines;
mod run_record;
mod signals;
mod stability_cases;
mod stability_table;
mod telemetry_setup;
mod track_map;

use std::process::ExitCode;

use args::{BenchCommand, Command, GarageCommand, ObjectsCommand};
use failure::Failure;
use output::Output;

fn main() -> ExitCode {
    return_buffers_to_system();
    disable_device_select_layer();
    let cli = match config::parse(std::env::args_os().collect()) {
        Ok(cli) => cli,
        Err(config::Stop::Shown(text)) => {
            return output::print(&text).map_or_else(|failure| fail(&failure), |()| ExitCode::SUCCESS);
        }
        Err(config::Stop::Usage(line)) => return fail(&Failure::Input(line)),
    };
    let telemetry = match telemetry_setup::start(&cli) {
        Ok(telemetry) => telemetry,
        Err(error) => return fail(&error.into()),
    };
    let output = Output::new(cli.json, cli.quiet, telemetry_setup::format(&cli) == telemetry::Format::Json);
    let done = match &cli.command {
        Command::Demo(args) => commands::demo::run(args, &output),
        Command::Synth(args) => commands::synth::run(args, &output),
        Command::Inspect(args) => commands::inspect::run(args, &output),
        Command::Plan(args) => commands::plan::run(args, &output),
        Command::Train(args) => commands::train::run(args, &output),
        Command::Eval(args) => commands::eval::run(args, &output),
        Command::Render(args) => commands::render::run(args, &output),
        Command::Prune(args) => commands::prune::run(args, &output),
        Command::Update(args) => commands::update::run(args, &output),
        Command::Export(args) => commands::export::run(args, &output),
        Command::Import(args) => commands::import::run(args, &output),
        Command::Serve(args) => commands::serve::run(args, &output),
        Command::Garage(GarageCommand::Add(args)) => commands::garage::add(args, &output),
        Command::Garage(GarageCommand::List(args)) => commands::garage::list(args, &output),
        Command::Garage(GarageCommand::Place(args)) => commands::garage::place(args, &output),
        Command::Objects(ObjectsCommand::Pose(args)) => commands::object_poses::run(args, &output),
        Command::Objects(ObjectsCommand::Track(args)) => commands::object_tracks::run(args, &output),
        Command::Coordinator(args) => commands::coordinator::run(args, &output),
        Command::Worker(args) => commands::worker::run(args, &output),
        Command::Submit(args) => commands::submit::run(args, &output),
        Command::Jobs(args) => commands::jobs::list(args, &output),
        Command::Status(args) => commands::jobs::status(args, &output),
        Command::Cancel(args) => commands::jobs::cancel(args, &output),
        Command::Pause(args) => commands::jobs::pause(args, &output),
        Command::Resume(args) => commands::jobs::resume(args, &output),
        Command::Retry(args) => commands::jobs::retry(args, &output),
        Command::Forget(args) => commands::jobs::forget(args, &output),
        Command::Logs(args) => commands::jobs::logs(args, &output),
        Command::Doctor(args) => commands::doctor::run(args, &output),
        Command::Bench(BenchCommand::Pareto(args)) => commands::pareto::run(args, &output),
        Command::Bench(BenchCommand::Ablate(args)) => commands::ablate::run(args, &output),
        Command::Bench(BenchCommand::Chart(args)) => commands::bench::chart(args, &output),
        Command::Bench(BenchCommand::Kernels(args)) => commands::kernels::run(args, &output),
        Command::Bench(BenchCommand::Ingest(args)) => commands::bench::ingest(args, &output),
        Command::Bench(BenchCommand::Stability(args)) => commands::stability::run(args, &output),
        Command::Bench(BenchCommand::Prune(args)) => commands::prune_orders::run(args, &output),
        Command::Bench(BenchCommand::Tree(args)) => commands::bench::tree(args, &output),
        Command::Bench(BenchCommand::Scale(args)) => commands::scale::scale(args, &output),
        Command::Bench(BenchCommand::Adaptive(args)) => commands::bench::adaptive(args, &output),
        Command::Bench(BenchCommand::Demo(args)) => commands::bench::demo(args, &output),
    };
    let code = done.map_or_else(
        |failure| {
            output.error(&failure);
            ExitCode::from(failure.exit_code())
        },
        |()| ExitCode::SUCCESS,
    );
    telemetry.finish();
    code
}

fn fail(failure: &Failure) -> ExitCode {
    output::print_error(&failure.to_string());
    ExitCode::from(failure.exit_code())
}

/// Makes glibc return freed buffers of 1 MiB and more to the system, and use one heap for all threads.
///
/// By default glibc raises that threshold to 32 MB as such buffers are freed, and freed buffers of finished tasks then stay in the heap:
/// a third of the peak memory of a city. With a heap per thread, each keeps the pages of its largest task: half of the memory at the end.
fn return_buffers_to_system() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: mallopt sets parameters of the allocator; no other thread exists yet.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, 1 << 20);
        libc::mallopt(libc::M_ARENA_MAX, 1);
    }
}

/// Disables Mesa's device select layer, which prints errors on stderr if there is no display.
fn disable_device_select_layer() {
    #[cfg(target_os = "linux")]
    // SAFETY: no other thread exists yet that could read the environment.
    unsafe {
        std::env::set_var("NODEVICE_SELECT", "1");
    }
}
