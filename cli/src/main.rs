//! `plat`: photos in, merged city out.
//!
//! Parses the command line, runs the command, and says with the exit code how it went: 0 done, 1 the work failed,
//! 2 bad usage or bad input. Results go to stdout, everything else to stderr.

mod args;
mod cameras;
mod clock;
mod commands;
mod config;
mod cuts;
mod failure;
mod journal;
mod live;
mod lpips;
mod maps;
mod model;
mod output;
mod record;
mod remote;
mod seams;
mod signals;
mod told;
mod variants;

use std::process::ExitCode;

use args::{BenchCommand, Command};
use failure::Failure;
use output::Output;

fn main() -> ExitCode {
    give_buffers_back();
    leave_adapters_to_us();
    let cli = match config::parse(std::env::args_os().collect()) {
        Ok(cli) => cli,
        Err(config::Stop::Shown(text)) => {
            return output::print(&text).map_or_else(|failure| fail(&failure), |()| ExitCode::SUCCESS);
        }
        Err(config::Stop::Usage(line)) => return fail(&Failure::Input(line)),
    };
    let telemetry = match told::start(&cli) {
        Ok(telemetry) => telemetry,
        Err(error) => return fail(&error.into()),
    };
    let output = Output::new(cli.json, cli.quiet, told::format(&cli) == telemetry::Format::Json);
    let done = match &cli.command {
        Command::Demo(args) => commands::demo::run(args, &output),
        Command::Synth(args) => commands::synth::run(args, &output),
        Command::Inspect(args) => commands::inspect::run(args, &output),
        Command::Plan(args) => commands::plan::run(args, &output),
        Command::Train(args) => commands::train::run(args, &output),
        Command::Eval(args) => commands::eval::run(args, &output),
        Command::Render(args) => commands::render::run(args, &output),
        Command::Prune(args) => commands::prune::run(args, &output),
        Command::Export(args) => commands::export::run(args, &output),
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
        Command::Bench(BenchCommand::Prune(args)) => commands::prune::bench(args, &output),
        Command::Bench(BenchCommand::Tree(args)) => commands::bench::tree(args, &output),
        Command::Bench(BenchCommand::Scale(args)) => commands::scale::scale(args, &output),
        Command::Bench(BenchCommand::Adaptive(args)) => commands::bench::adaptive(args, &output),
        Command::Bench(BenchCommand::Demo(args)) => commands::bench::demo(args, &output),
    };
    let code = done.map_or_else(
        |failure| {
            output.complain(&failure);
            ExitCode::from(failure.exit_code())
        },
        |()| ExitCode::SUCCESS,
    );
    telemetry.finish();
    code
}

fn fail(failure: &Failure) -> ExitCode {
    output::complain(&failure.to_string());
    ExitCode::from(failure.exit_code())
}

/// Buffers of a megabyte and more go back to the system once a task is done with them. glibc moves that border up to 32 MB by
/// itself when such are freed, and what the tasks of a city left behind piled up in the heap: a third of the most memory it took.
/// Smaller ones share one heap: with one for each thread every heap keeps what the largest task left in it, half of what a city took
/// at its end.
fn give_buffers_back() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: it sets numbers of the allocator, before there is another thread.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, 1 << 20);
        libc::mallopt(libc::M_ARENA_MAX, 1);
    }
}

/// Mesa's layer that puts the display's adapter first looks for a display, and complains on stderr where there is none.
fn leave_adapters_to_us() {
    #[cfg(target_os = "linux")]
    // SAFETY: there is no other thread yet that could read the environment.
    unsafe {
        std::env::set_var("NODEVICE_SELECT", "1");
    }
}
