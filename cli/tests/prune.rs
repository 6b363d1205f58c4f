//! `plat prune` as run by scripts.

mod common;

use common::{city, command, done, json_of, refused};
use glam::Vec3;
use scene::{Splat, Splats, ply};

#[test]
fn a_file_is_pruned_by_opacity_and_size_alone() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let mut splats = Splats::new(0);
    for i in 0..10 {
        let opacity = if i % 2 == 0 { 0.9 } else { 0.1 };
        splats.push(&Splat::round(Vec3::new(i as f32, 0.0, 0.0), -1.0, Vec3::splat(0.5), opacity));
    }
    std::fs::write(at.join("ten.ply"), ply::write(&splats, &["antialiased"])).unwrap();
    let said = done(at, &["prune", "ten.ply", "--keep", "0.5", "--out", "new/five.ply"]);
    assert_eq!((&said["splats_before"], &said["splats"], &said["order"]), (&10.into(), &5.into(), &"surface".into()));
    let bytes = std::fs::read(at.join("new/five.ply")).unwrap();
    assert_eq!(ply::read(&bytes).unwrap(), splats.select(&[0, 2, 4, 6, 8]));
    assert!(ply::comments(&bytes).iter().any(|comment| comment == "antialiased"), "the antialiased comment was lost");

    let out = ["--out", "o.ply"];
    let prune = |words: &[&'static str]| [&["prune", "ten.ply"][..], &out, words].concat();
    refused(at, &prune(&[]), "--capture");
    refused(at, &prune(&["--tolerance-db", "0.1"]), "--capture");
    refused(at, &prune(&["--tolerance-db=-1"]), "--tolerance-db");
    refused(at, &prune(&["--tolerance-db", "0.1", "--keep", "0.5"]), "--keep");
    for share in ["0", "1.5", "nan", "half"] {
        refused(at, &[&prune(&["--keep"])[..], &[share]].concat(), "--keep");
    }
    refused(at, &prune(&["--tolerance-db=inf"]), "--tolerance-db");
    refused(at, &prune(&["--keep", "0.001"]), "--keep");
    refused(at, &prune(&["--tolerance-db", "0.1", "--capture", "missing"]), "missing");
    assert!(!at.join("o.ply").exists());
    refused(at, &["prune", "ten.ply", "--keep", "0.5", "--out", "ten.ply"], "ten.ply");
    refused(at, &["prune", "ten.ply", "--keep", "0.5", "--out", "ten.spz"], ".ply");
    refused(at, &["prune", "missing.ply", "--keep", "0.5", "--out", "o.ply"], "missing.ply");
}

#[test]
fn a_trained_folder_is_pruned_within_a_tolerance_reproducibly() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 20, 64, 48);
    let options = ["--steps", "80", "--budget", "1500", "--levels", "1", "--test-every", "5"];
    done(at, &[&["train", "city", "--out", "model"][..], &options].concat());
    let prune = |out: &str, threads: &str, more: &[&str]| {
        let words = [&["prune", "model", "--capture", "city", "--out", out][..], more].concat();
        json_of(command(at, &words).env("RAYON_NUM_THREADS", threads))
    };
    let said = prune("one", "1", &["--tolerance-db", "0.3"]);
    prune("two", "2", &["--tolerance-db", "0.3"]);
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    assert!(bytes("one/merged.ply") == bytes("two/merged.ply"), "the number of threads changes the result");
    assert_eq!(bytes("one/model/model.json"), bytes("two/model/model.json"));

    let before = ply::read(&bytes("model/merged.ply")).unwrap().len();
    let merged = ply::read(&bytes("one/merged.ply")).unwrap();
    assert!(merged.len() < before, "{said}");
    assert_eq!((&said["splats_before"], &said["splats"]), (&before.into(), &merged.len().into()));
    let held_in = said["held_in_psnr"].as_array().unwrap();
    assert!(held_in[1].as_f64().unwrap() >= held_in[0].as_f64().unwrap() - 0.3 - 1e-6, "{said}");
    // The folder is a complete model: its blocks merge to the same splats and give the same figures.
    done(at, &["export", "one", "--to", "ply", "--out", "sewn.ply"]);
    assert_eq!(bytes("sewn.ply"), bytes("one/merged.ply"));
    let measured = done(at, &["eval", "one", "city"])["psnr"].as_f64().unwrap();
    assert!((measured - said["psnr"].as_f64().unwrap()).abs() < 1e-3, "{measured} {said}");

    let said = prune("half", "2", &["--keep", "0.5"]);
    assert_eq!(said["splats"], (before as f64 * 0.5).round() as u64);
    refused(at, &["prune", "model", "--keep", "0.5", "--out", "model"], "model");
    refused(at, &["prune", "model/model", "--keep", "0.5", "--out", "model"], "model");
    refused(at, &["prune", "model", "--keep", "0.5", "--out", "sewn.ply"], "sewn.ply");
}
