// Constants of Adam, and powers.

const BETA1: f32 = 0.9;
const EPSILON: f32 = 1e-15;

// base^exponent by multiplications only, which rounds alike on every device.
fn power(base: f32, exponent: u32) -> f32 {
    var result = 1.0;
    var square = base;
    for (var n = exponent; n > 0u; n >>= 1u) {
        if (n & 1u) == 1u {
            result *= square;
        }
        square *= square;
    }
    return result;
}
