//! What each of ONNX's operators is here, after its specification (onnx.ai, operators of version 9 and later).

mod places;
mod windows;

use super::constant::{Constant, Data, FLOAT, INT32, INT64};
use super::onnx::Node;
use super::plan::{Builder, Value};
use super::pointwise::{Binary, Unary};
use super::selection::{broadcast, common_shape};
use places::{concat, gathered, new_shape, rearranged, split};
use windows::{conv, pool, softmax};

/// The values of a node's outputs.
pub(super) fn read(builder: &mut Builder, node: &Node) -> Result<Vec<Value>, String> {
    let one = match node.op_type.as_str() {
        "Constant" => constant(node),
        "Identity" | "Dropout" => builder.input(node, 0),
        "Cast" => cast(builder, node),
        "Shape" => {
            let shape = builder.input(node, 0)?.shape().iter().map(|&side| side as i64).collect();
            Ok(Value::Constant(Constant::ints(shape).into()))
        }
        "Reshape" | "Flatten" | "Squeeze" | "Unsqueeze" => {
            let value = builder.input(node, 0)?;
            let shape = new_shape(builder, node, value.shape())?;
            builder.reshape(value, shape)
        }
        "Slice" | "Transpose" | "Pad" | "Expand" | "Resize" | "Upsample" => rearranged(builder, node),
        "Gather" => gathered(builder, node),
        "Split" => return split(builder, node),
        "Concat" => concat(builder, node),
        "Conv" => conv(builder, node),
        "MaxPool" | "AveragePool" | "GlobalAveragePool" => pool(builder, node),
        "Softmax" => softmax(builder, node),
        "Add" => binary(builder, node, Binary::Add),
        "Sub" => binary(builder, node, Binary::Sub),
        "Mul" => product(builder, node),
        "Div" => binary(builder, node, Binary::Div),
        "Relu" => unary(builder, node, Unary::Relu),
        "LeakyRelu" => unary(builder, node, Unary::LeakyRelu(node.float("alpha", 0.01))),
        "Clip" => clip(builder, node),
        "Exp" => unary(builder, node, Unary::Exp),
        "Tanh" => unary(builder, node, Unary::Tanh),
        "Sigmoid" => {
            builder.sigmoids.insert(node.output[0].clone(), node.input.first().cloned().unwrap_or_default());
            unary(builder, node, Unary::Sigmoid)
        }
        other => Err(format!("has the operator {other}, whose gradient plat does not know")),
    };
    Ok(vec![one?])
}

fn constant(node: &Node) -> Result<Value, String> {
    let tensor = node.get("value").and_then(|value| value.t.as_ref());
    let of = |data: Data, shape: Vec<usize>| Ok(Value::constant(shape, data));
    if let Some(tensor) = tensor {
        return Ok(Value::Constant(Constant::read(tensor)?.into()));
    }
    if let Some(value) = node.get("value_ints") {
        return Ok(Value::Constant(Constant::ints(value.ints.clone()).into()));
    }
    if let Some(value) = node.get("value_floats") {
        return of(Data::Floats(value.floats.clone()), vec![value.floats.len()]);
    }
    match (node.get("value_int"), node.get("value_float")) {
        (Some(value), _) => of(Data::Ints(vec![value.i]), Vec::new()),
        (_, Some(value)) => of(Data::Floats(vec![value.f]), Vec::new()),
        _ => Err(node.unknown("no numbers")),
    }
}

fn cast(builder: &Builder, node: &Node) -> Result<Value, String> {
    let data = |constant: &Constant, to: i64| match (&constant.data, to) {
        (Data::Floats(values), INT32 | INT64) => Some(Data::Ints(values.iter().map(|&value| value as i64).collect())),
        (Data::Ints(values), FLOAT) => Some(Data::Floats(values.iter().map(|&value| value as f32).collect())),
        (data, FLOAT | INT32 | INT64) => Some(data.clone()),
        _ => None,
    };
    let to = node.int("to", 0);
    match builder.input(node, 0)? {
        live @ Value::Live(..) if to == FLOAT => Ok(live),
        Value::Constant(constant) if data(&constant, to).is_some() => {
            let shape = constant.shape.clone();
            Ok(data(&constant, to).map_or(Value::Constant(constant), |data| Value::constant(shape, data)))
        }
        _ => Err(node.unknown(&format!("ONNX's type {to}"))),
    }
}

fn unary(builder: &mut Builder, node: &Node, operator: Unary) -> Result<Value, String> {
    let value = builder.input(node, 0)?;
    let shape = value.shape().to_vec();
    builder.apply(operator, &[value], shape)
}

fn clip(builder: &mut Builder, node: &Node) -> Result<Value, String> {
    let bound = |i: usize, name: &str, default: f32| {
        let given = builder.floats(node, i)?.and_then(|bound| bound.as_floats()?.first().copied());
        Ok::<f32, String>(given.unwrap_or(node.float(name, default)))
    };
    let (low, high) = (bound(1, "min", f32::MIN)?, bound(2, "max", f32::MAX)?);
    unary(builder, node, Unary::Clip(low, high))
}

/// x · Sigmoid(x) is one function; its Sigmoid is left out where nothing else needs it.
fn product(builder: &mut Builder, node: &Node) -> Result<Value, String> {
    if let [a, b] = &node.input[..] {
        let is_silu = |x: &String, s: &String| builder.sigmoids.get(s) == Some(x);
        if is_silu(a, b) {
            return unary(builder, node, Unary::Silu);
        }
        if is_silu(b, a) {
            let value = builder.input(node, 1)?;
            let shape = value.shape().to_vec();
            return builder.apply(Unary::Silu, &[value], shape);
        }
    }
    binary(builder, node, Binary::Mul)
}

fn binary(builder: &mut Builder, node: &Node, operator: Binary) -> Result<Value, String> {
    let values = [builder.input(node, 0)?, builder.input(node, 1)?];
    let shape = common_shape(values[0].shape(), values[1].shape())?;
    let mut fitted = Vec::new();
    for value in values {
        let is_whole = value.shape() == shape;
        fitted.push(if is_whole { value } else { builder.pick(&value, &broadcast(value.shape(), &shape))? });
    }
    if let [Value::Constant(a), Value::Constant(b)] = &fitted[..]
        && let (Some(a), Some(b)) = (a.as_ints(), b.as_ints())
    {
        let value = |(&a, &b): (&i64, &i64)| match operator {
            Binary::Add => a.checked_add(b),
            Binary::Sub => a.checked_sub(b),
            Binary::Mul => a.checked_mul(b),
            Binary::Div => a.checked_div(b),
        };
        let ints: Option<Vec<i64>> = a.iter().zip(b).map(value).collect();
        let ints = ints.ok_or_else(|| node.unknown("whole numbers that overflow"))?;
        return Ok(Value::constant(shape, Data::Ints(ints)));
    }
    builder.apply(operator, &fitted, shape)
}
