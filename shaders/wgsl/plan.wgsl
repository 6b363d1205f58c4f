// Stage `plan`: one thread decides, between the stages, how many workgroups the next ones take.

@group(0) @binding(0) var<uniform> views: Views;
@group(0) @binding(1) var<storage, read_write> status: Status;
// Exclusive sums of `seen` over all entries (plan_visible) or of the visible ones' tiles (plan_pairs).
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> args: array<u32>;

const SCAN_BLOCK: u32 = 1024u;
const RADIX_BLOCK: u32 = 4096u;
const DIGITS: u32 = 256u;
const REDUCE_SPLATS: u32 = 16u;
const GROUPS_IN_A_ROW: u32 = 32768u;

fn blocks(count: u32, block: u32) -> u32 {
    return count / block + select(0u, 1u, count % block != 0u);
}

// Dispatch `place` covers `count` entries, `block` a workgroup.
fn plan(place: u32, count: u32, block: u32) {
    let groups = blocks(count, block);
    let columns = clamp(groups, 1u, GROUPS_IN_A_ROW);
    args[3u * place] = select(columns, 0u, groups == 0u);
    args[3u * place + 1u] = blocks(groups, columns);
    args[3u * place + 2u] = 1u;
}

// Before the first scan.
@compute @workgroup_size(1)
fn plan_start() {
    sums[views.total] = 0u;
    status.splat_slots = views.total + 1u;
}

// After the first scan.
@compute @workgroup_size(1)
fn plan_visible() {
    // After an overflow nothing is visible until the host has made room.
    let drawn = status.overflow == 0u;
    let visible = select(0u, sums[views.total], drawn);
    let seen = select(0u, sums[views.own], drawn);
    status.visible = visible;
    status.seen = seen;
    status.visible_slots = visible + 1u;
    status.visible_digits = DIGITS * blocks(visible, RADIX_BLOCK);
    plan(0u, visible, GROUP);
    plan(1u, visible, RADIX_BLOCK);
    plan(2u, status.visible_digits, SCAN_BLOCK);
    plan(3u, visible + 1u, SCAN_BLOCK);
    plan(7u, seen, GROUP);
    plan(8u, seen, REDUCE_SPLATS);
}

// After the second scan.
@compute @workgroup_size(1)
fn plan_pairs() {
    var pairs = 0u;
    if status.visible > 0u {
        pairs = sums[status.visible];
    }
    status.most_pairs = max(status.most_pairs, pairs);
    if pairs > views.pair_capacity {
        status.overflow = 1u;
        status.seen = 0u;
        pairs = 0u;
        plan(7u, 0u, GROUP);
        plan(8u, 0u, REDUCE_SPLATS);
    }
    status.pairs = pairs;
    status.pair_digits = DIGITS * blocks(pairs, RADIX_BLOCK);
    plan(4u, pairs, GROUP);
    plan(5u, pairs, RADIX_BLOCK);
    plan(6u, status.pair_digits, SCAN_BLOCK);
}
