//! `plat bench kernels`: times the renderer's stages, on the CPU with the machine's roofline, and compares the stages of both backends.

mod bisect;
mod compare;
mod cpu;
mod gpu;
mod scene;

use bench::parts::{Kernels, StageTime};
use bench::{PartLine, append_part};

use crate::args::{Backend, KernelsArgs};
use crate::backend::open_gpu;
use crate::failure::{Failure, make_folder};
use crate::output::Output;

/// The file of kernel timings.
const LINES: &str = "kernels.jsonl";

pub(crate) fn run(args: &KernelsArgs, output: &Output) -> Result<(), Failure> {
    let gpu = match (args.backend, args.from_stage) {
        (Backend::Gpu, _) | (_, Some(_)) => Some(open_gpu()?),
        _ => None,
    };
    if gpu.is_none() && args.views > 1 {
        return Err(Failure::Input("--views: needs a GPU; give --backend gpu".into()));
    }
    let scene = scene::scene(args)?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads as usize).build();
    let pool = pool.map_err(|error| Failure::Work(format!("cannot start {} threads: {error}", args.threads)))?;
    if let (Some(gpu), Some(from)) = (&gpu, args.from_stage) {
        return pool.install(|| bisect::run(gpu, &scene, from, output));
    }
    let timed = match &gpu {
        Some(gpu) => pool.install(|| gpu::time(gpu, args, &scene))?,
        None => pool.install(|| cpu::time(args, &scene)),
    };
    let text = text(&timed);
    let line = PartLine::Kernels(timed);
    if let Some(results) = &args.results {
        make_folder(results)?;
        append_part(&results.join(LINES), &line)?;
    }
    output.result(&line, text.trim_end())
}

fn text(timed: &Kernels) -> String {
    let class = timed.adapter_class.as_ref().map_or(String::new(), |class| format!(" ({class})"));
    let mut text = format!(
        "{} splats, {}×{}, {}{} pairs, {}{class} on {} thread{}: forward {:.2} ms CPU, backward {:.2} ms CPU ({:.2} and {:.2} ms wall)\n",
        timed.splats,
        timed.width,
        timed.height,
        timed.views.map_or(String::new(), |views| format!("{views} views in one pass, each "),),
        timed.pairs,
        timed.backend,
        timed.threads,
        if timed.threads == 1 { "" } else { "s" },
        timed.forward_cpu_millis,
        timed.backward_cpu_millis,
        timed.forward_wall_millis,
        timed.backward_wall_millis,
    );
    if let (Some(flops), Some(bytes)) = (timed.ceiling_gflops, timed.ceiling_gbytes) {
        text += &format!("roofline of one core: {flops:.1} Gflop/s, {bytes:.1} GB/s\n");
    }
    if let Some(clock) = &timed.clock {
        text += &format!("stages timed by: {clock}\n");
    }
    for StageTime { stage, cpu_millis, device_millis, gflops, gbytes, of_ceiling } in &timed.stages {
        let rate = match (gflops, gbytes) {
            (Some(gflops), _) => format!("{gflops:>6.1} Gflop/s"),
            (None, Some(gbytes)) => format!("{gbytes:>6.1} GB/s   "),
            (None, None) => String::new(),
        };
        let share = of_ceiling.map_or(String::new(), |share| format!("{:>4.0} %", 100.0 * share));
        let (millis, clock) = match (cpu_millis, device_millis) {
            (Some(millis), _) => (*millis, "CPU"),
            (None, millis) => (millis.unwrap_or_default(), "device"),
        };
        text += &format!("{stage:<19} {millis:>7.2} ms {clock}  {rate} {share}\n");
    }
    text
}
