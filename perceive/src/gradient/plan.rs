//! From a file to steps with fixed shapes: constants are folded, nodes that the output does not need are left out, and
//! reshapes are other views of the same numbers.

use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;

use super::arrange::{Pick, picked};
use super::budget::Budget;
use super::constant::{Constant, Data, elements};
use super::onnx::{Graph, Node, decode};
use super::operator::Operator;
use super::selection::{Side, elements_read};

/// What a step reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Input {
    /// A tensor that depends on the network's input, by its number.
    Tensor(usize),
    /// A constant, by its number.
    Constant(usize),
}

/// An operator with its tensors.
pub(super) struct Step {
    pub(super) operator: Box<dyn Operator>,
    pub(super) inputs: Vec<Input>,
    /// The tensor that it writes, which no other step does.
    pub(super) output: usize,
}

/// A network as steps in order.
pub(super) struct Plan {
    pub(super) steps: Vec<Step>,
    /// Elements of each tensor. The first is the input.
    pub(super) lengths: Vec<usize>,
    pub(super) constants: Vec<Vec<f32>>,
    pub(super) input_shape: Vec<usize>,
    pub(super) output_shape: Vec<usize>,
    /// The tensor that is the output.
    pub(super) output: usize,
    /// Multiply-adds of a forward pass.
    pub(super) work: usize,
}

/// The value of a name.
#[derive(Clone)]
pub(super) enum Value {
    Constant(Rc<Constant>),
    /// A tensor by its number, and its shape here.
    Live(usize, Vec<usize>),
}

/// A step that may still change: picks of picks become one.
enum Draft {
    Operator(Box<dyn Operator>),
    Pick(Vec<u32>),
}

/// A graph that is being read, node by node.
#[derive(Default)]
pub(super) struct Builder {
    /// Version of the standard operators.
    pub(super) version: i64,
    pub(super) budget: Budget,
    values: BTreeMap<String, Value>,
    /// For each output of a Sigmoid the name of its input.
    pub(super) sigmoids: BTreeMap<String, String>,
    steps: Vec<(Draft, Vec<Input>, usize)>,
    lengths: Vec<usize>,
    constants: Vec<Vec<f32>>,
}

impl Value {
    pub(super) fn shape(&self) -> &[usize] {
        match self {
            Self::Constant(constant) => &constant.shape,
            Self::Live(_, shape) => shape,
        }
    }

    pub(super) fn constant(shape: Vec<usize>, data: Data) -> Self {
        Self::Constant(Rc::new(Constant { shape, data }))
    }
}

impl Builder {
    /// The steps of the graph in a file; `read` gives the values of a node's outputs.
    pub(super) fn plan(
        bytes: &[u8],
        read: impl Fn(&mut Self, &Node) -> Result<Vec<Value>, String>,
    ) -> Result<Plan, String> {
        let (graph, version) = decode(bytes)?;
        let mut builder = Self { version, ..Self::default() };
        for tensor in &graph.initializer {
            builder.values.insert(tensor.name.clone(), Value::Constant(Rc::new(Constant::read(tensor)?)));
        }
        // Old files list the weights as inputs, too.
        let inputs: Vec<_> = graph.input.iter().filter(|input| !builder.values.contains_key(&input.name)).collect();
        let ([input], [output]) = (&inputs[..], &graph.output[..]) else {
            return Err(format!("has {} inputs and {} outputs, not one of each", inputs.len(), graph.output.len()));
        };
        let input_shape = input.sides().ok_or("has an input whose sides are not all fixed")?;
        let first = builder.tensor(&input_shape)?;
        builder.values.insert(input.name.clone(), Value::Live(first, input_shape.clone()));
        let needed = needed(&graph, &output.name);
        for (node, _) in graph.node.iter().zip(needed).filter(|(_, is_needed)| *is_needed) {
            if !matches!(node.domain.as_str(), "" | "ai.onnx") {
                return Err(format!(
                    "has the operator {} of {}, whose gradient plat does not know",
                    node.op_type, node.domain
                ));
            }
            let values = read(&mut builder, node)?;
            builder.values.extend(node.output.iter().cloned().zip(values));
        }
        match builder.values.remove(&output.name) {
            Some(Value::Live(output, output_shape)) => builder.finish(input_shape, output, output_shape),
            _ => Err("has an output that does not depend on its input".to_owned()),
        }
    }

    /// Leaves out steps that the output does not need, and fixes the others.
    fn finish(mut self, input_shape: Vec<usize>, output: usize, output_shape: Vec<usize>) -> Result<Plan, String> {
        let mut needed = BTreeSet::from([output]);
        let mut steps = Vec::new();
        for (draft, inputs, output) in self.steps.into_iter().rev() {
            if !needed.contains(&output) {
                self.lengths[output] = 0;
                continue;
            }
            needed.extend(inputs.iter().filter_map(|input| match input {
                Input::Tensor(tensor) => Some(*tensor),
                Input::Constant(_) => None,
            }));
            let operator: Box<dyn Operator> = match draft {
                Draft::Operator(operator) => operator,
                Draft::Pick(from) => {
                    let length = match inputs[..] {
                        [Input::Tensor(tensor)] => self.lengths[tensor],
                        _ => 0,
                    };
                    self.budget.take(Pick::most_read(&from, length).checked_mul(length))?;
                    Box::new(Pick::new(from, length))
                }
            };
            steps.push(Step { operator, inputs, output });
        }
        steps.reverse();
        let work = self.budget.worked();
        Ok(Plan { steps, lengths: self.lengths, constants: self.constants, input_shape, output_shape, output, work })
    }

    /// Input number `i` of a node.
    pub(super) fn input(&self, node: &Node, i: usize) -> Result<Value, String> {
        self.optional(node, i)?.ok_or_else(|| format!("has a {} without its input {i}", node.op_type))
    }

    /// Input number `i` of a node, if it has one.
    pub(super) fn optional(&self, node: &Node, i: usize) -> Result<Option<Value>, String> {
        let Some(name) = node.input.get(i).filter(|name| !name.is_empty()) else { return Ok(None) };
        let no = || format!("has a {} of {name}, which nothing before it gives", node.op_type);
        self.values.get(name).cloned().map(Some).ok_or_else(no)
    }

    /// The whole numbers of input number `i`, if there is one.
    pub(super) fn ints(&self, node: &Node, i: usize) -> Result<Option<Vec<i64>>, String> {
        match self.optional(node, i)? {
            None => Ok(None),
            Some(Value::Constant(constant)) if constant.as_ints().is_some() => {
                Ok(constant.as_ints().map(<[i64]>::to_vec))
            }
            Some(_) => Err(format!("has a {} whose input {i} is not made of constant whole numbers", node.op_type)),
        }
    }

    /// The constant floats of input number `i` with their shape, if there is one.
    pub(super) fn floats(&self, node: &Node, i: usize) -> Result<Option<Rc<Constant>>, String> {
        match self.optional(node, i)? {
            None => Ok(None),
            Some(Value::Constant(constant)) if constant.as_floats().is_some() => Ok(Some(constant)),
            Some(_) => Err(format!("has a {} whose input {i} is not made of constant floats", node.op_type)),
        }
    }

    /// A new tensor of this shape.
    fn tensor(&mut self, shape: &[usize]) -> Result<usize, String> {
        let length = elements(shape);
        if length == Some(0) {
            return Err(format!("has an empty tensor, of shape {shape:?}"));
        }
        self.budget.take(length)?;
        self.lengths.push(length.unwrap_or(0));
        Ok(self.lengths.len() - 1)
    }

    /// The value of an operator, which is run now if its inputs are constants.
    pub(super) fn apply(
        &mut self,
        operator: impl Operator + 'static,
        of: &[Value],
        shape: Vec<usize>,
    ) -> Result<Value, String> {
        let no = || "has arithmetic between floats and whole numbers".to_owned();
        let constant = |value: &Value| match value {
            Value::Constant(constant) => Some(constant.clone()),
            Value::Live(..) => None,
        };
        if let Some(constants) = of.iter().map(constant).collect::<Option<Vec<_>>>() {
            let inputs: Option<Vec<&[f32]>> = constants.iter().map(|constant| constant.as_floats()).collect();
            let length = elements(&shape);
            self.budget.take(length)?;
            let mut output = vec![0.0; length.unwrap_or(0)];
            let inputs = inputs.ok_or_else(no)?;
            if !output.is_empty() {
                operator.forward(&inputs, &mut output);
            }
            return Ok(Value::constant(shape, Data::Floats(output)));
        }
        let mut inputs = Vec::new();
        for value in of {
            inputs.push(match value {
                Value::Live(tensor, _) => Input::Tensor(*tensor),
                Value::Constant(constant) => {
                    self.budget.take(Some(constant.len()))?;
                    self.constants.push(constant.as_floats().ok_or_else(no)?.to_vec());
                    Input::Constant(self.constants.len() - 1)
                }
            });
        }
        let output = self.tensor(&shape)?;
        self.steps.push((Draft::Operator(Box::new(operator)), inputs, output));
        Ok(Value::Live(output, shape))
    }

    /// The elements of a value that the sides read.
    pub(super) fn pick(&mut self, value: &Value, sides: &[Side]) -> Result<Value, String> {
        let shape: Vec<usize> = sides.iter().map(|side| side.length).collect();
        // Twice: the elements read are gathered side by side.
        let length = sides.iter().try_fold(2usize, |product, side| product.checked_mul(side.length.max(1)));
        self.budget.take(length)?;
        let mut from = elements_read(sides);
        match value {
            Value::Constant(constant) => Ok(Value::constant(
                shape,
                match &constant.data {
                    Data::Floats(values) => Data::Floats(picked(&from, values, 0.0)),
                    Data::Ints(values) => Data::Ints(picked(&from, values, 0)),
                },
            )),
            Value::Live(tensor, _) => {
                let mut input = Input::Tensor(*tensor);
                // Every tensor but the first has its step.
                let before = tensor.checked_sub(1).and_then(|step| self.steps.get(step));
                if let Some((Draft::Pick(before), inputs, _)) = before {
                    from = picked(&from, before, super::arrange::NONE);
                    input = inputs[0];
                }
                let output = self.tensor(&shape)?;
                self.steps.push((Draft::Pick(from), vec![input], output));
                Ok(Value::Live(output, shape))
            }
        }
    }

    /// The same numbers in another shape of as many elements.
    pub(super) fn reshape(&mut self, value: Value, shape: Vec<usize>) -> Result<Value, String> {
        if elements(&shape) != elements(value.shape()) {
            return Err(format!("has a tensor of {:?} made one of {shape:?}", value.shape()));
        }
        match value {
            Value::Constant(constant) => {
                self.budget.take(Some(2 * constant.len()))?;
                Ok(Value::constant(shape, constant.data.clone()))
            }
            Value::Live(tensor, _) => Ok(Value::Live(tensor, shape)),
        }
    }
}

/// Which nodes the output needs.
fn needed(graph: &Graph, output: &str) -> Vec<bool> {
    let mut names = BTreeSet::from([output]);
    let mut needed = vec![false; graph.node.len()];
    for (node, is_needed) in graph.node.iter().zip(&mut needed).rev() {
        *is_needed = node.output.iter().any(|name| names.contains(name.as_str()));
        if *is_needed {
            names.extend(node.input.iter().map(String::as_str));
        }
    }
    needed
}
