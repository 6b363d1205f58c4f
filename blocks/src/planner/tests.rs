//! Tests of whole plans.

use std::collections::BTreeSet;

use glam::DVec3;
use scene::{BlockId, Camera};

use super::*;
use crate::budgets::COSTED_SPLATS;
use crate::cost::epoch_cost;
use crate::detection::{DetectorCost, detect_tasks};
use crate::lint::{Severity, lint};
use crate::plan::PlannedTask;
use crate::task::Task;
use crate::testing::{aerial, capture, look_at, noise, street};

fn settings(mode: Mode, levels: Option<u8>) -> PlanSettings {
    PlanSettings { mode, levels, steps: 4000, budget: 50_000, ..PlanSettings::default() }
}

fn plan_of(capture: &Capture, mode: Mode, levels: Option<u8>) -> Plan {
    let plan = plan(capture, ArtefactId::of(b"capture"), &settings(mode, levels), "cpu").unwrap();
    let errors: Vec<String> =
        (lint(&plan, capture).iter()).filter(|f| f.severity == Severity::Error).map(ToString::to_string).collect();
    assert!(errors.is_empty(), "{errors:?}");
    plan
}

#[test]
fn evaluation_tasks_come_after_training_and_read_all_blocks() {
    let capture = aerial(8, 300.0, 8000);
    let settings = settings(Mode::Tree, Some(1));
    let plain = plan(&capture, ArtefactId::of(b"capture"), &settings, "cpu").unwrap();
    let settings = PlanSettings { evaluate: true, ..settings };
    let evaluated = plan(&capture, ArtefactId::of(b"capture"), &settings, "cpu").unwrap();
    assert!(evaluated.tasks == plain.tasks && plain.eval_tasks.is_empty() && lint(&evaluated, &capture).is_empty());
    let (training, all) = (evaluated.tasks.len() as u32, evaluated.len() as u32);
    assert_eq!(all, training + evaluated.eval_tasks.len() as u32);
    assert!(evaluated.all_tasks().eq((0..all).filter_map(|index| evaluated.planned(index))));
    assert!(all > training && evaluated.planned(all).is_none() && evaluated.planned(u32::MAX).is_none());
    for index in 0..all {
        let task = evaluated.planned(index).unwrap();
        let inputs: Vec<u32> = evaluated.inputs(task).into_iter().filter_map(|b| evaluated.index(b)).collect();
        match task {
            PlannedTask::Train(_) => assert!(inputs.iter().all(|&input| input < index)),
            PlannedTask::Evaluate(_) => {
                assert_eq!(inputs.into_iter().collect::<BTreeSet<u32>>(), (0..training).collect());
            }
            PlannedTask::Detect(_) | PlannedTask::Object(_) => unreachable!("none was asked for"),
        }
    }
    let none = PlanSettings { test_every: 0, ..settings };
    let error = plan(&capture, ArtefactId::of(b"capture"), &none, "cpu").unwrap_err();
    assert!(error.to_string().contains("--evaluate"), "{error}");
}

#[test]
fn blocks_depend_on_the_detection_of_their_views() {
    let capture = aerial(8, 300.0, 8000);
    let settings = PlanSettings { evaluate: true, zone_weight: 4.0, ..settings(Mode::Tree, Some(1)) };
    let planned = plan(&capture, ArtefactId::of(b"capture"), &settings, "cpu").unwrap();
    let cost = DetectorCost { cpu_seconds: 1.0, memory_bytes: 1 };
    let detect_tasks = detect_tasks(&capture, cost);
    let plan = Plan { detector: Some(ArtefactId::of(b"network")), detect_tasks, ..planned };
    assert!(plan.detect_tasks.len() > 3 && lint(&plan, &capture).is_empty());
    assert_eq!(Plan::from_frame(&plan.to_frame()).unwrap(), plan);
    let (training, first, all) = (plan.tasks.len() as u32, plan.first_detection() as u32, plan.len() as u32);
    assert!(plan.all_tasks().eq((0..all).filter_map(|index| plan.planned(index))) && plan.planned(all).is_none());
    for (index, task) in (0..).zip(plan.all_tasks()) {
        let (needed, detections) = (plan.dependencies(task).unwrap(), plan.detections(task));
        match task {
            PlannedTask::Train(task) => {
                assert!(needed.iter().all(|&other| other < index || other >= first));
                let seen = |view: u32| {
                    detections.iter().any(|&of| match plan.planned(of) {
                        Some(PlannedTask::Detect(of)) => of.views().contains(&view),
                        _ => false,
                    })
                };
                let last = capture.views.len() as u32 - 1;
                let near = |view: u32| [view.saturating_sub(1), view, (view + 1).min(last)];
                assert!(task.views.iter().flat_map(|used| near(used.view)).all(seen));
            }
            PlannedTask::Evaluate(_) => assert!(needed == (0..training).collect() && detections.is_empty()),
            PlannedTask::Detect(_) | PlannedTask::Object(_) => assert!(needed.is_empty()),
        }
    }
    // Where zones have no weight, nobody waits for them.
    let plain = Plan { settings: PlanSettings { zone_weight: 0.0, ..plan.settings.clone() }, ..plan.clone() };
    assert!(plain.all_tasks().all(|task| plain.detections(task).is_empty()));
}

#[test]
fn a_tree_is_complete_and_ordered() {
    let capture = aerial(8, 300.0, 8000);
    let plan = plan_of(&capture, Mode::Tree, Some(2));
    assert_eq!((plan.levels, plan.tasks.len()), (2, 1 + 4 + 16));
    assert_eq!(plan.tasks[0].block, BlockId::ROOT);
    assert!(plan.tasks[0].parent.is_none() && plan.tasks[0].context.is_empty());
    for (coarse, fine) in plan.rho_metres.iter().zip(&plan.rho_metres[1..]) {
        assert!((coarse / fine - 2.0).abs() < 1e-12);
    }
    for task in &plan.tasks[1..] {
        assert_eq!(task.parent, task.block.parent());
        assert!(task.views.iter().all(|v| v.view % 8 != 0));
        assert_eq!(plan.task(task.block), Some(task));
    }
    let mips: Vec<u8> = [0, 1, 5].map(|i: usize| plan.tasks[i].views[0].mip).to_vec();
    assert_eq!(mips, [2, 1, 0]);
    assert!(lint(&plan, &capture).is_empty(), "{:?}", lint(&plan, &capture));
}

/// The plan of more splats than a block holds, with automatic levels.
fn crowded_plan_of(capture: &Capture) -> Plan {
    let settings = PlanSettings { budget: 500_000, ..settings(Mode::Tree, None) };
    plan(capture, ArtefactId::of(b"capture"), &settings, "cpu").unwrap()
}

#[test]
fn automatic_levels_follow_resolution_views_and_points() {
    // 300 m at 0.12 m a pixel are 2,500 pixels: one division leaves at least 768 per leaf.
    assert_eq!(crowded_plan_of(&aerial(12, 300.0, 20_000)).levels, 1);
    assert_eq!(crowded_plan_of(&aerial(12, 300.0, 1000)).levels, 0, "too few points");
    assert_eq!(crowded_plan_of(&aerial(4, 300.0, 20_000)).levels, 0, "too few views");
    assert_eq!(crowded_plan_of(&aerial(8, 60.0, 20_000)).levels, 0, "too small");
}

#[test]
fn automatic_levels_divide_only_what_no_block_can_hold() {
    for capture in [street(120, 20_000), aerial(12, 300.0, 20_000)] {
        let levels = |budget: u32| {
            let settings = PlanSettings { budget, ..settings(Mode::Tree, None) };
            plan(&capture, ArtefactId::of(b"capture"), &settings, "cpu").unwrap().levels
        };
        assert_eq!([50_000, 400_000, 2_000_000].map(levels), [0, 0, 1]);
    }
}

#[test]
fn automatic_levels_keep_blocks_within_the_memory_limit() {
    let capture = aerial(12, 300.0, 20_000);
    let with = |memory_limit_bytes: u64, levels: Option<u8>| {
        let settings = PlanSettings { budget: 300_000, memory_limit_bytes, ..settings(Mode::Tree, levels) };
        plan(&capture, ArtefactId::of(b"capture"), &settings, "cpu").unwrap()
    };
    let largest = |plan: &Plan| plan.tasks.iter().map(|task| task.memory_bytes).max().unwrap();
    let is_refused = |plan: &Plan| lint(plan, &capture).iter().any(|finding| finding.message.contains("the limit is"));
    let one = with(4 << 30, None);
    assert_eq!((one.levels, is_refused(&one)), (0, false));
    let limit = largest(&one) * 2 / 3;
    let fits = with(limit, None);
    assert!(fits.levels > 0 && largest(&fits) <= limit && !is_refused(&fits), "{} of {limit}", largest(&fits));
    assert_eq!(fits.settings.levels, None);
    // Levels that were asked for are kept, and a limit that no division keeps to ends the search; both are refused.
    let asked = with(limit, Some(0));
    assert!(asked.levels == 0 && is_refused(&asked) && is_refused(&with(1 << 20, None)));
}

#[test]
fn splats_that_the_steps_cannot_train_are_left_out() {
    let capture = aerial(12, 300.0, 20_000);
    let with = |steps: u32, levels: Option<u8>| {
        let settings = PlanSettings { budget: 2_000_000, steps, ..settings(Mode::Tree, levels) };
        plan_at_most(&capture, ArtefactId::of(b"capture"), &settings, "cpu").unwrap()
    };
    let enough = with(4000, None);
    assert!(enough.levels == 1 && enough.leaf_visits() > 1.0, "{}", enough.leaf_visits());
    assert_eq!(enough.settings.budget, 2_000_000);
    let few = with(20, None);
    assert_eq!((few.levels, few.settings.budget, few.settings.steps), (0, BLOCK_SPLATS, 20));
    let asked = with(20, Some(1));
    assert_eq!((asked.levels, asked.settings.budget), (1, 2_000_000));
    let warned = |plan: &Plan| lint(plan, &capture).iter().any(|finding| finding.message.contains("draw each photo"));
    assert_eq!([&enough, &few, &asked].map(warned), [false, false, true]);
}

/// In an aerial capture every level trains on the photos about as often as a single block would.
#[test]
fn heights_get_work_for_what_they_are_the_first_to_see() {
    let capture = aerial(12, 300.0, 20_000);
    let plan = plan_of(&capture, Mode::Tree, Some(2));
    let epochs = |level: u8| {
        let of_level = plan.tasks.iter().filter(|t| t.block.level == level);
        let (steps, views) = of_level.fold((0, 0), |(s, v), t| (s + t.steps, v + t.views.len()));
        f64::from(steps) / views as f64
    };
    let whole = 4000.0 / plan.tasks[0].views.len() as f64;
    let ratios = [0, 1, 2].map(|level| epochs(level) / whole);
    let [least, most] = [f64::min, f64::max].map(|of| ratios.into_iter().fold(ratios[0], of));
    assert!(least > 0.5 && most < 1.0 && most < 1.6 * least, "{ratios:?}");
}

/// Along a street the root sees everything as finely as the leaves, but only the leaves have all splats.
#[test]
fn leaves_of_a_street_are_trained_though_their_parents_saw_their_pixels() {
    for levels in [1, 2] {
        let plan = plan_of(&street(120, 20_000), Mode::Tree, Some(levels));
        let visits = |of: &dyn Fn(&Task) -> bool| {
            let tasks = plan.tasks.iter().filter(|task| of(task));
            let (steps, views) = tasks.fold((0, 0), |(s, v), t| (s + t.steps, v + t.views.len()));
            f64::from(steps) / views as f64
        };
        let whole = 4000.0 / plan.tasks[0].views.len() as f64;
        let leaves = visits(&|task| task.block.level == plan.levels) / whole;
        let inner = visits(&|task| task.block.level < plan.levels) / whole;
        println!("{levels} levels: leaves {leaves:.2}, inner {inner:.2} of the visits of a whole scene");
        assert!(leaves > 0.28 && inner > leaves, "{levels}: {leaves} {inner}");
    }
}

/// From the air each level sees everything more finely than the one above, along a street a part of it.
#[test]
fn finer_pixels_of_a_child_are_those_at_a_finer_mip_than_its_parents() {
    let shares = |capture: &Capture| -> Vec<f64> {
        let plan = plan_of(capture, Mode::Tree, Some(1));
        let children = plan.tasks.iter().filter(|task| task.parent.is_some());
        children.map(|task| task.finer_share(&plan.tasks[0])).collect()
    };
    let (above, along) = (shares(&aerial(12, 300.0, 20_000)), shares(&street(120, 20_000)));
    println!("aerial {above:.2?}, street {along:.2?}");
    assert!(above.len() == 4 && above.iter().all(|share| *share > 0.9 && *share <= 1.0), "{above:?}");
    assert!(along.len() == 4 && along.iter().all(|share| (0.0..0.6).contains(share)), "{along:?}");
    assert!(along.contains(&0.0), "{along:?}");
    let plan = plan_of(&aerial(8, 300.0, 8000), Mode::Tree, Some(1));
    let [root, child] = [&plan.tasks[0], &plan.tasks[1]];
    assert_eq!(root.finer_share(root), 0.0);
    // A view that the parent lacks counts as finer.
    assert_eq!(child.finer_share(&Task { views: Vec::new(), ..root.clone() }), 1.0);
}

#[test]
fn budgets_add_up_to_the_merged_model() {
    for (levels, mode) in [(0, Mode::Whole), (0, Mode::Tree), (1, Mode::Tree), (2, Mode::Tree), (2, Mode::Flat)] {
        let plan = plan_of(&aerial(8, 300.0, 8000), mode, Some(levels));
        let finest: u64 = plan.tasks.iter().filter(|t| t.block.level == plan.levels).map(|t| u64::from(t.budget)).sum();
        assert_eq!(plan.tasks.iter().filter(|t| t.block.level == levels).count(), 1 << (2 * levels));
        assert_eq!(finest, 50_000, "{mode:?} {levels}");
        assert!(plan.tasks.iter().all(|t| t.budget > 0 && t.steps > 0 && t.memory_bytes > 0));
    }
}

#[test]
fn all_modes_cost_about_the_same() {
    let capture = aerial(8, 300.0, 8000);
    let work = |plan: &Plan| -> f64 {
        let epochs = |t: &Task| f64::from(t.steps) / t.views.len() as f64;
        plan.tasks.iter().map(|t| epochs(t) * epoch_cost(t)).sum()
    };
    let whole = plan_of(&capture, Mode::Whole, None);
    assert_eq!(whole.tasks[0].steps, 4000);
    for (mode, levels) in [(Mode::Tree, 0), (Mode::Tree, 1), (Mode::Tree, 2), (Mode::Flat, 1), (Mode::Flat, 2)] {
        let plan = plan_of(&capture, mode, Some(levels));
        let ratio = work(&plan) / work(&whole);
        assert!((0.95..1.10).contains(&ratio), "{mode:?} {levels}: {ratio}");
    }
}

#[test]
fn finished_neighbours_are_donors_along_their_faces() {
    let plan = plan_of(&aerial(8, 300.0, 8000), Mode::Tree, Some(1));
    let ground = &plan.ground;
    let block = |x, y| BlockId { level: 1, x, y };
    let donor = |of: BlockId, x: f64, y: f64| {
        // Relative to the centre of the root, in edges of its children.
        let at = ground.core(BlockId::ROOT).centre() + glam::DVec2::new(x, y) * ground.core_edge_metres(1);
        plan.task(of).unwrap().donor(ground, ground.to_world(at.extend(0.0)))
    };
    // A block of the second sweep has two finished neighbours here, a block of the first none.
    let last = block(1, 0);
    assert_eq!(donor(last, 0.05, -0.5), Some(block(0, 0)));
    assert_eq!(donor(last, 0.5, -0.05), Some(block(1, 1)));
    assert_eq!(donor(last, 0.05, -0.08), Some(block(0, 0)), "the nearest one");
    for (x, y) in [(0.11, -0.5), (0.5, -0.11), (0.9, -0.9), (-0.05, -0.5), (0.5, 0.05), (f64::NAN, -0.5)] {
        assert_eq!(donor(last, x, y), None, "{x} {y}");
    }
    assert_eq!(donor(block(1, 1), 0.05, 0.5), None);
    assert_eq!(donor(block(0, 0), -0.05, -0.5), None);
    assert_eq!(donor(BlockId::ROOT, 0.05, 0.5), None);
}

#[test]
fn splats_beyond_the_largest_costed_scene_do_not_raise_the_work() {
    // Small photos, so that splats dominate the cost.
    let mut capture = aerial(8, 300.0, 8000);
    capture.views.iter_mut().for_each(|view| view.camera = view.camera.mip(2));
    let work = |budget: u32| -> f64 {
        let settings = PlanSettings { budget, ..settings(Mode::Tree, Some(2)) };
        let plan = plan(&capture, ArtefactId::of(b"capture"), &settings, "cpu").unwrap();
        plan.tasks.iter().map(|t| f64::from(t.steps) / t.views.len() as f64 * epoch_cost(t)).sum()
    };
    let [few, many, more] = [COSTED_SPLATS / 16, COSTED_SPLATS, 4 * COSTED_SPLATS].map(work);
    assert!(many > 1.5 * few && (0.95..1.05).contains(&(more / many)), "{few} {many} {more}");
}

#[test]
fn whole_and_flat_plans_have_the_expected_tasks() {
    let capture = street(40, 4000);
    let whole = plan_of(&capture, Mode::Whole, Some(3));
    assert_eq!((whole.levels, whole.tasks.len()), (0, 1));
    let root = &whole.tasks[0];
    assert_eq!((root.views.len(), root.test_views.len()), (35, 5));
    assert!(root.views.iter().all(|v| v.mip == 0 && (v.window.width, v.window.height) == (640, 480)));
    let flat = plan_of(&capture, Mode::Flat, Some(2));
    assert!(flat.tasks.iter().all(|t| t.block.level == 2 && t.parent.is_none() && t.context.is_empty()));
    // A street crosses only some of the leaves. The area of the others has an owner too.
    assert!(flat.tasks.len() < 16);
    assert!(flat.leaves().owner_of(&flat.ground, DVec3::new(-1e6, 1e6, 0.0)).is_some());
}

#[test]
fn areas_without_a_task_belong_to_their_ancestor() {
    let capture = street(40, 4000);
    let plan = plan_of(&capture, Mode::Tree, Some(3));
    let (leaves, tasks) = (plan.leaves(), plan.tasks.iter().map(|t| t.block).collect::<BTreeSet<_>>());
    for i in 0..2000 {
        let at = DVec3::new(noise(2 * i) * 300.0 - 100.0, noise(2 * i + 1) * 300.0 - 150.0, 0.0);
        let cell = plan.ground.block_at(plan.levels, at);
        let deepest = (0..=plan.levels).rev().map(|l| cell.ancestor(l)).find(|b| tasks.contains(b));
        let deepest = if plan.ground.is_background(at) { Some(BlockId::ROOT) } else { deepest };
        assert_eq!(leaves.owner_of(&plan.ground, at), deepest);
    }
    let owned: u64 = leaves.blocks().iter().filter_map(|&b| plan.task(b)).map(|t| u64::from(t.budget)).sum();
    assert!(owned >= 50_000);
}

#[test]
fn a_tree_too_deep_for_its_capture_is_reduced() {
    let capture = aerial(4, 100.0, 600);
    let plan = plan_of(&capture, Mode::Tree, Some(9));
    assert!(plan.levels < 5);
    assert!(lint(&plan, &capture).iter().any(|f| f.severity == Severity::Warning && f.message.contains("of 9 levels")));
}

#[test]
fn plans_are_deterministic_and_round_trip() {
    let capture = aerial(5, 150.0, 3000);
    let plan = plan_of(&capture, Mode::Tree, Some(1));
    assert_eq!(plan, plan_of(&capture, Mode::Tree, Some(1)));
    assert_eq!(Plan::from_frame(&plan.to_frame()).unwrap(), plan);
    let json = serde_json::to_string(&plan).unwrap();
    let back: Plan = serde_json::from_str(&json).unwrap();
    assert_eq!(back.id(), plan.id());
    assert!(Plan::from_frame(&plan.to_frame()[..99]).is_err());
    let mut other = plan.clone();
    other.settings.seed = 1;
    assert_ne!(other.id(), plan.id());
    let mut broken = plan.clone();
    broken.tasks.swap(0, 1);
    assert!(Plan::from_frame(&broken.to_frame()).is_err());
    for side in [0, u32::MAX] {
        broken = plan.clone();
        broken.tasks[0].views[0].window.width = side;
        assert!(Plan::from_frame(&broken.to_frame()).is_err());
    }
    broken = plan;
    broken.ground.edge_metres = f64::NAN;
    assert!(Plan::from_frame(&broken.to_frame()).is_err());
}

/// Every capture gives a plan without lint errors or a `PlanError`, for every mode and depth.
#[test]
fn degenerate_captures_give_a_plan_or_an_error() {
    let grid = |n: usize| (0..n).map(move |i| DVec3::new((i % 30) as f64, (i / 30) as f64, noise(i as u64)));
    let above = |x: f64, y: f64| {
        let eye = DVec3::new(x, y, 20.0);
        look_at(eye, eye - DVec3::Z, DVec3::Y)
    };
    let line: Vec<Camera> = (0..30).map(|i| above(f64::from(i), 15.0)).collect();
    let corner: Vec<Camera> = (0..30).map(|_| above(0.0, 0.0)).collect();
    let islands: Vec<Camera> = (0..40).map(|i| above(f64::from(i % 2) * 5e4 + f64::from(i), 0.0)).collect();
    let island_points =
        (0..2000).map(|i| DVec3::new(f64::from(i % 2) * 5e4 + noise(i as u64) * 40.0, noise(i as u64 + 9) * 20.0, 0.0));
    // A ring of cameras and of points with an empty centre.
    let ring = |radius: f64, i: usize| {
        let (sin, cos) = (f64::from(i as u32) * 0.618).sin_cos();
        DVec3::new(radius * cos, radius * sin, noise(i as u64))
    };
    let around: Vec<Camera> = (0..60).map(|i| above(ring(200.0, i).x, ring(200.0, i).y)).collect();
    let rim = |n: usize| (0..n).map(move |i| ring(190.0 + 20.0 * noise(3 * i as u64), i));
    let captures = [
        ("line", capture(&line, grid(900).collect(), true)),
        ("corner", capture(&corner, grid(900).collect(), true)),
        ("islands", capture(&islands, island_points.collect(), true)),
        ("hole", capture(&around, rim(900).collect(), true)),
        ("one view", capture(&line[..1], grid(900).collect(), true)),
        ("two views", capture(&line[..2], grid(900).collect(), true)),
        ("one spot", capture(&line, vec![DVec3::new(3.0, 15.0, 1.0); 500], true)),
        ("one point", capture(&line, vec![DVec3::new(3.0, 15.0, 1.0)], true)),
        ("no tracks", capture(&line, grid(900).collect(), false)),
        ("no points", capture(&line, Vec::new(), false)),
        ("nothing finite", capture(&line, vec![DVec3::NAN; 9], false)),
        ("no observations", capture(&line, vec![DVec3::Z * 500.0; 9], false)),
        ("huge", capture(&line, grid(900).map(|p| p * 1e300).collect(), false)),
        ("nothing", Capture::default()),
    ];
    for (name, capture) in &captures {
        for mode in [Mode::Tree, Mode::Flat, Mode::Whole] {
            for levels in [None, Some(0), Some(1), Some(3), Some(MAX_LEVELS)] {
                let id = ArtefactId::of(b"capture");
                match plan(capture, id, &settings(mode, levels), "cpu") {
                    Ok(plan) => {
                        let findings = lint(&plan, capture);
                        let error = findings.iter().find(|f| f.severity == Severity::Error);
                        assert!(error.is_none(), "{name} {mode:?} {levels:?}: {}", findings[0]);
                        let sane = |t: &Task| !t.views.is_empty() && t.steps < 1_000_000;
                        let bad = plan.tasks.iter().find(|t| !sane(t));
                        assert!(bad.is_none(), "{name} {mode:?} {levels:?}: {bad:?}");
                        let svg = crate::draw(&plan, capture);
                        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{name}: {svg}");
                    }
                    Err(error) => assert!(
                        ["one view", "no points", "nothing finite", "no observations", "huge", "nothing"]
                            .contains(name)
                            || mode == Mode::Flat,
                        "{name} {mode:?} {levels:?}: {error}"
                    ),
                }
            }
        }
    }
}

#[test]
fn crowded_leaves_are_split() {
    let even = aerial(14, 300.0, 8000);
    // A sixteenth of the area holds more points than all the rest.
    let mut crowd = even.points.positions.clone();
    let at = |i: u64, k: u64| noise(1_000_000 + 3 * i + k);
    crowd.extend((0..24_000).map(|i| DVec3::new(-140.0 + 60.0 * at(i, 0), -140.0 + 60.0 * at(i, 1), 4.0 * at(i, 2))));
    let cameras: Vec<Camera> = even.views.iter().map(|view| view.camera).collect();
    let [even, crowded] = [even.points.positions, crowd].map(|points| {
        let capture = capture(&cameras, points, true);
        (crowded_plan_of(&capture), capture)
    });
    assert_eq!(even.0.levels, 1);
    let (plan, capture) = crowded;
    assert!(plan.levels > 1, "{}", plan.levels);
    let split: BTreeSet<BlockId> = plan.tasks.iter().filter(|t| t.block.level == 2).filter_map(|t| t.parent).collect();
    assert_eq!(split, BTreeSet::from([plan.ground.block_at(1, DVec3::new(-110.0, -110.0, 0.0))]));
    // The children have the same resolution: only the work is divided.
    assert_eq!(plan.rho_metres[1], plan.rho_metres[2]);
    assert!(!lint(&plan, &capture).iter().any(|f| f.message.contains("coarser")), "{:?}", lint(&plan, &capture));
    let [low, high] = epochs_of_leaves(&plan);
    assert!(high < 1.1 * low, "{low} {high}");
}

#[test]
fn areas_without_finer_views_stay_with_their_parent() {
    // Pixels are small near the path. The far side has as many views, at eight times the distance.
    let cameras: Vec<Camera> = (0..60)
        .map(|i| {
            let eye = DVec3::new(f64::from(i) * 5.0 - 150.0, -150.0, 30.0);
            look_at(eye, eye + DVec3::new(0.0, 100.0, -20.0), DVec3::Z)
        })
        .collect();
    let at = |i: u64, k: u64| noise(3 * i + k) - 0.5;
    let points: Vec<DVec3> =
        (0..20_000).map(|i| DVec3::new(300.0 * at(i, 0), 300.0 * at(i, 1), 4.0 * at(i, 2))).collect();
    let plan = plan_of(&capture(&cameras, points, true), Mode::Tree, Some(3));
    let rows = |level: u8| -> BTreeSet<u32> {
        plan.tasks.iter().filter(|t| t.block.level == level).map(|t| t.block.y).collect()
    };
    assert!(rows(1).len() == 2 && rows(3).contains(&1), "{:?} {:?}", rows(1), rows(3));
    assert!(!rows(3).contains(&7), "{:?}", rows(3));
    // Views and points are not the limit: blocks of level 2, twice as coarse, exist farther out.
    assert!(rows(2).last() > rows(3).last().map(|row| row / 2).as_ref(), "{:?} {:?}", rows(2), rows(3));
    // Leaves of all levels get the same number of epochs.
    let [low, high] = epochs_of_leaves(&plan);
    assert!(high < 1.1 * low, "{low} {high}");
}

/// Minimum and maximum steps per view of tasks without children.
fn epochs_of_leaves(plan: &Plan) -> [f64; 2] {
    let parents: BTreeSet<_> = plan.tasks.iter().filter_map(|t| t.parent).collect();
    let leaves = plan.tasks.iter().filter(|t| !parents.contains(&t.block));
    leaves
        .map(|t| f64::from(t.steps) / t.views.len() as f64)
        .fold([f64::MAX, 0.0], |[low, high], v| [low.min(v), high.max(v)])
}

#[test]
fn settings_out_of_range_are_refused() {
    let capture = aerial(3, 60.0, 300);
    for bad in [
        PlanSettings { steps: 0, ..PlanSettings::default() },
        PlanSettings { budget: 0, ..PlanSettings::default() },
        PlanSettings { sh_degree: 4, ..PlanSettings::default() },
        PlanSettings { levels: Some(17), ..PlanSettings::default() },
        PlanSettings { test_stretches: f64::NAN, ..PlanSettings::default() },
        // An aerial survey has no street.
        PlanSettings { test_stretches: 20.0, ..PlanSettings::default() },
    ] {
        let error = plan(&capture, ArtefactId::of(b""), &bad, "cpu").unwrap_err();
        assert!(matches!(error, PlanError::Setting { .. }), "{error}");
    }
    let all_test = PlanSettings { test_every: 1, ..PlanSettings::default() };
    let error = plan(&capture, ArtefactId::of(b""), &all_test, "cpu").unwrap_err();
    assert_eq!(error, PlanError::NoTrainViews { views: 9, usable: 9, test: 9 });
}
