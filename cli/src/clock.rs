//! The one place in the program that reads clocks and counters of the operating system.

pub(crate) use worker::clock::Stopwatch;

/// Largest resident memory of this process so far, bytes; `None` where the system does not say.
pub(crate) fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kilobytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kilobytes * 1024)
}

/// From now on the peak is that of what follows; where the system does not do that, it stays what it was.
pub(crate) fn forget_peak_memory() {
    // A file of the kernel's: nothing is kept there.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}
