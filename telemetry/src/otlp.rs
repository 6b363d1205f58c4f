//! Spans to a collector: OpenTelemetry's protocol over gRPC, as the standard variables of the environment say.
//!
//! A bounded queue (`OTEL_BSP_MAX_QUEUE_SIZE`) and two threads stand between the work and the collector; what does not fit is lost.

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

/// Where the collector is; the first that is set counts.
const ENDPOINTS: [&str; 2] = ["OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT"];
const PROTOCOLS: [&str; 2] = ["OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL"];
const CERTIFICATES: [&str; 2] = ["OTEL_EXPORTER_OTLP_TRACES_CERTIFICATE", "OTEL_EXPORTER_OTLP_CERTIFICATE"];
/// The last spans have this long to reach the collector.
const GOODBYE: Duration = Duration::from_secs(2);

/// The way of spans to a collector.
pub(crate) struct Traces {
    provider: SdkTracerProvider,
    /// Of the exporter's connection.
    runtime: Runtime,
}

impl Traces {
    /// `None` where the environment names no collector.
    pub(crate) fn from_environment(service: &str) -> Result<Option<Self>, BadInput> {
        let Some((variable, endpoint)) = variable(ENDPOINTS) else { return Ok(None) };
        if std::env::var("OTEL_SDK_DISABLED").is_ok_and(|value| value.eq_ignore_ascii_case("true")) {
            return Ok(None);
        }
        if let Some((name, protocol)) = variable_not(PROTOCOLS, "grpc") {
            let problem = format!("'{protocol}' is not spoken here");
            return Err(BadInput::new(
                name,
                problem,
                "set it to grpc, and the endpoint to the collector's port for that (4317)",
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
        let runtime = threads.map_err(|error| bad(format!("cannot be served: {error}")))?;
        // The connection is made, and kept, in there.
        let entered = runtime.enter();
        let mut builder = SpanExporter::builder().with_tonic().with_retry_policy(persistence());
        if endpoint.starts_with("https://") {
            builder = builder.with_tls_config(trust()?);
        }
        let exporter = builder.build().map_err(|error| bad(format!("cannot be used ({error})")))?;
        drop(entered);
        let exporter = Patient { exporter, endpoint: endpoint.clone(), is_away: AtomicBool::new(false) };
        let provider =
            SdkTracerProvider::builder().with_resource(resource(service)).with_batch_exporter(exporter).build();
        Ok(Some(Self { provider, runtime }))
    }

    /// What hands spans over.
    pub(crate) fn layer<S: Subscriber + for<'a> LookupSpan<'a>>(&self) -> OpenTelemetryLayer<S, SdkTracer> {
        let layer = tracing_opentelemetry::layer().with_tracer(self.provider.tracer("plat"));
        layer.with_location(false).with_threads(false).with_tracked_inactivity(false)
    }

    /// Exports what waits.
    pub(crate) fn finish(self) {
        // What went wrong was said when it did.
        let _ = self.provider.shutdown_with_timeout(GOODBYE);
        self.runtime.shutdown_background();
    }
}

/// Two tries more within half a second: whoever waits for the last spans is not to wait for long.
fn persistence() -> RetryPolicy {
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

/// Whom to trust where the way is encrypted.
fn trust() -> Result<ClientTlsConfig, BadInput> {
    let (name, path) = variable(CERTIFICATES).ok_or_else(|| {
        let advice = "set it to the file of the certificate that signed the collector's, PEM";
        BadInput::new(CERTIFICATES[1], "is not set, and the collector's way is encrypted", advice)
    })?;
    let pem = std::fs::read(&path).map_err(|error| {
        BadInput::new(name, format!("'{path}' cannot be read ({error})"), "give a file with a certificate, PEM")
    })?;
    Ok(ClientTlsConfig::new().ca_certificate(Certificate::from_pem(pem)))
}

/// Who exports: the environment's word, and `service` where it has none.
fn resource(service: &str) -> Resource {
    let named = std::env::var("OTEL_SERVICE_NAME").is_ok_and(|name| !name.is_empty())
        || std::env::var("OTEL_RESOURCE_ATTRIBUTES").is_ok_and(|all| all.contains("service.name="));
    let resource = Resource::builder().with_attribute(KeyValue::new("service.version", env!("CARGO_PKG_VERSION")));
    if named { resource.build() } else { resource.with_service_name(service.to_owned()).build() }
}

/// An exporter whose troubles are told once, and once more when they are over.
#[derive(Debug)]
struct Patient<E> {
    exporter: E,
    endpoint: String,
    is_away: AtomicBool,
}

impl<E: Export> Export for Patient<E> {
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
