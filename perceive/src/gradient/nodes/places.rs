//! Operators that leave numbers as they are and put them in other places or shapes.

use crate::gradient::arrange::Concat;
use crate::gradient::constant::{Constant, MAX_SIDES, elements};
use crate::gradient::onnx::Node;
use crate::gradient::plan::{Builder, Value};
use crate::gradient::selection::{axis_of, broadcast, common_shape, gather, pad, resize, slice, transposed, whole};

/// The shape that an operator gives which leaves the elements as they are.
pub(super) fn new_shape(builder: &Builder, node: &Node, shape: &[usize]) -> Result<Vec<usize>, String> {
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
            if sides > MAX_SIDES {
                return Err(node.unknown(&format!("{sides} sides")));
            }
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
pub(super) fn rearranged(builder: &mut Builder, node: &Node) -> Result<Value, String> {
    let value = builder.input(node, 0)?;
    let shape = value.shape().to_vec();
    let mut sides = whole(&shape);
    match node.op_type.as_str() {
        "Transpose" => {
            let reversed = || (0..shape.len() as i64).rev().collect();
            sides = transposed(&shape, &node.get("perm").map_or_else(reversed, |perm| perm.ints.clone()))?;
        }
        "Slice" => {
            let no = || node.unknown("neither starts nor ends");
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
                return Err(node.unknown("other than zeros"));
            }
            let pads = match node.get("pads") {
                Some(pads) => pads.ints.clone(),
                None => builder.ints(node, 1)?.unwrap_or_default(),
            };
            let axes = builder.ints(node, 3)?.unwrap_or_else(|| (0..shape.len() as i64).collect());
            if pads.len() != 2 * axes.len() {
                return Err(node.unknown("pads that do not fit"));
            }
            for (i, axis) in axes.iter().enumerate() {
                pad(&mut sides[axis_of(*axis, shape.len())?], pads[i], pads[i + axes.len()])?;
            }
        }
        "Expand" => {
            let wanted = builder.ints(node, 1)?.unwrap_or_default();
            let wanted: Option<Vec<usize>> = wanted.iter().map(|&side| usize::try_from(side).ok()).collect();
            let common = common_shape(&shape, &wanted.ok_or_else(|| node.unknown("a negative shape"))?)?;
            sides = broadcast(&shape, &common);
        }
        _ => {
            // Resize has a region of interest before its scales since version 11.
            let at = if node.op_type == "Resize" && builder.version >= 11 { 2 } else { 1 };
            if node.text("mode", "nearest") != "nearest" || node.get("axes").is_some() {
                return Err(node.unknown("a mode other than nearest"));
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
                let scale = scale.ok_or_else(|| node.unknown("scales that do not fit"))?;
                let length = if scales.is_some() { (old * scale).floor() } else { (old * scale).round() };
                if scale != 1.0 {
                    resize(side, node, scale, length as usize)?;
                }
            }
        }
    }
    builder.pick(&value, &sides)
}

pub(super) fn gathered(builder: &mut Builder, node: &Node) -> Result<Value, String> {
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

pub(super) fn split(builder: &mut Builder, node: &Node) -> Result<Vec<Value>, String> {
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
        return Err(node.unknown("lengths that do not fit"));
    }
    Ok(values)
}

pub(super) fn concat(builder: &mut Builder, node: &Node) -> Result<Value, String> {
    let values: Vec<Value> = (0..node.input.len()).map(|i| builder.input(node, i)).collect::<Result<_, _>>()?;
    let mut shape = values.first().ok_or_else(|| node.unknown("nothing"))?.shape().to_vec();
    let axis = axis_of(node.int("axis", 0), shape.len())?;
    let fits = |of: &[usize]| of.len() == shape.len() && (0..of.len()).all(|i| i == axis || of[i] == shape[i]);
    if !values.iter().all(|value| fits(value.shape())) {
        return Err(node.unknown("tensors that do not fit"));
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
