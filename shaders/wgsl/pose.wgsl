// Stage `pose`: an Adam step of the displacement of each view of a step in turn, after each of which the common motion
// of all cameras is removed. All sums run in a fixed order.

@group(0) @binding(0) var<uniform> constants: PoseConstants;
@group(0) @binding(1) var<storage, read> state: OptimiserState;
// Per view of the step: the gradient of its pose, six numbers in two vectors.
@group(0) @binding(2) var<storage, read> gradients: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> given: array<GivenPose>;
// Per camera six numbers: the translation in metres and the rotation vector in radians, in the camera's axes.
@group(0) @binding(4) var<storage, read_write> displacements: array<f32>;
// Per camera: six first, then six second moments.
@group(0) @binding(5) var<storage, read_write> moments: array<f32>;
// Adam steps of each camera.
@group(0) @binding(6) var<storage, read_write> steps: array<u32>;

const BETA2: f32 = 0.99;

// One workgroup.
@compute @workgroup_size(256)
fn pose_step(@builtin(local_invocation_index) local: u32) {
    for (var v = 0u; v < constants.views; v++) {
        let number = constants.row[v / 4u][v % 4u];
        let changes = state.is_step_valid != 0u && number != 0u && is_gradient_finite(v);
        let at = number - 1u;
        if changes && local < 6u {
            update(at, local, gradients[2u * v + local / 4u][local % 4u]);
        }
        storageBarrier();
        if changes && local == 0u {
            steps[at] = min(steps[at], 0xfffffffeu) + 1u;
        }
        remove_common_motion(local, changes && constants.is_anchored != 0u);
        storageBarrier();
    }
}

fn is_gradient_finite(v: u32) -> bool {
    let low = gradients[2u * v];
    let high = gradients[2u * v + 1u];
    return is_finite(low.x) && is_finite(low.y) && is_finite(low.z) && is_finite(low.w) && is_finite(high.x)
        && is_finite(high.y);
}

// Adam on number k of a displacement, whose gradient is that of the pose with the sign turned.
fn update(at: u32, k: u32, gradient: f32) {
    let age = min(steps[at] + 1u, 1u << 20u);
    let rate = constants.rate * select(1.0, given[at].translation_rate, k < 3u);
    let first = 12u * at + k;
    let m = BETA1 * moments[first] - (1.0 - BETA1) * gradient;
    let v = BETA2 * moments[first + 6u] + (1.0 - BETA2) * gradient * gradient;
    let size = sqrt(v / (1.0 - power(BETA2, age))) + EPSILON;
    let kept = (1.0 - constants.decay) * displacements[6u * at + k];
    displacements[6u * at + k] = kept - rate * (m / (1.0 - power(BETA1, age))) / size;
    moments[first] = m;
    moments[first + 6u] = v;
}

// Three numbers of displacements, turned from the camera's axes to the world's.
fn in_world(camera: u32, first: u32) -> vec3<f32> {
    let at = 6u * camera + first;
    let rows = given[camera].rows;
    return rows[0].xyz * displacements[at] + rows[1].xyz * displacements[at + 1u] + rows[2].xyz * displacements[at + 2u];
}

// The inverse: subtracts a vector of the world.
fn subtract(camera: u32, first: u32, vector: vec3<f32>) {
    for (var r = 0u; r < 3u; r++) {
        displacements[6u * camera + first + r] -= dot(given[camera].rows[r].xyz, vector);
    }
}

// The camera's offset from the mean of all, metres.
fn offset(camera: u32) -> vec3<f32> {
    let rows = given[camera].rows;
    return vec3<f32>(rows[0].w, rows[1].w, rows[2].w);
}

// Subtracts the mean translation, the mean rotation and the growth of all cameras.
fn remove_common_motion(local: u32, removes: bool) {
    var shift = vec4<f32>(0.0); // and the growth
    var turn = vec4<f32>(0.0);
    for (var k = local; k < constants.cameras; k += WORKGROUP_SIZE) {
        let translation = in_world(k, 0u);
        shift += vec4<f32>(translation, dot(translation, offset(k)));
        turn += vec4<f32>(in_world(k, 3u), 0.0);
    }
    shift = workgroup_sum(shift, local);
    workgroupBarrier(); // protects `totals` until all threads have read the sum
    turn = workgroup_sum(turn, local);
    workgroupBarrier(); // as above
    let cameras = f32(constants.cameras);
    let growth = shift.w / constants.spread;
    for (var k = local; removes && k < constants.cameras; k += WORKGROUP_SIZE) {
        subtract(k, 0u, shift.xyz / cameras + growth * offset(k));
        subtract(k, 3u, turn.xyz / cameras);
    }
}
