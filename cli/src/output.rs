//! Prints results on stdout, notes and progress on stderr.

use std::fmt::Display;
use std::io::{ErrorKind, IsTerminal, Write};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;
use store::file::SaveError;

use crate::failure::Failure;

/// Where and how to print.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Output {
    json: bool,
    quiet: bool,
    /// Notes go into the structured log instead of stderr.
    logged: bool,
    terminal: bool,
}

impl Output {
    pub(crate) fn new(json: bool, quiet: bool, logged: bool) -> Self {
        Self { json, quiet, logged, terminal: std::io::stderr().is_terminal() }
    }

    /// Prints no notes and no progress.
    pub(crate) fn silent() -> Self {
        Self::new(false, true, false)
    }

    /// Whether the result is printed as JSON.
    pub(crate) fn is_json(&self) -> bool {
        self.json
    }

    /// Prints a line on stderr while the command runs.
    pub(crate) fn note(&self, line: impl Display) {
        match (self.quiet, self.logged) {
            (true, _) => {}
            (false, true) => tracing::info!("{line}"),
            (false, false) => to_stderr(&format!("{line}\n")),
        }
    }

    /// Prints the one line of an error, with `--quiet` too.
    pub(crate) fn error(&self, failure: &Failure) {
        if self.logged && tracing::enabled!(tracing::Level::ERROR) {
            tracing::error!("{failure}");
        } else {
            print_error(&failure.to_string());
        }
    }

    /// Prints the command's result: the object with `--json`, else the text.
    pub(crate) fn result(&self, object: &impl Serialize, text: &str) -> Result<(), Failure> {
        if self.json {
            let line = serde_json::to_string(object).map_err(|error| Failure::Work(error.to_string()))?;
            print(&(line + "\n"))
        } else {
            print(&format!("{}\n", text.trim_end()))
        }
    }

    /// A region of the terminal that can be redrawn; `None` if stderr is not a terminal, or with `--quiet`.
    pub(crate) fn screen(&self) -> Option<Screen> {
        (self.terminal && !self.quiet).then_some(Screen { lines: 0 })
    }

    /// A progress display of this many parts.
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

    /// A progress display for stages that are not known in advance.
    pub(crate) fn stages(&self) -> Stages {
        Stages { output: *self, now: Mutex::new(None) }
    }
}

/// What follows the number of blocks in the text of a model that also has objects which move.
pub(crate) fn beside(objects: usize) -> String {
    match objects {
        0 => String::new(),
        1 => " and an object that moves".into(),
        count => format!(" and {count} objects that move"),
    }
}

/// The redrawn last lines of the terminal.
#[derive(Debug)]
pub(crate) struct Screen {
    lines: usize,
}

impl Screen {
    /// Replaces the lines that were drawn before.
    pub(crate) fn draw(&mut self, lines: &[String]) {
        let up = if self.lines > 0 { format!("\x1b[{}A", self.lines) } else { String::new() };
        to_stderr(&format!("{up}\x1b[J{}\n", lines.join("\n")));
        self.lines = lines.len();
    }
}

/// A bar on a terminal; elsewhere a line for every tenth.
pub(crate) struct Progress {
    bar: Option<ProgressBar>,
    what: String,
    total: u64,
    output: Output,
    tenths: AtomicU64,
}

impl Progress {
    /// Shows the parts that are done. May be called from any thread.
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

    /// Prints a line above the bar.
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

/// A progress display for each stage, one after the other.
pub(crate) struct Stages {
    output: Output,
    now: Mutex<Option<(&'static str, Progress)>>,
}

impl Stages {
    /// Shows the parts of a stage that are done. A new stage replaces the one before. May be called from any thread.
    pub(crate) fn at(&self, what: &'static str, done: u64, total: u64, message: &str) {
        let mut now = self.now.lock().unwrap_or_else(PoisonError::into_inner);
        if now.as_ref().is_none_or(|(shown, _)| *shown != what) {
            // The old bar is cleared before the new one is drawn.
            *now = None;
            *now = Some((what, self.output.progress(what, total)));
        }
        if let Some((_, progress)) = now.as_ref() {
            progress.at(done, message);
        }
    }

    /// Prints a line above the bar.
    pub(crate) fn note(&self, line: impl Display) {
        let now = self.now.lock().unwrap_or_else(PoisonError::into_inner);
        match now.as_ref() {
            Some((_, progress)) => progress.note(line),
            None => self.output.note(line),
        }
    }
}

/// Prints text on stdout. A closed pipe (`plat … | head`) is not an error, a full disk is.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(SaveError::new(Path::new("standard output"), &error).into())
        }
        _ => Ok(()),
    }
}

/// Prints the one line of an error on stderr.
pub(crate) fn print_error(line: &str) {
    to_stderr(&format!("plat: {line}\n"));
}

fn to_stderr(text: &str) {
    let _ = std::io::stderr().lock().write_all(text.as_bytes());
}
