//! Detection tasks: what is found does not depend on how the photos are divided into tasks, on who looks, or on who dies.
#![cfg(unix)]

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use blocks::{DetectTask, Plan, PlannedTask};
use common::cluster::{Running, coordinator, has_task};
use common::{city, done, json_of, refused};
use proto::watch_event::Event;
use proto::{Access, Outcome, TaskState};
use scene::{ArtefactId, Zones};
use serde_json::Value;
use store::{BlockingStore, Store};

/// A plan with zones of a small network's objects, trained in one process into the folder `calm`.
fn calm(at: &Path, views: u32) -> (Plan, Value) {
    city(at, views, 64, 48);
    common::write_tiny(at);
    #[rustfmt::skip]
    let words = [
        "train", "city", "--steps", "200", "--budget", "600", "--levels", "1", "--blocks", "tree", "--detector", "tiny.onnx",
        "--zone-weight", "2", "--threads", "1", "--out", "calm",
    ];
    let said = done(at, &words);
    let frame = store(at, "calm/store").get(said["plan"].as_str().unwrap().parse().unwrap()).unwrap();
    (Plan::from_frame(&frame).unwrap(), said)
}

fn store(at: &Path, folder: &str) -> BlockingStore {
    Store::open(&at.join(folder).display().to_string()).unwrap().blocking()
}

/// The same plan with this many photos a task.
fn divided(plan: &Plan, count: u32) -> Plan {
    let views = plan.detect_tasks.last().unwrap().views().end;
    let task = |first: u32| DetectTask { first, count: count.min(views - first), ..plan.detect_tasks[0].clone() };
    Plan { detect_tasks: (0..views).step_by(count as usize).map(task).collect(), ..plan.clone() }
}

fn worker(at: &Path, url: &str, name: &str) -> Running {
    let words = ["worker", "--coordinator", url, "--name", name, "--threads", "1", "--quiet"];
    Running::start(&mut common::command(at, &words))
}

/// Submits a plan that is in the store.
fn submit(at: &Path, url: &str, plan: &Plan) {
    let shared = store(at, "shared");
    let id = shared.put(plan.to_frame()).unwrap();
    let request = proto::SubmitRequest { plan: id.0.to_vec(), store_url: shared.store().url().into() };
    runtime().block_on(async { proto::connect(url, &Access::default()).unwrap().submit(request).await }).unwrap();
}

/// Follows a job to its end: its outcome, the results of its tasks, and why tasks failed.
fn followed(url: &str, job: u64) -> (Outcome, BTreeMap<u32, ArtefactId>, Vec<String>) {
    let (mut results, mut failures) = (BTreeMap::new(), Vec::new());
    runtime().block_on(async {
        let mut client = proto::connect(url, &Access::default()).unwrap();
        let mut events = client.watch(proto::WatchRequest { job }).await.unwrap().into_inner();
        while let Some(event) = events.message().await.unwrap() {
            match event.event.unwrap() {
                Event::Changed(of) if of.state() == TaskState::Done => {
                    results.insert(of.task, proto::artefact_id(&of.artefact).unwrap());
                }
                Event::Changed(of) if matches!(of.state(), TaskState::Failed | TaskState::Quarantined) => {
                    failures.push(of.message);
                }
                Event::Finished(finished) => return (finished.outcome(), results, failures),
                _ => {}
            }
        }
        panic!("the stream ended before the job");
    })
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap()
}

/// What the detection tasks of a plan found, put together.
fn zones(plan: &Plan, store: &BlockingStore, result: impl Fn(u32) -> ArtefactId) -> Zones {
    let capture = dataset::ingest::load_capture(store, plan.capture).unwrap();
    let part = |(index, task): (u32, PlannedTask)| match task {
        PlannedTask::Detect(task) => {
            Some((task.first, dataset::zones::objects_from_frame(&store.get(result(index)).unwrap()).unwrap()))
        }
        _ => None,
    };
    dataset::zones::gathered(&capture, (0..).zip(plan.all_tasks()).filter_map(part).collect()).unwrap()
}

#[test]
fn workers_and_coordinators_that_die_while_they_look_for_objects_change_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let (plan, _) = calm(at, 160);
    assert!(plan.zones.is_none() && plan.detector.is_some());
    // The cluster has the photos, and no memory of what was found on them.
    assert!(Command::new("cp").args(["-r", "calm/store", "shared"]).current_dir(at).status().unwrap().success());
    for names in ["zones", "results"] {
        fs::remove_dir_all(at.join("shared/names").join(names)).unwrap();
    }
    let divided = divided(&plan, 23);
    assert_eq!(divided.detect_tasks.len(), 7);

    let (host, url) = coordinator(at);
    submit(at, &url, &divided);
    let first = worker(at, &url, "first");
    assert!(has_task(at, &["--coordinator", &url], "first"));
    first.signal("-KILL");
    let status = done(at, &["status", "1", "--coordinator", &url]);
    let task = status["running"][0]["task"].as_u64().unwrap_or_default();
    assert!(task >= divided.first_detection() as u64, "the worker is killed while it looks for objects: {status}");
    let second = worker(at, &url, "second");
    assert!(has_task(at, &["--coordinator", &url], "second"));
    host.signal("-KILL");
    second.signal("-KILL");
    let (_host, url) = coordinator(at);
    let _workers = ["third", "fourth"].map(|name| worker(at, &url, name));
    let (outcome, results, failures) = followed(&url, 1);
    assert!(outcome == Outcome::Done && failures.is_empty() && results.len() == divided.len(), "{failures:?}");

    let whole = store(at, "calm/store");
    let model: Value = serde_json::from_slice(&fs::read(at.join("calm/model/model.json")).unwrap()).unwrap();
    let blocks = model["blocks"].as_array().unwrap();
    for (index, task) in (0..).zip(&divided.tasks) {
        let name = serde_json::to_value(task.block).unwrap();
        let block = blocks.iter().find(|of| of["block"] == name).unwrap();
        assert_eq!(block["artefact"], results[&index].to_string(), "block {}", task.block);
    }
    let found = zones(&divided, &store(at, "shared"), |task| results[&task]);
    // In one process each result is recorded by the plan and the task, which has no inputs.
    let recorded = |task: u32| {
        let key = proto::result_key(plan.id(), task, &BTreeMap::new());
        let record = whole.get_record(&format!("results/{key}")).unwrap().unwrap();
        ArtefactId(record.as_ref().try_into().unwrap())
    };
    assert!(!found.is_empty() && found == zones(&plan, &whole, recorded));
    // The tasks are named by what they do.
    let log = common::plat(at, &["logs", "1", "--coordinator", &url]);
    let log = String::from_utf8(log.stdout).unwrap();
    assert!(log.contains(&format!("detection task {}, attempt 1", divided.first_detection())), "{log}");
}

#[test]
fn a_detector_that_fails_on_workers_ends_the_job_with_its_reason() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let (plan, _) = calm(at, 16);
    assert!(Command::new("cp").args(["-r", "calm/store", "shared"]).current_dir(at).status().unwrap().success());
    let shared = store(at, "shared");
    let onnx = fs::read(at.join("tiny.onnx")).unwrap();
    let put = |onnx: &[u8], card: &str| shared.put(dataset::networks::to_frame(onnx, Some(card))).unwrap();
    let (host, url) = coordinator(at);
    let _worker = worker(at, &url, "only");
    let cases = [
        (put(b"no network", "score = 0.5"), "is not an ONNX graph"),
        (put(&onnx, "classes = ['car']"), "a detector has"),
        (shared.put(b"no frame".as_slice()).unwrap(), "not a plat 'netw' frame"),
    ];
    for (job, (detector, reason)) in (1..).zip(cases) {
        submit(at, &url, &Plan { detector: Some(detector), ..plan.clone() });
        let (outcome, results, failures) = followed(&url, job);
        assert!(outcome == Outcome::Incomplete && results.is_empty(), "{failures:?}");
        assert!(failures.len() == 1 && failures[0].contains(reason), "{failures:?}");
    }
    // A plan that looks at more photos than there are.
    let mut more = plan.clone();
    more.detect_tasks[0].count += 1;
    submit(at, &url, &more);
    let (outcome, _, failures) = followed(&url, 4);
    assert!(outcome == Outcome::Incomplete && failures[0].contains("do not exist"), "{failures:?}");
    drop(host);
}

#[test]
fn what_is_no_detector_is_refused_before_anything_is_submitted() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 16, 64, 48);
    let tiny = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../perceive/tests/yolov8_tiny.onnx");
    for (name, onnx, card) in [
        ("text", b"no network".to_vec(), "score = 0.5"),
        ("card", fs::read(&tiny).unwrap(), "classes = ['car']"),
        ("keys", fs::read(&tiny).unwrap(), "colour = 'red'"),
    ] {
        fs::write(at.join(name).with_extension("onnx"), onnx).unwrap();
        fs::write(at.join(name).with_extension("toml"), card).unwrap();
    }
    let (_host, url) = coordinator(at);
    let says = [
        ("text.onnx", "is not an ONNX graph"),
        ("card.onnx", "a detector has"),
        ("keys.onnx", "colour"),
        ("none.onnx", "none.onnx"),
    ];
    for (file, says) in says {
        refused(at, &["train", "city", "--detector", file, "--out", "out"], says);
        refused(at, &["submit", "city", "--detector", file, "--coordinator", &url, "--quiet"], says);
    }
    assert_eq!(done(at, &["jobs", "--coordinator", &url])["jobs"].as_array().unwrap().len(), 0);
    assert!(!at.join("out").exists() && !at.join("shared/artefacts").exists());
}

#[test]
fn objects_are_looked_for_on_two_workers_and_found_again() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let (plan, calm) = calm(at, 16);
    assert_eq!(calm["resumed"], 0);
    #[rustfmt::skip]
    let words = ["train", "city", "--config", "calm/config.toml", "--workers", "2", "--threads", "1", "--out", "two"];
    let two = json_of(&mut common::command(at, &words));
    let merged = |out: &str| fs::read(at.join(out).join("merged.ply")).unwrap();
    assert!(two["plan"] == calm["plan"] && merged("two") == merged("calm"), "the same plan gives another model");
    // Every task's result is found again, those of detection as well.
    let again = json_of(&mut common::command(at, &words));
    assert_eq!(again["resumed"], plan.len());
}
