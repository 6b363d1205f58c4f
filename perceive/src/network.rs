//! ONNX graphs run in process by rten, whose panics on unusual graphs become errors.

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Once;

use rten::{Dimension, Model};

thread_local! {
    /// Whether this thread runs the inference runtime.
    static RUNS: Cell<bool> = const { Cell::new(false) };
}
/// Names of the runtime's own threads begin so.
const THREADS: &str = "rten-";

/// Runs the inference runtime; its panics become errors, and print nothing.
///
/// # Errors
/// Those of the work, or its panic.
pub fn without_panic<T>(work: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
    // Set once: workers of one process run networks at the same time, and could not put back each other's hooks.
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let others = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            let is_own = std::thread::current().name().is_some_and(|name| name.starts_with(THREADS));
            if !is_own && !RUNS.get() {
                others(panic);
            }
        }));
    });
    let before = RUNS.replace(true);
    let done = catch_unwind(AssertUnwindSafe(work));
    RUNS.set(before);
    done.unwrap_or_else(|_| Err("the runtime panicked".to_owned()))
}

/// Loads a graph from the bytes of an ONNX file with its weights inside.
///
/// # Errors
/// Not an ONNX graph, or one with operators that the runtime does not know.
pub fn load(bytes: Vec<u8>) -> Result<Model, String> {
    let loaded = without_panic(|| Model::load(bytes).map_err(|error| error.to_string()));
    loaded.map_err(|error| format!("is not an ONNX graph that can be run ({error})"))
}

/// The sides of a graph's inputs and outputs; `None` where the file leaves one open.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shapes {
    /// Of each input.
    pub inputs: Vec<Vec<Option<usize>>>,
    /// Of each output.
    pub outputs: Vec<Vec<Option<usize>>>,
}

impl Shapes {
    /// The shapes that a graph declares. An input or output without a shape has no sides.
    pub fn of(model: &Model) -> Self {
        let side = |dimension: Dimension| match dimension {
            Dimension::Fixed(side) => Some(side),
            Dimension::Symbolic(_) => None,
        };
        let sides = |id: &rten::NodeId| {
            let shape = model.node_info(*id).and_then(|node| node.shape()).unwrap_or_default();
            shape.into_iter().map(side).collect()
        };
        Self {
            inputs: model.input_ids().iter().map(sides).collect(),
            outputs: model.output_ids().iter().map(sides).collect(),
        }
    }
}

impl std::fmt::Display for Shapes {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let show = |shapes: &[Vec<Option<usize>>]| {
            let side = |side: &Option<usize>| side.map_or("?".to_owned(), |side| side.to_string());
            let shape = |sides: &Vec<Option<usize>>| sides.iter().map(side).collect::<Vec<_>>().join("×");
            shapes.iter().map(shape).collect::<Vec<_>>().join(", ")
        };
        write!(f, "{} in, {} out", show(&self.inputs), show(&self.outputs))
    }
}
