// Stage `scan`: exclusive prefix sum in place, in three dispatches: within blocks, over block sums, and their
// combination. Sums saturate at 2^32 - 1, so that a comparison with a limit never sees a wrapped value.

struct PassConstants {
    len_word: u32,
    shift: u32,
    padding: vec2<u32>,
}

@group(0) @binding(0) var<storage, read_write> data: array<u32>;
@group(0) @binding(1) var<storage, read_write> block_sums: array<u32>;
@group(0) @binding(2) var<storage, read> status: array<u32>;
@group(0) @binding(3) var<uniform> pass_: PassConstants;

const BLOCK: u32 = 1024u; // four entries a thread

fn saturating_add(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xffffffffu, sum < a);
}

fn block_index(group: vec3<u32>, groups: vec3<u32>) -> u32 {
    return group.y * groups.x + group.x;
}

fn load(at: u32, count: u32) -> u32 {
    if at < count {
        return data[at];
    }
    return 0u;
}

@compute @workgroup_size(256)
fn scan_blocks(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    thread: Thread,
) {
    let local = local_index(thread);
    let count = status[pass_.len_word];
    let block = block_index(group, groups);
    let at = block * BLOCK + 4u * local;
    let sum = saturating_add(saturating_add(load(at, count), load(at + 1u, count)), saturating_add(load(at + 2u, count), load(at + 3u, count)));
    exclusive_scan(sum, thread);
    if local == 0u && block * BLOCK < count {
        block_sums[block] = scan_total(thread);
    }
}

@compute @workgroup_size(256)
fn scan_sums(thread: Thread) {
    let local = local_index(thread);
    let count = status[pass_.len_word];
    let blocks = count / BLOCK + select(0u, 1u, count % BLOCK != 0u);
    var carry = 0u;
    for (var first = 0u; first < blocks; first += 256u) {
        let at = first + local;
        var value = 0u;
        if at < blocks {
            value = block_sums[at];
        }
        let before = exclusive_scan(value, thread);
        if at < blocks {
            block_sums[at] = saturating_add(carry, before);
        }
        carry = saturating_add(carry, scan_total(thread));
        workgroupBarrier();
    }
}

@compute @workgroup_size(256)
fn scan_apply(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    thread: Thread,
) {
    let local = local_index(thread);
    let count = status[pass_.len_word];
    let block = block_index(group, groups);
    let at = block * BLOCK + 4u * local;
    var values = array<u32, 4>(load(at, count), load(at + 1u, count), load(at + 2u, count), load(at + 3u, count));
    let before = exclusive_scan(saturating_add(saturating_add(values[0], values[1]), saturating_add(values[2], values[3])), thread);
    if block * BLOCK >= count {
        return;
    }
    var sum = saturating_add(block_sums[block], before);
    for (var k = 0u; k < 4u; k++) {
        if at + k < count {
            data[at + k] = sum;
        }
        sum = saturating_add(sum, values[k]);
    }
}
