//! Plans for tests.

use blocks::{Ground, Mode, Plan, PlanSettings, Task};
use glam::{DQuat, DVec2};
use scene::{ArtefactId, BlockId};

/// A task on a block without views.
pub(crate) fn task(block: BlockId, steps: u32) -> Task {
    Task {
        block,
        parent: block.parent(),
        context: Vec::new(),
        views: Vec::new(),
        test_views: Vec::new(),
        points: 0,
        budget: 1000,
        steps,
        rho_metres: 1.0,
        visible_splats: 1000,
        visible_context_splats: 0,
        memory_bytes: 0,
    }
}

/// A plan of two levels on a square of 8 m, without background.
pub(crate) fn plan_of(mode: Mode, tasks: Vec<Task>) -> Plan {
    Plan {
        version: blocks::plan::VERSION,
        capture: ArtefactId([1; 32]),
        zones: None,
        detector: None,
        settings: PlanSettings { mode, ..PlanSettings::default() },
        backend: "none".into(),
        ground: Ground {
            ground_from_world: DQuat::IDENTITY,
            min: DVec2::ZERO,
            edge_metres: 8.0,
            height_metres: 0.0,
            near_metres: 1e300,
        },
        levels: 1,
        rho_metres: vec![2.0, 1.0],
        tasks,
        eval_tasks: Vec::new(),
        detect_tasks: Vec::new(),
        object_tasks: Vec::new(),
    }
}
