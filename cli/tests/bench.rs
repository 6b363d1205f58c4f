//! `plat bench`: resumable sweeps, and comparisons of recipes.

mod common;

use std::path::Path;

use common::{city, done, plat, refused};
use serde_json::Value;

fn lines(at: &Path, file: &str) -> Vec<Value> {
    let text = std::fs::read_to_string(at.join("results").join(file)).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn a_sweep_has_a_line_for_each_combination_and_can_be_resumed() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 16, 64, 48);
    let sweep = |words: &[&str]| -> Value {
        let usual = ["bench", "pareto", "--label", "plat", "--out", "o", "--results", "results", "--levels", "0"];
        done(at, &[&usual[..], &["--tolerance-db", "0", "--budget", "300", "--threads", "1"], words].concat())
    };
    // A sweep of one run, as if it had been interrupted after the first.
    let first = sweep(&["a=city", "--steps", "5"]);
    let swept = sweep(&["a=city", "b=city", "--steps", "5,10"]);
    assert_eq!((&swept["skipped"], swept["lines"].as_array().unwrap().len()), (&1.into(), 4));
    assert!(swept["lines"].as_array().unwrap().contains(&first));
    let kept = lines(at, "plat.jsonl");
    assert_eq!(kept.len(), 4);
    let has = |scene: &str, steps: u32| kept.iter().any(|line| line["scene"] == scene && line["steps"] == steps);
    assert!(has("a", 5) && has("a", 10) && has("b", 5) && has("b", 10));
    assert!(kept.iter().all(|line| line["budget"] == 300 && line["tolerance_db"] == 0.0 && line["psnr"].is_f64()));
    assert!(!at.join("o/a-auto-5-steps-300-splats-0-dB-seed-0/store").exists(), "the photos of every run are kept");

    // All lines exist; other seeds and labels, and --fresh, add lines.
    assert_eq!(sweep(&["a=city", "b=city", "--steps", "5,10"])["skipped"], 4);
    assert_eq!(sweep(&["a=city", "--steps", "5"]), first);
    assert_eq!(lines(at, "plat.jsonl").len(), 4);
    sweep(&["a=city", "--steps", "5", "--seed", "7"]);
    sweep(&["a=city", "--steps", "5", "--fresh"]);
    sweep(&["a=city", "--steps", "5", "--label", "other"]);
    assert_eq!(lines(at, "plat.jsonl").len(), 7);

    std::fs::create_dir_all(at.join("docs/src")).unwrap();
    for document in ["README.md", "docs/src/performance.md"] {
        std::fs::write(at.join(document), "<!-- bench:begin -->\n<!-- bench:end -->\n").unwrap();
    }
    std::fs::create_dir(at.join("references")).unwrap();
    let other = r#"{"trainer": "Other", "version": "1", "machine": "m", "backend": "cuda", "source": "a paper", "runs": [
        {"scene": "a", "downscale": 1, "command": "other a", "cpu_seconds": 900, "psnr": 31.5, "lpips": 0.2}]}"#;
    std::fs::write(at.join("references/other.json"), other).unwrap();
    let drawn = done(at, &["bench", "chart", "--results", "results", "--reference", "references"]);
    assert_eq!((&drawn["lines"], &drawn["references"]), (&7.into(), &1.into()));
    let [readme, all] =
        ["README.md", "docs/src/performance.md"].map(|name| std::fs::read_to_string(at.join(name)).unwrap());
    assert!(all.contains("| plat, 10 steps |") && all.contains("| Other | cuda | 31.50 |"), "{all}");
    assert!(readme.contains("| 31.50 | 900 | not reached |") && !readme.contains("| Other |"), "{readme}");
    let chart = std::fs::read_to_string(at.join("results/chart.svg")).unwrap();
    assert!(chart.contains("plat, 10 steps: ") && chart.contains("Other: 31.50 after 900.0 CPU s"), "{chart}");
    refused(at, &["bench", "chart", "--results", "results", "--reference", "nowhere"], "nowhere");
}

#[test]
fn variants_of_the_recipe_are_trained_as_by_a_worker() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    city(at, 16, 64, 48);
    let job = ["city", "--steps", "40", "--budget", "400", "--threads", "1"];
    fn ablate<'a>(words: &[&'a str]) -> Vec<&'a str> {
        let usual = ["bench", "ablate", "city", "--results", "results", "--steps", "40", "--budget", "400"];
        [&usual, words].concat()
    }
    let variants = ["--seeds", "0,1", "--variants", "default,all-colours", "--looks", "4"];
    let said = done(at, &ablate(&[&variants[..], &["--to-gain", "0.5"]].concat()));
    let kept = lines(at, "ablation.jsonl");
    assert_eq!(kept.len(), 4);
    let who = |line: &Value| (line["variant"].as_str().unwrap().to_owned(), line["seed"].as_u64().unwrap());
    let order: Vec<_> = kept.iter().map(who).collect();
    let wanted = [("default", 0), ("all-colours", 0), ("default", 1), ("all-colours", 1)];
    assert_eq!(order, wanted.map(|(variant, seed)| (variant.to_owned(), seed)), "variants are not interleaved");
    let number = |value: &Value| value.as_f64().expect("a number");
    let of_default = || kept.iter().filter(|line| line["variant"] == "default");
    let ends = |get: fn(&Value) -> &Value| of_default().map(|line| number(get(line))).sum::<f64>() / 2.0;
    let middle = 0.5 * (ends(|line| &line["curve"][0]["psnr"]) + ends(|line| &line["psnr"]));
    assert!((number(&said["targets"][0]) - middle).abs() < 1e-9, "{said}");
    for line in &kept {
        assert_eq!((&line["kind"], line["curve"].as_array().unwrap().len()), (&"ablation".into(), 5));
        assert_eq!((&line["steps"], &line["budget"], &line["scene"]), (&40.into(), &400.into(), &"city".into()));
        assert!(line["cpu_seconds"].as_f64() >= line["reached"][0]["cpu_seconds"].as_f64(), "{line}");
    }
    assert!(said["means"][0]["reached"][0]["cpu_seconds"].is_f64() && said["means"][0]["variant"] == "default");
    assert_ne!(kept[0]["psnr"], kept[1]["psnr"], "the variant makes no difference");

    // The default variant gives the bits of a worker for the same plan.
    for (line, seed) in [(0, "0"), (2, "1")] {
        let plan = ["--levels", "0", "--tolerance-db", "0", "--seed", seed];
        let trained = done(at, &[&["train", "--out", &format!("o{seed}")], &job[..], &plan].concat());
        assert_eq!((&trained["psnr"], &trained["splats"]), (&kept[line]["psnr"], &kept[line]["splats"]));
    }
    let table = plat(at, &ablate(&["--seeds", "0", "--to", "5,90", "--variants", "fine"]));
    let text = String::from_utf8(table.stdout).unwrap();
    assert!(
        text.contains("s to 5.00 dB") && text.lines().any(|l| l.starts_with("fine") && l.contains("never")),
        "{text}"
    );
    refused(at, &ablate(&["--variants", "faster"]), "all-at-once");
    refused(at, &ablate(&["--variants", "fine", "--to-gain", "0.5"]), "--to-gain");
    refused(at, &["bench", "ablate", "nowhere"], "nowhere");
}
