//! `plat doctor` as run by scripts.

mod common;

use common::{command, done, plat, refused, stopped};

#[test]
fn a_folder_is_tested_and_left_empty() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let output = plat(at, &["doctor", "--store", "store"]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(
        text.contains("12 of 12 races had exactly one winner")
            && text.trim_end().ends_with("store is fit for a cluster"),
        "{text}"
    );
    let found = done(at, &["doctor", "--store", "store"]);
    assert_eq!((&found["fit"], &found["races"], &found["races_held"]), (&true.into(), &12.into(), &12.into()));
    for key in ["create_p50_ms", "create_p99_ms", "read_p99_ms", "write_bytes_per_second", "read_bytes_per_second"] {
        assert!(found[key].as_f64().is_some_and(|value| value > 0.0), "{key}: {found}");
    }
}

#[test]
fn bad_urls_are_refused_and_unwritable_stores_fail() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    refused(at, &["doctor"], "--store");
    refused(at, &["doctor", "--store", "gs://bucket"], "gs://");
    // Incomplete keys are reported before any request to the server.
    let mut half = command(at, &["doctor", "--store", "s3://bucket/prefix"]);
    stopped(half.env("AWS_ACCESS_KEY_ID", "k").env_remove("AWS_SECRET_ACCESS_KEY"), 2, "half of its keys");
    std::fs::create_dir(at.join("store")).unwrap();
    std::fs::write(at.join("store/names"), "a file where the folder should be").unwrap();
    stopped(&mut command(at, &["doctor", "--store", "store"]), 1, "cannot write names/doctor");
}
