//! Exports spans to a collector by OTLP over gRPC, configured by OpenTelemetry's standard environment variables.
//!
//! A bounded queue (`OTEL_BSP_MAX_QUEUE_SIZE`) and two threads decouple the work from the collector; spans that do not fit are dropped.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use opentelemetry::KeyValue;
use opentelemetry::trace::TracerProvider;
use opentelemetry_otlp::{RetryPolicy, SpanExporter, WithTonicConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::trace::{SdkTracer, SdkTracerProvider, SpanData, SpanExporter as Export};
use scene::BadInput;
use tokio::runtime::Runtime;
use tonic::transport::{Certificate, ClientTlsConfig};
use tracing::Subscriber;
use tracing_opentelemetry::OpenTelemetryLayer;
use tracing_subscriber::registry::LookupSpan;

/// Variables with the collector's endpoint; the first one that is set counts.
const ENDPOINTS: [&str; 2] = ["OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT"];
const PROTOCOLS: [&str; 2] = ["OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL"];
const CERTIFICATES: [&str; 2] = ["OTEL_EXPORTER_OTLP_TRACES_CERTIFICATE", "OTEL_EXPORTER_OTLP_CERTIFICATE"];
/// Time limit of exporting the last spans.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(2);

/// The exporter of spans to a collector.
pub(crate) struct Traces {
    provider: SdkTracerProvider,
    /// Runs the exporter's connection.
    runtime: Runtime,
}

impl Traces {
    /// `None` if the environment names no collector.
    pub(crate) fn from_environment(service: &str) -> Result<Option<Self>, BadInput> {
        let Some((variable, endpoint)) = variable(ENDPOINTS) else { return Ok(None) };
        if std::env::var("OTEL_SDK_DISABLED").is_ok_and(|value| value.eq_ignore_ascii_case("true")) {
            return Ok(None);
        }
        if let Some((name, protocol)) = variable_not(PROTOCOLS, "grpc") {
            let problem = format!("'{protocol}' is not supported");
            return Err(BadInput::new(
                name,
                problem,
                "set it to grpc, and the endpoint to the collector's gRPC port (4317)",
            ));
        }
        let bad = |problem: String| {
            BadInput::new(variable, format!("'{endpoint}' {problem}"), "give the collector as http://host:4317")
        };
        if !endpoint.starts_with("http://") && !endpoint.starts_with("https://") {
            return Err(bad("is not a URL".into()));
        }
        let threads =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).thread_name("otlp").enable_all().build();
        let runtime = threads.map_err(|error| bad(format!("cannot be exported to: {error}")))?;
        // The connection is created on this runtime.
        let entered = runtime.enter();
        let mut builder = SpanExporter::builder().with_tonic().with_retry_policy(retry_policy());
        if endpoint.starts_with("https://") {
            builder = builder.with_tls_config(tls_config()?);
        }
        let exporter = builder.build().map_err(|error| bad(format!("cannot be used ({error})")))?;
        drop(entered);
        let exporter = LoggingExporter { exporter, endpoint: endpoint.clone(), is_away: AtomicBool::new(false) };
        let provider =
            SdkTracerProvider::builder().with_resource(resource(service)).with_batch_exporter(exporter).build();
        Ok(Some(Self { provider, runtime }))
    }

    /// The layer that passes spans to the exporter.
    pub(crate) fn layer<S: Subscriber + for<'a> LookupSpan<'a>>(&self) -> OpenTelemetryLayer<S, SdkTracer> {
        let layer = tracing_opentelemetry::layer().with_tracer(self.provider.tracer("plat"));
        layer.with_location(false).with_threads(false).with_tracked_inactivity(false)
    }

    /// Exports the queued spans, within [`SHUTDOWN_TIMEOUT`].
    pub(crate) fn finish(self) {
        // Errors were logged when they occurred.
        let _ = self.provider.shutdown_with_timeout(SHUTDOWN_TIMEOUT);
        self.runtime.shutdown_background();
    }
}

/// Two retries within half a second, so that the export of the last spans does not delay the process's end.
fn retry_policy() -> RetryPolicy {
    let first = Duration::from_millis(100);
    RetryPolicy::default()
        .with_max_retries(2)
        .with_initial_delay(first)
        .with_max_delay(2 * first)
        .with_max_jitter(first)
}

/// The name and the value of the first of these variables that is set and not empty.
fn variable<const N: usize>(names: [&'static str; N]) -> Option<(&'static str, String)> {
    names.into_iter().find_map(|name| Some((name, std::env::var(name).ok().filter(|value| !value.is_empty())?)))
}

fn variable_not<const N: usize>(names: [&'static str; N], wanted: &str) -> Option<(&'static str, String)> {
    variable(names).filter(|(_, value)| value != wanted)
}

/// The root certificate of a collector with TLS.
fn tls_config() -> Result<ClientTlsConfig, BadInput> {
    let (name, path) = variable(CERTIFICATES).ok_or_else(|| {
        let advice = "set it to the file of the certificate that signed the collector's, PEM";
        BadInput::new(CERTIFICATES[1], "is not set, and the collector's endpoint uses TLS", advice)
    })?;
    let pem = std::fs::read(&path).map_err(|error| {
        BadInput::new(name, format!("'{path}' cannot be read ({error})"), "give a file with a certificate, PEM")
    })?;
    Ok(ClientTlsConfig::new().ca_certificate(Certificate::from_pem(pem)))
}

/// The exporting service: named by the environment, else `service`.
fn resource(service: &str) -> Resource {
    let named = std::env::var("OTEL_SERVICE_NAME").is_ok_and(|name| !name.is_empty())
        || std::env::var("OTEL_RESOURCE_ATTRIBUTES").is_ok_and(|all| all.contains("service.name="));
    let resource = Resource::builder().with_attribute(KeyValue::new("service.version", env!("CARGO_PKG_VERSION")));
    if named { resource.build() } else { resource.with_service_name(service.to_owned()).build() }
}

/// An exporter that logs the first failed export, and the first one that succeeds after it.
#[derive(Debug)]
struct LoggingExporter<E> {
    exporter: E,
    endpoint: String,
    is_away: AtomicBool,
}

impl<E: Export> Export for LoggingExporter<E> {
    async fn export(&self, batch: Vec<SpanData>) -> OTelSdkResult {
        match self.exporter.export(batch).await {
            Ok(()) => {
                if self.is_away.swap(false, Ordering::Relaxed) {
                    tracing::warn!("traces reach {} again", self.endpoint);
                }
            }
            Err(error) => {
                if !self.is_away.swap(true, Ordering::Relaxed) {
                    tracing::warn!("traces are lost until {} takes them: {error}", self.endpoint);
                }
            }
        }
        Ok(())
    }

    fn shutdown_with_timeout(&self, timeout: Duration) -> OTelSdkResult {
        self.exporter.shutdown_with_timeout(timeout)
    }

    fn set_resource(&mut self, resource: &Resource) {
        self.exporter.set_resource(resource);
    }
}
