//! Writes events as flat JSON lines: an event's own fields beside those of its spans, so that `job`, `task` and `attempt` are always at the
//! same place.

use std::fmt;
use std::io::Write;

use serde_json::{Map, Value};
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Subscriber};
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::time::{FormatTime, SystemTime};
use tracing_subscriber::layer::{Context, Layer};
use tracing_subscriber::registry::LookupSpan;

/// A layer that writes each event as a JSON line.
pub(crate) struct JsonLines<W> {
    writer: W,
}

impl<W> JsonLines<W> {
    pub(crate) fn new(writer: W) -> Self {
        Self { writer }
    }
}

/// The fields of a span or of an event.
#[derive(Debug, Default)]
struct Fields(Map<String, Value>);

impl<S, W> Layer<S> for JsonLines<W>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    W: for<'w> MakeWriter<'w> + 'static,
{
    fn on_new_span(&self, attributes: &Attributes<'_>, id: &Id, context: Context<'_, S>) {
        let mut fields = Fields::default();
        attributes.record(&mut fields);
        if let Some(span) = context.span(id) {
            span.extensions_mut().insert(fields);
        }
    }

    fn on_record(&self, id: &Id, values: &Record<'_>, context: Context<'_, S>) {
        if let Some(span) = context.span(id)
            && let Some(fields) = span.extensions_mut().get_mut::<Fields>()
        {
            values.record(fields);
        }
    }

    fn on_event(&self, event: &Event<'_>, context: Context<'_, S>) {
        let mut line = Fields::default();
        for span in context.event_scope(event).into_iter().flat_map(|scope| scope.from_root()) {
            if let Some(Fields(fields)) = span.extensions().get::<Fields>() {
                line.0.extend(fields.iter().map(|(name, value)| (name.clone(), value.clone())));
            }
        }
        event.record(&mut line);
        // Added last, so that no field overrides them.
        let mut timestamp = String::new();
        let _ = SystemTime.format_time(&mut Writer::new(&mut timestamp));
        let about = event.metadata();
        let own = [("timestamp", timestamp), ("level", about.level().to_string()), ("target", about.target().into())];
        line.0.extend(own.map(|(name, value)| (name.into(), value.into())));
        // Cannot fail, as all keys are strings.
        let text = Value::Object(line.0).to_string() + "\n";
        // A failing log does not stop the program.
        let _ = self.writer.make_writer_for(about).write_all(text.as_bytes());
    }
}

impl Fields {
    fn put(&mut self, field: &Field, value: impl Into<Value>) {
        // Fields of the span exporter only.
        if !field.name().starts_with("otel.") {
            self.0.insert(field.name().into(), value.into());
        }
    }
}

impl Visit for Fields {
    fn record_f64(&mut self, field: &Field, value: f64) {
        self.put(field, value);
    }

    fn record_i64(&mut self, field: &Field, value: i64) {
        self.put(field, value);
    }

    fn record_u64(&mut self, field: &Field, value: u64) {
        self.put(field, value);
    }

    fn record_bool(&mut self, field: &Field, value: bool) {
        self.put(field, value);
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.put(field, value);
    }

    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        self.put(field, format!("{value:?}"));
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use tracing_subscriber::layer::SubscriberExt;

    use super::*;

    #[derive(Clone, Default)]
    struct Buffer(Arc<Mutex<Vec<u8>>>);

    impl Write for Buffer {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_line_has_the_fields_of_its_spans() {
        let buffer = Buffer::default();
        let writer = buffer.clone();
        let subscriber = tracing_subscriber::registry().with(JsonLines::new(move || writer.clone()));
        tracing::subscriber::with_default(subscriber, || {
            let task = tracing::info_span!("task", job = 3, task = 7, outcome = tracing::field::Empty, otel.kind = "x");
            task.in_scope(|| {
                tracing::info_span!("train", steps = 10)
                    .in_scope(|| tracing::warn!(steps = 4, "line\nbreak \"{}\"", 1.5));
            });
            task.record("outcome", "done");
            task.in_scope(|| tracing::info!(level = "high", share = 0.5, "over"));
            tracing::info!("outside");
        });
        let text = String::from_utf8(buffer.0.lock().unwrap().clone()).unwrap();
        let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        let [warned, over, outside] = &lines[..] else { panic!("{text}") };
        assert_eq!((&warned["job"], &warned["task"], &warned["steps"]), (&3.into(), &7.into(), &4.into()));
        assert_eq!((&warned["message"], &warned["level"]), (&"line\nbreak \"1.5\"".into(), &"WARN".into()));
        assert!(warned.get("otel.kind").is_none() && warned["target"] == module_path!(), "{warned}");
        assert_eq!((&over["outcome"], &over["level"], &over["share"]), (&"done".into(), &"INFO".into(), &0.5.into()));
        assert!(outside.get("job").is_none() && outside["timestamp"].as_str().unwrap().ends_with('Z'), "{outside}");
    }
}
