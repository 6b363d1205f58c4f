//! What each of ONNX's operators is here, after its specification (onnx.ai, operators of version 9 and later).

use super::arrange::Concat;
use super::axis::Axis;
use super::constant::{Constant, Data, FLOAT, INT32, INT64, elements};
use super::conv::Conv;
use super::depthwise::Depthwise;
use super::onnx::Node;
use super::plan::{Builder, Value};
use super::pointwise::{Binary, Unary};
use super::pool::{AveragePool, MaxPool};
use super::selection::{axis_of, broadcast, common_shape, gather, pad, resize, slice, transposed, whole};
use super::softmax::Softmax;

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

fn unknown(node: &Node, what: &str) -> String {
    format!("has a {} with {what}, whose gradient plat does not know", node.op_type)
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
        _ => Err(unknown(node, "no numbers")),
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
        _ => Err(unknown(node, &format!("ONNX's type {to}"))),
    }
}

/// The shape that an operator gives which leaves the elements as they are.
fn new_shape(builder: &Builder, node: &Node, shape: &[usize]) -> Result<Vec<usize>, String> {
    let sides = shape.len();
    // From version 13 on the axes are an input.
    let axes = match node.get("axes") {
        Some(axes) => Some(axes.ints.clone()),
        None if matches!(node.op_type.as_str(), "Squeeze" | "Unsqueeze") => builder.ints(node, 1)?,
        None => None,
    };
    match node.op_type.as_str() {
        "Flatten" => {
            let axis = node.int("axis", 1);
            let axis = if axis == sides as i64 { sides } else { axis_of(axis, sides)? };
            Ok(vec![shape[..axis].iter().product(), shape[axis..].iter().product()])
        }
        "Squeeze" => {
            let axes: Option<Vec<usize>> =
                axes.map(|axes| axes.iter().map(|&axis| axis_of(axis, sides)).collect()).transpose()?;
            let is_dropped = |axis: usize| shape[axis] == 1 && axes.as_ref().is_none_or(|axes| axes.contains(&axis));
            Ok((0..sides).filter(|&axis| !is_dropped(axis)).map(|axis| shape[axis]).collect())
        }
        "Unsqueeze" => {
            let axes = axes.unwrap_or_default();
            let sides = sides + axes.len();
            let axes: Vec<usize> = axes.iter().map(|&axis| axis_of(axis, sides)).collect::<Result<_, _>>()?;
            let mut old = shape.iter();
            Ok((0..sides).map(|axis| if axes.contains(&axis) { 1 } else { *old.next().unwrap_or(&1) }).collect())
        }
        _ => {
            let wanted = builder.ints(node, 1)?.ok_or("has a Reshape without a shape")?;
            let side = |(axis, &side): (usize, &i64)| match side {
                0 if node.int("allowzero", 0) == 0 => shape.get(axis).copied(),
                -1 => Some(1),
                side => usize::try_from(side).ok(),
            };
            let no = || format!("has a Reshape of {shape:?} to {wanted:?}");
            let mut new: Vec<usize> = wanted.iter().enumerate().map(side).collect::<Option<_>>().ok_or_else(no)?;
            if let Some(open) = wanted.iter().position(|&side| side == -1) {
                let (all, known) = (elements(shape), elements(&new).filter(|&known| known > 0));
                new[open] = all.zip(known).map(|(all, known)| all / known).ok_or_else(no)?;
            }
            Ok(new)
        }
    }
}

/// The operators that read elements side by side, and have one output.
fn rearranged(builder: &mut Builder, node: &Node) -> Result<Value, String> {
    let value = builder.input(node, 0)?;
    let shape = value.shape().to_vec();
    let mut sides = whole(&shape);
    match node.op_type.as_str() {
        "Transpose" => {
            let reversed = || (0..shape.len() as i64).rev().collect();
            sides = transposed(&shape, &node.get("perm").map_or_else(reversed, |perm| perm.ints.clone()))?;
        }
        "Slice" => {
            let no = || unknown(node, "neither starts nor ends");
            let [starts, ends] = [1, 2].map(|i| builder.ints(node, i));
            let (starts, ends) = (starts?.ok_or_else(no)?, ends?.ok_or_else(no)?);
            let axes = builder.ints(node, 3)?.unwrap_or_else(|| (0..starts.len() as i64).collect());
            let steps = builder.ints(node, 4)?.unwrap_or_else(|| vec![1; starts.len()]);
            for (((axis, start), end), step) in axes.iter().zip(&starts).zip(&ends).zip(&steps) {
                slice(&mut sides[axis_of(*axis, shape.len())?], *start, *end, *step)?;
            }
        }
        "Pad" => {
            let fill = builder.floats(node, 2)?.and_then(|fill| fill.as_floats()?.first().copied());
            if node.text("mode", "constant") != "constant" || fill.unwrap_or(node.float("value", 0.0)) != 0.0 {
                return Err(unknown(node, "other than zeros"));
            }
            let pads = match node.get("pads") {
                Some(pads) => pads.ints.clone(),
                None => builder.ints(node, 1)?.unwrap_or_default(),
            };
            let axes = builder.ints(node, 3)?.unwrap_or_else(|| (0..shape.len() as i64).collect());
            if pads.len() != 2 * axes.len() {
                return Err(unknown(node, "pads that do not fit"));
            }
            for (i, axis) in axes.iter().enumerate() {
                pad(&mut sides[axis_of(*axis, shape.len())?], pads[i], pads[i + axes.len()])?;
            }
        }
        "Expand" => {
            let wanted = builder.ints(node, 1)?.unwrap_or_default();
            let wanted: Option<Vec<usize>> = wanted.iter().map(|&side| usize::try_from(side).ok()).collect();
            let common = common_shape(&shape, &wanted.ok_or_else(|| unknown(node, "a negative shape"))?)?;
            sides = broadcast(&shape, &common);
        }
        _ => {
            // Resize has a region of interest before its scales since version 11.
            let at = if node.op_type == "Resize" && builder.version >= 11 { 2 } else { 1 };
            if node.text("mode", "nearest") != "nearest" || node.get("axes").is_some() {
                return Err(unknown(node, "a mode other than nearest"));
            }
            let scales = builder.floats(node, at)?;
            let scales = scales.as_ref().and_then(|scales| scales.as_floats()).filter(|scales| !scales.is_empty());
            let sizes = builder.ints(node, at + 1)?.unwrap_or_default();
            for (axis, side) in sides.iter_mut().enumerate() {
                let old = side.length as f64;
                let scale = scales.map_or_else(
                    || sizes.get(axis).map(|&size| size as f64 / old),
                    |scales| scales.get(axis).map(|&scale| f64::from(scale)),
                );
                let scale = scale.filter(|scale| scale.is_finite() && *scale > 0.0);
                let scale = scale.ok_or_else(|| unknown(node, "scales that do not fit"))?;
                let length = if scales.is_some() { (old * scale).floor() } else { (old * scale).round() };
                if scale != 1.0 {
                    resize(side, node, scale, length as usize)?;
                }
            }
        }
    }
    builder.pick(&value, &sides)
}

fn gathered(builder: &mut Builder, node: &Node) -> Result<Value, String> {
    let value = builder.input(node, 0)?;
    let shape = value.shape().to_vec();
    let axis = axis_of(node.int("axis", 0), shape.len())?;
    let places = builder.ints(node, 1)?.unwrap_or_default();
    let of_places = builder.input(node, 1)?.shape().to_vec();
    let mut sides = whole(&shape);
    gather(&mut sides[axis], &places)?;
    let picked = builder.pick(&value, &sides)?;
    builder.reshape(picked, [&shape[..axis], &of_places, &shape[axis + 1..]].concat())
}

fn split(builder: &mut Builder, node: &Node) -> Result<Vec<Value>, String> {
    let value = builder.input(node, 0)?;
    let shape = value.shape().to_vec();
    let axis = axis_of(node.int("axis", 0), shape.len())?;
    let parts = node.output.len();
    let equal = || vec![shape[axis].div_ceil(parts) as i64; parts];
    let lengths = match node.get("split") {
        Some(split) => split.ints.clone(),
        None => builder.ints(node, 1)?.unwrap_or_else(equal),
    };
    let mut start = 0i64;
    let mut values = Vec::new();
    for length in lengths {
        let end = start.saturating_add(length);
        let mut sides = whole(&shape);
        slice(&mut sides[axis], start, end, 1)?;
        values.push(builder.pick(&value, &sides)?);
        start = end;
    }
    if values.len() != parts {
        return Err(unknown(node, "lengths that do not fit"));
    }
    Ok(values)
}

fn concat(builder: &mut Builder, node: &Node) -> Result<Value, String> {
    let values: Vec<Value> = (0..node.input.len()).map(|i| builder.input(node, i)).collect::<Result<_, _>>()?;
    let mut shape = values.first().ok_or_else(|| unknown(node, "nothing"))?.shape().to_vec();
    let axis = axis_of(node.int("axis", 0), shape.len())?;
    let fits = |of: &[usize]| of.len() == shape.len() && (0..of.len()).all(|i| i == axis || of[i] == shape[i]);
    if !values.iter().all(|value| fits(value.shape())) {
        return Err(unknown(node, "tensors that do not fit"));
    }
    let all_ints = |value: &Value| match value {
        Value::Constant(constant) if constant.shape.len() == 1 => constant.as_ints().map(<[i64]>::to_vec),
        _ => None,
    };
    if let Some(ints) = values.iter().map(all_ints).collect::<Option<Vec<_>>>() {
        return Ok(Value::Constant(Constant::ints(ints.concat()).into()));
    }
    let inner = elements(&shape[axis + 1..]).unwrap_or(0);
    let lengths = values.iter().map(|value| value.shape()[axis] * inner).collect();
    shape[axis] = values.iter().map(|value| value.shape()[axis]).sum();
    builder.apply(Concat { lengths }, &values, shape)
}

/// The axes of a window on a picture: sides 2 and 3 of a tensor with four.
fn window(node: &Node, shape: &[usize], kernel: [usize; 2]) -> Result<[Axis; 2], String> {
    if !matches!(node.text("auto_pad", "NOTSET"), "NOTSET" | "VALID") {
        return Err(unknown(node, "automatic pads"));
    }
    let [strides, dilations] = [node.sizes::<2>("strides", 1)?, node.sizes::<2>("dilations", 1)?];
    let pads = node.sizes::<4>("pads", 0)?;
    let ceil = node.int("ceil_mode", 0) != 0;
    let axis = |i: usize| Axis::new(shape[2 + i], kernel[i], strides[i], dilations[i], [pads[i], pads[2 + i]], ceil);
    Ok([axis(0)?, axis(1)?])
}

/// A picture's shape: one, channels, height, width.
fn picture(node: &Node, value: &Value) -> Result<[usize; 4], String> {
    let shape = <[usize; 4]>::try_from(value.shape()).ok().filter(|shape| shape[0] == 1);
    shape.ok_or_else(|| unknown(node, &format!("a tensor of {:?}", value.shape())))
}

fn conv(builder: &mut Builder, node: &Node) -> Result<Value, String> {
    let value = builder.input(node, 0)?;
    let shape = picture(node, &value)?;
    let weights = builder.floats(node, 1)?.ok_or_else(|| unknown(node, "no weights"))?;
    let bias = builder.floats(node, 2)?;
    let groups = usize::try_from(node.int("group", 1)).unwrap_or(0);
    let no = || unknown(node, &format!("weights of {:?} in {groups} groups for a picture of {shape:?}", weights.shape));
    let Ok([to, from, height, width]) = <[usize; 4]>::try_from(&weights.shape[..]) else { return Err(no()) };
    let fits_groups = groups > 0 && shape[1].is_multiple_of(groups) && to.is_multiple_of(groups);
    if !fits_groups || shape[1] / groups != from || from == 0 || to == 0 {
        return Err(no());
    }
    if node.sizes::<2>("kernel_shape", 0)? != [height, width] && node.get("kernel_shape").is_some() {
        return Err(no());
    }
    let axes = window(node, &shape, [height, width])?;
    let bias = match bias {
        Some(bias) if bias.shape == [to] => bias.as_floats().unwrap_or_default().to_vec(),
        None => vec![0.0; to],
        Some(_) => return Err(no()),
    };
    let outputs = axes.map(|axis| axis.output);
    builder.budget.work(&[to, from, height, width, outputs[0], outputs[1]])?;
    builder.budget.take(Depthwise::room(&axes))?;
    // Weights are kept once for each direction, in blocks of eight rows.
    let kernel = weights.len() / (to * from);
    let blocks = |rows: usize, columns: usize| rows.next_multiple_of(8).checked_mul(columns * kernel * groups);
    builder.budget.take(blocks(to / groups, from))?;
    builder.budget.take(blocks(from, to / groups))?;
    let conv = Conv::new(axes, [shape[1], to], groups, weights.as_floats().unwrap_or_default(), &bias);
    builder.apply(conv, &[value], vec![1, to, outputs[0], outputs[1]])
}

fn pool(builder: &mut Builder, node: &Node) -> Result<Value, String> {
    let value = builder.input(node, 0)?;
    let shape = picture(node, &value)?;
    let is_global = node.op_type.starts_with("Global");
    let kernel = if is_global { [shape[2], shape[3]] } else { node.sizes("kernel_shape", 0)? };
    if node.sizes::<2>("dilations", 1)? != [1, 1] || node.output.len() != 1 {
        return Err(unknown(node, "dilations or indices"));
    }
    let axes = window(node, &shape, kernel)?;
    let [rows, columns] = axes.map(|axis| axis.output);
    builder.budget.work(&[shape[1], rows, columns, kernel[0], kernel[1]])?;
    let out = vec![1, shape[1], rows, columns];
    if node.op_type == "MaxPool" {
        return builder.apply(MaxPool(axes), &[value], out);
    }
    let counts_pads = node.int("count_include_pad", 0) != 0;
    if counts_pads && node.int("ceil_mode", 0) != 0 {
        return Err(unknown(node, "pads that count under ceil_mode"));
    }
    builder.apply(AveragePool { axes, counts_pads }, &[value], out)
}

/// Before version 13 the side and all later ones are one.
fn softmax(builder: &mut Builder, node: &Node) -> Result<Value, String> {
    let value = builder.input(node, 0)?;
    let shape = value.shape().to_vec();
    let is_old = builder.version < 13;
    let axis = axis_of(node.int("axis", if is_old { 1 } else { -1 }), shape.len())?;
    let rest: usize = shape[axis + 1..].iter().product();
    let softmax = if is_old {
        Softmax { length: shape[axis] * rest, stride: 1 }
    } else {
        Softmax { length: shape[axis], stride: rest }
    };
    builder.apply(softmax, &[value], shape)
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
        let ints = ints.ok_or_else(|| unknown(node, "whole numbers that overflow"))?;
        return Ok(Value::constant(shape, Data::Ints(ints)));
    }
    builder.apply(operator, &fitted, shape)
}
