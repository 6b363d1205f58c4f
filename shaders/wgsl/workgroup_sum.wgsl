// The sum of a vector over the threads of a workgroup.

var<workgroup> totals: array<vec4<f32>, 256>;

// By halving, in a fixed order. A barrier must follow before the next sum. Needs uniform control flow.
fn workgroup_sum(value: vec4<f32>, local: u32) -> vec4<f32> {
    totals[local] = value;
    workgroupBarrier();
    for (var half = WORKGROUP_SIZE / 2u; half > 0u; half /= 2u) {
        if local < half {
            totals[local] += totals[local + half];
        }
        workgroupBarrier();
    }
    return totals[0];
}
