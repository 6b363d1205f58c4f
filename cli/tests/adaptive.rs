//! Adaptive refinement: a bare plain stays at its parent's resolution while houses are refined.

mod common;

use blocks::{Plan, Task};
use city::CitySettings;
use common::json_of;
use dataset::synth::{self, Settings};
use scene::{BlockId, Splats, frame};

#[test]
fn a_plain_stays_coarse_while_houses_are_refined() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let small = common::small(72, 144, 96);
    let city = Settings { city: CitySettings { plain: 0.5, ..small.city }, ..small };
    synth::write(&at.join("city"), &city, &|_, _, _| ()).unwrap();
    let train = |out: &str, words: &[&str]| {
        let job =
            ["train", "city", "--steps", "2000", "--budget", "5000", "--levels", "2", "--tolerance-db", "0", "--out"];
        json_of(&mut common::command(at, &[&job, &[out][..], words].concat()))
    };
    let adaptive = train("adaptive", &["--threads", "2"]);
    let fixed = train("fixed", &["--residual", "0"]);
    let bytes = |path: &str| std::fs::read(at.join(path)).unwrap();
    let plan = Plan::from_frame(&bytes("adaptive/model/plan.plat")).unwrap();
    assert_eq!(plan.levels, 2);
    let result = |out: &str, BlockId { level, x, y }: BlockId| -> Splats {
        frame::decode_splats(&bytes(&format!("{out}/model/blocks/{level}-{x}-{y}.plat"))).unwrap()
    };
    // A settled block has exactly its parent's splats. Along a face it has those of a neighbour that was trained before it.
    let owned = |splats: &Splats, task: &Task| {
        let place = |i: usize| splats.mean(i).as_dvec3();
        let of_block =
            |i: &usize| plan.ground.owns(task.block, place(*i)) && task.donor(&plan.ground, place(*i)).is_none();
        (0..splats.len()).filter(of_block).count()
    };
    let in_core = |splats: &Splats, task: &Task| {
        (0..splats.len()).filter(|&i| plan.ground.owns(task.block, splats.mean(i).as_dvec3())).count()
    };
    let (mut settled, mut refined) = (Vec::new(), Vec::new());
    for task in plan.tasks.iter().filter(|task| task.block.level == 2) {
        let [parent, own] = [task.parent.unwrap(), task.block].map(|block| result("adaptive", block));
        let west = plan.ground.core(task.block).centre().x < -10.0;
        if owned(&own, task) == owned(&parent, task) {
            settled.push(west);
        } else {
            refined.push(west);
            let [before, after] = [&parent, &own].map(|splats| in_core(splats, task));
            assert!(after > before, "{}: {after} splats of the parent's {before}", task.block);
        }
    }
    assert!(settled.len() >= 2 && settled.iter().all(|west| *west), "settled {settled:?}, refined {refined:?}");
    assert!(refined.iter().filter(|west| !*west).count() >= 6, "settled {settled:?}, refined {refined:?}");
    let number = |of: &serde_json::Value, key: &str| of[key].as_f64().unwrap();
    assert!(number(&adaptive, "settled") >= settled.len() as f64 && number(&fixed, "settled") == 0.0);
    assert!(number(&adaptive, "splats") < 0.97 * number(&fixed, "splats"), "{adaptive} {fixed}");

    // Adaptation is deterministic, and the plain is as good as without it.
    train("again", &["--threads", "1"]);
    assert!(bytes("adaptive/merged.ply") == bytes("again/merged.ply"));
    assert!(number(&adaptive, "psnr") > number(&fixed, "psnr") - 0.5, "{adaptive} {fixed}");
}
