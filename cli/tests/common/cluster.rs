//! Processes of a cluster that are killed with their test.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc;
use std::thread::JoinHandle;
use std::time::Duration;

use serde_json::Value;

/// A process whose output is collected; killed when dropped.
pub(crate) struct Running {
    child: Child,
    /// Lines of stderr as they arrive.
    lines: mpsc::Receiver<String>,
    output: Option<[JoinHandle<String>; 2]>,
}

/// Status and output of a process that has ended.
pub(crate) struct Ended {
    pub(crate) status: ExitStatus,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

impl Running {
    pub(crate) fn start(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("plat runs");
        let (mut stdout, stderr) = (child.stdout.take().unwrap(), BufReader::new(child.stderr.take().unwrap()));
        let (sender, lines) = mpsc::channel();
        // Both pipes are drained, so that the process is never blocked.
        let stdout = std::thread::spawn(move || {
            let mut all = String::new();
            stdout.read_to_string(&mut all).unwrap();
            all
        });
        let stderr = std::thread::spawn(move || {
            let mut all = String::new();
            for line in stderr.lines().map_while(Result::ok) {
                all += &line;
                all.push('\n');
                let _ = sender.send(line);
            }
            all
        });
        Self { child, lines, output: Some([stdout, stderr]) }
    }

    /// The next line on stderr that matches.
    pub(crate) fn line(&self, matches: impl Fn(&str) -> bool) -> String {
        loop {
            let line = self.lines.recv_timeout(Duration::from_secs(60)).expect("the line appears within a minute");
            if matches(&line) {
                return line;
            }
        }
    }

    /// The next line on stderr that contains these words.
    pub(crate) fn line_with(&self, words: &str) -> String {
        self.line(|line| line.contains(words))
    }

    pub(crate) fn signal(&self, name: &str) {
        assert!(Command::new("kill").args([name, &self.child.id().to_string()]).status().unwrap().success());
    }

    /// Waits for its end.
    pub(crate) fn end(mut self) -> Ended {
        let status = self.child.wait().unwrap();
        let [stdout, stderr] = self.output.take().unwrap().map(|output| output.join().unwrap());
        Ended { status, stdout, stderr }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A coordinator that is the leader, and its URL.
pub(crate) fn coordinator(at: &Path) -> (Running, String) {
    let words = ["coordinator", "--store", "shared", "--listen", "127.0.0.1:0", "--lease-seconds", "1"];
    let running = Running::start(&mut super::command(at, &words));
    let line = running.line_with("http://");
    running.line_with("leading");
    let url = line.split_whitespace().find(|word| word.starts_with("http://")).unwrap();
    (running, url.trim_end_matches(',').to_string())
}

/// Waits until the worker has a task of job 1, and returns true; returns false if the job ends first.
pub(crate) fn has_task(at: &Path, connection: &[&str], name: &str) -> bool {
    loop {
        // The job may not have been submitted yet.
        let asked = super::plat(at, &[&["status", "1", "--json", "--quiet"], connection].concat());
        let status: Value = serde_json::from_slice(&asked.stdout).unwrap_or_default();
        let running = status["running"].as_array().cloned().unwrap_or_default();
        if running.iter().any(|task| task["worker"] == name) {
            return true;
        }
        if status["state"] == "done" {
            return false;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}
