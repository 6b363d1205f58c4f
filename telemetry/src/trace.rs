//! Passes a span's position in its trace between processes: W3C Trace Context, level 1, without `tracestate`.

use opentelemetry::Context;
use opentelemetry::trace::{SpanContext, SpanId, TraceContextExt, TraceFlags, TraceId, TraceState};
use serde::{Deserialize, Serialize};
use tonic::Request;
use tonic::metadata::MetadataMap;
use tracing::Span;
use tracing_opentelemetry::OpenTelemetrySpanExt;

/// The gRPC header of a [`TraceParent`].
pub const HEADER: &str = "traceparent";

/// A span of this or another process: `00-<trace, 32 hex>-<span, 16 hex>-<flags, 2 hex>`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct TraceParent(String);

impl TraceParent {
    /// Parses another process's value; `None` if it is invalid, which counts as absent.
    pub fn parse(text: &str) -> Option<Self> {
        Self::context(text).map(|_| Self(text.into()))
    }

    /// The value in a call's headers.
    pub fn of_header(header: &MetadataMap) -> Option<Self> {
        Self::parse(header.get(HEADER)?.to_str().ok()?)
    }

    /// The value of a span of this process; `None` if no spans are exported.
    pub fn of(span: &Span) -> Option<Self> {
        let context = span.context();
        let of = context.span().span_context().clone();
        let (trace, span, flags) = (of.trace_id(), of.span_id(), of.trace_flags().to_u8());
        of.is_valid().then(|| Self(format!("00-{trace}-{span}-{flags:02x}")))
    }

    /// Makes a span that has not been entered a child of this one.
    pub fn adopt(&self, span: &Span) {
        if let Some(parent) = Self::context(&self.0) {
            // Fails if no spans are exported.
            let _ = span.set_parent(Context::new().with_remote_span_context(parent));
        }
    }

    /// The header's text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    fn context(text: &str) -> Option<SpanContext> {
        let bytes = text.as_bytes();
        let is_hex = |byte: &u8| byte.is_ascii_digit() || (b'a'..=b'f').contains(byte);
        let dashes = [2, 35, 52];
        let fits = |(at, byte): (usize, &u8)| if dashes.contains(&at) { *byte == b'-' } else { is_hex(byte) };
        if bytes.len() != 55 || !bytes.iter().enumerate().all(fits) || &text[..2] != "00" {
            return None;
        }
        let flags = TraceFlags::new(u8::from_str_radix(&text[53..], 16).ok()?) & TraceFlags::SAMPLED;
        let (trace, span) = (TraceId::from_hex(&text[3..35]).ok()?, SpanId::from_hex(&text[36..52]).ok()?);
        let context = SpanContext::new(trace, span, flags, true, TraceState::NONE);
        context.is_valid().then_some(context)
    }
}

impl TryFrom<String> for TraceParent {
    type Error = &'static str;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        Self::parse(&text).ok_or("not a traceparent of version 00")
    }
}

impl From<TraceParent> for String {
    fn from(parent: TraceParent) -> Self {
        parent.0
    }
}

/// A request with the current span in its header.
pub fn traced<T>(message: T) -> Request<T> {
    let mut request = Request::new(message);
    if let Some(value) = TraceParent::of(&Span::current()).and_then(|parent| parent.0.parse().ok()) {
        request.metadata_mut().insert(HEADER, value);
    }
    request
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use opentelemetry::trace::TracerProvider;
    use opentelemetry_sdk::error::OTelSdkResult;
    use opentelemetry_sdk::trace::{SdkTracerProvider, SpanData, SpanExporter};
    use tracing_subscriber::layer::SubscriberExt;

    use super::*;

    const PARENT: &str = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01";

    #[derive(Debug, Clone, Default)]
    struct Exported(Arc<Mutex<Vec<SpanData>>>);

    impl SpanExporter for Exported {
        async fn export(&self, batch: Vec<SpanData>) -> OTelSdkResult {
            self.0.lock().unwrap().extend(batch);
            Ok(())
        }
    }

    #[test]
    fn an_invalid_traceparent_counts_as_absent() {
        assert_eq!(TraceParent::parse(PARENT).unwrap().as_str(), PARENT);
        for bad in [
            "",
            "00",
            "01-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
            "ff-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
            "00-0AF7651916CD43DD8448EB211C80319C-b7ad6b7169203331-01",
            "00-00000000000000000000000000000000-b7ad6b7169203331-01",
            "00-0af7651916cd43dd8448eb211c80319c-0000000000000000-01",
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-0g",
            "00_0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-011",
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b71692033é1-01",
        ] {
            assert_eq!(TraceParent::parse(bad), None, "{bad}");
        }
        let read = serde_json::from_str::<TraceParent>("\"nonsense\"");
        assert!(
            read.is_err() && serde_json::to_string(&TraceParent(PARENT.into())).unwrap() == format!("\"{PARENT}\"")
        );
    }

    #[test]
    fn a_span_is_adopted_and_passed_on() {
        assert_eq!(TraceParent::of(&tracing::info_span!("not exported")), None);
        assert!(traced(()).metadata().get(HEADER).is_none());
        let exported = Exported::default();
        let provider = SdkTracerProvider::builder().with_simple_exporter(exported.clone()).build();
        let layer = tracing_opentelemetry::layer().with_tracer(provider.tracer("test"));
        tracing::subscriber::with_default(tracing_subscriber::registry().with(layer), || {
            let task = tracing::info_span!("task");
            TraceParent::parse(PARENT).unwrap().adopt(&task);
            let call = task.in_scope(|| tracing::info_span!("call").in_scope(|| traced(())));
            let passed = TraceParent::of_header(call.metadata()).unwrap();
            assert!(passed.as_str().starts_with(&PARENT[..36]) && passed.as_str() != PARENT, "{passed:?}");
            drop(task);
            let spans = exported.0.lock().unwrap();
            let [call, task] = &spans[..] else { panic!("{spans:?}") };
            assert_eq!(task.parent_span_id, SpanId::from_hex(&PARENT[36..52]).unwrap());
            assert_eq!((call.parent_span_id, &call.name[..]), (task.span_context.span_id(), "call"));
            assert_eq!(passed.as_str()[36..52], call.span_context.span_id().to_string());
        });
    }
}
