//! Operators with a window on a picture, and Softmax.

use crate::gradient::axis::Axis;
use crate::gradient::conv::Conv;
use crate::gradient::depthwise::Depthwise;
use crate::gradient::onnx::Node;
use crate::gradient::plan::{Builder, Value};
use crate::gradient::pool::{AveragePool, MaxPool};
use crate::gradient::selection::axis_of;
use crate::gradient::softmax::Softmax;

/// The axes of a window on a picture: sides 2 and 3 of a tensor with four.
fn window(node: &Node, shape: &[usize], kernel: [usize; 2]) -> Result<[Axis; 2], String> {
    if !matches!(node.text("auto_pad", "NOTSET"), "NOTSET" | "VALID") {
        return Err(node.unknown("automatic pads"));
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
    shape.ok_or_else(|| node.unknown(&format!("a tensor of {:?}", value.shape())))
}

pub(super) fn conv(builder: &mut Builder, node: &Node) -> Result<Value, String> {
    let value = builder.input(node, 0)?;
    let shape = picture(node, &value)?;
    let weights = builder.floats(node, 1)?.ok_or_else(|| node.unknown("no weights"))?;
    let bias = builder.floats(node, 2)?;
    let groups = usize::try_from(node.int("group", 1)).unwrap_or(0);
    let no = || node.unknown(&format!("weights of {:?} in {groups} groups for a picture of {shape:?}", weights.shape));
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

pub(super) fn pool(builder: &mut Builder, node: &Node) -> Result<Value, String> {
    let value = builder.input(node, 0)?;
    let shape = picture(node, &value)?;
    let is_global = node.op_type.starts_with("Global");
    let kernel = if is_global { [shape[2], shape[3]] } else { node.sizes("kernel_shape", 0)? };
    if node.sizes::<2>("dilations", 1)? != [1, 1] || node.output.len() != 1 {
        return Err(node.unknown("dilations or indices"));
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
        return Err(node.unknown("pads that count under ceil_mode"));
    }
    builder.apply(AveragePool { axes, counts_pads }, &[value], out)
}

/// Before version 13 the side and all later ones are one.
pub(super) fn softmax(builder: &mut Builder, node: &Node) -> Result<Value, String> {
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
