//! LPIPS (Zhang et al. 2018): the perceptual distance of two pictures by a network.
//!
//! plat does not ship the weights. `plat eval --help` says how to export the network. The file is any ONNX
//! graph with two float inputs (1, 3, height, width) of sRGB values in -1..1 and one scalar output.

use std::fs::File;
use std::io::Read;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use rten::{Model, NodeId, Value};
use scene::BadInput;

/// LPIPS networks have 10 MB (AlexNet) to 60 MB (VGG).
const FILE_LIMIT: u64 = 1 << 30;
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
        let mut bytes = Vec::new();
        let opened = File::open(path).map(|opened| opened.take(FILE_LIMIT + 1));
        opened
            .and_then(|mut opened| opened.read_to_end(&mut bytes))
            .map_err(|e| bad(format!("cannot be read ({e})")))?;
        if bytes.len() as u64 > FILE_LIMIT {
            return Err(bad(format!("is larger than {} MB", FILE_LIMIT >> 20)));
        }
        let model = without_panic(|| Model::load(bytes).map_err(|error| error.to_string()));
        let model = model.map_err(|error| bad(format!("is not an ONNX graph that can be run ({error})")))?;
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

/// Runs the inference runtime; its panics on unusual graphs become errors.
fn without_panic<T>(work: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let done = catch_unwind(AssertUnwindSafe(work));
    std::panic::set_hook(hook);
    done.unwrap_or_else(|_| Err("the runtime panicked".to_owned()))
}
