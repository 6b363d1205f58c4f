//! What the program tells of itself beside its results: its log, its traces, its metrics.

use prometheus_client::registry::Registry;
use scene::BadInput;
use telemetry::{Format, Logs, Telemetry};
use tokio::net::TcpListener;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::args::{Cli, Command, LogFormat, Told};
use crate::failure::Failure;
use crate::output::Output;

/// Of programs that run for days, where `RUST_LOG` does not say.
const FILTER: &str = "warn,plat=info,coordinator=info,worker=info";

/// Begins to tell. Who runs for days says what happens without being asked; whoever runs a command sees its notes.
pub(crate) fn start(cli: &Cli) -> Result<Telemetry, BadInput> {
    let (service, serves) = match &cli.command {
        Command::Coordinator(_) => ("plat-coordinator", true),
        Command::Worker(_) => ("plat-worker", true),
        _ => ("plat", false),
    };
    let logs = Logs { format: format(cli), filter: FILTER };
    let wanted = std::env::var_os("RUST_LOG").is_some() || (serves && !cli.quiet);
    telemetry::start(service, wanted.then_some(logs))
}

/// What a line of the log looks like.
pub(crate) fn format(cli: &Cli) -> Format {
    let told = match &cli.command {
        Command::Coordinator(args) => Some(&args.told),
        Command::Worker(args) => Some(&args.told),
        _ => None,
    };
    match told.map(|told| told.log_format) {
        Some(LogFormat::Json) => Format::Json,
        Some(LogFormat::Text) | None => Format::Text,
    }
}

/// Where Prometheus will ask.
pub(crate) struct Metrics(Option<TcpListener>);

impl Metrics {
    /// Takes the address that was asked for, so that what is wrong with it is said before any work begins.
    pub(crate) async fn listen(told: &Told) -> Result<Self, Failure> {
        Ok(Self(match told.metrics {
            Some(address) => Some(telemetry::metrics::listen(address).await?),
            None => None,
        }))
    }

    /// Answers with what `register` names, until what this returns is dropped.
    pub(crate) fn tell(self, output: &Output, register: impl FnOnce(&mut Registry)) -> Option<DropGuard> {
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
