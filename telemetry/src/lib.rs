//! Logs, traces (one from a submitted job to its artefacts) and Prometheus metrics.
//!
//! ```text
//! events ──filter (RUST_LOG)──▶ lines on stderr, as text or JSON
//! spans ──bounded queue──▶ a thread ──OTLP──▶ a collector            only where OTEL_EXPORTER_OTLP_ENDPOINT names one
//! atomics ◀──GET /metrics── Prometheus                              only where --metrics names an address
//! ```
//!
//! Architecture invariant: the work never waits for telemetry. A full queue drops spans, an unreachable collector costs one log line, a
//! scrape reads atomics. No result depends on telemetry.

mod accept;
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

pub use accept::accept;
pub use trace::{HEADER, TraceParent, traced};

/// The crates whose spans are exported.
const TRACED: [&str; 4] = ["plat", "coordinator", "store", "worker"];

/// The format of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Format {
    /// Plain text, for people.
    #[default]
    Text,
    /// One JSON object per line, for tools: `timestamp`, `level`, `target`, `message`, and the fields of the event and of the spans around it.
    Json,
}

/// What a process logs to stderr.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Logs {
    /// The format of the lines.
    pub format: Format,
    /// The filter if `RUST_LOG` is not set.
    pub filter: &'static str,
}

/// Running telemetry, until [`finish`](Telemetry::finish).
#[must_use = "without `finish` the last spans are lost"]
pub struct Telemetry {
    traces: Option<otlp::Traces>,
}

/// Starts logging, and exports the spans of `service` if the environment names a collector. Called once per process.
///
/// # Errors
/// Invalid environment variables.
pub fn start(service: &str, logs: Option<Logs>) -> Result<Telemetry, BadInput> {
    let traces = otlp::Traces::from_environment(service)?;
    // Failing exports are logged even if nothing else is.
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
        // Only tests have a subscriber already, and keep it.
        let _ = tracing_subscriber::registry().with(lines).with(spans).try_init();
    }
    Ok(Telemetry { traces })
}

impl Telemetry {
    /// Exports the queued spans, within a time limit.
    pub fn finish(self) {
        if let Some(traces) = self.traces {
            traces.finish();
        }
    }
}
