// Sum of the 32 partial moments of each pair, serially, through workgroup memory.

const STRIDE: u32 = 33u; // not 32, to avoid bank conflicts between threads that sum different moments

// Thread 32 k + p passes part p of pair k. Needs uniform control flow.
fn reduce_parts(m: Moments, count: u32, thread: Thread) {
    let local = local_index(thread);
    let k = local / PARTS;
    workgroupBarrier();
    if k < count {
        let to = k * MOMENTS * STRIDE + local % PARTS;
        shared_[to] = m.a.x;
        shared_[to + STRIDE] = m.a.y;
        shared_[to + 2u * STRIDE] = m.a.z;
        shared_[to + 3u * STRIDE] = m.a.w;
        shared_[to + 4u * STRIDE] = m.b.x;
        shared_[to + 5u * STRIDE] = m.b.y;
        shared_[to + 6u * STRIDE] = m.b.z;
        shared_[to + 7u * STRIDE] = m.b.w;
        shared_[to + 8u * STRIDE] = m.c.x;
        shared_[to + 9u * STRIDE] = m.c.y;
        shared_[to + 10u * STRIDE] = m.c.z;
        shared_[to + 11u * STRIDE] = m.c.w;
        shared_[to + 12u * STRIDE] = m.d;
    }
    workgroupBarrier();
    if local < count * MOMENTS && is_trainable[local / MOMENTS] != 0u {
        var total = 0.0;
        for (var p = 0u; p < PARTS; p++) {
            total += shared_[local * STRIDE + p];
        }
        write_moment(output_slots[local / MOMENTS] * MOMENTS + local % MOMENTS, total);
    }
    workgroupBarrier();
}
