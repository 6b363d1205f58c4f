//! Small graphs written as ONNX files, and the checks that every one passes.

use prost::Message;
use rten::Value;

use crate::gradient::onnx::{
    Attribute, Dimension, Graph, Model, Node, OperatorSet, Shape, Tensor, TensorType, Type, ValueInfo,
};
use crate::gradient::{Activations, Network};
use crate::testing::dot;

/// A node from its operator, inputs (separated by spaces, `-` for none) and attributes.
pub(super) fn node(operator: &str, inputs: &str, output: &str, attribute: Vec<Attribute>) -> Node {
    let names = |names: &str| names.split_whitespace().map(|name| name.replace('-', "")).collect();
    Node { op_type: operator.into(), input: names(inputs), output: names(output), attribute, domain: String::new() }
}

pub(super) fn int(name: &str, i: i64) -> Attribute {
    // 2 is ONNX's number for an attribute of this type, which rten asks for.
    Attribute { name: name.into(), i, r#type: 2, ..Attribute::default() }
}

pub(super) fn float(name: &str, f: f32) -> Attribute {
    Attribute { name: name.into(), f, r#type: 1, ..Attribute::default() }
}

pub(super) fn ints(name: &str, ints: &[i64]) -> Attribute {
    Attribute { name: name.into(), ints: ints.to_vec(), r#type: 7, ..Attribute::default() }
}

pub(super) fn text(name: &str, text: &str) -> Attribute {
    Attribute { name: name.into(), s: text.into(), r#type: 3, ..Attribute::default() }
}

pub(super) fn whole(name: &str, values: &[i64]) -> Tensor {
    let dims = vec![values.len() as i64];
    Tensor { name: name.into(), dims, data_type: 7, int64_data: values.to_vec(), ..Tensor::default() }
}

/// Floats between -1 and 1, none of which is 0.
pub(super) fn floats(name: &str, dims: &[i64]) -> Tensor {
    let count = dims.iter().product::<i64>() as usize;
    let raw_data =
        noise(count, name.len() as u64 + 7).into_iter().flat_map(|w| (0.9 * w - 0.07).to_le_bytes()).collect();
    Tensor { name: name.into(), dims: dims.to_vec(), data_type: 1, raw_data, ..Tensor::default() }
}

/// Numbers between -1 and 1, no two of which are alike.
pub(super) fn noise(count: usize, seed: u64) -> Vec<f32> {
    let mut order: Vec<usize> = (0..count).collect();
    let mut state = seed;
    for i in (1..count).rev() {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        order.swap(i, (state >> 33) as usize % (i + 1));
    }
    order.into_iter().map(|i| (2 * i + 1) as f32 / count as f32 - 1.0).collect()
}

fn value(name: &str, sides: &[i64]) -> ValueInfo {
    let dim = sides.iter().map(|&dim_value| Dimension { dim_value }).collect();
    let tensor_type = Some(TensorType { elem_type: 1, shape: Some(Shape { dim }) });
    ValueInfo { name: name.into(), r#type: Some(Type { tensor_type }) }
}

/// A file with the input `x` and the output `y`.
pub(super) fn file(version: i64, input: &[i64], node: Vec<Node>, initializer: Vec<Tensor>) -> Vec<u8> {
    let output = vec![ValueInfo { name: "y".into(), ..value("y", &[]) }];
    let graph = Graph { node, initializer, input: vec![value("x", input)], output };
    let opset_import = vec![OperatorSet { domain: String::new(), version }];
    Model { ir_version: 6, graph: Some(graph), opset_import }.encode_to_vec()
}

/// Compares the network's output with rten's, and the derivative along random directions with differences.
pub(super) fn check(name: &str, bytes: &[u8]) {
    let network = Network::load(bytes).unwrap_or_else(|error| panic!("{name} {error}"));
    let count: usize = network.input_shape().iter().product();
    // Around 0.31, so that nothing is symmetric.
    let input: Vec<f32> = noise(count, 1).iter().map(|x| 0.9 * x + 0.31).collect();
    let mut activations = Activations::default();
    let output = network.forward(&input, &mut activations).to_vec();
    assert_eq!(output.len(), network.output_shape().iter().product::<usize>(), "{name}");
    let theirs = rten(bytes, network.input_shape(), &input);
    assert_eq!(theirs.len(), output.len(), "{name}");
    let off = output.iter().zip(&theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(
        output.iter().all(|y| y.is_finite()) && off < 1e-5,
        "{name} is off by {off}: {output:?} against {theirs:?}"
    );

    let weights = noise(output.len(), 2);
    let gradient = network.backward(&mut activations, &weights);
    let mut along = |direction: &[f32], step: f32| {
        let moved: Vec<f32> = input.iter().zip(direction).map(|(x, d)| x + step * d).collect();
        dot(network.forward(&moved, &mut activations), &weights)
    };
    let mut worst = 0.0f64;
    for seed in 3..9 {
        // Steps stay below the distance of any two inputs.
        let direction = noise(count, seed);
        let h = 0.4 / count.max(20) as f32;
        let mut slope = |h: f32| (along(&direction, h) - along(&direction, -h)) / (2.0 * f64::from(h));
        // Richardson's extrapolation, exact up to the fourth power of the step.
        let expected = (4.0 * slope(0.5 * h) - slope(h)) / 3.0;
        let size = dot(&gradient, &gradient).sqrt().max(0.1) * dot(&direction, &direction).sqrt();
        worst = worst.max((dot(&gradient, &direction) - expected).abs() / size);
    }
    println!("{name}: off by {off:.1e}, derivative by {worst:.1e}");
    assert!(worst < 2e-4, "{name}: derivative is off by {worst}");
}

/// What rten gives.
pub(super) fn rten(bytes: &[u8], shape: &[usize], input: &[f32]) -> Vec<f32> {
    let model = crate::network::load(bytes.to_vec()).unwrap();
    let input = Value::from_shape(shape, input.to_vec()).unwrap();
    model.run_one(input.into(), None).unwrap().into_tensor::<f32>().unwrap().into_data()
}
