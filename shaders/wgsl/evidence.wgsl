// Stage `evidence`: what a view says of the splats that it has seen, for the next refinement; a thread a splat.

@group(0) @binding(0) var<uniform> rates: Rates;
@group(0) @binding(1) var<storage, read> status: Status;
@group(0) @binding(2) var<storage, read> books: Books;
@group(0) @binding(3) var<storage, read> visible: array<u32>;
// Columns: length of the mean's gradient in pixels, the same summed without cancellation, sum of alpha T.
@group(0) @binding(4) var<storage, read> statistics: array<f32>;
// Columns: sum of that gradient without cancellation, largest sum of alpha T.
@group(0) @binding(5) var<storage, read_write> found: array<f32>;
@group(0) @binding(6) var<storage, read_write> views: array<u32>;

@compute @workgroup_size(256)
fn evidence(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let place = linear(group, groups, local);
    if place >= status.seen || books.good == 0u {
        return;
    }
    let i = visible[place];
    let n = rates.stride;
    found[i] += statistics[n + i] * rates.pixels;
    found[n + i] = max(found[n + i], statistics[2u * n + i]);
    views[i]++;
}
