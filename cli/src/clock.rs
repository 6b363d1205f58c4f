//! Reads clocks and memory counters of the operating system.

pub(crate) use worker::clock::Stopwatch;

/// Largest resident memory of this process so far, bytes; `None` if the system does not report it.
pub(crate) fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kilobytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kilobytes * 1024)
}

/// Resets the peak of resident memory, where the system supports that.
pub(crate) fn reset_peak_memory() {
    // A file of the kernel: the write only resets the counter.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// Milliseconds since 1970, for what people read: no result depends on it.
#[allow(clippy::disallowed_methods)]
pub(crate) fn unix_ms() -> u64 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |since| since.as_millis() as u64)
}
