//! A job while it runs: on a terminal a map of its blocks that is drawn again and again, elsewhere a line for what happens.
//!
//! ```text
//! 1100##..    digits: trained to that level    #: being trained    x: failed    .: waits
//! 11000000
//! ```
//! A cell shows the deepest block over it that has begun, north is up.

use std::collections::BTreeMap;

use coordinator::Results;
use proto::watch_event::Event as News;
use proto::{TaskChanged, TaskState};
use scene::BlockId;

use crate::clock::Stopwatch;
use crate::output::{Output, Screen};

/// Levels of the tree that cells are small enough for: 32 cells a side.
const LEVELS_SHOWN: u8 = 5;
/// Tasks under way that are listed beside the map.
const TASKS_SHOWN: usize = 8;
/// Seconds between two drawings.
const PERIOD: f64 = 0.25;

/// A job as it is shown.
pub(crate) struct Live<'a> {
    job: u64,
    blocks: Vec<BlockId>,
    /// Of tasks under way, in thousandths.
    progress: BTreeMap<u32, u64>,
    states: Vec<TaskState>,
    output: &'a Output,
    screen: Option<Screen>,
    clock: Stopwatch,
    drawn: f64,
}

impl<'a> Live<'a> {
    /// A job with these blocks; none if they are not known, then there is no map.
    pub(crate) fn new(job: u64, blocks: Vec<BlockId>, output: &'a Output) -> Self {
        let (progress, screen, clock) = (BTreeMap::new(), output.screen(), Stopwatch::start());
        Self { job, blocks, progress, states: Vec::new(), output, screen, clock, drawn: f64::NEG_INFINITY }
    }

    /// Shows a piece of news, which the results have taken in.
    pub(crate) fn note(&mut self, results: &Results, news: &News) {
        match news {
            News::Reported(reported) => {
                let permille = |report: &proto::Report| report.step.saturating_mul(1000).checked_div(report.steps);
                if let Some(permille) = reported.report.as_ref().and_then(permille) {
                    self.progress.insert(reported.task, permille.min(1000));
                }
            }
            News::Changed(changed) => {
                if changed.state() != TaskState::Leased {
                    self.progress.remove(&changed.task);
                }
                if self.screen.is_none() {
                    self.tell(results, changed);
                }
            }
            News::Finished(_) => self.drawn = f64::NEG_INFINITY,
        }
        if self.screen.is_some() && self.clock.wall_seconds() - self.drawn >= PERIOD {
            self.drawn = self.clock.wall_seconds();
            let mut lines = map(&self.blocks, results.tasks(), true);
            lines.extend(self.summary(results));
            self.screen.iter_mut().for_each(|screen| screen.draw(&lines));
        }
    }

    /// A line for a change that is one.
    fn tell(&mut self, results: &Results, changed: &TaskChanged) {
        self.states.resize(results.tasks().len(), TaskState::Waiting);
        let Some(before) = self.states.get_mut(changed.task as usize) else { return };
        if std::mem::replace(before, changed.state()) == changed.state() {
            return;
        }
        let name = name_of(&self.blocks, changed.task);
        let (done, all) = (count(results, TaskState::Done), results.tasks().len());
        match changed.state() {
            TaskState::Done => self.output.note(format!("{name} done, {done} of {all}")),
            TaskState::Leased => self.output.note(format!("{name} goes to {}", changed.worker)),
            TaskState::Failed | TaskState::Quarantined => {
                self.output.note(format!("{name} failed: {}", proto::one_line(&changed.message)));
            }
            TaskState::Waiting | TaskState::Ready => {}
        }
    }

    fn summary(&self, results: &Results) -> Vec<String> {
        let [done, leased, ready, waiting] = [TaskState::Done, TaskState::Leased, TaskState::Ready, TaskState::Waiting]
            .map(|state| count(results, state));
        let all = results.tasks().len();
        let failed = all - done - leased - ready - waiting;
        let mut lines = vec![format!(
            "job {}: {done} of {all} done, {leased} being trained, {ready} ready, {waiting} waiting, {failed} failed",
            self.job
        )];
        let running = results.tasks().iter().filter(|task| task.state() == TaskState::Leased);
        lines.extend(running.take(TASKS_SHOWN).map(|task| {
            let percent = self.progress.get(&task.task).copied().unwrap_or(0) / 10;
            format!("  {:<14} {percent:>3} %  {}", name_of(&self.blocks, task.task), task.worker)
        }));
        lines
    }
}

/// A task's block where it is known, else its number.
pub(crate) fn name_of(blocks: &[BlockId], task: u32) -> String {
    blocks.get(task as usize).map_or(format!("task {task}"), |block| format!("block {block}"))
}

fn count(results: &Results, wanted: TaskState) -> usize {
    results.tasks().iter().filter(|task| task.state() == wanted).count()
}

/// The blocks from above, a line a row and the legend beneath; nothing where there are no blocks.
pub(crate) fn map(blocks: &[BlockId], tasks: &[TaskChanged], colours: bool) -> Vec<String> {
    let Some(deepest) = blocks.iter().map(|block| block.level).max() else { return Vec::new() };
    let shown = deepest.min(LEVELS_SHOWN);
    let side = 1u32 << shown;
    let mut cells = vec![b' '; (side * side) as usize];
    // Deeper blocks lie over those above them, and of those that share a cell what is under way over what is done.
    let mut order: Vec<(&BlockId, u8)> =
        blocks.iter().zip(tasks).map(|(block, task)| (block, mark(block, task))).collect();
    order.sort_by_key(|(block, mark)| (block.level, rank(*mark), block.y, block.x));
    for (block, mark) in order {
        let (low, cells_wide) = match shown.checked_sub(block.level) {
            Some(up) => ((block.x << up, block.y << up), 1u32 << up),
            None => {
                let of = block.ancestor(shown);
                ((of.x, of.y), 1)
            }
        };
        for y in low.1..low.1 + cells_wide {
            for cell in &mut cells[(y * side + low.0) as usize..][..cells_wide as usize] {
                *cell = if mark == b'.' && *cell != b' ' { *cell } else { mark };
            }
        }
    }
    let row = |y: u32| {
        let row = &cells[(y * side) as usize..][..side as usize];
        row.iter().map(|&cell| painted(cell, colours)).collect::<String>()
    };
    let mut lines: Vec<String> = (0..side).rev().map(row).collect();
    lines.push("digits: trained to that level    #: being trained    x: failed    .: waits".into());
    lines
}

fn mark(block: &BlockId, task: &TaskChanged) -> u8 {
    match task.state() {
        TaskState::Done => char::from_digit(block.level.into(), 36).map_or(b'?', |digit| digit as u8),
        TaskState::Leased => b'#',
        TaskState::Failed | TaskState::Quarantined => b'x',
        TaskState::Waiting | TaskState::Ready => b'.',
    }
}

fn rank(mark: u8) -> u8 {
    match mark {
        b'.' => 0,
        b'#' => 2,
        b'x' => 3,
        _ => 1,
    }
}

/// Two characters, so that cells are about square.
fn painted(cell: u8, colours: bool) -> String {
    let text = char::from(cell).to_string().repeat(2);
    let colour = match cell {
        b'#' => 33,
        b'x' => 31,
        b'.' | b' ' => return text,
        _ => 32,
    };
    if colours { format!("\x1b[{colour}m{text}\x1b[0m") } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_map_shows_the_deepest_block_that_has_begun() {
        let blocks: Vec<BlockId> = ["0/0/0", "1/0/0", "1/1/0", "1/0/1", "1/1/1", "2/0/0", "2/1/0"]
            .iter()
            .map(|id| id.parse().unwrap())
            .collect();
        use TaskState::{Done, Leased, Quarantined, Ready, Waiting};
        let states = [Done, Done, Leased, Quarantined, Ready, Leased, Waiting];
        let task = |(task, state): (u32, TaskState)| {
            let mut changed = TaskChanged { task, ..TaskChanged::default() };
            changed.set_state(state);
            changed
        };
        let tasks: Vec<TaskChanged> = (0..).zip(states).map(task).collect();
        let lines = map(&blocks, &tasks, false);
        assert_eq!(lines[..4], ["xxxx0000", "xxxx0000", "1111####", "##11####"]);
        assert!(map(&blocks, &tasks, true)[0].starts_with("\u{1b}[31mxx\u{1b}[0m"));
        assert!(map(&[], &tasks, false).is_empty());
        // Blocks too small for a cell of their own share one.
        let deep: Vec<BlockId> = ["0/0/0", "9/0/0", "9/1/0"].iter().map(|id| id.parse().unwrap()).collect();
        let tasks: Vec<TaskChanged> = (0..).zip([Done, Leased, Done]).map(task).collect();
        let lines = map(&deep, &tasks, false);
        assert_eq!((lines.len(), &lines[31][..6]), (33, "##0000"));
    }
}
