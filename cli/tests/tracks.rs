//! `plat objects track`: the traffic of a generated city, from its lidar and from its photos.

mod common;

use std::fs;

use common::{command, done, json_of, refused};
use serde_json::Value;

#[test]
fn the_traffic_of_a_street_is_found_where_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let drive = ["--views", "150", "--spacing", "2", "--aerial", "0", "--size", "320x180", "--lidar", "--radar"];
    done(at, &[&["synth", "--area-km2", "0.02", "--traffic", "medium", "--out", "city"][..], &drive].concat());

    let track = ["objects", "track", "city", "--out", "found/tracks.json", "--against", "city/tracks.json"];
    let said = done(at, &[&track[..], &["--svg", "found/map.svg"]].concat());
    println!("{said}");
    let vehicles = &said["against"]["vehicles"];
    assert!(vehicles["objects"].as_u64().unwrap() >= 5, "{said}");
    assert!(vehicles["mota"].as_f64().unwrap() >= 0.8, "{said}");
    assert!(vehicles["median_metres"].as_f64().unwrap() <= 0.3, "{said}");
    let bytes = fs::read(at.join("found/tracks.json")).unwrap();
    let file: Value = serde_json::from_slice(&bytes).unwrap();
    assert_eq!(file["tracks"].as_array().unwrap().len() as u64, said["objects"].as_u64().unwrap());
    assert_eq!(file["seconds"].as_object().unwrap().len(), 150);
    assert!(fs::read_to_string(at.join("found/map.svg")).unwrap().matches("<polyline").count() >= 2);

    // The radar alone finds some of them, near to where they are, and the lidar does without it.
    let by = |more: &[&str]| {
        let track = ["objects", "track", "city", "--out", "one.json", "--against", "city/tracks.json"];
        let said = done(at, &[&track[..], more].concat());
        println!("{said}");
        let of = |key: &str| said["against"]["vehicles"][key].as_f64().unwrap();
        [of("objects") - of("misses"), of("median_metres"), of("mota")]
    };
    let [found, off, _] = by(&["--no-lidar"]);
    assert!(found >= 2.0 && off <= 1.5, "{found} {off}");
    let [_, off, mota] = by(&["--no-radar"]);
    assert!(mota >= 0.8 && off <= 0.3, "{mota} {off}");

    // The same again, by one thread; and what is found is what a capture may have beside it.
    json_of(command(at, &["objects", "track", "city", "--out", "again.json"]).env("RAYON_NUM_THREADS", "1"));
    assert_eq!(fs::read(at.join("again.json")).unwrap(), bytes);
    fs::write(at.join("city/tracks.json"), &bytes).unwrap();
    assert_eq!(done(at, &["inspect", "city"])["moving"], said["objects"]);

    // The labels say what is on the photos, and vehicles on them are where they touch the ground.
    let seen = ["objects", "track", "city", "--out", "seen.json", "--zones", "@labels", "--no-lidar", "--no-radar"];
    let said = done(at, &seen);
    println!("{said}");
    assert!(said["objects"].as_u64().unwrap() >= 1 && said["sweeps"] == 0 && said["radar_sweeps"] == 0, "{said}");

    let none = ["objects", "track", "city", "--out", "none.json"];
    let blind = [&none[..], &["--no-lidar", "--no-radar"]].concat();
    refused(at, &blind, "has no sweeps that are used, and nobody looks at its photos; give --detector");
    fs::write(at.join("bad.json"), "{\"tracks\": 3}").unwrap();
    refused(at, &[&none[..], &["--against", "bad.json"]].concat(), "bad.json");
    fs::remove_file(at.join("city/tracks.json")).unwrap();
    refused(at, &none, "does not tell when its photos were taken; name the times");
    assert!(!at.join("none.json").exists());
}
