//! `plat bench scale`: the same job on clusters of several sizes, each of real processes on this machine, one round after the other.

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
use crate::cameras;
use crate::commands::bench::invoked;
use crate::commands::train::make_folder;
use crate::failure::Failure;
use crate::output::Output;
use crate::record::commit;
use crate::remote::Remote;

/// The file of clusters.
const SCALES: &str = "scale.jsonl";
/// Between two looks at who is there.
const LOOK: Duration = Duration::from_millis(50);

#[derive(Serialize)]
struct Scaled<'a> {
    command: &'static str,
    lines: &'a [Scale],
    /// Of each store and number of workers, the median seconds of a job.
    medians: Vec<(String, u32, f64)>,
}

/// Runs the rounds, and appends a line for each job.
pub(crate) fn scale(args: &ScaleArgs, output: &Output) -> Result<(), Failure> {
    if !cfg!(unix) {
        return Err(Failure::Work("workers are told to stop by signals, which this system has not".into()));
    }
    let scene = args.scene.clone().unwrap_or_else(|| cameras::name_of(&args.capture));
    let folder = tempfile::tempdir().map_err(|error| work("a temporary folder", error))?;
    let folders = folder.path().display().to_string();
    let stores: Vec<&str> = std::iter::once(folders.as_str()).chain(args.store.as_deref()).collect();
    make_folder(&args.results)?;
    let file = args.results.join(SCALES);
    let mut lines = Vec::new();
    for round in 0..args.rounds {
        for store in &stores {
            for &workers in &args.workers {
                // A store of its own, so that nothing of an earlier job is of use to a later one.
                let place = format!("{store}/{}-{round}-{workers}", std::process::id());
                let kind = if store.starts_with("s3://") { "s3" } else { "file" };
                let (turn, turns) = (lines.len() + 1, args.rounds as usize * stores.len() * args.workers.len());
                output.note(format!("job {turn} of {turns}: {kind}, {workers} workers …"));
                let line = measure(args, &scene, &place, kind, workers)?;
                output.note(format!("{kind}, {workers} workers: {:.1} s for {} tasks", line.job_seconds, line.tasks));
                append_part(&file, &PartLine::Scale(line.clone()))?;
                lines.push(line);
                if *store == folders {
                    let _ = std::fs::remove_dir_all(&place);
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
            format!("{kind}, {workers} workers: {seconds:.1} s, {:.2} times", first / seconds)
        })
        .collect();
    let text = format!("{}\nappended to {}", text.join("\n"), file.display());
    output.result(&Scaled { command: "bench scale", lines: &lines, medians }, &text)
}

/// One job on a cluster of its own.
fn measure(args: &ScaleArgs, scene: &str, store: &str, kind: &str, workers: u32) -> Result<Scale, Failure> {
    let host = ["coordinator", "--store", store, "--listen", "127.0.0.1:0"];
    let host = Process::start(host.map(String::from).to_vec())?;
    let url = host.listens()?;
    let mut hands = Vec::new();
    for number in 0..workers {
        let name = format!("hand-{number}");
        let words = ["worker", "--coordinator", &url, "--name", &name, "--threads", "1", "--backend", "cpu"];
        hands.push(Process::start(
            [&words[..], &["--json", "--quiet"]].concat().into_iter().map(String::from).collect(),
        )?);
    }
    wait_for(&url, workers, &mut hands)?;
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
        command: invoked(),
    };
    for hand in hands {
        let said = hand.end(true)?;
        line.cpu_seconds += said["cpu_seconds"].as_f64().unwrap_or(f64::NAN);
        line.bytes_read += said["bytes_read"].as_u64().unwrap_or_default();
        line.bytes_written += said["bytes_written"].as_u64().unwrap_or_default();
        line.window_bytes_read += said["window_bytes_read"].as_u64().unwrap_or_default();
        line.window_bytes_used += said["window_bytes_used"].as_u64().unwrap_or_default();
    }
    host.stop();
    Ok(line)
}

/// Waits until so many workers are there; one that ended instead says why.
fn wait_for(url: &str, workers: u32, hands: &mut Vec<Process>) -> Result<(), Failure> {
    let access =
        Connection { coordinator: url.to_owned(), tls_ca: None, tls_cert: None, tls_key: None, token_file: None };
    let mut remote = Remote::open(&access)?;
    loop {
        let about = remote.call(async |client: &mut Client| client.about(proto::AboutRequest {}).await)?;
        if about.backends.iter().map(|of| of.workers).sum::<u32>() >= workers {
            return Ok(());
        }
        if let Some(ended) = hands.iter_mut().position(Process::has_ended) {
            let hand = hands.swap_remove(ended);
            let words = hand.words.clone();
            return hand.end(false).and_then(|_| Err(work(&words, "ended before the job began")));
        }
        std::thread::sleep(LOOK);
    }
}

/// This program as another process, which does not outlive this one's interest in it.
struct Process {
    words: String,
    child: Child,
    /// The lines of its stderr, which is always read: a full pipe would stop it.
    troubles: Receiver<String>,
}

impl Process {
    fn start(words: Vec<String>) -> Result<Self, Failure> {
        let program = std::env::current_exe().map_err(|error| work("this program", error))?;
        let child = Command::new(program).args(&words).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
        let words = words.join(" ");
        let mut child = child.map_err(|error| work(&words, error))?;
        let (say, troubles) = mpsc::channel();
        if let Some(stderr) = child.stderr.take() {
            std::thread::spawn(move || {
                // Nobody may want to hear it any more.
                BufReader::new(stderr).lines().map_while(Result::ok).for_each(|line| drop(say.send(line)));
            });
        }
        Ok(Self { words, child, troubles })
    }

    /// The URL that it says it is reached at, once it leads.
    fn listens(&self) -> Result<String, Failure> {
        let mut heard = Vec::new();
        for line in &self.troubles {
            let leads = line.contains("leading");
            heard.push(line);
            if leads {
                break;
            }
        }
        let said = heard.iter().flat_map(|line| line.split_whitespace()).find(|word| word.starts_with("http://"));
        let url = said.map(|url| url.trim_end_matches(',').to_owned());
        url.ok_or_else(|| work(&self.words, format!("does not say where it listens: {}", heard.join("; "))))
    }

    fn has_ended(&mut self) -> bool {
        !matches!(self.child.try_wait(), Ok(None))
    }

    /// Tells it to stop, where it does not by itself, and hears its result.
    fn end(mut self, told: bool) -> Result<Value, Failure> {
        if told {
            self.terminate();
        }
        let mut said = String::new();
        let read = self.child.stdout.take().map_or(Ok(0), |mut stdout| stdout.read_to_string(&mut said));
        read.map_err(|error| work(&self.words, error))?;
        let status = self.child.wait().map_err(|error| work(&self.words, error))?;
        let result = said.lines().last().and_then(|line| serde_json::from_str(line).ok());
        result
            .filter(|_| status.success())
            .ok_or_else(|| work(&self.words, self.troubles.iter().collect::<Vec<_>>().join("; ")))
    }

    fn stop(mut self) {
        self.terminate();
        let _ = self.child.wait();
    }

    fn terminate(&self) {
        #[cfg(unix)]
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(rustix::process::Pid::from_raw) {
            // One that is gone needs no signal.
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

fn work(what: &str, error: impl std::fmt::Display) -> Failure {
    Failure::Work(format!("{what}: {error}"))
}
