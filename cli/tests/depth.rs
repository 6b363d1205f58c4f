//! Sparse points as target depths: every division of a scene trains with them, and captures without tracks are refused.

mod common;

use common::{city, done, refused};

#[test]
fn depth_targets_change_the_model_in_every_division_and_need_tracks() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 16, 96, 64);
    for blocks in ["whole", "flat", "tree"] {
        let train = |out: &str, weight: &str| -> Vec<u8> {
            let job = ["train", "city", "--steps", "60", "--budget", "600", "--tolerance-db", "0", "--residual", "0"];
            let words = ["--blocks", blocks, "--depth-weight", weight, "--out", out];
            let levels: &[&str] = if blocks == "whole" { &[] } else { &["--levels", "1"] };
            done(at, &[&job[..], &words, levels].concat());
            std::fs::read(at.join(out).join("merged.ply")).unwrap()
        };
        let [plain, deep, again] = [("plain", "0"), ("deep", "0.5"), ("again", "0.5")]
            .map(|(out, weight)| train(&format!("{blocks}-{out}"), weight));
        assert!(plain != deep, "{blocks}: depths must matter");
        assert!(deep == again, "{blocks}: the same bytes again");
    }

    let first = std::fs::read_dir(at.join("city/images")).unwrap().map(|file| file.unwrap().path()).min().unwrap();
    std::fs::create_dir(at.join("bare")).unwrap();
    let name = format!("photo.{}", first.extension().unwrap().to_string_lossy());
    let frame = |x: f64| {
        std::fs::copy(&first, at.join(format!("bare/{x}-{name}"))).unwrap();
        format!(r#"{{"file_path": "{x}-{name}", "transform_matrix": [[1,0,0,{x}],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}}"#)
    };
    let text = format!(
        r#"{{"w": 96, "h": 64, "fl_x": 80, "fl_y": 80, "cx": 48, "cy": 32, "frames": [{}, {}]}}"#,
        frame(0.0),
        frame(1.0)
    );
    std::fs::write(at.join("bare/transforms.json"), text).unwrap();
    refused(at, &["train", "bare", "--depth-weight", "0.5", "--out", "x"], "--depth-weight");
    refused(at, &["train", "city", "--depth-weight", "inf", "--out", "x"], "--depth-weight");
}
