//! Measures the machine's memory, and checks this process against its memory budget.

use sysinfo::{MemoryRefreshKind, Pid, ProcessRefreshKind, ProcessesToUpdate, System};

/// Memory of this machine, or of this process's container if that is less, bytes. `None` if the machine
/// does not report its memory.
pub fn total_bytes() -> Option<u64> {
    let mut system = System::new();
    system.refresh_memory_specifics(MemoryRefreshKind::nothing().with_ram());
    let container = system.cgroup_limits().map_or(u64::MAX, |limits| limits.total_memory);
    Some(system.total_memory().min(container)).filter(|bytes| *bytes > 0)
}

/// The budget of a worker's task of `--memory` bytes; none without that option.
pub(crate) fn memory_budget(memory_bytes: u64) -> Option<MemoryBudget> {
    (memory_bytes > 0).then(|| MemoryBudget::new(memory_bytes)).flatten()
}

/// A limit on this process's resident memory. Nothing enforces it: the caller polls [`MemoryBudget::overrun`].
pub(crate) struct MemoryBudget {
    limit: u64,
    system: System,
    process: Pid,
}

impl MemoryBudget {
    /// A budget of `limit` bytes, or of what is resident now if that is more: memory that earlier tasks freed may still be
    /// resident, and the next task reuses it. `None` if the system does not report resident memory.
    pub(crate) fn new(limit: u64) -> Option<Self> {
        let process = sysinfo::get_current_pid().ok()?;
        let mut budget = Self { limit, system: System::new(), process };
        budget.limit = limit.max(budget.resident()?);
        Some(budget)
    }

    /// All resident memory, bytes, if it exceeds the budget. `None` if it does not, or cannot be measured.
    pub(crate) fn overrun(&mut self) -> Option<u64> {
        self.resident().filter(|resident| *resident > self.limit)
    }

    /// Resident memory of this process, bytes.
    fn resident(&mut self) -> Option<u64> {
        let this = ProcessesToUpdate::Some(&[self.process]);
        self.system.refresh_processes_specifics(this, false, ProcessRefreshKind::nothing().with_memory());
        self.system.process(self.process).map(sysinfo::Process::memory)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resident_memory_above_the_budget_is_an_overrun() {
        let total = total_bytes().expect("Linux reports it");
        assert!((64 << 20..1 << 50).contains(&total), "{total} bytes");
        let mut wide = MemoryBudget::new(total).expect("Linux reports it");
        let mut narrow = MemoryBudget::new(1).expect("Linux reports it");
        let before = narrow.limit;
        assert!(before > 1 << 20, "memory that is resident already is within the budget: {before}");
        // Written to, so that it is resident.
        let more = vec![1_u8; 256 << 20];
        assert_eq!(wide.overrun(), None);
        let resident = narrow.overrun().expect("256 MiB more");
        assert!(resident > before + (128 << 20), "{resident} after {before}");
        drop(more);
    }
}
