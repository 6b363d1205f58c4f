//! Splat attributes: the block that trained each splat passes from training through the merge into the PLY, and can be rendered.

mod common;

use std::collections::BTreeSet;

use blocks::Plan;
use common::{done, refused};
use scene::{BLOCK_ATTRIBUTE, BlockId, Splats, ply, spz};

#[test]
fn labels_name_the_block_that_trained_a_splat_and_change_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 24, 96, 64);
    let train = |out: &str, words: &[&str]| {
        // Nothing is settled with --residual 0, so that every block labels its own splats.
        let job = ["train", "city", "--steps", "300", "--budget", "1500", "--levels", "1", "--residual", "0", "--out"];
        done(at, &[&job, &[out][..], words].concat())
    };
    train("plain", &[]);
    train("labelled", &["--label-blocks"]);
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    let merged = |out: &str| -> Splats { ply::read(&bytes(&format!("{out}/merged.ply"))).unwrap() };
    let (plain, labelled) = (merged("plain"), merged("labelled"));
    assert!(plain.columns() == labelled.columns(), "labels change no other number");
    assert_eq!(plain.attributes(), []);

    let plan = Plan::from_frame(&bytes("labelled/model/plan.plat")).unwrap();
    let leaves = plan.leaves();
    let labels = labelled.attribute(BLOCK_ATTRIBUTE).expect("a label");
    let mut blocks = BTreeSet::new();
    for (i, &label) in labels.iter().enumerate() {
        let block = BlockId::from_code(label).expect("a block");
        assert_eq!(leaves.owner_of(&plan.ground, labelled.mean(i).as_dvec3()), Some(block), "splat {i}");
        blocks.insert(block);
    }
    assert!(blocks.len() > 2, "{blocks:?}");

    // A folder knows its blocks without labels too. A PLY only has what its attributes say.
    for (model, out) in [("plain", "by-owner"), ("labelled", "by-label"), ("labelled/merged.ply", "by-ply")] {
        done(at, &["render", model, "--cameras", "city", "--by", "block", "--out", out]);
    }
    let first = std::fs::read_dir(at.join("city/images")).unwrap().map(|file| file.unwrap().path()).min().unwrap();
    let picture = |out: &str| bytes(&format!("{out}/{}.png", first.file_stem().unwrap().to_string_lossy()));
    assert!(picture("by-owner") == picture("by-label") && picture("by-label") == picture("by-ply"));
    refused(
        at,
        &["render", "plain/merged.ply", "--cameras", "city", "--by", "block", "--out", "x"],
        "no attribute 'block'",
    );
    refused(at, &["render", "labelled", "--cameras", "city", "--by", "object", "--out", "x"], "it has block");

    // Pruning and exporting keep rows and labels together; SPZ has no place for labels.
    done(at, &["prune", "labelled/merged.ply", "--out", "half.ply", "--keep", "0.5"]);
    let half = ply::read(&bytes("half.ply")).unwrap();
    let rows: BTreeSet<Vec<u32>> = (0..labelled.len()).map(|i| row(&labelled, i)).collect();
    assert!(half.len() < labelled.len() && (0..half.len()).all(|i| rows.contains(&row(&half, i))));
    done(at, &["export", "labelled", "--to", "spz", "--out", "model.spz"]);
    assert_eq!(spz::read(&bytes("model.spz")).unwrap().0.attributes(), []);
}

/// Mean and label of a splat, as bits.
fn row(splats: &Splats, i: usize) -> Vec<u32> {
    let label = splats.attribute(BLOCK_ATTRIBUTE).expect("a label")[i];
    splats.mean(i).to_array().iter().map(|value| value.to_bits()).chain([label]).collect()
}
