//! LPIPS (Zhang et al. 2018): the perceptual distance of two pictures by a network.
//!
//! plat does not ship the weights. `plat eval --help` says how to export the network. The file is any ONNX
//! graph with two float inputs (1, 3, height, width) of sRGB values in -1..1 and one scalar output.

use std::path::Path;

use perceive::network::{self, without_panic};
use rten::{Model, NodeId, Value};
use scene::BadInput;

use crate::networks::read_network;

const ADVICE: &str = "export the network as plat eval --help says";

/// A network that computes the distance of two pictures.
pub struct Lpips {
    file: String,
    model: Model,
    inputs: [NodeId; 2],
    output: NodeId,
}

impl Lpips {
    /// Loads the network.
    ///
    /// # Errors
    /// A file that cannot be read, is not an ONNX graph, or has other inputs and outputs.
    pub fn load(path: &Path) -> Result<Self, BadInput> {
        let file = path.display().to_string();
        let bad = |problem: String| BadInput::new(file.clone(), problem, ADVICE);
        let model = network::load(read_network(path, ADVICE)?).map_err(bad)?;
        let (&[a, b], &[output]) = (model.input_ids(), model.output_ids()) else {
            let (inputs, outputs) = (model.input_ids().len(), model.output_ids().len());
            return Err(bad(format!("has {inputs} inputs and {outputs} outputs, LPIPS has 2 and 1")));
        };
        Ok(Self { file, model, inputs: [a, b], output })
    }

    /// The distance of two pictures: three planes of sRGB values in 0..1 each, as in [`train::metrics`].
    ///
    /// # Errors
    /// A network that refuses pictures of this size, or whose output is not one finite number.
    pub(crate) fn distance(&self, a: &[f32], b: &[f32], width: usize, height: usize) -> Result<f64, BadInput> {
        let tensor = |image: &[f32]| {
            Value::from_shape(&[1, 3, height, width], image.iter().map(|v| 2.0 * v - 1.0).collect::<Vec<f32>>())
                .map_err(|error| error.to_string())
        };
        let run = || {
            let [first, second] = self.inputs;
            let inputs = vec![(first, tensor(a)?.into()), (second, tensor(b)?.into())];
            let [output] = self.model.run_n(inputs, [self.output], None).map_err(|error| error.to_string())?;
            let values = output.into_tensor::<f32>().ok_or("its output is not made of floats")?.into_data();
            match values[..] {
                [value] if value.is_finite() => Ok(f64::from(value)),
                [_] => Err("its output is not finite".to_owned()),
                _ => Err(format!("its output has {} values", values.len())),
            }
        };
        let bad = |error| format!("does not compare two pictures of {width}×{height} ({error})");
        without_panic(run).map_err(|error| BadInput::new(self.file.clone(), bad(error), ADVICE))
    }
}
