//! Files that are damaged or ask for too much.

use proptest::prelude::*;

use super::graphs::{file, floats, int, ints, node, whole};
use crate::gradient::onnx::{Node, Tensor};
use crate::gradient::{Activations, Network};

fn refused(input: &[i64], nodes: Vec<Node>, constants: Vec<Tensor>) -> String {
    let error = Network::load(&file(13, input, nodes, constants)).err().expect("refused");
    assert!(!error.contains('\n'), "{error}");
    error
}

#[test]
fn what_is_unknown_is_named() {
    let one = |operator: &str| vec![node(operator, "x", "y", vec![])];
    assert!(refused(&[1, 2], one("Erf"), vec![]).contains("the operator Erf"));
    let custom = Node { domain: "ai.example".into(), ..node("Relu", "x", "y", vec![]) };
    assert!(refused(&[1, 2], vec![custom], vec![]).contains("Relu of ai.example"));
    assert!(refused(&[1, 0], one("Relu"), vec![]).contains("not all fixed"));
    assert!(refused(&[1, 2], vec![node("Relu", "z", "y", vec![])], vec![]).contains("of z, which nothing"));
    assert!(refused(&[1, 2], vec![node("Relu", "c", "y", vec![])], vec![floats("c", &[2])]).contains("depend"));
    assert!(refused(&[1, 2], vec![], vec![]).contains("depend"));
    assert!(
        refused(&[2, 1, 4, 4], vec![node("Conv", "x w", "y", vec![])], vec![floats("w", &[1, 1, 1, 1])])
            .contains("[2, 1, 4, 4]")
    );
}

#[test]
fn what_is_too_large_is_refused_before_it_is_allocated() {
    let relu = || vec![node("Relu", "x", "y", vec![])];
    assert!(refused(&[1, 3, 1 << 20, 1 << 20], relu(), vec![]).contains("MiB"));
    assert!(refused(&[i64::MAX, i64::MAX], relu(), vec![]).contains("MiB"));
    assert!(refused(&[1; 9], relu(), vec![]).contains("MiB"));
    let expand = |to: &[i64]| refused(&[1, 1], vec![node("Expand", "x to", "y", vec![])], vec![whole("to", to)]);
    assert!(expand(&[1 << 40, 1 << 40]).contains("MiB"));
    assert!(expand(&[1 << 30, 1]).contains("MiB"));
    assert!(expand(&[1 << 30, 0]).contains("MiB"));
    let pad = [i64::MAX / 2, 0, 0, 0];
    assert!(refused(&[1, 1], vec![node("Pad", "x by", "y", vec![])], vec![whole("by", &pad)]).contains("MiB"));
    let conv = |attributes| {
        refused(&[1, 1, 4, 4], vec![node("Conv", "x w", "y", attributes)], vec![floats("w", &[1, 1, 3, 3])])
    };
    for (name, values) in [
        ("pads", vec![1 << 40, 0, 0, 0]),
        ("pads", vec![1 << 31, 0, 0, 0]),
        ("pads", vec![-1, 0, 0, 0]),
        ("strides", vec![0, 1]),
        ("strides", vec![1]),
        ("dilations", vec![1 << 31, 1]),
        ("kernel_shape", vec![2, 3]),
    ] {
        conv(vec![ints(name, &values)]);
    }
    conv(vec![int("group", 0)]);
    conv(vec![int("group", 3)]);
    let unsqueeze = vec![node("Unsqueeze", "x axes", "y", vec![])];
    assert!(refused(&[1], unsqueeze, vec![whole("axes", &[0; 1000])]).contains("1001 sides"));
    // Empty constants, alone and beside the input.
    for (operator, inputs) in [("Concat", "none none"), ("Softmax", "none"), ("Add", "x none")] {
        let nodes =
            vec![node(operator, inputs, "c", vec![int("axis", 0)]), node("Concat", "x c", "y", vec![int("axis", 0)])];
        let _ = Network::load(&file(13, &[2], nodes, vec![floats("none", &[0])]));
    }
    // Many nodes that each take a little.
    let doubled = |i: usize| node("Concat", &format!("x{i} x{i}"), &format!("x{}", i + 1), vec![int("axis", 0)]);
    let mut nodes = vec![node("Relu", "x", "x0", vec![])];
    nodes.extend((0..40).map(doubled));
    nodes.push(node("Relu", "x40", "y", vec![]));
    assert!(refused(&[1000], nodes, vec![]).contains("MiB"));
    let heavy = |i: usize| {
        node(
            "MaxPool",
            &format!("x{i}"),
            &format!("x{}", i + 1),
            vec![ints("kernel_shape", &[999, 999]), ints("pads", &[499; 4])],
        )
    };
    let mut nodes = vec![node("Relu", "x", "x0", vec![])];
    nodes.extend((0..4).map(heavy));
    nodes.push(node("Relu", "x4", "y", vec![]));
    assert!(refused(&[1, 1, 1000, 1000], nodes, vec![]).contains("multiply-adds"));
}

fn small() -> Vec<u8> {
    let nodes = vec![
        node("Conv", "x w", "a", vec![ints("strides", &[2, 2]), ints("pads", &[1; 4])]),
        node("MaxPool", "a", "b", vec![ints("kernel_shape", &[2, 2])]),
        node("Reshape", "b to", "c", vec![]),
        node("Slice", "c from end axes", "d", vec![]),
        node("Softmax", "d", "y", vec![]),
    ];
    let constants = vec![
        floats("w", &[4, 2, 3, 3]),
        whole("to", &[1, 4, -1]),
        whole("from", &[1]),
        whole("end", &[9]),
        whole("axes", &[2]),
    ];
    file(13, &[1, 2, 9, 9], nodes, constants)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn damaged_files_do_not_panic(at in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6)) {
        let mut bytes = small();
        for (place, byte) in at {
            let place = place.index(bytes.len());
            bytes[place] = byte;
        }
        if let Ok(network) = Network::load(&bytes) {
            let count: usize = network.input_shape().iter().product();
            if count < 1 << 16 && network.work() < 1 << 24 {
                let mut activations = Activations::default();
                let output = network.forward(&vec![0.5; count], &mut activations).to_vec();
                prop_assert_eq!(network.backward(&mut activations, &output).len(), count);
            }
        }
    }
}
