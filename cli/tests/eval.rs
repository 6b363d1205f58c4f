//! `plat eval` of cuts and seams as run by scripts.

mod common;

use common::{city, done, refused};

#[test]
fn cuts_and_seams_of_a_tree_are_measured() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 24, 96, 72);
    let train = |out: &str, blocks: &str| {
        let options = ["--steps", "900", "--budget", "3000", "--levels", "1", "--threads", "1", "--tolerance-db", "0"];
        done(at, &[&["train", "city", "--out", out, "--blocks", blocks][..], &options].concat())
    };
    train("tree", "tree");
    train("whole", "whole");

    let plain = done(at, &["eval", "tree", "city"]);
    assert!(plain.get("cuts").is_none() && plain.get("seams").is_none());
    let said = done(at, &["eval", "tree", "city", "--level", "all", "--budget", "500,1000000", "--seams"]);
    let cuts = said["cuts"].as_array().unwrap();
    let figure = |cut: usize, key: &str| cuts[cut][key].as_f64().unwrap_or(f64::NAN);
    assert_eq!(cuts.len(), 2);
    assert_eq!((&cuts[0]["level"], &cuts[1]["level"]), (&0.into(), &1.into()));
    // What a viewer draws: within the budget, and with enough of it all but what is smaller than a pixel.
    let budget = |i: usize, key: &str| said["budgets"][i][key].as_f64().unwrap_or(f64::NAN);
    assert!(budget(0, "budget") == 500.0 && budget(0, "drawn") <= 500.0 && budget(0, "gain_db").is_finite());
    assert!(budget(0, "loss_db") > budget(1, "loss_db") && budget(1, "loss_db").abs() < 0.2, "{}", said["budgets"]);
    // The finest level is the model itself: it loses nothing, and pruning to as many splats removes none.
    assert_eq!([figure(1, "loss_db"), figure(1, "away_loss_db"), figure(1, "away_gain_db")], [0.0; 3]);
    assert_eq!((&cuts[1]["full"]["psnr"], &cuts[1]["splats"]), (&said["psnr"], &said["splats"].as_f64().into()));
    assert!(figure(0, "loss_db") > 0.1, "{}", figure(0, "loss_db"));
    let [coarse, fine] = [0, 1].map(|cut| figure(cut, "away_mip"));
    assert!(coarse > fine, "the viewing distance of the coarser level is not larger: {coarse} {fine}");
    // The three ways to render give three results; which is best depends on the scene.
    let away = |way: &str| cuts[0]["away"][way]["psnr"].as_f64().unwrap();
    assert!(away("thinned") != away("classic") && away("antialiased") != away("classic"));
    assert!(figure(0, "away_loss_db").is_finite() && figure(0, "away_gain_db").is_finite());

    let seams = &said["seams"];
    assert_eq!(seams["faces"].as_array().unwrap().len(), 4);
    assert!(seams["seam_psnr"].is_f64() && seams["interior_psnr"].is_f64() && seams["of"].is_null());
    assert!(seams["faces"][0]["jump"].as_f64().unwrap() > 0.0 && seams["faces"][0]["step"].is_f64());
    let share = |key: &str| seams[key].as_f64().unwrap();
    assert!(share("seam_share") > 0.01 && share("seam_share") < share("interior_share"));
    for picture in ["seams.png", "seams_birdseye.png"] {
        assert!(image::open(at.join("tree/eval").join(picture)).is_ok(), "{picture}");
    }
    assert_eq!(done(at, &["eval", "tree", "city", "--seams"])["seams"]["faces"], seams["faces"]);

    // The same regions of a model without faces.
    let control = done(at, &["eval", "whole", "city", "--seams-of", "tree"]);
    assert_eq!(control["seams"]["of"]["seam_psnr"], seams["seam_psnr"]);
    assert_ne!(control["seams"]["seam_psnr"], seams["seam_psnr"]);
    assert!(control["seams"]["faces_cost_db"].is_f64() && control["seams"]["faces"][0]["control_step"].is_f64());
    // The same figures as a result line.
    let line = done(at, &["bench", "tree", "tree", "city", "--whole", "whole", "--results", "results"]);
    assert_eq!(line["faces"]["psnr"][0], seams["seam_psnr"]);
    assert_eq!(line["faces"]["without_psnr"][0], control["seams"]["seam_psnr"]);
    assert_eq!((&line["levels"][0]["psnr"], &line["splats"]), (&cuts[0]["full"]["psnr"], &said["splats"]));
    let kept = std::fs::read_to_string(at.join("results/tree.jsonl")).unwrap();
    assert_eq!(serde_json::from_str::<serde_json::Value>(kept.trim()).unwrap(), line);

    let wide = done(at, &["eval", "tree", "city", "--seam-metres", "12"]);
    assert!(wide["seams"]["seam_share"].as_f64().unwrap() > share("seam_share"));

    refused(at, &["eval", "whole", "city", "--seams"], "--seams-of");
    refused(at, &["eval", "tree", "city", "--level", "2"], "--level");
    refused(at, &["eval", "tree", "city", "--level", "fine"], "--level");
    assert_eq!(done(at, &["eval", "tree/merged.ply", "city", "--budget", "100"])["budgets"][0]["budget"], 100);
    refused(at, &["eval", "tree", "city", "--budget", "0"], "--budget");
    for metres in ["0", "-1", "nan"] {
        refused(at, &["eval", "tree", "city", &format!("--seam-metres={metres}")], "--seam-metres");
    }
}
