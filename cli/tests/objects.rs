//! Objects that move: trained beside the static scene, drawn where they are, left out, moved, and refused where their paths are wrong.

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use common::{done, refused, write_tiny};
use serde_json::Value;

const SYNTH: [&str; 16] = [
    "synth",
    "--area-km2",
    "0.02",
    "--views",
    "240",
    "--spacing",
    "2",
    "--size",
    "160x96",
    "--traffic",
    "medium",
    "--aerial",
    "0",
    "--out",
    "city",
    "--quiet",
];
const TRAIN: [&str; 11] =
    ["train", "city", "--steps", "1200", "--budget", "4000", "--levels", "1", "--tolerance-db", "0", "--quiet"];

/// Files of a folder, by name.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap());
    entries.map(|entry| (entry.file_name().into_string().unwrap(), fs::read(entry.path()).unwrap())).collect()
}

/// Whether two folders of pictures differ.
fn differ(at: &Path, a: &str, b: &str) -> bool {
    files(&at.join(a)) != files(&at.join(b))
}

/// A street that cameras on posts film for three seconds, and someone who walks there.
const FILM: [&str; 19] = [
    "synth",
    "--area-km2",
    "0.02",
    "--layout",
    "alley",
    "--traffic",
    "heavy",
    "--seed",
    "3",
    "--watch=-29,42,7",
    "--film",
    "3",
    "--views",
    "240",
    "--size",
    "192x108",
    "--quiet",
    "--out",
    "film",
];

#[test]
fn people_who_walk_swing_their_limbs() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let made = done(at, &FILM);
    assert_eq!(made["views"].as_u64().map(|views| (views % 30, views > 60)), Some((0, true)), "{made}");
    // Of another class they are rigid.
    let tracks = fs::read_to_string(at.join("film/tracks.json")).unwrap();
    let psnr = |out: &str, class: &str| {
        fs::write(at.join("film/tracks.json"), tracks.replace("\"person\"", &format!("\"{class}\""))).unwrap();
        let train = ["train", "film", "--out", out, "--steps", "3000", "--budget", "4000", "--levels", "1"];
        done(at, &[&train[..], &["--tolerance-db", "0", "--objects", "--backend", "cpu", "--quiet"]].concat());
        let report = done(at, &["eval", out, "film", "--backend", "cpu", "--quiet"]);
        report["moving"]["psnr"].as_f64().unwrap()
    };
    let [swinging, rigid] = [psnr("swinging", "person"), psnr("rigid", "statue")];
    println!("{swinging:.2} dB in boxes of people, {rigid:.2} dB where they are rigid");
    assert!(swinging > rigid + 1.0, "{swinging} {rigid}");
    assert!(!files(&at.join("rigid/objects")).keys().any(|name| name.ends_with(".swing")));

    // A garage keeps it.
    let of_objects = files(&at.join("swinging/objects"));
    let name = of_objects.keys().find_map(|name| name.strip_suffix(".swing")).unwrap();
    let swing = format!("{name}.swing");
    done(at, &["garage", "add", "garage", "--model", "swinging", "--object", name, "--name", "walker"]);
    done(at, &["garage", "place", "garage", "walker", "--model", "rigid", "--at", "0,0,0,0", "--id", "guest"]);
    let kept = [at.join("garage/walker.swing"), at.join("rigid/objects/guest.swing")];
    kept.iter().for_each(|path| assert!(fs::read(path).unwrap() == of_objects[&swing], "{}", path.display()));

    // One that is damaged is refused.
    fs::write(at.join("swinging/objects").join(&swing), &of_objects[&swing][..50]).unwrap();
    refused(at, &["eval", "swinging", "film", "--backend", "cpu"], &swing);
}

#[test]
fn what_moves_has_splats_of_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    done(at, &SYNTH);
    let found = done(at, &["inspect", "city"]);
    assert!(found["moving"].as_u64() > Some(3) && found["views_with_time"] == found["views"], "{found}");
    let train = |out: &str, more: &[&str]| {
        done(at, &[&TRAIN[..], &["--out", out, "--backend", "cpu"], more].concat());
        fs::read(at.join(out).join("merged.ply")).unwrap()
    };
    // The static scene is what it is without them, and the objects are what they are with any number of workers.
    let merged = train("model", &["--objects", "--threads", "1", "--evaluate"]);
    // Evaluation tasks draw them: the figures are those of plat eval.
    let in_job: Value = serde_json::from_slice(&fs::read(at.join("model/eval/report.json")).unwrap()).unwrap();
    let planned: Value = serde_json::from_slice(&fs::read(at.join("model/report.json")).unwrap()).unwrap();
    let after = done(at, &["eval", "model", "city", "--backend", "cpu", "--quiet"]);
    assert!(in_job["psnr"] == after["psnr"] && planned["objects"].as_u64() > Some(0), "{in_job} {planned}");
    let of_objects = files(&at.join("model/objects"));
    assert!(of_objects.len() > 1 && of_objects.contains_key("paths.json"), "{:?}", of_objects.keys());
    assert!(train("static", &[]) == merged && !at.join("static/objects").exists());
    assert!(train("two", &["--objects", "--workers", "2", "--threads", "2"]) == merged);
    assert!(files(&at.join("two/objects")) == of_objects, "the number of workers changes nothing");
    let name = of_objects.keys().find_map(|name| name.strip_suffix(".ply")).unwrap();

    // Held-out photos: inside its box far better than without it, outside as good.
    let moving = |model: &str| -> [f64; 2] {
        let report = done(at, &["eval", model, "city", "--backend", "cpu", "--quiet"]);
        let objects = report["moving"]["objects"].as_array().unwrap();
        let of = objects.iter().find(|of| of["id"] == *name).unwrap_or(&Value::Null);
        [of["psnr"].as_f64().unwrap(), report["psnr"].as_f64().unwrap()]
    };
    let [with, without] = [moving("model"), moving("static")];
    assert!(with[0] > without[0] + 6.0 && with[1] > without[1] - 0.1, "{with:?} {without:?}");

    // Where a photo shows it, the picture has it; at a time when it is elsewhere, it has not.
    let paths: Value = serde_json::from_slice(&of_objects["paths.json"]).unwrap();
    let track = paths["tracks"].as_array().unwrap().iter().find(|track| track["id"] == *name).unwrap();
    let poses = track["poses"].as_array().unwrap();
    let end = poses[poses.len() - 1][0].as_f64().unwrap();
    let late = format!("{}", end + 100.0);
    let render = |out: &str, more: &[&str]| {
        let words = ["render", "model", "--cameras", "city", "--out", out, "--backend", "cpu", "--quiet"];
        done(at, &[&words[..], more].concat())
    };
    assert!(render("composed", &[])["objects"].as_u64() > Some(0));
    assert_eq!(render("bare", &["--without", "all"])["objects"], 0);
    render("late", &["--time", &late]);
    assert!(differ(at, "composed", "bare") && !differ(at, "late", "bare"));
    render("without", &["--without", name]);
    render("moved", &["--move", &format!("{name}=0,0,3,90")]);
    assert!(differ(at, "without", "composed") && differ(at, "moved", "composed") && differ(at, "moved", "without"));
    let only = render("only", &["--only", name]);
    assert_eq!((&only["splats"], &only["objects"]), (&0.into(), &1.into()));
    refused(at, &["render", "static", "--cameras", "city", "--out", "x", "--time", "1"], "has no objects that move");
    refused(at, &["plan", "city", "--objects", "--no-masks", "--out", "plan.json"], "no photo has a mask");
    refused(at, &["render", "model", "--cameras", "city", "--out", "x", "--without", "none"], "has no object 'none'");
    refused(at, &["render", "model", "--cameras", "city", "--out", "x", "--move", "7=1,2"], "give ID=X,Y,Z");

    detected(at);
    films(at, "model");

    done(at, &["prune", "model", "--keep", "0.5", "--out", "pruned", "--quiet"]);
    assert!(files(&at.join("pruned/objects")) == of_objects, "a pruned model keeps its objects");

    // What is wrong with a path is said in one line.
    let tracks = fs::read_to_string(at.join("city/tracks.json")).unwrap();
    let changed = |from: &str, to: &str| {
        assert!(tracks.contains(from));
        fs::write(at.join("city/tracks.json"), tracks.replacen(from, to, 1)).unwrap();
    };
    changed("\"low\":[", "\"low\":[9e9,");
    refused(at, &["inspect", "city"], "tracks.json");
    let first: Value = serde_json::from_str(&tracks).unwrap();
    let place = first["tracks"][0]["poses"][1][1].to_string();
    changed(&place, "[1e5,0.0,0.0]");
    refused(at, &["inspect", "city"], "jumps");
    fs::write(at.join("city/tracks.json"), &tracks).unwrap();
    refused(at, &["plan", "city", "--blocks", "flat", "--objects", "--out", "plan.json"], "--objects");
    refused(at, &["train", "city", "--objects", "--minutes", "1", "--out", "x"], "--minutes");
}

/// Detectors look for objects where they were, and where a model puts them anew.
fn detected(at: &Path) {
    write_tiny(at);
    let eval = |model: &'static str, later: &'static str| {
        ["eval", model, "city", "--backend", "cpu", "--detector", "tiny.onnx", "--objects-later", later, "--quiet"]
    };
    let moved = |later: &'static str| done(at, &eval("model", later))["objects_moved"].clone();
    let (same, gone) = (moved("0"), moved("1000"));
    let of = &same["detectors"][0];
    assert!(same["views"].as_u64() > Some(0) && of["renders"]["boxes"].as_u64() > Some(0), "{same}");
    assert!(of["moved"] == of["renders"] && of["photos"]["boxes"] == of["renders"]["boxes"], "{same}");
    assert!(gone["detectors"][0]["moved"]["boxes"] == 0 && gone["detectors"][0]["renders"] == of["renders"], "{gone}");
    refused(at, &eval("static", "1"), "finds no objects in the model");
}

/// Films along one camera's photos of the city.
fn films(at: &Path, model: &str) {
    let follow = ["render", model, "--cameras", "city", "--backend", "cpu", "--quiet", "--sequence"];
    let film = |out: &str, more: &[&str]| {
        done(at, &[&follow[..], &["10", "--out", out, "--sensor", "street-front-left"], more].concat())
    };
    let said = film("film", &["--smooth", "1"]);
    let pictures = files(&at.join("film"));
    assert!(pictures.len() > 20 && said["views"] == pictures.len() && pictures.contains_key("000020.png"), "{said}");
    // Every fifth of a second one is that of a photo; a filter that takes nothing of the past changes nothing.
    let photo = |name: &str| image::open(at.join(name)).unwrap().to_rgb8();
    assert!(photo("film/000002.png") == photo("composed/street-front-left-0000-00001.png"));
    assert_eq!(said["flicker"][0], said["flicker"][1]);
    let calm = film("calm", &["--smooth", "0.4"]);
    let flicker = |i: usize| calm["flicker"][i].as_f64().unwrap();
    assert!(flicker(1) < 0.9 * flicker(0) && flicker(0) == said["flicker"][0].as_f64().unwrap(), "{calm}");
    film("tinted", &["--overlay"]);
    assert!(differ(at, "tinted", "film"));

    // As one file, whose pictures are the same.
    let said = film("film.apng", &[]);
    let bytes = fs::read(at.join("film.apng")).unwrap();
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
    assert_eq!(reader.info().animation_control().map(|of| u64::from(of.num_frames)), said["views"].as_u64());
    let mut first = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut first).unwrap();
    assert!(first == photo("film/000000.png").into_raw());
    if std::process::Command::new("ffmpeg").arg("-version").output().is_ok() {
        film("film.mp4", &[]);
        let bytes = fs::read(at.join("film.mp4")).unwrap();
        assert!(bytes.len() > 5_000 && &bytes[4..8] == b"ftyp");
    } else {
        println!("skipped: ffmpeg is not there");
        refused(at, &[&follow[..], &["9", "--out", "x.mp4", "--sensor", "street-left"]].concat(), "install ffmpeg");
    }
    let left: Vec<String> = files_named(at, ".part");
    assert!(left.is_empty(), "{left:?}");

    refused(at, &[&follow[..], &["10", "--out", "x"]].concat(), "name one of them by --sensor");
    refused(at, &[&follow[..], &["10", "--out", "x", "--sensor", "roof"]].concat(), "street-front-left");
    refused(at, &[&follow[..], &["0", "--out", "x"]].concat(), "pictures a second");
    refused(at, &[&follow[..6], &["--out", "x", "--smooth", "0.5"]].concat(), "--sequence");
    refused(at, &[&follow[..6], &["--out", "x", "--overlay", "--without", "all"]].concat(), "--overlay");
}

/// Names in a folder that contain this.
fn files_named(at: &Path, part: &str) -> Vec<String> {
    let names = fs::read_dir(at).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter(|name| name.contains(part)).collect()
}
