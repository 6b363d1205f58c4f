//! A cluster of real processes on one machine, some of which die.
#![cfg(unix)]

mod common;

use std::path::Path;
use std::time::Duration;

use common::cluster::{Running, coordinator, has_task};
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use serde_json::Value;

#[rustfmt::skip]
const PLAN: [&str; 8] = ["--steps", "960", "--budget", "900", "--levels", "1", "--blocks", "tree"];

fn worker(at: &Path, url: &str, name: &str) -> Running {
    let words = ["worker", "--coordinator", url, "--name", name, "--threads", "1", "--checkpoint-every", "0.05"];
    Running::start(&mut common::command(at, &[&words[..], &["--quiet", "--json"]].concat()))
}

#[test]
fn a_cluster_whose_workers_are_killed_and_stopped_gives_the_bytes_of_one_process() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    let (host, url) = coordinator(at);
    let asked = |words: &[&str]| common::done(at, &[words, &["--coordinator", &url]].concat());
    assert_eq!(asked(&["jobs"])["jobs"].as_array().unwrap().len(), 0);
    let words = ["submit", "city", "--coordinator", &url, "--wait", "--out", "far", "--json", "--evaluate"];
    let submit = Running::start(&mut common::command(at, &[&words[..], &PLAN].concat()));

    // One worker is killed while it trains; one is stopped and returns its task. Each is the only worker until then, so that it has a
    // task.
    let first = worker(at, &url, "first");
    assert!(has_task(at, &["--coordinator", &url], "first"));
    first.signal("-KILL");
    let second = worker(at, &url, "second");
    assert!(has_task(at, &["--coordinator", &url], "second"));
    second.signal("-TERM");
    let left = second.end();
    assert!(left.status.success(), "{}", left.stderr);
    let left: Value = serde_json::from_str(&left.stdout).unwrap();
    assert_eq!(left["name"], "second");
    let status = asked(&["status", "1"]);
    let holders: Vec<&Value> = status["running"].as_array().unwrap().iter().map(|task| &task["worker"]).collect();
    assert!(status["state"] == "running" && !holders.contains(&&left["name"]), "{status}");
    let last = ["third", "fourth"].map(|name| worker(at, &url, name));
    let submit = submit.end();
    assert!(submit.status.success(), "{}", submit.stderr);
    let said: Value = serde_json::from_str(submit.stdout.lines().last().unwrap()).unwrap();
    assert_eq!((&said["job"], said["tasks"].as_u64() > Some(2)), (&1.into(), true), "{said}");
    let ends = last.map(|worker| {
        worker.signal("-TERM");
        serde_json::from_str::<Value>(&worker.end().stdout).unwrap()
    });
    assert!(ends.iter().any(|end| end["resumed"].as_u64() >= Some(1)), "no worker resumed from a checkpoint: {ends:?}");

    let train = ["train", "city", "--out", "calm", "--workers", "1", "--evaluate"];
    let calm = common::done(at, &[&train[..], &PLAN].concat());
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    assert!(bytes("far/merged.ply") == bytes("calm/merged.ply"), "the cluster changes the result");
    assert_eq!((&said["plan"], &said["splats"]), (&calm["plan"], &calm["splats"]));
    // The workers measured the model too.
    let measured = common::done(at, &["eval", "far", "city", "--out", "eval"]);
    assert!(measured["psnr"].is_f64() && measured["psnr"] == said["psnr"] && said["psnr"] == calm["psnr"], "{said}");

    // The log is complete, and no task is left.
    let log = asked(&["logs", "1"]);
    let lines: Vec<&str> = log["lines"].as_array().unwrap().iter().map(|line| line["what"].as_str().unwrap()).collect();
    assert!(lines[0].starts_with("submitted") && lines.last() == Some(&"finished: Done"), "{lines:?}");
    let trouble =
        |line: &&str| line.starts_with("ended without a result, GivenBack") || *line == "waits for a worker again";
    assert!(lines.iter().any(trouble), "{lines:?}");
    assert_eq!(asked(&["jobs"])["jobs"][0]["state"], "done");
    assert_eq!(asked(&["status", "1", "--watch"])["done"], said["tasks"]);
    host.signal("-TERM");
    assert!(host.end().status.success());
}

#[test]
fn a_damaged_result_is_recomputed() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    let (_host, url) = coordinator(at);
    let words = ["submit", "city", "--coordinator", &url, "--wait", "--out", "far"];
    let submit = Running::start(&mut common::command(at, &[&words[..], &PLAN].concat()));
    // The root's result exists, and its dependents are not finished.
    let first = worker(at, &url, "first");
    let results = at.join("shared/names/results");
    let root = loop {
        let found = std::fs::read_dir(&results).into_iter().flatten().filter_map(|entry| entry.ok());
        // A file that is being written has a temporary name and may be gone by now.
        let mut records = found.filter_map(|entry| std::fs::read(entry.path()).ok()).filter(|bytes| bytes.len() == 32);
        match records.next() {
            Some(root) => break root,
            None => std::thread::sleep(Duration::from_millis(5)),
        }
    };
    first.signal("-TERM");
    assert!(first.end().status.success());
    let name: String = root.iter().map(|byte| format!("{byte:02x}")).collect();
    let artefact = at.join("shared/artefacts").join(&name[..2]).join(&name);
    let sound = std::fs::read(&artefact).unwrap();
    let mut damaged = sound.clone();
    damaged[sound.len() / 2] ^= 1;
    std::fs::write(&artefact, damaged).unwrap();
    let second = worker(at, &url, "second");
    let submit = submit.end();
    assert!(submit.status.success(), "{}", submit.stderr);
    assert!(std::fs::read(&artefact).unwrap() == sound, "the recomputed artefact differs");
    second.signal("-TERM");
    assert!(second.end().status.success());
    common::done(at, &[&["train", "city", "--out", "calm", "--workers", "1"][..], &PLAN].concat());
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    assert!(bytes("far/merged.ply") == bytes("calm/merged.ply"), "the damage changes the result");
}

#[test]
fn waiting_for_a_job_survives_a_restart_of_the_coordinator() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    let (host, _) = coordinator(at);
    let store = format!("file://{}", at.join("shared").display());
    let words = ["submit", "city", "--coordinator", &store, "--wait"];
    let submit = Running::start(&mut common::command(at, &[&words[..], &PLAN].concat()));
    submit.line_with("job 1 of");
    host.signal("-KILL");
    submit.line_with("waiting for the coordinator");
    let (_next, url) = coordinator(at);
    assert_eq!(common::done(at, &["cancel", "1", "--coordinator", &url])["state"], "cancelled");
    let submit = submit.end();
    assert!(submit.status.code() == Some(1) && submit.stderr.contains("job 1 was cancelled"), "{}", submit.stderr);
}

#[test]
fn a_block_is_given_to_a_worker_with_enough_memory() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    let (_host, url) = coordinator(at);
    let asked = |words: &[&str]| common::done(at, &[words, &["--coordinator", &url]].concat());
    let until = |job: &str, state: &str| {
        // The same timeout as for lines: a block that no worker gets would be waited for forever.
        for _ in 0..1200 {
            let status = asked(&["status", job]);
            if status["state"] == state {
                return status;
            }
            assert_eq!(status["state"], "running", "{status}");
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("job {job} does not become {state}");
    };
    // The estimate for training 40,000 splats is over 100 MiB, for 2,000 under 24 MiB, which the program alone nearly needs.
    let plan = ["--blocks", "whole", "--steps", "200", "--tolerance-db", "0"];
    asked(&[&["submit", "city", "--budget", "40000"][..], &plan].concat());
    asked(&[&["submit", "city", "--budget", "2000"][..], &plan].concat());
    let begin = |name: &str, memory: &str| {
        let words = ["worker", "--coordinator", &url, "--name", name, "--threads", "1", "--memory", memory, "--json"];
        Running::start(&mut common::command(at, &words))
    };
    let small = begin("small", "24");
    let failed = until("2", "incomplete");
    let line = failed["failures"][0]["message"].as_str().unwrap();
    assert!(line.contains("--memory gives it 24") && line.contains("add a larger worker"), "{line}");
    let first = asked(&["status", "1"]);
    assert!(first["state"] == "running" && first["running"].as_array().unwrap().is_empty(), "{first}");
    small.signal("-TERM");
    let large = begin("large", "auto");
    asked(&["retry", "2", "0/0/0"]);
    until("1", "done");
    until("2", "done");
    let [small, large] = [small, large].map(|worker| {
        worker.signal("-TERM");
        serde_json::from_str::<Value>(&worker.end().stdout).unwrap()
    });
    assert_eq!((&small["done"], &small["memory_bytes"]), (&0.into(), &(24 << 20).into()));
    assert_eq!(
        (&large["done"], &large["resumed"]),
        (&2.into(), &1.into()),
        "it did not resume from the checkpoint: {large}"
    );
    assert!(large["memory_bytes"].as_u64() > Some(256 << 20), "{large}");
    common::refused(at, &["worker", "--coordinator", &url, "--memory", "8"], "--memory");
}

#[test]
fn clusters_of_several_sizes_are_compared() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    let words = ["bench", "scale", "city", "--workers", "1,2", "--rounds", "1", "--results", "results", "--json", "--"];
    let output = common::plat(at, &[&words[..], &PLAN].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let lines = std::fs::read_to_string(at.join("results/scale.jsonl")).unwrap();
    let lines: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let workers: Vec<u64> = lines.iter().map(|line| line["workers"].as_u64().unwrap()).collect();
    assert_eq!(workers, [1, 2]);
    for line in &lines {
        assert!(line["plan"] == lines[0]["plan"] && line["tasks"].as_u64() > Some(2), "{line}");
        // Every cluster starts with an empty store: photos and context were read, results written.
        assert!(line["bytes_read"].as_u64() > Some(10_000) && line["bytes_written"].as_u64() > Some(10_000), "{line}");
        assert!(line["job_seconds"].as_f64() > Some(0.0) && line["cpu_seconds"].as_f64() > Some(0.0), "{line}");
    }
    common::refused(at, &["bench", "scale", "city", "--workers", "0"], "--workers");
}

#[test]
fn jobs_can_be_controlled_and_wrong_requests_are_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    let (host, url) = coordinator(at);
    let to = |words: &[&str]| -> Vec<String> {
        words.iter().chain(&["--coordinator", &url, "--quiet"]).map(ToString::to_string).collect()
    };
    let asked = |words: &[&str]| common::done(at, &to(words).iter().map(String::as_str).collect::<Vec<_>>());
    let refused = |words: &[&str], wanted: &str| {
        common::refused(at, &to(words).iter().map(String::as_str).collect::<Vec<_>>(), wanted);
    };
    refused(&["status", "1"], "no job 1");
    let said = asked(&[&["submit", "city"][..], &PLAN].concat());
    assert_eq!((&said["job"], said["tasks"].as_u64() > Some(2)), (&1.into(), true));
    // There is no worker, so all tasks wait.
    assert_eq!((&asked(&["status", "1"])["done"], &asked(&["pause", "1"])["state"]), (&0.into(), &"paused".into()));
    assert_eq!(asked(&["resume", "1"])["state"], "running");
    refused(&["retry", "1", "0/0/0"], "neither failed");
    refused(&["retry", "1", "7/0/0"], "block 7/0/0");
    refused(&["retry", "1", "first"], "level/x/y");
    refused(&["submit", "city", "--out", "o"], "--wait");
    refused(&["submit", "city", "--backend", "gpu"], "--backend");
    refused(&["worker", "--name", "two words"], "--name");
    assert_eq!(asked(&["cancel", "1"])["state"], "cancelled");
    let watched = common::plat(at, &["status", "1", "--watch", "--coordinator", &url, "--json"]);
    assert_eq!(watched.status.code(), Some(1), "the exit code is not that of the job");
    let words: Vec<String> = asked(&["logs", "1", "--follow"])["lines"]
        .as_array()
        .unwrap()
        .iter()
        .map(|line| line["what"].as_str().unwrap().to_string())
        .collect();
    assert_eq!(
        words[1..],
        [
            "requested: pause",
            "requested: resume",
            "requested: retry task 0",
            "requested: cancel",
            "finished: Cancelled"
        ]
    );
    // Only the plan is left; the store names the leader.
    let store = format!("file://{}", at.join("shared").display());
    let forgotten = common::done(at, &["forget", "1", "--coordinator", &store]);
    assert_eq!((&forgotten["job"], &forgotten["deleted"]), (&1.into(), &1.into()));
    refused(&["status", "1"], "no job 1");
    drop(host);

    // No coordinator; no CA certificate; no token; another store.
    common::stopped(&mut common::command(at, &["jobs", "--coordinator", &url]), 1, "check that it is running");
    common::refused(at, &["jobs", "--coordinator", "https://127.0.0.1:1"], "--tls-ca");
    common::refused(at, &["jobs"], "--coordinator");
    std::fs::write(at.join("token"), "short\n").unwrap();
    let listen = ["coordinator", "--store", "s", "--listen"];
    common::refused(at, &[&listen[..], &["127.0.0.1:0", "--token-file", "token"]].concat(), "token");
    common::refused(at, &[&listen[..], &["127.0.0.1:0", "--tls-cert", "token"]].concat(), "--tls-key");
    let pair = ["--tls-cert", "token", "--tls-key", "token"];
    common::refused(at, &[&listen[..], &["127.0.0.1:0"], &pair[..]].concat(), "certificate");
    common::refused(at, &[&listen[..], &["0.0.0.0:0", "--quiet"]].concat(), "other machines");
}

#[test]
fn a_missing_client_certificate_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let signed = |params: CertificateParams, issuer: Option<&Issuer<KeyPair>>| {
        let key = KeyPair::generate().unwrap();
        let certificate = match issuer {
            Some(issuer) => params.signed_by(&key, issuer).unwrap(),
            None => params.clone().self_signed(&key).unwrap(),
        };
        (certificate.pem(), key, params)
    };
    let mut params = CertificateParams::new(Vec::<String>::new()).unwrap();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let (authority, key, params) = signed(params, None);
    let issuer = Issuer::new(params, key);
    std::fs::write(at.join("ca.pem"), authority).unwrap();
    for name in ["server", "client"] {
        let params = CertificateParams::new(["127.0.0.1".to_string()]).unwrap();
        let (certificate, key, _) = signed(params, Some(&issuer));
        std::fs::write(at.join(format!("{name}.pem")), certificate).unwrap();
        std::fs::write(at.join(format!("{name}.key")), key.serialize_pem()).unwrap();
    }
    #[rustfmt::skip]
    let words = ["coordinator", "--store", "s", "--listen", "127.0.0.1:0", "--tls-cert", "server.pem", "--tls-key", "server.key",
        "--tls-client-ca", "ca.pem"];
    let host = Running::start(&mut common::command(at, &words));
    let line = host.line_with("https://");
    let url = line.split_whitespace().find(|word| word.starts_with("https://")).unwrap().trim_end_matches(',');
    host.line_with("leading");
    let jobs = ["jobs", "--coordinator", url, "--tls-ca", "ca.pem"];
    common::done(at, &[&jobs[..], &["--tls-cert", "client.pem", "--tls-key", "client.key"]].concat());
    common::refused(at, &jobs, "requires a client certificate, and none is given; give --tls-cert");
}
