//! What a person or a script sees: results on stdout, notes and progress on stderr.

use std::fmt::Display;
use std::io::{ErrorKind, IsTerminal, Write};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;
use store::file::SaveError;

use crate::failure::Failure;

/// How to talk.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Output {
    json: bool,
    quiet: bool,
    /// Notes go into the log, which is for tools.
    logged: bool,
    terminal: bool,
}

impl Output {
    pub(crate) fn new(json: bool, quiet: bool, logged: bool) -> Self {
        Self { json, quiet, logged, terminal: std::io::stderr().is_terminal() }
    }

    /// Whether the result is an object for a program.
    pub(crate) fn is_json(&self) -> bool {
        self.json
    }

    /// A line on the way, on stderr.
    pub(crate) fn note(&self, line: impl Display) {
        match (self.quiet, self.logged) {
            (true, _) => {}
            (false, true) => tracing::info!("{line}"),
            (false, false) => to_stderr(&format!("{line}\n")),
        }
    }

    /// The one line of an error; said in any case.
    pub(crate) fn complain(&self, failure: &Failure) {
        if self.logged && tracing::enabled!(tracing::Level::ERROR) {
            tracing::error!("{failure}");
        } else {
            complain(&failure.to_string());
        }
    }

    /// The command's result: the object with `--json`, else the text.
    pub(crate) fn result(&self, object: &impl Serialize, text: &str) -> Result<(), Failure> {
        if self.json {
            let line = serde_json::to_string(object).map_err(|error| Failure::Work(error.to_string()))?;
            print(&(line + "\n"))
        } else {
            print(&format!("{}\n", text.trim_end()))
        }
    }

    /// A part of the terminal that is drawn again and again; `None` where stderr is no terminal, or quiet is asked for.
    pub(crate) fn screen(&self) -> Option<Screen> {
        (self.terminal && !self.quiet).then_some(Screen { lines: 0 })
    }

    /// Progress of something with this many parts.
    pub(crate) fn progress(&self, what: &str, total: u64) -> Progress {
        let bar = (self.terminal && !self.quiet).then(|| {
            let bar = ProgressBar::with_draw_target(Some(total), ProgressDrawTarget::stderr());
            let style = ProgressStyle::with_template("{prefix:<10} {bar:30} {pos}/{len} {eta_precise} {msg}");
            bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar.set_prefix(what.to_owned());
            bar
        });
        Progress { bar, what: what.to_owned(), total, output: *self, tenths: AtomicU64::new(0) }
    }

    /// Progress of something whose stages become known on the way.
    pub(crate) fn stages(&self) -> Stages {
        Stages { output: *self, now: Mutex::new(None) }
    }
}

/// The last lines of the terminal.
#[derive(Debug)]
pub(crate) struct Screen {
    lines: usize,
}

impl Screen {
    /// Draws these lines in the place of those before.
    pub(crate) fn draw(&mut self, lines: &[String]) {
        let up = if self.lines > 0 { format!("\x1b[{}A", self.lines) } else { String::new() };
        to_stderr(&format!("{up}\x1b[J{}\n", lines.join("\n")));
        self.lines = lines.len();
    }
}

/// A bar on a terminal, a line for every tenth elsewhere.
pub(crate) struct Progress {
    bar: Option<ProgressBar>,
    what: String,
    total: u64,
    output: Output,
    tenths: AtomicU64,
}

impl Progress {
    /// So much is done now; from any thread.
    pub(crate) fn at(&self, done: u64, message: impl Display) {
        if let Some(bar) = &self.bar {
            bar.set_message(message.to_string());
            return bar.set_position(done);
        }
        let tenths = (10 * done).checked_div(self.total).unwrap_or(10);
        if tenths > self.tenths.fetch_max(tenths, Ordering::Relaxed) {
            let line = format!("{}: {done} of {} {message}", self.what, self.total);
            self.output.note(line.trim_end());
        }
    }

    /// A line beside the bar.
    pub(crate) fn note(&self, line: impl Display) {
        match &self.bar {
            Some(bar) => bar.suspend(|| self.output.note(line)),
            None => self.output.note(line),
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// Progress of work in stages that are named as they begin: a bar for each, one after the other.
pub(crate) struct Stages {
    output: Output,
    now: Mutex<Option<(&'static str, Progress)>>,
}

impl Stages {
    /// So much of this stage is done now; from any thread.
    pub(crate) fn at(&self, what: &'static str, done: usize, total: usize) {
        let mut now = self.now.lock().unwrap_or_else(PoisonError::into_inner);
        if now.as_ref().is_none_or(|(shown, _)| *shown != what) {
            // The old one goes before there is a new one.
            *now = None;
            *now = Some((what, self.output.progress(what, total as u64)));
        }
        if let Some((_, progress)) = now.as_ref() {
            progress.at(done as u64, "");
        }
    }
}

/// Text on stdout. A reader that went away (`plat … | head`) is no reason to fail, a full disk is.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(SaveError::new(Path::new("standard output"), &error).into())
        }
        _ => Ok(()),
    }
}

/// The one line of an error, on stderr.
pub(crate) fn complain(line: &str) {
    to_stderr(&format!("plat: {line}\n"));
}

fn to_stderr(text: &str) {
    let _ = std::io::stderr().lock().write_all(text.as_bytes());
}
