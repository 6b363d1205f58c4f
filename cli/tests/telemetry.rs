//! Telemetry of a cluster: one trace of a job over all processes, metrics, and logs without secrets.
#![cfg(unix)]

mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::Command;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use common::cluster::{Running, has_task};
use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{TraceService, TraceServiceServer};
use opentelemetry_proto::tonic::collector::trace::v1::{ExportTraceServiceRequest, ExportTraceServiceResponse};
use opentelemetry_proto::tonic::common::v1::KeyValue;
use opentelemetry_proto::tonic::common::v1::any_value::Value as Any;
use opentelemetry_proto::tonic::trace::v1::Span;
use opentelemetry_proto::tonic::trace::v1::span::SpanKind;
use serde_json::Value;
use tonic::{Request, Response, Status};

#[rustfmt::skip]
const PLAN: [&str; 8] = ["--steps", "960", "--budget", "900", "--levels", "1", "--blocks", "tree"];
const TOKEN: &str = "d34db33f-secret-of-the-cluster";

/// A span with its service.
type Told = (String, Span);

/// An OpenTelemetry collector.
#[derive(Clone, Default)]
struct Collector(Arc<Mutex<Vec<Told>>>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        for resource in request.into_inner().resource_spans {
            let service = resource.resource.map(|of| text(&of.attributes, "service.name")).unwrap_or_default();
            let spans = resource.scope_spans.into_iter().flat_map(|scope| scope.spans);
            self.0.lock().unwrap().extend(spans.map(|span| (service.clone(), span)));
        }
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

impl Collector {
    /// A listening collector, its URL, and the guard that keeps it running.
    fn start() -> (Self, String, tokio::runtime::Runtime) {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
        let collector = Self::default();
        let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let service = TraceServiceServer::new(collector.clone());
        let incoming = tonic::transport::server::TcpIncoming::from(listener);
        runtime.spawn(tonic::transport::Server::builder().add_service(service).serve_with_incoming(incoming));
        (collector, url, runtime)
    }
}

fn value(attributes: &[KeyValue], key: &str) -> Option<Any> {
    attributes.iter().find(|attribute| attribute.key == key)?.value.clone()?.value
}

fn text(attributes: &[KeyValue], key: &str) -> String {
    match value(attributes, key) {
        Some(Any::StringValue(text)) => text,
        _ => String::new(),
    }
}

/// Integers are exported as text: tracing's are unsigned, OpenTelemetry's are signed.
fn number(span: &Span, key: &str) -> u64 {
    let text = text(&span.attributes, key);
    text.parse().unwrap_or_else(|_| panic!("{} has {key} '{text}'", span.name))
}

/// The metrics at this URL, by name and labels.
fn scraped(url: &str) -> BTreeMap<String, f64> {
    let address = url.strip_prefix("http://").unwrap().strip_suffix("/metrics").unwrap();
    let mut stream = TcpStream::connect(address).unwrap();
    write!(stream, "GET /metrics HTTP/1.1\r\nHost: {address}\r\n\r\n").unwrap();
    let mut said = String::new();
    stream.read_to_string(&mut said).unwrap();
    let (head, body) = said.split_once("\r\n\r\n").unwrap();
    assert!(head.starts_with("HTTP/1.1 200 "), "{head}");
    let samples = body.lines().filter(|line| !line.starts_with('#'));
    samples
        .map(|line| line.rsplit_once(' ').map(|(name, value)| (name.into(), value.parse().unwrap())).unwrap())
        .collect()
}

/// The program with a token and with all telemetry enabled.
fn watched(at: &Path, words: &[&str], collector: &str) -> Command {
    let mut command = common::command(at, &[words, &["--token-file", "token"]].concat());
    command
        .env("OTEL_EXPORTER_OTLP_ENDPOINT", collector)
        .env("OTEL_BSP_SCHEDULE_DELAY", "100")
        .env("RUST_LOG", "trace");
    command
}

fn worker(at: &Path, url: &str, name: &str, collector: &str) -> Running {
    let words = ["worker", "--coordinator", url, "--name", name, "--threads", "1", "--checkpoint-every", "0.05"];
    Running::start(&mut watched(at, &[&words[..], &["--metrics", "0", "--log-format", "json"]].concat(), collector))
}

/// The URL in the line of this program's log that begins with these words.
fn url_after(running: &Running, words: &str) -> String {
    let line = running.line(|line| object(line)["message"].as_str().is_some_and(|message| message.starts_with(words)));
    let message = object(&line)["message"].as_str().unwrap().to_owned();
    let url = message.split_whitespace().find(|word| word.starts_with("http://")).unwrap();
    url.trim_end_matches(',').into()
}

fn object(line: &str) -> Value {
    serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"))
}

#[test]
fn a_job_is_one_trace_and_the_token_is_never_printed() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    std::fs::write(at.join("token"), TOKEN).unwrap();
    let (collector, otlp, runtime) = Collector::start();

    let words =
        ["coordinator", "--store", "shared", "--listen", "127.0.0.1:0", "--metrics", "0", "--log-format", "json"];
    let host = Running::start(&mut watched(at, &words, &otlp));
    let url = url_after(&host, "listening on");
    let host_metrics = url_after(&host, "metrics at");
    let first = worker(at, &url, "first", &otlp);
    let words = ["submit", "city", "--coordinator", &url, "--wait", "--json"];
    let mut submit = watched(at, &[&words[..], &PLAN].concat(), &otlp);
    let submit = Running::start(submit.env("OTEL_SERVICE_NAME", "tester"));
    // Each of two workers trains a task: the second starts when the first has one, and the first stops before the end.
    let asked = ["--coordinator", &url, "--token-file", "token"];
    assert!(has_task(at, &asked, "first"));
    let second = worker(at, &url, "second", &otlp);
    let second_metrics = url_after(&second, "metrics at");
    first.signal("-TERM");
    let first = first.end();
    let submit = submit.end();
    assert!(submit.status.success(), "{}", submit.stderr);
    let job = object(submit.stdout.lines().last().unwrap());
    let tasks = job["tasks"].as_u64().unwrap();
    assert!(tasks > 2, "{job}");

    let seen = scraped(&second_metrics);
    assert!(seen["plat_worker_tasks_done_total"] >= 2.0 && seen["plat_worker_steps_total"] > 100.0, "{seen:?}");
    assert!(seen["plat_worker_cpu_seconds_total"] > 0.0 && seen["plat_worker_checkpoints_total"] > 0.0, "{seen:?}");
    assert!(seen["plat_worker_store_read_bytes_total"] > 1e4 && seen["plat_worker_splats"] == 0.0, "{seen:?}");
    // They are updated once per second.
    let seen = loop {
        let seen = scraped(&host_metrics);
        if seen["plat_completions_total"] >= tasks as f64 {
            break seen;
        }
        std::thread::sleep(Duration::from_millis(50));
    };
    assert_eq!((seen["plat_tasks_done"], seen["plat_jobs{state=\"done\"}"]), (tasks as f64, 1.0), "{seen:?}");
    assert_eq!((seen["plat_leader"], seen["plat_epoch"], seen["plat_tasks_leased"]), (1.0, 1.0, 0.0), "{seen:?}");
    assert!(seen["plat_durable_write_seconds_count"] > 2.0 && seen["plat_grants_total"] >= tasks as f64, "{seen:?}");

    let [second, host] = [second, host].map(|running| {
        running.signal("-TERM");
        running.end()
    });
    drop(runtime);
    check_trace(&collector.0.lock().unwrap(), tasks);

    for (ended, wanted) in [(&host, "granted"), (&first, "begins"), (&second, "done")] {
        assert!(ended.status.success(), "{}", ended.stderr);
        let lines: Vec<Value> = ended.stderr.lines().map(object).collect();
        let of_attempts = lines.iter().filter(|line| line["message"] == wanted);
        let named = of_attempts.map(|line| ["job", "task", "attempt"].map(|field| line[field].as_u64()));
        let named: Vec<_> = named.collect();
        assert!(
            !named.is_empty()
                && named.iter().all(|[job, task, attempt]| {
                    *job == Some(1)
                        && task.is_some_and(|task| task < tasks)
                        && attempt.is_some_and(|attempt| attempt > 0)
                }),
            "{wanted}: {named:?}"
        );
    }
    // Log lines within a task name the task, at any depth.
    let pruned = second.stderr.lines().map(object).find(|line| line["message"] == "pruned").expect("leaves are pruned");
    assert!(pruned["job"] == 1 && pruned["attempt"].is_u64() && pruned["worker"] == "second", "{pruned}");
    for ended in [&first, &second, &host, &submit] {
        assert!(!ended.stderr.contains(TOKEN) && !ended.stdout.contains(TOKEN), "the token was printed");
    }
}

/// All spans of a job belong to one trace, each below its parent.
fn check_trace(told: &[Told], tasks: u64) {
    let names: Vec<&str> = told.iter().map(|(_, span)| &span.name[..]).collect();
    let all = |name: &str| -> Vec<&Told> { told.iter().filter(|(_, span)| span.name == name).collect() };
    let one = |name: &str| match &all(name)[..] {
        [(service, span)] => (service.as_str(), span),
        other => panic!("{name} is there {} times: {names:?}", other.len()),
    };
    let (service, submit) = one("submit");
    assert_eq!((service, &submit.parent_span_id[..]), ("tester", &[][..]));
    assert!(told.iter().all(|(_, span)| span.trace_id == submit.trace_id), "{names:?}");
    assert_eq!(one("ingest").1.parent_span_id, submit.span_id);
    let (service, accept) = one("accept");
    assert_eq!((service, &accept.parent_span_id), ("plat-coordinator", &submit.span_id));
    assert_eq!((accept.kind(), number(accept, "job"), number(accept, "tasks")), (SpanKind::Server, 1, tasks));

    let attempts = all("task");
    let by_id: BTreeMap<&[u8], &Span> = attempts.iter().map(|(_, span)| (&span.span_id[..], span)).collect();
    assert_eq!(by_id.len(), attempts.len());
    for (service, task) in &attempts {
        assert_eq!((service.as_str(), &task.parent_span_id), ("plat-worker", &accept.span_id));
        assert_eq!(number(task, "job"), 1);
    }
    let workers: BTreeSet<String> = by_id.values().map(|task| text(&task.attributes, "worker")).collect();
    assert_eq!(workers, ["first", "second"].map(String::from).into());
    let done: Vec<&&Span> = by_id.values().filter(|task| !text(&task.attributes, "artefact").is_empty()).collect();
    let numbers: BTreeSet<u64> = done.iter().map(|task| number(task, "task")).collect();
    assert_eq!(numbers, (0..tasks).collect(), "a task has no span");

    let task_of = |span: &Span| {
        *by_id.get(&span.parent_span_id[..]).unwrap_or_else(|| panic!("{} is no task's: {names:?}", span.name))
    };
    for part in ["fetch", "train", "keep", "commit"] {
        let within: BTreeSet<&[u8]> = all(part).iter().map(|(_, span)| &task_of(span).span_id[..]).collect();
        assert!(done.iter().all(|task| within.contains(&task.span_id[..])), "{part} of each task: {names:?}");
    }
    for (service, commit) in all("commit") {
        let task = task_of(commit);
        let place = |span| ["job", "task", "attempt"].map(|key| number(span, key));
        assert_eq!((service.as_str(), place(commit)), ("plat-coordinator", place(task)));
        assert_eq!(text(&commit.attributes, "artefact"), text(&task.attributes, "artefact"));
        assert_eq!(value(&commit.attributes, "accepted"), Some(Any::BoolValue(true)));
    }
    let training: BTreeSet<&[u8]> = all("train").iter().map(|(_, span)| &span.span_id[..]).collect();
    let checkpoints = all("checkpoint");
    assert!(!checkpoints.is_empty() && checkpoints.iter().all(|(_, span)| training.contains(&span.parent_span_id[..])));
}

#[test]
fn an_unreachable_collector_costs_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 16, 64, 48);
    std::fs::write(at.join("token"), TOKEN).unwrap();
    // Nothing listens at this address any more.
    let away = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let away = format!("http://{away}");
    let words = ["coordinator", "--store", "shared", "--listen", "127.0.0.1:0", "--log-format", "json"];
    let host = Running::start(watched(at, &words, &away).env("RUST_LOG", "info"));
    let url = url_after(&host, "listening on");
    let submit = |number: usize| {
        let words = ["submit", "city", "--coordinator", &url, "--json", "--quiet"];
        let mut submit = watched(at, &[&words[..], &PLAN].concat(), &away);
        let submit = Running::start(submit.env_remove("RUST_LOG")).end();
        assert!(submit.status.success(), "{}", submit.stderr);
        assert_eq!(object(submit.stdout.trim())["job"], number);
        assert!(submit.stderr.lines().count() == 1 && submit.stderr.contains("traces are lost"), "{}", submit.stderr);
    };
    submit(1);
    submit(2);
    // The spans of both jobs have been rejected by now, each in a batch of its own.
    host.line_with("traces are lost");
    host.signal("-TERM");
    let host = host.end();
    assert!(host.status.success(), "{}", host.stderr);
    assert_eq!(host.stderr.matches("traces are lost").count(), 1, "{}", host.stderr);

    for (variable, value, wanted) in [
        ("OTEL_EXPORTER_OTLP_ENDPOINT", "nonsense", "http://host:4317"),
        ("OTEL_EXPORTER_OTLP_PROTOCOL", "http/json", "grpc"),
        ("OTEL_EXPORTER_OTLP_ENDPOINT", "https://127.0.0.1:1", "OTEL_EXPORTER_OTLP_CERTIFICATE"),
    ] {
        let mut command = watched(at, &["jobs", "--coordinator", &url], &away);
        let line = common::stopped(command.env(variable, value), 2, wanted);
        assert!(line.contains(variable) || line.contains("CERTIFICATE"), "{line}");
    }
    for bad in ["nowhere", "1.2.3.4", "70000"] {
        common::refused(at, &["worker", "--coordinator", &url, "--metrics", bad], "9464");
    }
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    common::refused(at, &["worker", "--coordinator", &url, "--quiet", "--metrics", &port], "--metrics");
}
