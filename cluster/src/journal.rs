//! What a scheduler heard and said, a JSON object a line: the first says how it began, the others are its steps.
//!
//! ```text
//! {"began":{"settings":{…},"snapshot":{…},"epoch":3,"now_millis":0}}
//! {"step":{"now_millis":17,"event":{…},"said":1234}}
//! ```
//! Written beside a running coordinator and replayed by [`replay`], which is deterministic: the same events give the same
//! actions, and `said` tells whether they did.

use std::fmt;

use serde::{Deserialize, Serialize};

use scene::ArtefactId;

use crate::events::{Action, Event};
use crate::invariants::{check, check_step};
use crate::scheduler::Scheduler;
use crate::snapshot::Snapshot;
use crate::words::Settings;

/// The longest line that is read, in bytes.
pub const LINE_BYTES_LIMIT: usize = 256 << 20;

/// The invariants are checked after each step while there are no more tasks than this.
const CHECKED_TASKS: usize = 2000;

/// A line of the journal.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Line {
    /// How the scheduler began.
    Began {
        /// Its limits.
        settings: Settings,
        /// What it was restored from; empty for a new one.
        snapshot: Snapshot,
        /// Its epoch.
        epoch: u64,
        /// When.
        now_millis: u64,
    },
    /// One step.
    Step {
        /// When.
        now_millis: u64,
        /// What it heard.
        event: Event,
        /// [`digest`] of what it answered.
        said: u64,
    },
}

/// The first 64 bits of the hash of some actions.
pub fn digest(actions: &[Action]) -> u64 {
    ArtefactId::of(&serde_json::to_vec(actions).unwrap_or_default()).seed()
}

/// A line as text, without the line break.
pub fn to_text(line: &Line) -> String {
    // Maps with keys that are no strings cannot occur in these types.
    serde_json::to_string(line).unwrap_or_default()
}

/// What came of a replay.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Replayed {
    /// Steps taken.
    pub steps: u64,
    /// Restarts within the journal.
    pub restarts: u64,
    /// The state at the end.
    pub last: Snapshot,
}

/// Takes all steps of a journal again, checks the invariants after each, and compares what is answered. A last line that
/// was cut off is left out, as a killed process leaves one.
///
/// # Errors
/// The line, and what is wrong with it: not a line of a journal, an invariant that does not hold, another answer.
pub fn replay<'a>(
    lines: impl Iterator<Item = &'a str>,
    mut trace: impl FnMut(fmt::Arguments<'_>),
) -> Result<Replayed, String> {
    let mut lines = (1u64..).zip(lines).peekable();
    let mut scheduler: Option<Scheduler> = None;
    let (mut steps, mut starts) = (0, 0);
    while let Some((number, text)) = lines.next() {
        let wrong = |what: String| format!("line {number}: {what}");
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
            (Line::Step { .. }, None) => return Err(wrong("a step before the journal says how it began".into())),
            (Line::Step { now_millis, event, said }, Some(scheduler)) => {
                let before = (scheduler.total() <= CHECKED_TASKS).then(|| scheduler.clone());
                let actions = scheduler.step(now_millis, event.clone());
                trace(format_args!("{now_millis} {event:?} -> {actions:?}"));
                if let Some(before) = before {
                    let held = check(scheduler).and_then(|()| check_step(&before, scheduler, &event, &actions));
                    held.map_err(|violation| wrong(violation.to_string()))?;
                }
                if digest(&actions) != said {
                    return Err(wrong(format!("another answer than then: {actions:?}")));
                }
                steps += 1;
            }
        }
    }
    let scheduler = scheduler.ok_or("the journal is empty")?;
    Ok(Replayed { steps, restarts: starts - 1, last: scheduler.snapshot() })
}
