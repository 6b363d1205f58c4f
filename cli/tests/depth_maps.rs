//! Depth maps in files: `--depths` and its kind decide the targets in one block and in a tree, and bad maps end with exit code 2.

mod common;

use std::fs;

use common::{done, refused, small};
use dataset::synth::Settings;

#[test]
fn depth_maps_change_the_model_and_damaged_ones_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let settings = Settings { truth: true, ..small(16, 96, 64) };
    dataset::synth::write(&at.join("city"), &settings, &|_, _, _| ()).unwrap();
    // The true depths, outside of the capture.
    fs::rename(at.join("city/depth"), at.join("maps")).unwrap();
    let seen = done(at, &["inspect", "city", "--depths", "maps"]);
    assert_eq!(
        (seen["depth_maps"].as_u64(), done(at, &["inspect", "city"])["depth_maps"].as_u64()),
        (Some(16), Some(0))
    );

    let job = ["train", "city", "--steps", "40", "--budget", "400", "--tolerance-db", "0", "--residual", "0"];
    let train = |out: &str, words: &[&str]| -> Vec<u8> {
        done(at, &[&job[..], &["--depth-weight", "0.5", "--out", out], words].concat());
        fs::read(at.join(out).join("merged.ply")).unwrap()
    };
    for (blocks, division) in [("whole", &["--blocks", "whole"][..]), ("tree", &["--levels", "1"])] {
        let sparse = train(&format!("{blocks}-sparse"), division);
        let [maps, again] =
            ["maps", "again"].map(|out| train(&format!("{blocks}-{out}"), &[division, &["--depths", "maps"]].concat()));
        assert!(sparse != maps && maps == again, "{blocks}");
    }

    let refuses =
        |words: &[&str], wanted: &str| refused(at, &[&job[..], &["--quiet", "--out", "x"], words].concat(), wanted);
    let deep = ["--depth-weight", "0.5"];
    refuses(&["--depths", "maps"], "--depths: has no effect without --depth-weight");
    refuses(&["--depth-kind", "inverse"], "--depth-kind: has no effect without --depth-weight");
    refuses(
        &[&deep[..], &["--depth-unit", "2"]].concat(),
        "--depth-unit: is given for depth maps, and the capture has none",
    );
    refuses(
        &[&deep[..], &["--depths", "maps", "--depth-kind", "inverse", "--depth-unit", "2"]].concat(),
        "--depth-unit",
    );
    refuses(&[&deep[..], &["--depths", "maps", "--no-depths"]].concat(), "--no-depths");
    refuses(&[&deep[..], &["--depths", "maps", "--depth-unit", "100"]].concat(), "times those of the sparse points");
    let map = fs::read_dir(at.join("maps")).unwrap().map(|file| file.unwrap().path()).min().unwrap();
    let whole = fs::read(&map).unwrap();
    fs::write(&map, &whole[..whole.len() - 4]).unwrap();
    let name = map.file_name().unwrap().to_string_lossy().into_owned();
    refuses(&[&deep[..], &["--depths", "maps"]].concat(), &name);
}
