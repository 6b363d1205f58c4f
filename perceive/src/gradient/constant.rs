//! Values that do not depend on the input: weights, and the whole numbers with which exporters compute shapes.

use super::onnx::Tensor;

/// A tensor that is known when the graph is loaded.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Constant {
    pub(super) shape: Vec<usize>,
    pub(super) data: Data,
}

/// Numbers by rows, the last side fastest.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Data {
    Floats(Vec<f32>),
    Ints(Vec<i64>),
}

/// ONNX's numbers for types.
pub(super) const FLOAT: i64 = 1;
pub(super) const INT32: i64 = 6;
pub(super) const INT64: i64 = 7;

/// Most sides of a tensor.
pub(super) const MAX_SIDES: usize = 8;

/// Number of elements of a tensor; `None` if it has more than 2³¹, or more sides than any picture needs.
pub(super) fn elements(shape: &[usize]) -> Option<usize> {
    if shape.len() > MAX_SIDES {
        return None;
    }
    let product = shape.iter().try_fold(1usize, |product, &side| product.checked_mul(side))?;
    (product <= 1 << 31).then_some(product)
}

impl Constant {
    pub(super) fn ints(values: Vec<i64>) -> Self {
        Self { shape: vec![values.len()], data: Data::Ints(values) }
    }

    /// The constant in a message. What it takes is bounded by the size of the file.
    pub(super) fn read(tensor: &Tensor) -> Result<Self, String> {
        let name = &tensor.name;
        if tensor.data_location != 0 {
            return Err(format!("has the weights {name} in another file"));
        }
        let shape: Option<Vec<usize>> = tensor.dims.iter().map(|&side| usize::try_from(side).ok()).collect();
        let raw = &tensor.raw_data;
        let data = match i64::from(tensor.data_type) {
            FLOAT if raw.is_empty() => Data::Floats(tensor.float_data.clone()),
            FLOAT => Data::Floats(raw.as_chunks().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect()),
            INT32 if raw.is_empty() => Data::Ints(tensor.int32_data.iter().map(|&i| i.into()).collect()),
            INT32 => Data::Ints(raw.as_chunks().0.iter().map(|&bytes| i32::from_le_bytes(bytes).into()).collect()),
            INT64 if raw.is_empty() => Data::Ints(tensor.int64_data.clone()),
            INT64 => Data::Ints(raw.as_chunks().0.iter().map(|&bytes| i64::from_le_bytes(bytes)).collect()),
            other => return Err(format!("has the constant {name} of ONNX's type {other}, not of 32-bit floats")),
        };
        let constant = Self { shape: shape.unwrap_or_default(), data };
        if elements(&constant.shape) != Some(constant.len()) {
            return Err(format!("has the constant {name} of shape {:?} with {} numbers", tensor.dims, constant.len()));
        }
        Ok(constant)
    }

    pub(super) fn len(&self) -> usize {
        match &self.data {
            Data::Floats(values) => values.len(),
            Data::Ints(values) => values.len(),
        }
    }

    /// Elements that are floats.
    pub(super) fn as_floats(&self) -> Option<&[f32]> {
        match &self.data {
            Data::Floats(values) => Some(values),
            Data::Ints(_) => None,
        }
    }

    /// Elements that are whole numbers.
    pub(super) fn as_ints(&self) -> Option<&[i64]> {
        match &self.data {
            Data::Floats(_) => None,
            Data::Ints(values) => Some(values),
        }
    }
}
