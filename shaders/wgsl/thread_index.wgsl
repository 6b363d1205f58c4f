// Index of a thread in its workgroup, portable version.

struct Thread {
    @builtin(local_invocation_index) local: u32,
}

// A permutation of 0 to 255.
fn local_index(thread: Thread) -> u32 {
    return thread.local;
}
