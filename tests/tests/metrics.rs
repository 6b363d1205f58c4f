//! Compares the metrics that docs/src/metrics.md lists with those that coordinator and worker export.

use std::collections::BTreeSet;

use prometheus_client::registry::Registry;

/// The documented metrics, each as `name type label`.
fn documented(section: &str) -> BTreeSet<String> {
    let text = include_str!("../../docs/src/metrics.md");
    let text = text.split("\n## ").find(|part| part.starts_with(section)).expect("the section is there");
    let rows = text.lines().filter(|line| line.starts_with("| `"));
    rows.map(|row| {
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        let name = cells[1].trim_matches('`');
        let label = cells[3].split('`').nth(1).unwrap_or_default();
        assert!(!cells[4].is_empty(), "{name} has no description");
        format!("{name} {} {label}", cells[2])
    })
    .collect()
}

/// The exported metrics, in the same form.
fn exported(registry: &Registry) -> BTreeSet<String> {
    let text = telemetry::metrics::text(registry).unwrap();
    let kinds = text.lines().filter_map(|line| line.strip_prefix("# TYPE ")).map(|line| {
        let (name, kind) = line.split_once(' ').unwrap();
        let sample = match kind {
            "counter" => format!("{name}_total"),
            "histogram" => format!("{name}_bucket"),
            _ => name.to_owned(),
        };
        let of_it = |line: &&str| line.strip_prefix(&sample).is_some_and(|rest| rest.starts_with([' ', '{']));
        let line = text.lines().find(of_it).unwrap_or_else(|| panic!("{sample} has no value: {text}"));
        let label = line.split_once('{').and_then(|(_, labels)| Some(labels.split_once('=')?.0));
        let shown = if kind == "histogram" { name } else { &sample };
        format!("{shown} {kind} {}", label.filter(|label| *label != "le").unwrap_or_default())
    });
    kinds.collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn the_coordinators_metrics_are_documented() {
    let options = coordinator::Options::new(store::Store::open("memory://").unwrap());
    let metrics = options.metrics.clone();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let stop = tokio_util::sync::CancellationToken::new();
    let serving = tokio::spawn(coordinator::serve(listener, options, stop.clone().cancelled_owned()));
    let mut registry = Registry::default();
    metrics.register(&mut registry);
    let mut client = proto::connect(&url, &proto::Access::default()).unwrap();
    let request = proto::LeaseRequest { worker: "w".into(), backend: "cpu-none".into(), ..Default::default() };
    client.lease(request).await.unwrap();
    let line = "plat_workers{backend=\"cpu-none\"} 1";
    let is_exported = || telemetry::metrics::text(&registry).unwrap().lines().any(|other| other == line);
    while !is_exported() {
        assert!(!serving.is_finished());
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    assert_eq!(exported(&registry), documented("Coordinator"));
    stop.cancel();
    serving.await.unwrap().unwrap();
}

#[test]
fn the_workers_metrics_are_documented() {
    let mut registry = Registry::default();
    worker::Shared::default().metrics.register(&mut registry);
    assert_eq!(exported(&registry), documented("Worker"));
}
