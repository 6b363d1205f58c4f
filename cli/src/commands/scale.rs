//! `plat bench scale`: runs the same job on clusters of several sizes, made of processes on this machine, round by round.

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::time::Duration;

use ::bench::parts::Scale;
use ::bench::{PartLine, append_part};
use proto::Client;
use serde::Serialize;
use serde_json::Value;

use crate::args::{Connection, ScaleArgs};
use crate::captures;
use crate::failure::{Failure, make_folder, temporary_folder};
use crate::output::Output;
use crate::remote::Remote;
use crate::run_record::{commit, invocation};

/// The file of cluster measurements.
const SCALES: &str = "scale.jsonl";
/// Pause between two queries of the number of workers.
const POLL_PERIOD: Duration = Duration::from_millis(50);

#[derive(Serialize)]
struct Scaled<'a> {
    command: &'static str,
    lines: &'a [Scale],
    /// Store, workers, median seconds of a job.
    medians: Vec<(String, u32, f64)>,
}

/// Runs the rounds and appends a line for each job.
pub(crate) fn scale(args: &ScaleArgs, output: &Output) -> Result<(), Failure> {
    if !cfg!(unix) {
        return Err(Failure::Work("bench scale stops its workers by SIGTERM, which this system does not have".into()));
    }
    let scene = args.scene.clone().unwrap_or_else(|| captures::name_of(&args.capture));
    let folder = temporary_folder()?;
    let folders = folder.path().display().to_string();
    let stores: Vec<&str> = std::iter::once(folders.as_str()).chain(args.store.as_deref()).collect();
    make_folder(&args.results)?;
    let file = args.results.join(SCALES);
    let mut lines = Vec::new();
    for round in 0..args.rounds {
        for store in &stores {
            for &workers in &args.workers {
                // A store of its own, so that no job reuses results of an earlier one.
                let store_url = format!("{store}/{}-{round}-{workers}", std::process::id());
                let kind = if store.starts_with("s3://") { "s3" } else { "file" };
                let (job, jobs) = (lines.len() + 1, args.rounds as usize * stores.len() * args.workers.len());
                output.note(format!("job {job} of {jobs}: {kind} store, {workers} workers …"));
                let line = measure(args, &scene, &store_url, kind, workers)?;
                output.note(format!(
                    "{kind} store, {workers} workers: {:.1} s for {} tasks",
                    line.job_seconds, line.tasks
                ));
                append_part(&file, &PartLine::Scale(line.clone()))?;
                lines.push(line);
                if *store == folders {
                    let _ = std::fs::remove_dir_all(&store_url);
                }
            }
        }
    }
    let mut medians = Vec::new();
    for kind in ["file", "s3"] {
        for &workers in &args.workers {
            let of = lines.iter().filter(|line| line.store == kind && line.workers == workers);
            let mut seconds: Vec<f64> = of.map(|line| line.job_seconds).collect();
            seconds.sort_by(f64::total_cmp);
            if let Some(&median) = seconds.get(seconds.len() / 2) {
                medians.push((kind.to_owned(), workers, median));
            }
        }
    }
    let first = medians.first().map_or(f64::NAN, |of| of.2);
    let text: Vec<String> = medians
        .iter()
        .map(|(kind, workers, seconds)| {
            format!("{kind} store, {workers} workers: {seconds:.1} s, speed-up {:.2}", first / seconds)
        })
        .collect();
    let text = format!("{}\nappended to {}", text.join("\n"), file.display());
    output.result(&Scaled { command: "bench scale", lines: &lines, medians }, &text)
}

/// Runs one job on a cluster of its own.
fn measure(args: &ScaleArgs, scene: &str, store: &str, kind: &str, workers: u32) -> Result<Scale, Failure> {
    let host = ["coordinator", "--store", store, "--listen", "127.0.0.1:0"];
    let host = Process::start(host.map(String::from).to_vec())?;
    let url = host.listens()?;
    let mut processes = Vec::new();
    for number in 0..workers {
        let name = format!("worker-{number}");
        let words = ["worker", "--coordinator", &url, "--name", &name, "--threads", "1", "--backend", "cpu"];
        processes.push(Process::start(
            [&words[..], &["--json", "--quiet"]].concat().into_iter().map(String::from).collect(),
        )?);
    }
    wait_for(&url, workers, &mut processes)?;
    let capture = args.capture.display().to_string();
    let words = ["submit", &capture, "--coordinator", &url, "--backend", "cpu", "--wait", "--json", "--quiet"];
    let words = words.into_iter().map(String::from).chain(args.plan.iter().cloned()).collect();
    let submitted = Process::start(words)?.end(false)?;
    let mut line = Scale {
        commit: commit().to_owned(),
        machine: ::bench::machine(),
        scene: scene.to_owned(),
        backend: submitted["backend"].as_str().unwrap_or_default().to_owned(),
        plan: submitted["plan"].as_str().unwrap_or_default().to_owned(),
        store: kind.to_owned(),
        workers,
        threads: 1,
        tasks: submitted["tasks"].as_u64().unwrap_or_default(),
        job_seconds: submitted["job_seconds"].as_f64().unwrap_or(f64::NAN),
        cpu_seconds: 0.0,
        bytes_read: 0,
        bytes_written: 0,
        window_bytes_read: 0,
        window_bytes_used: 0,
        command: invocation(),
    };
    for process in processes {
        let report = process.end(true)?;
        line.cpu_seconds += report["cpu_seconds"].as_f64().unwrap_or(f64::NAN);
        line.bytes_read += report["bytes_read"].as_u64().unwrap_or_default();
        line.bytes_written += report["bytes_written"].as_u64().unwrap_or_default();
        line.window_bytes_read += report["window_bytes_read"].as_u64().unwrap_or_default();
        line.window_bytes_used += report["window_bytes_used"].as_u64().unwrap_or_default();
    }
    host.stop();
    Ok(line)
}

/// Waits until this many workers are connected. Fails if one of them ends.
fn wait_for(url: &str, workers: u32, workers_started: &mut Vec<Process>) -> Result<(), Failure> {
    let access =
        Connection { coordinator: url.to_owned(), tls_ca: None, tls_cert: None, tls_key: None, token_file: None };
    let mut remote = Remote::open(&access)?;
    loop {
        let about = remote.call(async |client: &mut Client| client.about(proto::AboutRequest {}).await)?;
        if about.backends.iter().map(|of| of.workers).sum::<u32>() >= workers {
            return Ok(());
        }
        if let Some(ended) = workers_started.iter_mut().position(Process::has_ended) {
            let process = workers_started.swap_remove(ended);
            let words = process.words.clone();
            return process.end(false).and_then(|_| Err(failed(&words, "ended before the job began")));
        }
        std::thread::sleep(POLL_PERIOD);
    }
}

/// A child process of this program; killed when dropped.
struct Process {
    /// Its arguments.
    words: String,
    child: Child,
    /// Lines of its stderr. A thread always reads them: a full pipe would block the process.
    stderr: Receiver<String>,
}

impl Process {
    fn start(words: Vec<String>) -> Result<Self, Failure> {
        let program = std::env::current_exe().map_err(|error| failed("this program", error))?;
        let child = Command::new(program).args(&words).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
        let words = words.join(" ");
        let mut child = child.map_err(|error| failed(&words, error))?;
        let (sender, lines) = mpsc::channel();
        if let Some(pipe) = child.stderr.take() {
            std::thread::spawn(move || {
                // The receiver may be gone; the pipe is drained anyway.
                BufReader::new(pipe).lines().map_while(Result::ok).for_each(|line| drop(sender.send(line)));
            });
        }
        Ok(Self { words, child, stderr: lines })
    }

    /// The URL that a coordinator prints once it is the leader.
    fn listens(&self) -> Result<String, Failure> {
        let mut lines = Vec::new();
        for line in &self.stderr {
            let leads = line.contains("leading");
            lines.push(line);
            if leads {
                break;
            }
        }
        let url = lines.iter().flat_map(|line| line.split_whitespace()).find(|word| word.starts_with("http://"));
        let url = url.map(|url| url.trim_end_matches(',').to_owned());
        url.ok_or_else(|| failed(&self.words, format!("did not print its address: {}", lines.join("; "))))
    }

    fn has_ended(&mut self) -> bool {
        !matches!(self.child.try_wait(), Ok(None))
    }

    /// Waits for its end, after SIGTERM if asked, and returns its JSON result.
    fn end(mut self, terminate: bool) -> Result<Value, Failure> {
        if terminate {
            self.terminate();
        }
        let mut stdout = String::new();
        let read = self.child.stdout.take().map_or(Ok(0), |mut pipe| pipe.read_to_string(&mut stdout));
        read.map_err(|error| failed(&self.words, error))?;
        let status = self.child.wait().map_err(|error| failed(&self.words, error))?;
        let result = stdout.lines().last().and_then(|line| serde_json::from_str(line).ok());
        result
            .filter(|_| status.success())
            .ok_or_else(|| failed(&self.words, self.stderr.iter().collect::<Vec<_>>().join("; ")))
    }

    fn stop(mut self) {
        self.terminate();
        let _ = self.child.wait();
    }

    fn terminate(&self) {
        #[cfg(unix)]
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(rustix::process::Pid::from_raw) {
            // An error means that the process has ended.
            let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn failed(what: &str, error: impl std::fmt::Display) -> Failure {
    Failure::Work(format!("{what}: {error}"))
}
