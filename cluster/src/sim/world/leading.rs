//! The coordinators: who leads, who only thinks so, and what must be true of everything that they say.

use crate::events::{Action, Event};
use crate::sim::coordinator::{Heard, Node};
use crate::words::TaskState;

use super::{Happening, NODES, SETTINGS, World};

impl World {
    /// A coordinator hears an event: what it may say, `None` if it died over it.
    pub(super) fn hear(&mut self, node: usize, event: Event) -> Result<Option<Vec<Action>>, String> {
        if self.nodes[node].scheduler.is_none() {
            return Ok(None);
        }
        self.report.steps += 1;
        let faults = self.store_faults;
        match self.nodes[node].hear(self.now, event, &mut self.store, faults, &mut self.random)? {
            Heard::Dead(why) => {
                self.note(why);
                self.node_dies(node);
                Ok(None)
            }
            Heard::Said(actions) => {
                for action in &actions {
                    self.watch(node, action)?;
                }
                Ok(Some(actions))
            }
        }
    }

    /// What must be true of everything that is said.
    pub(super) fn watch(&mut self, node: usize, action: &Action) -> Result<(), String> {
        match action {
            Action::Grant { attempt, .. } => {
                if !self.granted.insert(*attempt) {
                    return Err(format!("{attempt} was granted twice"));
                }
                let scheduler = self.nodes[node].scheduler.as_ref();
                let record = scheduler.and_then(|scheduler| scheduler.record(attempt.job, attempt.task));
                if record.is_some_and(|record| record.state.leases().len() > 1) {
                    self.note("second attempt");
                }
            }
            Action::Stop { .. } => self.note("stopped"),
            Action::Changed { job, task } => {
                let state = self.store.record(*job, *task).map(|record| &record.state);
                if matches!(state, Some(TaskState::Quarantined { .. })) {
                    self.note("quarantined");
                }
            }
            _ => {}
        }
        Ok(())
    }

    pub(super) fn node_starts(&mut self, node: usize) -> Result<(), String> {
        if self.nodes[node].scheduler.is_some() {
            return Ok(());
        }
        if self.nodes.iter().any(|other| other.scheduler.is_some()) {
            self.note("two coordinators");
        }
        let skew = if self.random.chance(300) { self.random.between(0, 5_000_000) } else { 0 };
        if skew > 0 {
            self.note("clock skewed");
        }
        self.note("coordinator started");
        let journals = self.options.journals;
        let started = self.nodes[node].start(&mut self.store, SETTINGS, self.now, skew, journals);
        started.map_err(|error| error.to_string())?;
        let life = self.nodes[node].life;
        self.after(0, Happening::Ticks { node, life });
        Ok(())
    }

    /// A coordinator dies, and one starts after a while, here or there.
    pub(super) fn node_dies(&mut self, node: usize) {
        let journal = self.nodes[node].die();
        self.report.journals.extend(journal);
        let (later, place) = (self.random.between(50, 6000), self.random.between(0, NODES as u64) as usize);
        self.after(later, Happening::NodeStarts { node: place });
    }

    pub(super) fn ticks(&mut self, node: usize, life: u64) -> Result<(), String> {
        if self.nodes[node].life != life || self.nodes[node].scheduler.is_none() {
            return Ok(());
        }
        // Who writes nothing would never learn that it is fenced, and keep its workers waiting: it looks now and then.
        let epoch = self.nodes[node].scheduler.as_ref().map_or(0, |scheduler| scheduler.epoch());
        if epoch < self.store.epoch && (self.peace || self.random.chance(200)) {
            self.note("stepped down");
            self.node_dies(node);
            return Ok(());
        }
        self.hear(node, Event::Ticked)?;
        self.after(500, Happening::Ticks { node, life });
        Ok(())
    }

    /// The coordinator of the newest epoch, if it is alive.
    pub(super) fn leader(&self) -> Option<usize> {
        let leads = |node: &Node| node.scheduler.as_ref().is_some_and(|s| s.epoch() == self.store.epoch);
        self.nodes.iter().position(leads)
    }

    pub(super) fn asks(&mut self, event: Event) -> Result<(), String> {
        let answer = match self.leader() {
            Some(node) => self.hear(node, event.clone())?,
            None => None,
        };
        let Some(actions) = answer else {
            self.after(1000, Happening::Asks { event });
            return Ok(());
        };
        if actions.iter().any(|action| matches!(action, Action::Agreed { .. })) {
            match event {
                Event::CancelRequested { .. } => self.note("cancelled"),
                Event::PauseRequested { .. } => self.note("paused"),
                Event::RetryRequested { .. } => self.note("retried"),
                _ => {}
            }
        }
        Ok(())
    }
}
