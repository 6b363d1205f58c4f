// Which thread of its workgroup a thread is. This one every adapter knows.

struct Thread {
    @builtin(local_invocation_index) local: u32,
}

// 0 to 255, each once.
fn local_index(thread: Thread) -> u32 {
    return thread.local;
}
