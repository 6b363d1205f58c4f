//! `plat objects pose`: the traffic of a generated city is put on the road of its model, from positions alone.

mod common;

use std::fs;

use common::{done, refused};
use serde_json::{Value, json};

#[test]
fn vehicles_get_their_poses_from_positions_and_the_road() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    done(
        at,
        &["synth", "--area-km2", "0.02", "--views", "60", "--size", "160x90", "--traffic", "medium", "--out", "city"],
    );
    done(at, &["train", "city", "--steps", "300", "--budget", "6000", "--levels", "0", "--out", "model"]);
    let truth: Value = serde_json::from_slice(&fs::read(at.join("city/tracks.json")).unwrap()).unwrap();
    // Positions of vehicles, a tenth of a metre off and half a metre too high or low, some of them missing.
    let mut tracks = Vec::new();
    for track in truth["tracks"].as_array().unwrap().iter().filter(|track| track["class"] == "car").take(6) {
        let poses = track["poses"].as_array().unwrap().iter().enumerate().filter(|(i, _)| i % 7 != 3);
        let positions = poses.map(|(i, pose)| {
            let off = |k: usize, by: f64| by * (((i * 37 + k * 11) % 19) as f64 / 9.0 - 1.0);
            let place = |k: usize, by: f64| pose[1][k].as_f64().unwrap() + off(k, by);
            json!([pose[0], [place(0, 0.1), place(1, 0.1), place(2, 0.5)]])
        });
        let [id, class, low, high] = ["instance", "class", "low", "high"].map(|key| track[key].clone());
        let positions: Vec<Value> = positions.collect();
        tracks.push(json!({"id": id.to_string(), "class": class, "low": low, "high": high, "positions": positions}));
    }
    assert!(!tracks.is_empty());
    let write = |name: &str, tracks: &[Value]| fs::write(at.join(name), json!({"tracks": tracks}).to_string()).unwrap();
    write("positions.json", &tracks);
    let pose = ["objects", "pose", "model", "--positions", "positions.json"];
    let words = |out| [&pose[..], &["--against", "city/tracks.json", "--out", out]].concat();
    let said = done(at, &words("a.json"));
    println!("{said}");
    assert_eq!(said["objects"], tracks.len());
    // Of a model that is a fog, few corners find a road.
    let [poses, on_road] = ["poses", "on_road"].map(|name| said[name].as_u64().unwrap());
    assert!((poses / 10..=poses).contains(&on_road), "{said}");
    let against = &said["against"];
    assert!(
        against["within_10_degrees"].as_f64() > Some(0.8) && against["within_30_degrees"].as_f64() > Some(0.95),
        "{said}"
    );
    // Of that model, too.
    assert!(against["median_height_metres"].as_f64() < Some(0.5), "{said}");
    done(at, &words("b.json"));
    let bytes = |name: &str| fs::read(at.join(name)).unwrap();
    assert!(bytes("a.json") == bytes("b.json"));
    // What comes out is what goes in beside a capture.
    fs::copy(at.join("a.json"), at.join("city/tracks.json")).unwrap();
    done(at, &["inspect", "city"]);

    let mut far = tracks.clone();
    for position in far[0]["positions"].as_array_mut().unwrap() {
        position[1][0] = json!(position[1][0].as_f64().unwrap() + 1e4);
    }
    write("far.json", &far[..1]);
    let refused_with = |file: &str, says: &str| {
        refused(at, &["objects", "pose", "model", "--positions", file, "--out", "o.json"], says);
    };
    refused_with("far.json", "nowhere near");
    let mut jumps = tracks;
    jumps[0]["positions"][2][1][0] = json!(5000);
    write("jumps.json", &jumps);
    refused_with("jumps.json", "jumps");
    write("none.json", &[]);
    refused_with("none.json", "has no object");
    fs::write(at.join("text.json"), "positions").unwrap();
    refused_with("text.json", "text.json");
    refused_with("missing.json", "missing.json");
    write(
        "other.json",
        &[
            json!({"id": "x", "class": "car", "low": [0, 0, 0], "high": [1, 1, 1], "poses": [[0, [0, 0, 0], [0, 0, 0, 1]]]}),
        ],
    );
    refused(at, &[&pose[..], &["--against", "other.json", "--out", "o.json"]].concat(), "none of the objects");
    assert!(!at.join("o.json").exists());
}
