// Stage `rearrange`: the rows of a bank of columns in the order that refinement left; one thread per new row. Words, not
// floats, are moved, so that every bit is kept.

@group(0) @binding(0) var<uniform> constants: RearrangeConstants;
// For each new row the old row that it continues, or NO_ROW: it begins with zeros.
@group(0) @binding(1) var<storage, read> old_rows: array<u32>;
@group(0) @binding(2) var<storage, read> before: array<u32>;
@group(0) @binding(3) var<storage, read_write> after: array<u32>;

const NO_ROW: u32 = 0xffffffffu;

@compute @workgroup_size(256)
fn rearrange(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let row = thread_number(group, groups, local);
    if row >= constants.rows {
        return;
    }
    let old = old_rows[row];
    for (var k = 0u; k < constants.columns; k++) {
        var word = 0u;
        if old != NO_ROW {
            word = before[k * constants.stride + old];
        }
        after[k * constants.stride + row] = word;
    }
}
