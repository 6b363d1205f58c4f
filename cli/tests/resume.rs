//! A killed job is resumed and ends with the same bytes.

mod common;

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use serde_json::Value;

#[rustfmt::skip]
const JOB: [&str; 11] = [
    "train", "city", "--steps", "240", "--budget", "900", "--levels", "1", "--checkpoint-every", "0", "--exposure",
];

/// The command of the job, not yet started.
fn job(at: &Path, words: &[&str]) -> Command {
    common::command(at, &[&JOB, words].concat())
}

fn done(at: &Path, words: &[&str]) -> Value {
    common::json_of(&mut job(at, words))
}

#[test]
fn a_job_killed_five_times_gives_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 20, 64, 48);
    let undisturbed = done(at, &["--out", "calm", "--threads", "1"]);
    assert_eq!(undisturbed["resumed"], 0);

    // Lines of metrics.jsonl after which a run is killed: within the root, within leaves, in between.
    let mut kills = 0;
    for (n, lines) in [2, 9, 1, 14, 5].into_iter().enumerate() {
        let threads = ["1", "2"][n % 2];
        let mut run = job(at, &["--out", "killed", "--threads", threads]);
        let mut run = run.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let journal = at.join("killed/metrics.jsonl");
        let _ = std::fs::remove_file(&journal);
        loop {
            let written = std::fs::read_to_string(&journal).map_or(0, |text| text.lines().count());
            if run.try_wait().unwrap().is_some() {
                break;
            }
            if written >= lines {
                run.kill().unwrap();
                run.wait().unwrap();
                kills += 1;
                break;
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }
    assert!(kills >= 3, "only {kills} kills came before the end");
    let resumed = done(at, &["--out", "killed", "--threads", "2"]);
    assert!(resumed["resumed"].as_u64() >= Some(1), "{resumed}");
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    assert!(bytes("calm/merged.ply") == bytes("killed/merged.ply"), "a kill changes the result");
    assert!(bytes("calm/model/exposures.plat") == bytes("killed/model/exposures.plat"));
    assert_eq!(undisturbed["psnr"], resumed["psnr"]);

    // All tasks are finished already, unless --fresh is given.
    let again = done(at, &["--out", "killed"]);
    assert_eq!((&again["resumed"], &again["psnr"]), (&again["tasks"], &resumed["psnr"]));
    let anew = done(at, &["--out", "killed", "--fresh"]);
    assert_eq!((&anew["resumed"], &anew["psnr"]), (&0.into(), &resumed["psnr"]));
    assert!(bytes("calm/merged.ply") == bytes("killed/merged.ply"));
}
