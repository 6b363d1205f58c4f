// Stage `plan`: one thread computes the sizes of the indirect dispatches of the following stages.

@group(0) @binding(0) var<uniform> views: Views;
@group(0) @binding(1) var<storage, read_write> status: Status;
// Exclusive prefix sum of the visibility flags over all entries (plan_visible), or of the tile counts of visible
// entries (plan_pairs).
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> args: array<u32>;

const SCAN_BLOCK: u32 = 1024u;
const RADIX_BLOCK: u32 = 4096u;
const RADIX_BINS: u32 = 256u;
const REDUCE_SPLATS: u32 = 16u;
const MAX_GROUPS_X: u32 = 32768u;

fn blocks(count: u32, block: u32) -> u32 {
    return count / block + select(0u, 1u, count % block != 0u);
}

// Indirect dispatch `slot` covers `count` entries, `block` per workgroup.
fn plan_dispatch(slot: u32, count: u32, block: u32) {
    let groups = blocks(count, block);
    let columns = clamp(groups, 1u, MAX_GROUPS_X);
    args[3u * slot] = select(columns, 0u, groups == 0u);
    args[3u * slot + 1u] = blocks(groups, columns);
    args[3u * slot + 2u] = 1u;
}

// Runs before the first scan.
@compute @workgroup_size(1)
fn plan_start() {
    sums[views.entries] = 0u;
    status.entry_scan_len = views.entries + 1u;
}

// Runs after the first scan.
@compute @workgroup_size(1)
fn plan_visible() {
    // After an overflow nothing is drawn until the host has grown the buffers.
    let drawn = status.overflow == 0u;
    let visible = select(0u, sums[views.entries], drawn);
    let visible_trainable = select(0u, sums[views.trainable_entries], drawn);
    status.visible = visible;
    status.visible_trainable = visible_trainable;
    status.visible_scan_len = visible + 1u;
    status.visible_histogram_len = RADIX_BINS * blocks(visible, RADIX_BLOCK);
    plan_dispatch(0u, visible, WORKGROUP_SIZE);
    plan_dispatch(1u, visible, RADIX_BLOCK);
    plan_dispatch(2u, status.visible_histogram_len, SCAN_BLOCK);
    plan_dispatch(3u, visible + 1u, SCAN_BLOCK);
    plan_dispatch(7u, visible_trainable, WORKGROUP_SIZE);
    plan_dispatch(8u, visible_trainable, REDUCE_SPLATS);
}

// Runs after the second scan.
@compute @workgroup_size(1)
fn plan_pairs() {
    var pairs = 0u;
    if status.visible > 0u {
        pairs = sums[status.visible];
    }
    status.max_pairs = max(status.max_pairs, pairs);
    if pairs > views.pair_capacity {
        status.overflow = 1u;
        status.visible_trainable = 0u;
        pairs = 0u;
        plan_dispatch(7u, 0u, WORKGROUP_SIZE);
        plan_dispatch(8u, 0u, REDUCE_SPLATS);
    }
    status.pairs = pairs;
    status.pair_histogram_len = RADIX_BINS * blocks(pairs, RADIX_BLOCK);
    plan_dispatch(4u, pairs, WORKGROUP_SIZE);
    plan_dispatch(5u, pairs, RADIX_BLOCK);
    plan_dispatch(6u, status.pair_histogram_len, SCAN_BLOCK);
}
