// Stage `sensor`: an Adam step of the errors of the sensor of each view of a step in turn; then the displacement of every
// camera, its own and that by its sensor. All sums run in a fixed order.

@group(0) @binding(0) var<uniform> constants: SensorConstants;
@group(0) @binding(1) var<storage, read> state: OptimiserState;
// Per view of the step: the gradients of its pose and its focal length, seven numbers in two vectors.
@group(0) @binding(2) var<storage, read> gradients: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> cameras: array<SensorCamera>;
@group(0) @binding(4) var<storage, read_write> sensors: array<Sensor>;
// Per camera six numbers: its own displacement.
@group(0) @binding(5) var<storage, read> own: array<f32>;
// Per camera eight numbers, as `displace` reads them.
@group(0) @binding(6) var<storage, read_write> displacements: array<f32>;

const BETA2: f32 = 0.99;

// One workgroup.
@compute @workgroup_size(256)
fn sensor_step(@builtin(local_invocation_index) local: u32) {
    for (var v = 0u; v < constants.views; v++) {
        let number = constants.row[v / 4u][v % 4u];
        var sensor = 0u;
        if number != 0u {
            sensor = cameras[number - 1u].sensor;
        }
        let changes = state.is_step_valid != 0u && sensor != 0u && is_gradient_finite(v);
        if changes && local < 8u {
            update(sensor - 1u, local, gradient_of(v, number - 1u, local));
        }
        storageBarrier();
        if changes && local == 0u {
            sensors[sensor - 1u].steps = min(sensors[sensor - 1u].steps, 0xfffffffeu) + 1u;
        }
        storageBarrier();
    }
}

fn is_gradient_finite(v: u32) -> bool {
    let low = gradients[2u * v];
    let high = gradients[2u * v + 1u];
    return is_finite(low.x) && is_finite(low.y) && is_finite(low.z) && is_finite(low.w) && is_finite(high.x)
        && is_finite(high.y) && is_finite(high.z);
}

// The renderer's gradient of number k: of the pose, the focal length, or the clock, which moves the camera.
fn gradient_of(v: u32, camera: u32, k: u32) -> f32 {
    if k < 7u {
        return gradients[2u * v + k / 4u][k % 4u];
    }
    let shift = gradients[2u * v].xyz;
    let turn = vec3<f32>(gradients[2u * v].w, gradients[2u * v + 1u].xy);
    return dot(shift, cameras[camera].shift_per_second) + dot(turn, cameras[camera].turn_per_second);
}

// Adam. A motion of the camera has the gradient of its pose with the sign turned; a focal length has its own.
fn update(at: u32, k: u32, of_renderer: f32) {
    let gradient = select(-of_renderer, of_renderer, k == 6u);
    let age = min(sensors[at].steps + 1u, 1u << 20u);
    let m = BETA1 * sensors[at].first[k] + (1.0 - BETA1) * gradient;
    let v = BETA2 * sensors[at].second[k] + (1.0 - BETA2) * gradient * gradient;
    let size = sqrt(v / (1.0 - power(BETA2, age))) + EPSILON;
    let step = constants.rate * sensors[at].rates[k] * (m / (1.0 - power(BETA1, age))) / size;
    sensors[at].values[k] = (1.0 - constants.decay * sensors[at].share) * sensors[at].values[k] - step;
    sensors[at].first[k] = m;
    sensors[at].second[k] = v;
}

@compute @workgroup_size(256)
fn sum_displacements(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let camera = thread_number(group, groups, local);
    if camera >= constants.cameras {
        return;
    }
    let sensor = cameras[camera].sensor;
    let shift = cameras[camera].shift_per_second;
    let turn = cameras[camera].turn_per_second;
    let per_second = array<f32, 8>(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z, 0.0, 0.0);
    for (var k = 0u; k < 8u; k++) {
        var sum = 0.0;
        if k < 6u {
            sum = own[6u * camera + k];
        }
        if sensor != 0u && k < 7u {
            sum += fma(sensors[sensor - 1u].values[7], per_second[k], sensors[sensor - 1u].values[k]);
        }
        displacements[8u * camera + k] = sum;
    }
}
