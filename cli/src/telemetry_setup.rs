//! Sets up the program's log, traces and metrics.

use prometheus_client::registry::Registry;
use scene::BadInput;
use telemetry::{Format, Logs, Telemetry};
use tokio::net::TcpListener;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::args::{Cli, Command, LogFormat, TelemetryArgs};
use crate::failure::Failure;
use crate::output::Output;

/// Log filter of servers where `RUST_LOG` is not set.
const DEFAULT_FILTER: &str = "warn,plat=info,coordinator=info,worker=info";

/// Starts log and traces. Servers log by default, other commands only if `RUST_LOG` is set.
pub(crate) fn start(cli: &Cli) -> Result<Telemetry, BadInput> {
    let (service, is_server) = match &cli.command {
        Command::Coordinator(_) => ("plat-coordinator", true),
        Command::Worker(_) => ("plat-worker", true),
        _ => ("plat", false),
    };
    let logs = Logs { format: format(cli), filter: DEFAULT_FILTER };
    let logs_wanted = std::env::var_os("RUST_LOG").is_some() || (is_server && !cli.quiet);
    telemetry::start(service, logs_wanted.then_some(logs))
}

/// The format of log lines.
pub(crate) fn format(cli: &Cli) -> Format {
    let args = match &cli.command {
        Command::Coordinator(args) => Some(&args.telemetry),
        Command::Worker(args) => Some(&args.telemetry),
        _ => None,
    };
    match args.map(|args| args.log_format) {
        Some(LogFormat::Json) => Format::Json,
        Some(LogFormat::Text) | None => Format::Text,
    }
}

/// The listener for Prometheus, if there shall be one.
pub(crate) struct MetricsListener(Option<TcpListener>);

impl MetricsListener {
    /// Binds the address, so that a bad one is reported before any work begins.
    pub(crate) async fn bind(args: &TelemetryArgs) -> Result<Self, Failure> {
        Ok(Self(match args.metrics {
            Some(address) => Some(telemetry::metrics::listen(address).await?),
            None => None,
        }))
    }

    /// Serves the metrics that `register` adds, until the returned guard is dropped.
    pub(crate) fn serve(self, output: &Output, register: impl FnOnce(&mut Registry)) -> Option<DropGuard> {
        let listener = self.0?;
        let mut registry = Registry::default();
        register(&mut registry);
        if let Ok(address) = listener.local_addr() {
            output.note(format!("metrics at http://{address}/metrics"));
        }
        let stop = CancellationToken::new();
        tokio::spawn(telemetry::metrics::serve(listener, registry, stop.clone()));
        Some(stop.drop_guard())
    }
}
