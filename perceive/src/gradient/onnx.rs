//! The part of ONNX's protobuf messages (`onnx.proto` of ONNX 1.x) that an inference graph needs, and access to a
//! node's attributes. Fields that are not listed are skipped by the decoder.

use prost::Message;

/// The largest file. It bounds what decoding allocates, which is up to about a hundred times as much for a file made of
/// empty messages.
const MAX_FILE: usize = 64 << 20;

#[derive(Clone, PartialEq, Message)]
pub(super) struct Model {
    #[prost(int64, tag = "1")]
    pub(super) ir_version: i64,
    #[prost(message, optional, tag = "7")]
    pub(super) graph: Option<Graph>,
    #[prost(message, repeated, tag = "8")]
    pub(super) opset_import: Vec<OperatorSet>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct OperatorSet {
    /// Empty or `ai.onnx` for the standard operators.
    #[prost(string, tag = "1")]
    pub(super) domain: String,
    #[prost(int64, tag = "2")]
    pub(super) version: i64,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Graph {
    /// Every node stands after those whose outputs it reads.
    #[prost(message, repeated, tag = "1")]
    pub(super) node: Vec<Node>,
    #[prost(message, repeated, tag = "5")]
    pub(super) initializer: Vec<Tensor>,
    #[prost(message, repeated, tag = "11")]
    pub(super) input: Vec<ValueInfo>,
    #[prost(message, repeated, tag = "12")]
    pub(super) output: Vec<ValueInfo>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Node {
    /// Names of values; an optional input that is left out has the empty name.
    #[prost(string, repeated, tag = "1")]
    pub(super) input: Vec<String>,
    #[prost(string, repeated, tag = "2")]
    pub(super) output: Vec<String>,
    #[prost(string, tag = "4")]
    pub(super) op_type: String,
    #[prost(message, repeated, tag = "5")]
    pub(super) attribute: Vec<Attribute>,
    #[prost(string, tag = "7")]
    pub(super) domain: String,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Attribute {
    #[prost(string, tag = "1")]
    pub(super) name: String,
    #[prost(float, tag = "2")]
    pub(super) f: f32,
    #[prost(int64, tag = "3")]
    pub(super) i: i64,
    #[prost(bytes = "vec", tag = "4")]
    pub(super) s: Vec<u8>,
    #[prost(message, optional, boxed, tag = "5")]
    pub(super) t: Option<Box<Tensor>>,
    #[prost(float, repeated, packed = "false", tag = "7")]
    pub(super) floats: Vec<f32>,
    #[prost(int64, repeated, packed = "false", tag = "8")]
    pub(super) ints: Vec<i64>,
    /// Which of these it is.
    #[prost(int32, tag = "20")]
    pub(super) r#type: i32,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Tensor {
    #[prost(int64, repeated, packed = "false", tag = "1")]
    pub(super) dims: Vec<i64>,
    #[prost(int32, tag = "2")]
    pub(super) data_type: i32,
    #[prost(float, repeated, tag = "4")]
    pub(super) float_data: Vec<f32>,
    #[prost(int32, repeated, tag = "5")]
    pub(super) int32_data: Vec<i32>,
    #[prost(int64, repeated, tag = "7")]
    pub(super) int64_data: Vec<i64>,
    #[prost(string, tag = "8")]
    pub(super) name: String,
    /// Little-endian.
    #[prost(bytes = "vec", tag = "9")]
    pub(super) raw_data: Vec<u8>,
    /// 1 if the numbers lie in another file.
    #[prost(int32, tag = "14")]
    pub(super) data_location: i32,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct ValueInfo {
    #[prost(string, tag = "1")]
    pub(super) name: String,
    #[prost(message, optional, tag = "2")]
    pub(super) r#type: Option<Type>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Type {
    #[prost(message, optional, tag = "1")]
    pub(super) tensor_type: Option<TensorType>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct TensorType {
    #[prost(int32, tag = "1")]
    pub(super) elem_type: i32,
    #[prost(message, optional, tag = "2")]
    pub(super) shape: Option<Shape>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Shape {
    #[prost(message, repeated, tag = "1")]
    pub(super) dim: Vec<Dimension>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct Dimension {
    /// 0 if the file leaves it open.
    #[prost(int64, tag = "1")]
    pub(super) dim_value: i64,
}

/// The graph in a file, and the version of its standard operators.
pub(super) fn decode(bytes: &[u8]) -> Result<(Graph, i64), String> {
    if bytes.len() > MAX_FILE {
        return Err(format!("has {} bytes, more than {MAX_FILE}", bytes.len()));
    }
    let model = Model::decode(bytes).map_err(|error| format!("is not an ONNX file ({error})"))?;
    let is_standard = |set: &&OperatorSet| set.domain.is_empty() || set.domain == "ai.onnx";
    let version = model.opset_import.iter().find(is_standard).map_or(1, |set| set.version);
    Ok((model.graph.ok_or("is an ONNX file without a graph")?, version))
}

impl ValueInfo {
    /// The sides of a tensor whose sides are all fixed.
    pub(super) fn sides(&self) -> Option<Vec<usize>> {
        let shape = self.r#type.as_ref()?.tensor_type.as_ref()?.shape.as_ref()?;
        shape.dim.iter().map(|side| usize::try_from(side.dim_value).ok().filter(|&side| side > 0)).collect()
    }
}

impl Node {
    /// The attribute of a name.
    pub(super) fn get(&self, name: &str) -> Option<&Attribute> {
        self.attribute.iter().find(|attribute| attribute.name == name)
    }

    pub(super) fn int(&self, name: &str, default: i64) -> i64 {
        self.get(name).map_or(default, |attribute| attribute.i)
    }

    pub(super) fn float(&self, name: &str, default: f32) -> f32 {
        self.get(name).map_or(default, |attribute| attribute.f)
    }

    /// The attribute's text. Text that is not UTF-8 is no known value of any attribute.
    pub(super) fn text<'a>(&'a self, name: &str, default: &'a str) -> &'a str {
        self.get(name).map_or(default, |attribute| std::str::from_utf8(&attribute.s).unwrap_or("?"))
    }

    /// The error that this node has something which is not known here.
    pub(super) fn unknown(&self, what: &str) -> String {
        format!("has a {} with {what}, whose gradient plat does not know", self.op_type)
    }

    /// Whole numbers of at least 0, `N` of them: as given, or the default `N` times.
    pub(super) fn sizes<const N: usize>(&self, name: &str, default: usize) -> Result<[usize; N], String> {
        let Some(attribute) = self.get(name) else { return Ok([default; N]) };
        let sizes: Option<Vec<usize>> =
            attribute.ints.iter().map(|&i| u32::try_from(i).ok().map(|i| i as usize)).collect();
        let sizes = sizes.and_then(|sizes| <[usize; N]>::try_from(sizes).ok());
        sizes.ok_or_else(|| format!("has {} with {name} {:?}, not {N} sizes", self.op_type, attribute.ints))
    }
}
