//! Processes of a cluster, none of which outlives its test.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc;
use std::thread::JoinHandle;
use std::time::Duration;

use serde_json::Value;

/// A process whose words are kept; it is killed with the test.
pub(crate) struct Running {
    child: Child,
    /// Of stderr, as they come.
    lines: mpsc::Receiver<String>,
    said: Option<[JoinHandle<String>; 2]>,
}

/// What came of a process.
pub(crate) struct Ended {
    pub(crate) status: ExitStatus,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

impl Running {
    pub(crate) fn begin(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("plat runs");
        let (mut stdout, stderr) = (child.stdout.take().unwrap(), BufReader::new(child.stderr.take().unwrap()));
        let (sender, lines) = mpsc::channel();
        // Both are read to their ends, so that it is never held up.
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
        Self { child, lines, said: Some([stdout, stderr]) }
    }

    /// The next line on stderr that is such.
    pub(crate) fn line(&self, is_it: impl Fn(&str) -> bool) -> String {
        loop {
            let line = self.lines.recv_timeout(Duration::from_secs(60)).expect("it says so before long");
            if is_it(&line) {
                return line;
            }
        }
    }

    /// The next line on stderr in which these words stand.
    pub(crate) fn line_with(&self, words: &str) -> String {
        self.line(|line| line.contains(words))
    }

    pub(crate) fn signal(&self, name: &str) {
        assert!(Command::new("kill").args([name, &self.child.id().to_string()]).status().unwrap().success());
    }

    /// Its end, which must come.
    pub(crate) fn end(mut self) -> Ended {
        let status = self.child.wait().unwrap();
        let [stdout, stderr] = self.said.take().unwrap().map(|said| said.join().unwrap());
        Ended { status, stdout, stderr }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Waits until the worker has a task of job 1 in hand, or there is nothing left to have; whether it has.
pub(crate) fn is_at_work(at: &Path, connection: &[&str], name: &str) -> bool {
    loop {
        // The job may not be there yet.
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
