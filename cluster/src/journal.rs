//! The journal of a scheduler: JSON lines with its initial state, its events and digests of its answers.
//!
//! ```text
//! {"began":{"settings":{…},"snapshot":{…},"epoch":3,"now_millis":0}}
//! {"step":{"now_millis":17,"event":{…},"said":1234}}
//! ```
//! A coordinator can write a journal while it runs. [`replay`] repeats the steps and compares the actions by their
//! digests (`said`).

use std::fmt;

use serde::{Deserialize, Serialize};

use scene::ArtefactId;

use crate::events::{Action, Event};
use crate::invariants::{check, check_step};
use crate::scheduler::Scheduler;
use crate::snapshot::Snapshot;
use crate::types::Settings;

/// Maximum length of a line, bytes.
pub const LINE_BYTES_LIMIT: usize = 256 << 20;

/// The invariants are checked after each step up to this number of tasks.
const MAX_CHECKED_TASKS: usize = 2000;

/// A line of the journal.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Line {
    /// The initial state of the scheduler.
    Began {
        /// Its settings.
        settings: Settings,
        /// The snapshot it was restored from; empty for a new one.
        snapshot: Snapshot,
        /// Its epoch.
        epoch: u64,
        /// Time, milliseconds.
        now_millis: u64,
    },
    /// One step.
    Step {
        /// Time, milliseconds.
        now_millis: u64,
        /// The event.
        event: Event,
        /// [`digest`] of the actions.
        #[serde(rename = "said")]
        answer: u64,
    },
}

/// The first 64 bits of the hash of the actions' JSON.
pub fn digest(actions: &[Action]) -> u64 {
    ArtefactId::of(&serde_json::to_vec(actions).unwrap_or_default()).seed()
}

/// Encodes a line as JSON, without the line break.
pub fn to_text(line: &Line) -> String {
    // These types contain no maps with non-string keys, so encoding cannot fail.
    serde_json::to_string(line).unwrap_or_default()
}

/// The result of a replay.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Replayed {
    /// Number of steps.
    pub steps: u64,
    /// Number of restarts in the journal.
    pub restarts: u64,
    /// The final state.
    pub last: Snapshot,
}

/// Replays a journal: repeats all steps, checks the invariants after each and compares the actions. A truncated last
/// line, as a killed process leaves it, is ignored.
///
/// # Errors
/// The line number and the problem: an invalid line, a violated invariant, or different actions.
pub fn replay<'a>(
    lines: impl Iterator<Item = &'a str>,
    mut trace: impl FnMut(fmt::Arguments<'_>),
) -> Result<Replayed, String> {
    let mut lines = (1u64..).zip(lines).peekable();
    let mut scheduler: Option<Scheduler> = None;
    let (mut steps, mut starts) = (0, 0);
    while let Some((number, text)) = lines.next() {
        let wrong = |problem: String| format!("line {number}: {problem}");
        if text.len() > LINE_BYTES_LIMIT {
            return Err(wrong(format!("longer than {LINE_BYTES_LIMIT} bytes")));
        }
        let line = match serde_json::from_str(text) {
            Ok(line) => line,
            Err(error) if error.is_eof() && lines.peek().is_none() && scheduler.is_some() => break,
            Err(error) => return Err(wrong(format!("not a line of a journal: {error}"))),
        };
        match (line, &mut scheduler) {
            (Line::Began { settings, snapshot, epoch, now_millis }, scheduler) => {
                starts += 1;
                let restored = Scheduler::restore(snapshot, settings, epoch, now_millis);
                *scheduler = Some(restored.map_err(|error| wrong(error.to_string()))?);
            }
            (Line::Step { .. }, None) => return Err(wrong("a step before the initial state".into())),
            (Line::Step { now_millis, event, answer }, Some(scheduler)) => {
                let before = (scheduler.total() <= MAX_CHECKED_TASKS).then(|| scheduler.clone());
                let actions = scheduler.step(now_millis, event.clone());
                trace(format_args!("{now_millis} {event:?} -> {actions:?}"));
                if let Some(before) = before {
                    let checked = check(scheduler).and_then(|()| check_step(&before, scheduler, &event, &actions));
                    checked.map_err(|violation| wrong(violation.to_string()))?;
                }
                if digest(&actions) != answer {
                    return Err(wrong(format!("the actions differ from the journal: {actions:?}")));
                }
                steps += 1;
            }
        }
    }
    let scheduler = scheduler.ok_or("the journal is empty")?;
    Ok(Replayed { steps, restarts: starts - 1, last: scheduler.snapshot() })
}
