//! Every operator: forwards against rten, backwards against finite differences.

use super::graphs::{check, file, float, floats, int, ints, node, text, whole};
use crate::gradient::onnx::{Attribute, Tensor};

/// One node from `x` to `y`.
fn one(operator: &str, inputs: &str, attributes: Vec<Attribute>, input: &[i64], constants: Vec<Tensor>) {
    let bytes = file(13, input, vec![node(operator, inputs, "y", attributes)], constants);
    check(&format!("{operator} of {input:?}"), &bytes);
}

#[test]
fn convolutions() {
    let conv = |input: [i64; 3],
                weights: [i64; 4],
                group: i64,
                strides: [i64; 2],
                pads: [i64; 4],
                dilations: [i64; 2]| {
        let attributes =
            vec![int("group", group), ints("strides", &strides), ints("pads", &pads), ints("dilations", &dilations)];
        let constants = vec![floats("w", &weights), floats("bias", &[weights[0]])];
        one("Conv", "x w bias", attributes, &[1, input[0], input[1], input[2]], constants);
    };
    // Dense: 1×1, the size of panels and blocks and one more, 3×3, stem with stride, everything uneven.
    conv([3, 5, 7], [4, 3, 1, 1], 1, [1, 1], [0; 4], [1, 1]);
    conv([9, 4, 8], [8, 9, 1, 1], 1, [1, 1], [0; 4], [1, 1]);
    conv([5, 11, 13], [9, 5, 1, 1], 1, [1, 1], [0; 4], [1, 1]);
    conv([5, 11, 13], [9, 5, 3, 3], 1, [1, 1], [1; 4], [1, 1]);
    conv([3, 12, 14], [10, 3, 3, 3], 1, [2, 2], [1; 4], [1, 1]);
    conv([3, 30, 41], [4, 3, 3, 3], 1, [2, 2], [1; 4], [1, 1]);
    conv([2, 13, 10], [3, 2, 2, 3], 1, [3, 2], [0, 1, 1, 2], [2, 1]);
    conv([2, 7, 7], [3, 2, 1, 1], 1, [2, 2], [0; 4], [1, 1]);
    // Groups and depthwise.
    conv([6, 5, 5], [4, 3, 3, 3], 2, [1, 1], [1; 4], [1, 1]);
    conv([4, 6, 6], [8, 1, 3, 3], 4, [1, 1], [1; 4], [1, 1]);
    conv([5, 7, 9], [5, 1, 3, 3], 5, [1, 1], [1; 4], [1, 1]);
    conv([3, 8, 11], [3, 1, 5, 5], 3, [1, 1], [2; 4], [1, 1]);
    conv([4, 9, 8], [4, 1, 3, 3], 4, [2, 2], [1; 4], [1, 1]);
    conv([3, 40, 45], [3, 1, 3, 3], 3, [2, 2], [1; 4], [1, 1]);
    conv([2, 12, 13], [2, 1, 3, 2], 2, [2, 3], [0, 1, 2, 0], [2, 1]);
    // Without a bias; rten wants the rest.
    let plain = vec![ints("strides", &[1, 1]), ints("dilations", &[1, 1]), ints("pads", &[0; 4])];
    one("Conv", "x w", plain, &[1, 2, 4, 4], vec![floats("w", &[3, 2, 3, 3])]);
}

#[test]
fn pools() {
    let pool = |operator: &str, kernel: [i64; 2], strides: [i64; 2], pads: [i64; 4], more: Vec<Attribute>| {
        let mut attributes = vec![ints("kernel_shape", &kernel), ints("strides", &strides), ints("pads", &pads)];
        attributes.extend(more);
        one(operator, "x", attributes, &[1, 2, 7, 8], vec![]);
    };
    for operator in ["MaxPool", "AveragePool"] {
        pool(operator, [3, 3], [1, 1], [1; 4], vec![]);
        pool(operator, [5, 5], [1, 1], [2; 4], vec![]);
        pool(operator, [3, 2], [2, 2], [1, 0, 1, 1], vec![]);
        pool(operator, [2, 2], [2, 3], [0; 4], vec![int("ceil_mode", 1)]);
    }
    pool("AveragePool", [3, 3], [2, 2], [1; 4], vec![int("count_include_pad", 1)]);
    one("GlobalAveragePool", "x", vec![], &[1, 3, 4, 5], vec![]);
}

#[test]
fn functions_of_an_element() {
    let shape = [1, 2, 5, 4];
    for operator in ["Relu", "Sigmoid", "Tanh", "Exp"] {
        one(operator, "x", vec![], &shape, vec![]);
    }
    one("LeakyRelu", "x", vec![float("alpha", 0.2)], &shape, vec![]);
    let bound =
        |name: &str, value: f32| Tensor { dims: vec![], raw_data: value.to_le_bytes().into(), ..floats(name, &[1]) };
    one("Clip", "x low high", vec![], &shape, vec![bound("low", -0.22), bound("high", 0.66)]);
    // What exporters write for SiLU, in both orders, and with another reader of the Sigmoid.
    for (inputs, output) in [("x s", "y"), ("s x", "y"), ("x s", "z")] {
        let mut nodes = vec![node("Sigmoid", "x", "s", vec![]), node("Mul", inputs, output, vec![])];
        nodes.extend((output == "z").then(|| node("Add", "z s", "y", vec![])));
        check("SiLU", &file(13, &shape, nodes, vec![]));
    }
}

#[test]
fn functions_of_two() {
    for operator in ["Add", "Sub", "Mul", "Div"] {
        let nodes = vec![node("Exp", "x", "e", vec![]), node(operator, "x e", "y", vec![])];
        check(operator, &file(13, &[1, 2, 3, 4], nodes, vec![]));
        // Both inputs the same tensor; constants before and after, broadcast.
        one(operator, "x x", vec![], &[2, 5], vec![]);
        one(operator, "x c", vec![], &[1, 2, 3, 4], vec![floats("c", &[3, 1])]);
        // A tensor that is broadcast itself.
        let nodes = vec![node("Exp", "x", "e", vec![]), node(operator, "c e", "y", vec![])];
        check(operator, &file(13, &[1, 2, 1, 4], nodes, vec![floats("c", &[2, 3, 1])]));
    }
}

#[test]
fn softmax_before_and_since_version_13() {
    one("Softmax", "x", vec![int("axis", 1)], &[1, 5, 2, 3], vec![]);
    one("Softmax", "x", vec![], &[2, 3, 4], vec![]);
    let old = vec![node("Softmax", "x", "y", vec![int("axis", 3)])];
    check("Softmax", &file(11, &[1, 2, 3, 6], old, vec![]));
}

#[test]
fn elements_in_other_places() {
    one("Transpose", "x", vec![ints("perm", &[0, 2, 3, 1])], &[1, 2, 3, 4], vec![]);
    one("Transpose", "x", vec![], &[2, 3], vec![]);
    let constants =
        vec![whole("from", &[1, -1]), whole("to", &[i64::MAX, 0]), whole("axes", &[2, -1]), whole("by", &[2, -2])];
    one("Slice", "x from to axes by", vec![], &[1, 2, 5, 6], constants);
    one("Gather", "x i", vec![int("axis", 1)], &[2, 3, 2], vec![whole("i", &[2, 0, 2, -3])]);
    let scalar = Tensor { dims: vec![], ..whole("i", &[1]) };
    one("Gather", "x i", vec![int("axis", 0)], &[2, 3, 2], vec![scalar]);
    one("Pad", "x by", vec![], &[1, 2, 3, 3], vec![whole("by", &[0, 0, 1, 2, 0, 1, 0, 1])]);
    one("Expand", "x to", vec![], &[2, 1, 3], vec![whole("to", &[2, 2, 4, 1])]);
    one("Concat", "x x c", vec![int("axis", 1)], &[2, 3, 2], vec![floats("c", &[2, 1, 2])]);
    for (axis, shape) in [(0, [3, 2]), (-1, [2, 3])] {
        let nodes = vec![
            node("Split", "x sizes", "a b", vec![int("axis", axis)]),
            node("Exp", "a", "e", vec![]),
            node("Concat", "b e b", "y", vec![int("axis", axis)]),
        ];
        check("Split", &file(13, &shape, nodes, vec![whole("sizes", &[1, 2])]));
    }
    // A pick of a pick of a reshape.
    let nodes = vec![
        node("Reshape", "x to", "a", vec![]),
        node("Transpose", "a", "b", vec![ints("perm", &[1, 0, 2])]),
        node("Gather", "b i", "c", vec![int("axis", 0)]),
        node("Tanh", "c", "y", vec![]),
    ];
    check("shuffle", &file(13, &[1, 4, 3, 2], nodes, vec![whole("to", &[2, 2, -1]), whole("i", &[1, 0, 1])]));
}

#[test]
fn nearest_resizes() {
    let modes = ["asymmetric", "half_pixel", "align_corners", "pytorch_half_pixel"];
    for mode in modes {
        for nearest in ["floor", "ceil", "round_prefer_floor", "round_prefer_ceil"] {
            let attributes = || {
                vec![
                    text("mode", "nearest"),
                    text("coordinate_transformation_mode", mode),
                    text("nearest_mode", nearest),
                ]
            };
            let scales =
                |values: [f32; 4]| Tensor { raw_data: values.map(f32::to_le_bytes).concat(), ..floats("s", &[4]) };
            one("Resize", "x - s", attributes(), &[1, 2, 3, 4], vec![scales([1.0, 1.0, 2.0, 2.0])]);
            one("Resize", "x - - n", attributes(), &[1, 1, 5, 4], vec![whole("n", &[1, 1, 3, 7])]);
        }
    }
}

#[test]
fn shapes_that_are_computed_are_folded() {
    // What PyTorch writes for x.view(x.size(0), 2, -1) and for an anchor grid.
    let nodes = vec![
        node("Shape", "x", "shape", vec![]),
        node("Gather", "shape zero", "first", vec![]),
        node("Unsqueeze", "first zeros", "batch", vec![]),
        node("Mul", "two one", "half", vec![]),
        node("Concat", "batch half open", "to", vec![int("axis", 0)]),
        node("Reshape", "x to", "r", vec![]),
        node("Cast", "two", "f", vec![int("to", 1)]),
        node("Sigmoid", "f", "s", vec![]),
        node("Mul", "r s", "m", vec![]),
        node("Squeeze", "m zeros", "q", vec![]),
        node("Flatten", "q", "y", vec![int("axis", 0)]),
        // Not needed, and unknown.
        node("NonZero", "x", "none", vec![]),
    ];
    let zero = Tensor { dims: vec![], ..whole("zero", &[0]) };
    let constants = vec![zero, whole("zeros", &[0]), whole("two", &[2]), whole("one", &[1]), whole("open", &[-1])];
    check("shapes", &file(13, &[1, 3, 4], nodes, constants));
}
