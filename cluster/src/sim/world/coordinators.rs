//! The coordinators: leadership, crashes and restarts, and the checks of their actions.

use crate::events::{Action, Event};
use crate::sim::coordinator::{Node, StepOutcome};
use crate::types::TaskState;

use super::{NODES, SETTINGS, TraceEvent, World};

impl World {
    /// Steps a coordinator. Returns its actions; `None` if it is down or crashed.
    pub(super) fn step_coordinator(&mut self, node: usize, event: Event) -> Result<Option<Vec<Action>>, String> {
        if self.nodes[node].scheduler.is_none() {
            return Ok(None);
        }
        self.report.steps += 1;
        let faults = self.store_faults;
        match self.nodes[node].step(self.now, event, &mut self.store, faults, &mut self.random)? {
            StepOutcome::Crashed(reason) => {
                self.count(reason);
                self.node_stops(node);
                Ok(None)
            }
            StepOutcome::Actions(actions) => {
                for action in &actions {
                    self.check_action(node, action)?;
                }
                Ok(Some(actions))
            }
        }
    }

    /// Checks and counts an action.
    pub(super) fn check_action(&mut self, node: usize, action: &Action) -> Result<(), String> {
        match action {
            Action::Grant { attempt, .. } => {
                if !self.granted.insert(*attempt) {
                    return Err(format!("{attempt} was granted twice"));
                }
                let scheduler = self.nodes[node].scheduler.as_ref();
                let record = scheduler.and_then(|scheduler| scheduler.record(attempt.job, attempt.task));
                if record.is_some_and(|record| record.state.leases().len() > 1) {
                    self.count("second attempt");
                }
            }
            Action::Stop { .. } => self.count("stopped"),
            Action::Changed { job, task } => {
                let state = self.store.record(*job, *task).map(|record| &record.state);
                if matches!(state, Some(TaskState::Quarantined { .. })) {
                    self.count("quarantined");
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
            self.count("two coordinators");
        }
        let skew = if self.random.chance(300) { self.random.between(0, 5_000_000) } else { 0 };
        if skew > 0 {
            self.count("clock skewed");
        }
        self.count("coordinator started");
        let journals = self.options.journals;
        let started = self.nodes[node].start(&mut self.store, SETTINGS, self.now, skew, journals);
        started.map_err(|error| error.to_string())?;
        let incarnation = self.nodes[node].incarnation;
        self.after(0, TraceEvent::Ticks { node, incarnation });
        Ok(())
    }

    /// A coordinator stops, and one starts after a while on either node.
    pub(super) fn node_stops(&mut self, node: usize) {
        let journal = self.nodes[node].stop();
        self.report.journals.extend(journal);
        let (later, place) = (self.random.between(50, 6000), self.random.between(0, NODES as u64) as usize);
        self.after(later, TraceEvent::NodeStarts { node: place });
    }

    pub(super) fn ticks(&mut self, node: usize, incarnation: u64) -> Result<(), String> {
        if self.nodes[node].incarnation != incarnation || self.nodes[node].scheduler.is_none() {
            return Ok(());
        }
        // A fenced coordinator that writes nothing would not notice it and would keep its workers waiting, so it checks
        // periodically.
        let epoch = self.nodes[node].scheduler.as_ref().map_or(0, |scheduler| scheduler.epoch());
        if epoch < self.store.epoch && (self.faults_ended || self.random.chance(200)) {
            self.count("stepped down");
            self.node_stops(node);
            return Ok(());
        }
        self.step_coordinator(node, Event::Ticked)?;
        self.after(500, TraceEvent::Ticks { node, incarnation });
        Ok(())
    }

    /// The coordinator of the newest epoch, if it is running.
    pub(super) fn leader(&self) -> Option<usize> {
        let leads = |node: &Node| node.scheduler.as_ref().is_some_and(|s| s.epoch() == self.store.epoch);
        self.nodes.iter().position(leads)
    }

    pub(super) fn on_user_request(&mut self, event: Event) -> Result<(), String> {
        let answer = match self.leader() {
            Some(node) => self.step_coordinator(node, event.clone())?,
            None => None,
        };
        let Some(actions) = answer else {
            self.after(1000, TraceEvent::UserRequest { event });
            return Ok(());
        };
        if actions.iter().any(|action| matches!(action, Action::Agreed { .. })) {
            match event {
                Event::CancelRequested { .. } => self.count("cancelled"),
                Event::PauseRequested { .. } => self.count("paused"),
                Event::RetryRequested { .. } => self.count("retried"),
                _ => {}
            }
        }
        Ok(())
    }
}
