//! Which elements the operators that rearrange tensors read, side by side.

use super::arrange::NONE;
use super::onnx::Node;

/// One side of an output.
pub(super) struct Side {
    pub(super) length: usize,
    /// Elements of the input from one place of the side that is read to the next.
    pub(super) stride: usize,
    /// The place that is read at each place of the output; [`NONE`] reads zero.
    pub(super) reads: Box<dyn Fn(usize) -> u32>,
}

/// The element that each element of the output reads. The caller has checked the output's size.
pub(super) fn elements_read(sides: &[Side]) -> Vec<u32> {
    sides.iter().fold(vec![0], |starts, side| {
        let places: Vec<u32> = (0..side.length).map(|place| (side.reads)(place)).collect();
        let element = |start: u32, place: u32| match (start, place) {
            (NONE, _) | (_, NONE) => NONE,
            (start, place) => start + place * side.stride as u32,
        };
        starts.iter().flat_map(|&start| places.iter().map(move |&place| element(start, place))).collect()
    })
}

/// The sides of a tensor as they are.
pub(super) fn whole(shape: &[usize]) -> Vec<Side> {
    let stride = |axis: usize| shape[axis + 1..].iter().product();
    let side =
        |(axis, &length): (usize, &usize)| Side { length, stride: stride(axis), reads: Box::new(|place| place as u32) };
    shape.iter().enumerate().map(side).collect()
}

/// An axis counted from the front, or if negative from the back.
pub(super) fn axis_of(axis: i64, sides: usize) -> Result<usize, String> {
    let from_front = if axis < 0 { axis.saturating_add(sides as i64) } else { axis };
    let found = usize::try_from(from_front).ok().filter(|&axis| axis < sides);
    found.ok_or_else(|| format!("has an operator along axis {axis} of a tensor with {sides} sides"))
}

/// `Transpose`: output side `i` is input side `order[i]`.
pub(super) fn transposed(shape: &[usize], order: &[i64]) -> Result<Vec<Side>, String> {
    let mut sides: Vec<Option<Side>> = whole(shape).into_iter().map(Some).collect();
    let no = || format!("has a Transpose to {order:?} of a tensor with {} sides", shape.len());
    let taken: Option<Vec<Side>> =
        order.iter().map(|&axis| sides.get_mut(usize::try_from(axis).ok()?)?.take()).collect();
    taken.filter(|taken| taken.len() == shape.len()).ok_or_else(no)
}

/// `Slice`: from `start` on in steps, up to and without `end`, both counted from the back if negative.
pub(super) fn slice(side: &mut Side, start: i64, end: i64, step: i64) -> Result<(), String> {
    let length = side.length as i64;
    let from_front = |at: i64| if at < 0 { at.saturating_add(length) } else { at };
    let (start, end) = match step {
        1.. => (from_front(start).clamp(0, length), from_front(end).clamp(0, length)),
        0 => return Err("has a Slice of step 0".to_owned()),
        _ => (from_front(start).clamp(0, (length - 1).max(0)), from_front(end).clamp(-1, length - 1)),
    };
    let (distance, size) =
        if step > 0 { (end - start, step.unsigned_abs()) } else { (start - end, step.unsigned_abs()) };
    side.length = (distance.max(0) as u64).div_ceil(size) as usize;
    side.reads = Box::new(move |place| (start + place as i64 * step) as u32);
    Ok(())
}

/// `Gather` along one side.
pub(super) fn gather(side: &mut Side, places: &[i64]) -> Result<(), String> {
    let length = side.length;
    let places: Result<Vec<u32>, String> = places.iter().map(|&place| Ok(axis_of(place, length)? as u32)).collect();
    let places = places.map_err(|_| format!("has a Gather beyond the {length} places of a side"))?;
    side.length = places.len();
    side.reads = Box::new(move |place| places[place]);
    Ok(())
}

/// `Pad` with zeros, or without as many if negative.
pub(super) fn pad(side: &mut Side, before: i64, after: i64) -> Result<(), String> {
    let length = side.length;
    let padded = (length as i64).checked_add(before).and_then(|sum| sum.checked_add(after));
    side.length = padded.and_then(|sum| usize::try_from(sum).ok()).ok_or("has a Pad that leaves nothing")?;
    let place =
        move |place: usize| u32::try_from(place as i64 - before).ok().filter(|&place| (place as usize) < length);
    side.reads = Box::new(move |at| place(at).unwrap_or(NONE));
    Ok(())
}

/// Broadcast of sides of 1, as `Expand` and arithmetic do: the shape that both fit, and the sides of one in it.
pub(super) fn common_shape(a: &[usize], b: &[usize]) -> Result<Vec<usize>, String> {
    let sides = a.len().max(b.len());
    let side = |shape: &[usize], axis: usize| (axis + shape.len()).checked_sub(sides).map_or(1, |axis| shape[axis]);
    let both = |axis: usize| match (side(a, axis), side(b, axis)) {
        (1, b) => Some(b),
        (a, b) if b == 1 || a == b => Some(a),
        _ => None,
    };
    let shape: Option<Vec<usize>> = (0..sides).map(both).collect();
    shape.ok_or_else(|| format!("has an operator of tensors of {a:?} and {b:?}, which do not fit"))
}

/// The sides of a tensor that is repeated to fill `shape`, which it fits.
pub(super) fn broadcast(from: &[usize], shape: &[usize]) -> Vec<Side> {
    let mut padded = vec![1; shape.len().saturating_sub(from.len())];
    padded.extend(from);
    let mut sides = whole(&padded);
    for (side, &length) in sides.iter_mut().zip(shape).filter(|(side, length)| side.length != **length) {
        side.length = length;
        side.reads = Box::new(|_| 0);
    }
    sides
}

/// Nearest `Resize`, which reads at the position of each place under the node's modes, rounded as it says.
pub(super) fn resize(side: &mut Side, node: &Node, scale: f64, length: usize) -> Result<(), String> {
    let coordinates = node
        .text("coordinate_transformation_mode", if node.op_type == "Upsample" { "asymmetric" } else { "half_pixel" });
    let rounding = node.text("nearest_mode", if node.op_type == "Upsample" { "floor" } else { "round_prefer_floor" });
    let from = side.length as f64;
    let to = length as f64;
    let position: Box<dyn Fn(f64) -> f64> = match coordinates {
        "asymmetric" => Box::new(move |x| x / scale),
        "pytorch_half_pixel" if length == 1 => Box::new(|_| 0.0),
        "half_pixel" | "pytorch_half_pixel" => Box::new(move |x| (x + 0.5) / scale - 0.5),
        "align_corners" if length == 1 => Box::new(|_| 0.0),
        "align_corners" => Box::new(move |x| x * (from - 1.0) / (to - 1.0)),
        other => return Err(node.unknown(other)),
    };
    let round: fn(f64) -> f64 = match rounding {
        "floor" => f64::floor,
        "ceil" => f64::ceil,
        "round_prefer_floor" => |x| (x - 0.5).ceil(),
        "round_prefer_ceil" => |x| (x + 0.5).floor(),
        other => return Err(node.unknown(other)),
    };
    side.length = length;
    side.reads = Box::new(move |place| round(position(place as f64)).clamp(0.0, from - 1.0) as u32);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sliced(length: usize, start: i64, end: i64, step: i64) -> Vec<u32> {
        let mut side = whole(&[length]);
        slice(&mut side[0], start, end, step).unwrap();
        elements_read(&side)
    }

    #[test]
    fn slices_are_those_of_onnx() {
        assert_eq!(sliced(5, 1, i64::MAX, 2), [1, 3]);
        assert_eq!(sliced(5, -2, -1, 1), [3]);
        assert_eq!(sliced(5, -1, i64::MIN, -2), [4, 2, 0]);
        assert_eq!(sliced(5, 9, 1, -1), [4, 3, 2]);
        assert_eq!(sliced(5, i64::MIN, i64::MAX, i64::MAX), [0]);
        assert_eq!(sliced(5, 4, 0, i64::MIN), [4]);
        assert!(sliced(5, 3, 1, 1).is_empty());
        assert!(slice(&mut whole(&[5])[0], 0, 5, 0).is_err());
    }

    #[test]
    fn sides_combine_by_rows() {
        let mut sides = transposed(&[2, 3], &[1, 0]).unwrap();
        assert_eq!(elements_read(&sides), [0, 3, 1, 4, 2, 5]);
        gather(&mut sides[0], &[-1, 0]).unwrap();
        pad(&mut sides[1], 1, -1).unwrap();
        assert_eq!(elements_read(&sides), [NONE, 2, NONE, 0]);
        assert_eq!(elements_read(&broadcast(&[2, 1], &[2, 2, 3])), [0, 0, 0, 1, 1, 1, 0, 0, 0, 1, 1, 1]);
        assert_eq!(common_shape(&[3, 1], &[2, 1, 4]), Ok(vec![2, 3, 4]));
        assert!(common_shape(&[3], &[2]).is_err());
        for order in [&[0, 0][..], &[0], &[0, 2], &[-1, 0]] {
            assert!(transposed(&[2, 3], order).is_err());
        }
        assert!(gather(&mut whole(&[2])[0], &[2]).is_err());
        assert!(pad(&mut whole(&[2])[0], i64::MAX, 1).is_err());
    }
}
