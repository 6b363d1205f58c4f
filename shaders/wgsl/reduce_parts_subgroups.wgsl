// Sum of the 32 partial moments of each pair: three shuffles reduce eight lanes, workgroup memory the four results. At
// each shuffle a lane passes half of its moments on and keeps the sums of the others. The 32 parts form one binary tree
// for every subgroup size, so results do not depend on that size.

// Moment m of eight lanes n, 0 to 3, of pair k at 4 (16 k + m) + n.
var<workgroup> partial_sums: array<f32, 512>;

// Thread 32 k + p passes part p of pair k. Needs uniform control flow.
fn reduce_parts(m: Moments, count: u32, thread: Thread) {
    let local = local_index(thread);
    let upper = vec3<bool>((local & 1u) != 0u, (local & 2u) != 0u, (local & 4u) != 0u);
    let d = vec4<f32>(m.d, 0.0, 0.0, 0.0);
    let one = select(m.a, m.c, upper.x) + subgroupShuffleXor(select(m.c, m.a, upper.x), 1u);
    let two = select(m.b, d, upper.x) + subgroupShuffleXor(select(d, m.b, upper.x), 1u);
    let four = select(one, two, upper.y) + subgroupShuffleXor(select(two, one, upper.y), 2u);
    let last = select(four.xy, four.zw, upper.z) + subgroupShuffleXor(select(four.zw, four.xy, upper.z), 4u);
    let moment = 8u * u32(upper.x) + 4u * u32(upper.y) + 2u * u32(upper.z);
    let to = 4u * (16u * (local / PARTS) + moment) + (local % PARTS) / 8u;
    partial_sums[to] = last.x;
    partial_sums[to + 4u] = last.y;
    workgroupBarrier();
    let k = local / 16u;
    if k < count && local % 16u < MOMENTS && is_trainable[k] != 0u {
        let at = 4u * local;
        write_moment(output_slots[k] * MOMENTS + local % 16u, (partial_sums[at] + partial_sums[at + 1u]) + (partial_sums[at + 2u] + partial_sums[at + 3u]));
    }
    workgroupBarrier();
}
