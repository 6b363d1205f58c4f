//! Plans the tasks that train the objects which move.
//!
//! An object is trained in its own axes, where it stands still and the cameras move. The blocks around its path are its frozen context.

use std::collections::BTreeSet;

use glam::DVec2;
use scene::{BlockId, Camera, Capture, MovingObject, Rect};

use crate::budgets::{
    BASE_BYTES, BYTES_PER_FROZEN_COLUMN, BYTES_PER_FROZEN_PROJECTED, BYTES_PER_PIXEL, BYTES_PER_PROJECTED,
    BYTES_PER_TRAINED_COLUMN, COLUMNS,
};
use crate::cost::StepCost;
use crate::ground::{Ground, Square};
use crate::lod::cut_around;
use crate::plan::PlanSettings;
use crate::split::Split;
use crate::task::{ObjectTask, Task, ViewUse};
use crate::visibility::is_usable;

/// The least width and height of a window, and the least area of all windows together, pixels: an object that no photo shows larger
/// is not modelled.
const MIN_SIDE: u32 = 12;
const MIN_PIXELS: u64 = 2_000;
/// The least number of windows.
const MIN_VIEWS: usize = 3;
/// Windows of more pixels are read at a coarser mip.
const MAX_WINDOW_PIXELS: u64 = 1 << 18;
/// Splats per pixel of a large window, and their bounds.
const SPLATS_PER_PIXEL: f64 = 0.1;
const SPLATS: [f64; 2] = [200.0, 10_000.0];
/// How often each window is drawn, and the share of the job's steps that one object has at most.
const VISITS: u32 = 12;
const SHARE_OF_STEPS: u32 = 4;
const MIN_STEPS: u32 = 100;

/// Cost of a frozen splat around the path, relative to a pixel.
const FROZEN_COST: f64 = 0.1;

/// Tasks that train the objects which the photos show well enough, in the order of the capture's objects. Equal inputs give equal tasks.
pub(crate) fn object_tasks(
    capture: &Capture,
    tasks: &[Task],
    ground: &Ground,
    split: &Split,
    settings: &PlanSettings,
) -> Vec<ObjectTask> {
    let existing: BTreeSet<BlockId> = tasks.iter().map(|task| task.block).collect();
    let finest = existing.iter().map(|block| block.level).max().unwrap_or(0);
    let columns = COLUMNS[usize::from(settings.sh_degree.min(3))];
    let task = |(number, object): (usize, &MovingObject)| {
        let views: Vec<ViewUse> = (0..capture.views.len() as u32)
            .filter(|view| !split.is_held_out(*view))
            .filter_map(|view| window(capture, view, object))
            .collect();
        let mut areas: Vec<u64> = views.iter().map(|used| used.window.area()).collect();
        areas.sort_unstable();
        if views.len() < MIN_VIEWS || areas.iter().sum::<u64>() < MIN_PIXELS {
            return None;
        }
        let large = areas[areas.len() * 9 / 10] as f64;
        let budget = (SPLATS_PER_PIXEL * large).clamp(SPLATS[0], SPLATS[1]) as u32;
        let wanted = (views.len() as u32).saturating_mul(VISITS).min(settings.steps / SHARE_OF_STEPS);
        let steps = wanted.max(MIN_STEPS).min(settings.steps);
        // The blocks that it passes are its context, and none of them is trained here: one level finer than those of a block.
        let edge = ground.core_edge_metres(finest);
        let cut = cut_around(ground, &places(object, ground), finest.saturating_add(1), edge, &existing);
        let frozen: u64 =
            tasks.iter().filter(|task| cut.contains(&task.block)).map(|task| u64::from(task.budget)).sum();
        let memory_bytes = BASE_BYTES
            + (BYTES_PER_FROZEN_COLUMN * columns + BYTES_PER_FROZEN_PROJECTED) * frozen
            + (BYTES_PER_TRAINED_COLUMN * columns + BYTES_PER_PROJECTED) * u64::from(budget)
            + BYTES_PER_PIXEL * areas.last().copied().unwrap_or(0);
        // Pixels, splats of the object, and frozen ones, of which all are looked at and few are in a window.
        let mean_pixels = areas.iter().sum::<u64>() as f64 / areas.len() as f64;
        let step = mean_pixels + f64::from(budget) + FROZEN_COST * frozen as f64;
        let work_millis = (1e3 * f64::from(steps) * step * StepCost::CPU_SECONDS) as u64;
        let context = cut.into_iter().collect();
        Some(ObjectTask { object: number as u32, views, context, budget, steps, work_millis, memory_bytes })
    };
    capture.objects.iter().enumerate().filter_map(task).collect()
}

/// The square of the ground that the object's path crosses.
fn places(object: &MovingObject, ground: &Ground) -> Square {
    let mut places = object.path.iter().map(|pose| ground.from_world(pose.world_from_object.translation).truncate());
    let first = places.next().unwrap_or_default();
    let (low, high) = places.fold((first, first), |(low, high): (DVec2, DVec2), p| (low.min(p), high.max(p)));
    Square { min: low, max: high }
}

/// The window of a view that shows the object's box, at the finest mip of not too many pixels; `None` where it is not seen, or small.
fn window(capture: &Capture, view: u32, object: &MovingObject) -> Option<ViewUse> {
    let seen = &capture.views[view as usize];
    let camera = object_camera(&seen.camera, object, seen.seconds?)?;
    if !is_usable(&seen.camera) {
        return None;
    }
    let corners = object.splat_box().map(|corner| camera.camera_from_world.apply(corner));
    let outline = camera.pinhole.outline(&corners);
    let first = *outline.first()?;
    let (low, high) = outline.iter().fold((first, first), |(low, high), p| (low.min(*p), high.max(*p)));
    (0..16).find_map(|mip| {
        let (image, scale) = (seen.camera.mip(mip).pinhole, 1.0 / f64::from(1u32 << mip));
        let side = |low: f64, high: f64, size: u32| {
            let size = f64::from(size);
            let (from, to) = ((low * scale).floor().clamp(0.0, size), (high * scale).ceil().clamp(0.0, size));
            (from as u32, (to - from) as u32)
        };
        let ((x, width), (y, height)) = (side(low.x, high.x, image.width), side(low.y, high.y, image.height));
        let window = Rect { x, y, width, height };
        let is_large = mip == 0 && width.min(height) < MIN_SIDE;
        if is_large {
            return Some(None);
        }
        (window.area() <= MAX_WINDOW_PIXELS).then_some((width.min(height) > 0).then_some(ViewUse { view, mip, window }))
    })?
}

/// The camera in the axes of an object at a time: the object stands still, and the camera moves. `None` where it is not known where the
/// object is.
pub fn object_camera(camera: &Camera, object: &MovingObject, seconds: f64) -> Option<Camera> {
    let camera_from_world = camera.camera_from_world.after(&object.pose(seconds)?);
    Some(Camera { camera_from_world, ..*camera })
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use scene::{ArtefactId, PathPose, Rigid};

    use super::*;
    use crate::lint::lint;
    use crate::plan::{Mode, Plan, PlannedTask};
    use crate::planner::plan;
    use crate::testing::aerial;

    /// A van that drives east under an aerial survey that follows it.
    fn capture() -> Capture {
        let mut capture = aerial(8, 300.0, 8000);
        for (view, number) in capture.views.iter_mut().zip(0..) {
            (view.seconds, view.masked) = (Some(f64::from(8 * (number % 8))), true);
        }
        let pose = |seconds: f64| PathPose {
            seconds,
            world_from_object: Rigid {
                rotation: DQuat::IDENTITY,
                translation: DVec3::new(4.7 * seconds - 131.0, 20.0, 0.0),
            },
        };
        let van = |id: &str, metres: f64| MovingObject {
            id: id.into(),
            class: "van".into(),
            low: DVec3::new(-metres, -1.0, 0.0),
            high: DVec3::new(metres, 1.0, 2.0),
            path: (0..64).map(|second| pose(f64::from(second))).collect(),
        };
        capture.objects = vec![van("a-van", 3.0), van("never-seen", 0.2)];
        capture.objects[1].path = vec![PathPose { seconds: 500.0, ..pose(0.0) }];
        capture
    }

    fn planned(capture: &Capture, settings: &PlanSettings) -> Plan {
        let plan = plan(capture, ArtefactId::of(b"capture"), settings, "cpu").unwrap();
        assert!(lint(&plan, capture).is_empty(), "{:?}", lint(&plan, capture));
        plan
    }

    #[test]
    fn an_object_is_trained_on_windows_around_its_box_beside_the_blocks_that_it_passes() {
        let capture = capture();
        let settings = PlanSettings { levels: Some(2), steps: 4000, budget: 50_000, ..PlanSettings::default() };
        let plain = planned(&capture, &settings);
        let plan = planned(&capture, &PlanSettings { objects: true, ..settings.clone() });
        assert!(plain.object_tasks.is_empty() && plan.tasks == plain.tasks);
        let [task] = &plan.object_tasks[..] else { panic!("{:?}", plan.object_tasks) };
        assert_eq!((task.object, plan.planned(plan.first_object() as u32)), (0, Some(PlannedTask::Object(task))));
        assert_eq!((plan.len(), plan.planned(plan.len() as u32)), (plain.len() + 1, None));
        assert_eq!(Plan::from_frame(&plan.to_frame()).unwrap(), plan);
        // Its windows hold the middle of its box and little more.
        assert!(task.views.len() > 5);
        for used in &task.views {
            let seen = &capture.views[used.view as usize];
            let pose = capture.objects[0].pose(seen.seconds.unwrap()).unwrap();
            let (pixel, _) = seen.camera.mip(used.mip).window(used.window).project(pose.apply(DVec3::Z));
            let (width, height) = (f64::from(used.window.width), f64::from(used.window.height));
            let (full, _) = seen.camera.project(pose.apply(DVec3::Z));
            let is_whole = full.x > 60.0 && full.x < 580.0 && full.y > 40.0 && full.y < 440.0;
            assert!(!is_whole || (pixel.x > 0.0 && pixel.y > 0.0 && pixel.x < width && pixel.y < height), "{used:?}");
            assert!(width < 90.0 && height < 60.0 && used.view % 8 != 0, "{used:?}");
        }
        // The finest blocks under its path, and no finer detail far from it.
        let finest = |y: u32| task.context.iter().filter(move |block| block.level == 2 && block.y == y).count();
        assert_eq!((finest(2), task.context.contains(&BlockId::ROOT)), (4, false));
        let needed = plan.dependencies(PlannedTask::Object(task)).unwrap();
        assert_eq!(needed.len(), task.context.len());
        assert!(task.work_millis > 0 && task.memory_bytes > BASE_BYTES);
    }

    #[test]
    fn a_capture_that_does_not_show_objects_is_refused_or_says_so() {
        let settings = PlanSettings { objects: true, mode: Mode::Whole, ..PlanSettings::default() };
        let good = capture();
        assert_eq!(planned(&good, &settings).object_tasks.len(), 1);
        type Change = fn(&mut Capture);
        let changes: [(Change, &str); 3] = [
            (|capture| capture.objects.clear(), "knows no objects"),
            (|capture| capture.views.iter_mut().for_each(|view| view.seconds = None), "when photos were taken"),
            (|capture| capture.views.iter_mut().for_each(|view| view.masked = false), "no photo has a mask"),
        ];
        let refused = |capture: &Capture, settings: &PlanSettings, problem: &str| {
            let error = plan(capture, ArtefactId::of(b"capture"), settings, "cpu").unwrap_err().to_string();
            assert!(error.contains("--objects") && error.contains(problem), "{error}");
        };
        for (change, problem) in changes {
            let mut bad = good.clone();
            change(&mut bad);
            refused(&bad, &settings, problem);
        }
        refused(&good, &PlanSettings { mode: Mode::Flat, ..settings.clone() }, "flat blocks");
        // Objects that no photo shows well.
        let mut small = good.clone();
        small.objects.remove(0);
        let plan = plan(&small, ArtefactId::of(b"capture"), &settings, "cpu").unwrap();
        let said = lint(&plan, &small);
        assert!(
            plan.object_tasks.is_empty() && said.iter().any(|finding| finding.message.contains("no object")),
            "{said:?}"
        );
    }

    #[test]
    fn damaged_tasks_are_refused() {
        let settings = PlanSettings { objects: true, steps: 4000, ..PlanSettings::default() };
        let capture = capture();
        let good = planned(&capture, &settings);
        let changes: [fn(&mut ObjectTask); 3] = [
            |task| task.views.clear(),
            |task| task.views[0].window.width = 0,
            |task| task.context.push(BlockId { level: 9, x: 0, y: 0 }),
        ];
        for change in changes {
            let mut bad = good.clone();
            change(&mut bad.object_tasks[0]);
            assert!(bad.check().is_err());
        }
        for change in [|task: &mut ObjectTask| task.object = 7, |task: &mut ObjectTask| task.views[0].view = 0] {
            let mut bad = good.clone();
            change(&mut bad.object_tasks[0]);
            assert!(!lint(&bad, &capture).is_empty());
        }
    }
}
