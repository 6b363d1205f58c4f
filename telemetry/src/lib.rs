//! What happens, for people and their tools: lines of a log, one trace from a submitted job to its artefacts, metrics.
//!
//! ```text
//! events ──filter (RUST_LOG)──▶ lines on stderr, as text or JSON
//! spans ──bounded queue──▶ a thread ──OTLP──▶ a collector            only where OTEL_EXPORTER_OTLP_ENDPOINT names one
//! atomics ◀──GET /metrics── Prometheus                              only where --metrics names an address
//! ```
//!
//! Architecture invariant: whoever is watched never waits for whoever watches. A queue that is full loses spans, a collector that is
//! away costs one line, a scrape reads atomics. No result depends on anything here.

mod lines;
pub mod metrics;
mod otlp;
mod trace;

use std::io::IsTerminal;

use scene::BadInput;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::layer::{Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Registry, fmt};

pub use trace::{HEADER, TraceParent, traced};

/// Whose spans are exported.
const TRACED: [&str; 4] = ["plat", "coordinator", "store", "worker"];

/// What a line of the log looks like.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Format {
    /// For people.
    #[default]
    Text,
    /// An object a line, for tools: `timestamp`, `level`, `target`, `message`, and the fields of the event and of the spans around it.
    Json,
}

/// What a program writes to stderr.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Logs {
    /// What a line looks like.
    pub format: Format,
    /// What is written where `RUST_LOG` does not say.
    pub filter: &'static str,
}

/// What was started, until [`finish`](Telemetry::finish).
#[must_use = "what is not finished loses its last spans"]
pub struct Telemetry {
    traces: Option<otlp::Traces>,
}

/// Begins to write logs, and to export the spans of `service` where the environment asks for it. Once in a process.
///
/// # Errors
/// Variables of the environment that make no sense.
pub fn start(service: &str, logs: Option<Logs>) -> Result<Telemetry, BadInput> {
    let traces = otlp::Traces::from_environment(service)?;
    // That traces go nowhere is said in any case.
    let logs = logs.or(traces.is_some().then_some(Logs { format: Format::Text, filter: "off,telemetry=warn" }));
    let lines = logs.map(|logs| {
        let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(logs.filter));
        let layer: Box<dyn Layer<Registry> + Send + Sync> = match logs.format {
            Format::Text => {
                let ansi = std::io::stderr().is_terminal();
                fmt::layer().with_writer(std::io::stderr).with_ansi(ansi).boxed()
            }
            Format::Json => lines::JsonLines::new(std::io::stderr).boxed(),
        };
        layer.with_filter(filter)
    });
    let spans = traces.as_ref().map(|traces| {
        let ours = Targets::new().with_targets(TRACED.map(|target| (target, LevelFilter::INFO)));
        traces.layer().with_filter(ours)
    });
    if lines.is_some() || spans.is_some() {
        // Another one is there only in tests, which see theirs.
        let _ = tracing_subscriber::registry().with(lines).with(spans).try_init();
    }
    Ok(Telemetry { traces })
}

impl Telemetry {
    /// Exports what waits for it, for as long as that takes a collector that is there.
    pub fn finish(self) {
        if let Some(traces) = self.traces {
            traces.finish();
        }
    }
}
