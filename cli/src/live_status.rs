//! Shows the state of a running job: on a terminal as a redrawn map of its blocks, elsewhere as a line per change.
//!
//! ```text
//! 1100##..    digits: trained to that level    #: being trained    x: failed    .: waiting
//! 11000000
//! ```
//! North is up. A cell shows the deepest block there whose training has begun.

use std::collections::BTreeMap;

use blocks::Plan;
use coordinator::Results;
use proto::watch_event::Event;
use proto::{TaskChanged, TaskState};
use scene::BlockId;

use crate::clock::Stopwatch;
use crate::output::{Output, Screen};

/// Deepest level with cells of its own: 32 cells a side.
const MAX_LEVEL_SHOWN: u8 = 5;
/// Running tasks listed below the map.
const MAX_TASKS_SHOWN: usize = 8;
/// Least seconds between two redraws.
const REDRAW_PERIOD: f64 = 0.25;

/// What a job's tasks are called.
#[derive(Debug, Default)]
pub(crate) struct TaskNames {
    /// Of the tasks that train, which are the first. Empty if they are not known.
    pub(crate) blocks: Vec<BlockId>,
    /// The first task that looks for objects; 0 if there is none.
    pub(crate) first_detection: u32,
    /// The first task that trains an object that moves; 0 if there is none.
    pub(crate) first_object: u32,
}

impl TaskNames {
    /// Those of a plan.
    pub(crate) fn of(plan: &Plan) -> Self {
        let first_detection = if plan.detect_tasks.is_empty() { 0 } else { plan.first_detection() as u32 };
        let first_object = if plan.object_tasks.is_empty() { 0 } else { plan.first_object() as u32 };
        Self { blocks: plan.tasks.iter().map(|task| task.block).collect(), first_detection, first_object }
    }

    /// A task's block; what it does and its number if it trains none, or its number if the blocks are not known.
    pub(crate) fn name(&self, task: u32) -> String {
        match self.blocks.get(task as usize) {
            Some(block) => format!("block {block}"),
            None if self.blocks.is_empty() => format!("task {task}"),
            None if self.first_object > 0 && task >= self.first_object => format!("object task {task}"),
            None if self.first_detection > 0 && task >= self.first_detection => format!("detection task {task}"),
            None => format!("evaluation task {task}"),
        }
    }
}

/// The display of one job.
pub(crate) struct LiveStatus<'a> {
    job: u64,
    names: &'a TaskNames,
    /// Of running tasks, in thousandths.
    progress: BTreeMap<u32, u64>,
    states: Vec<TaskState>,
    output: &'a Output,
    screen: Option<Screen>,
    clock: Stopwatch,
    drawn: f64,
}

impl<'a> LiveStatus<'a> {
    /// A job with these tasks. Without blocks there is no map.
    pub(crate) fn new(job: u64, names: &'a TaskNames, output: &'a Output) -> Self {
        let (progress, screen, clock) = (BTreeMap::new(), output.screen(), Stopwatch::start());
        Self { job, names, progress, states: Vec::new(), output, screen, clock, drawn: f64::NEG_INFINITY }
    }

    /// Shows an update that `results` already contains.
    pub(crate) fn update(&mut self, results: &Results, update: &Event) {
        match update {
            Event::Reported(reported) => {
                let permille = |report: &proto::Report| report.step.saturating_mul(1000).checked_div(report.steps);
                if let Some(permille) = reported.report.as_ref().and_then(permille) {
                    self.progress.insert(reported.task, permille.min(1000));
                }
            }
            Event::Changed(changed) => {
                if changed.state() != TaskState::Leased {
                    self.progress.remove(&changed.task);
                }
                if self.screen.is_none() {
                    self.print_change(results, changed);
                }
            }
            Event::Finished(_) => self.drawn = f64::NEG_INFINITY,
        }
        if self.screen.is_some() && self.clock.wall_seconds() - self.drawn >= REDRAW_PERIOD {
            self.drawn = self.clock.wall_seconds();
            let mut lines = map(&self.names.blocks, results.tasks(), true);
            lines.extend(self.summary(results));
            self.screen.iter_mut().for_each(|screen| screen.draw(&lines));
        }
    }

    /// Prints a line if the task's state changed.
    fn print_change(&mut self, results: &Results, changed: &TaskChanged) {
        self.states.resize(results.tasks().len(), TaskState::Waiting);
        let Some(before) = self.states.get_mut(changed.task as usize) else { return };
        if std::mem::replace(before, changed.state()) == changed.state() {
            return;
        }
        let name = self.names.name(changed.task);
        let (done, all) = (count(results, TaskState::Done), results.tasks().len());
        match changed.state() {
            TaskState::Done => self.output.note(format!("{name} done, {done} of {all}")),
            TaskState::Leased => self.output.note(format!("{name} runs on {}", changed.worker)),
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
            "job {}: {done} of {all} done, {leased} running, {ready} ready, {waiting} waiting, {failed} failed",
            self.job
        )];
        let running = results.tasks().iter().filter(|task| task.state() == TaskState::Leased);
        lines.extend(running.take(MAX_TASKS_SHOWN).map(|task| {
            let percent = self.progress.get(&task.task).copied().unwrap_or(0) / 10;
            format!("  {:<14} {percent:>3} %  {}", self.names.name(task.task), task.worker)
        }));
        lines
    }
}

fn count(results: &Results, wanted: TaskState) -> usize {
    results.tasks().iter().filter(|task| task.state() == wanted).count()
}

/// The map of the blocks, a line per row, and its legend; empty without blocks.
pub(crate) fn map(blocks: &[BlockId], tasks: &[TaskChanged], colours: bool) -> Vec<String> {
    let Some(deepest) = blocks.iter().map(|block| block.level).max() else { return Vec::new() };
    let shown = deepest.min(MAX_LEVEL_SHOWN);
    let side = 1u32 << shown;
    let mut cells = vec![b' '; (side * side) as usize];
    // Deeper blocks cover coarser ones. Of blocks that share a cell, failed ones cover running ones, and those finished ones.
    let mut order: Vec<(&BlockId, u8)> =
        blocks.iter().zip(tasks).map(|(block, task)| (block, mark(block, task))).collect();
    order.sort_by_key(|(block, mark)| (block.level, rank(*mark), block.y, block.x));
    for (block, mark) in order {
        let (low, width) = match shown.checked_sub(block.level) {
            Some(up) => ((block.x << up, block.y << up), 1u32 << up),
            None => {
                let of = block.ancestor(shown);
                ((of.x, of.y), 1)
            }
        };
        for y in low.1..low.1 + width {
            for cell in &mut cells[(y * side + low.0) as usize..][..width as usize] {
                *cell = if mark == b'.' && *cell != b' ' { *cell } else { mark };
            }
        }
    }
    let row = |y: u32| {
        let row = &cells[(y * side) as usize..][..side as usize];
        row.iter().map(|&cell| painted(cell, colours)).collect::<String>()
    };
    let mut lines: Vec<String> = (0..side).rev().map(row).collect();
    lines.push("digits: trained to that level    #: being trained    x: failed    .: waiting".into());
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

/// A cell of two characters, so that it is about square.
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
    fn tasks_are_named_by_their_kind() {
        let blocks = vec![BlockId::ROOT];
        let names = TaskNames { blocks: blocks.clone(), first_detection: 3, first_object: 4 };
        let all: Vec<String> = (0..5).map(|task| names.name(task)).collect();
        assert_eq!(all[..3], ["block 0/0/0", "evaluation task 1", "evaluation task 2"]);
        assert_eq!(all[3..], ["detection task 3", "object task 4"]);
        assert_eq!(TaskNames { blocks, ..TaskNames::default() }.name(1), "evaluation task 1");
        assert_eq!(TaskNames::default().name(3), "task 3");
    }

    #[test]
    fn the_map_shows_the_deepest_block_whose_training_has_begun() {
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
        // Blocks too small for a cell share one.
        let deep: Vec<BlockId> = ["0/0/0", "9/0/0", "9/1/0"].iter().map(|id| id.parse().unwrap()).collect();
        let tasks: Vec<TaskChanged> = (0..).zip([Done, Leased, Done]).map(task).collect();
        let lines = map(&deep, &tasks, false);
        assert_eq!((lines.len(), &lines[31][..6]), (33, "##0000"));
    }
}
