// Stage `radix`: one pass of a stable LSD radix sort of keys and values, by 8-bit digits. `radix_count` builds the
// histogram of each block of 4096 entries, `scan` turns it (digit-major, then by block) into output offsets,
// `radix_scatter` writes the entries there.

struct PassConstants {
    len_word: u32,
    shift: u32,
    padding: vec2<u32>,
}

@group(0) @binding(0) var<storage, read> keys: array<u32>;
@group(0) @binding(1) var<storage, read> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(3) var<storage, read_write> values_out: array<u32>;
@group(0) @binding(4) var<storage, read_write> histogram: array<u32>;
@group(0) @binding(5) var<storage, read> status: array<u32>;
@group(0) @binding(6) var<uniform> pass_: PassConstants;

const BLOCK: u32 = 4096u;
const ROUNDS: u32 = 16u;

var<workgroup> counts: array<atomic<u32>, 256>;
// Bit t % 32 of word t / 32 of a digit: thread t has this digit in this round.
var<workgroup> digit_masks: array<atomic<u32>, 2048>;
var<workgroup> next_slot: array<u32, 256>;

fn block_index(group: vec3<u32>, groups: vec3<u32>) -> u32 {
    return group.y * groups.x + group.x;
}

@compute @workgroup_size(256)
fn radix_count(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    thread: Thread,
) {
    let local = local_index(thread);
    let count = status[pass_.len_word];
    let block = block_index(group, groups);
    atomicStore(&counts[local], 0u);
    workgroupBarrier();
    for (var round = 0u; round < ROUNDS; round++) {
        let at = block * BLOCK + round * 256u + local;
        var digit = 0u;
        if at < count {
            digit = (keys[at] >> pass_.shift) & 255u;
        }
        count_digit(digit, at < count, thread);
    }
    workgroupBarrier();
    let blocks = count / BLOCK + select(0u, 1u, count % BLOCK != 0u);
    if block < blocks {
        histogram[local * blocks + block] = atomicLoad(&counts[local]);
    }
}

@compute @workgroup_size(256)
fn radix_scatter(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    thread: Thread,
) {
    let local = local_index(thread);
    let count = status[pass_.len_word];
    let block = block_index(group, groups);
    let blocks = count / BLOCK + select(0u, 1u, count % BLOCK != 0u);
    var start = 0u;
    if block < blocks {
        start = histogram[local * blocks + block];
    }
    next_slot[local] = start;
    for (var word = 0u; word < 8u; word++) {
        atomicStore(&digit_masks[word * 256u + local], 0u);
    }
    workgroupBarrier();
    let word = local / 32u;
    let bit = 1u << (local % 32u);
    for (var round = 0u; round < ROUNDS; round++) {
        let at = block * BLOCK + round * 256u + local;
        var key = 0u;
        var digit = 0u;
        if at < count {
            key = keys[at];
            digit = (key >> pass_.shift) & 255u;
        }
        mark_digit(digit, at < count, thread);
        workgroupBarrier();
        if at < count {
            var rank = countOneBits(atomicLoad(&digit_masks[word * 256u + digit]) & (bit - 1u));
            for (var before = 0u; before < word; before++) {
                rank += countOneBits(atomicLoad(&digit_masks[before * 256u + digit]));
            }
            let to = next_slot[digit] + rank;
            keys_out[to] = key;
            values_out[to] = values[at];
        }
        workgroupBarrier();
        var count_of_digit = 0u;
        for (var each = 0u; each < 8u; each++) {
            count_of_digit += countOneBits(atomicLoad(&digit_masks[each * 256u + local]));
            atomicStore(&digit_masks[each * 256u + local], 0u);
        }
        next_slot[local] += count_of_digit;
        workgroupBarrier();
    }
}
