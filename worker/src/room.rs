//! How much memory there is, and whether this process takes more of it than it may.

use sysinfo::{MemoryRefreshKind, Pid, ProcessRefreshKind, ProcessesToUpdate, System};

/// The memory of this machine, or of the container around this process where that is less, bytes; `None` where neither is known.
pub fn bytes() -> Option<u64> {
    let mut system = System::new();
    system.refresh_memory_specifics(MemoryRefreshKind::nothing().with_ram());
    let container = system.cgroup_limits().map_or(u64::MAX, |limits| limits.total_memory);
    Some(system.total_memory().min(container)).filter(|bytes| *bytes > 0)
}

/// A bound on what this process takes.
pub(crate) struct Room {
    limit: u64,
    system: System,
    process: Pid,
}

impl Room {
    /// A bound of so many bytes; `None` where the system does not say what a process takes. What is taken by now is no overrun: an
    /// allocator keeps what tasks before this one gave back, and this one will use it.
    pub(crate) fn of(limit: u64) -> Option<Self> {
        let process = sysinfo::get_current_pid().ok()?;
        let mut room = Self { limit, system: System::new(), process };
        room.limit = limit.max(room.resident()?);
        Some(room)
    }

    /// What is taken, bytes, where that is more than the bound.
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
    fn what_is_taken_beyond_the_bound_is_told() {
        let all = bytes().expect("Linux says");
        assert!((64 << 20..1 << 50).contains(&all), "{all} bytes");
        let mut wide = Room::of(all).expect("Linux says");
        let mut narrow = Room::of(1).expect("Linux says");
        let before = narrow.limit;
        assert!(before > 1 << 20, "what is there already counts as given: {before}");
        // Written to, so that it is there.
        let more = vec![1_u8; 256 << 20];
        assert_eq!(wide.overrun(), None);
        let taken = narrow.overrun().expect("256 MiB more");
        assert!(taken > before + (128 << 20), "{taken} after {before}");
        drop(more);
    }
}
