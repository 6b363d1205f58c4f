//! Helpers of several integration tests: plans without views, an executor that trains nothing, and lease requests.

// Each test binary uses some of them.
#![allow(dead_code)]

use std::sync::{Arc, Mutex};
use std::time::Duration;

use blocks::{Ground, Plan, PlanSettings, Task};
use glam::{DQuat, DVec2};
use proto::lease_reply::Reply;
use proto::{Access, Attempt, Client};
use scene::{ArtefactId, BlockId};
use worker::{Execute, ExecuteError, Flow, Report, TaskOrder};

/// The backend of the plans and workers.
pub(crate) const BACKEND: &str = "cpu-none";

/// A task of one step without views.
pub(crate) fn task(block: &str, context: &[&str]) -> Task {
    let block: BlockId = block.parse().unwrap();
    Task {
        block,
        parent: block.parent(),
        context: context.iter().map(|block| block.parse().unwrap()).collect(),
        views: Vec::new(),
        test_views: Vec::new(),
        points: 0,
        budget: 1,
        steps: 1,
        rho_metres: 1.0,
        visible_splats: 0,
        visible_context_splats: 0,
        memory_bytes: 0,
    }
}

/// A plan of these tasks, down to level `levels`.
pub(crate) fn plan_of(levels: u8, tasks: Vec<Task>) -> Plan {
    Plan {
        version: blocks::plan::VERSION,
        capture: ArtefactId([1; 32]),
        zones: None,
        detector: None,
        settings: PlanSettings::default(),
        backend: BACKEND.into(),
        ground: Ground {
            ground_from_world: DQuat::IDENTITY,
            min: DVec2::ZERO,
            edge_metres: 100.0,
            height_metres: 0.0,
            near_metres: 1e300,
        },
        levels,
        rho_metres: (0..=levels).rev().map(|level| f64::from(1u32 << level)).collect(),
        tasks,
        eval_tasks: Vec::new(),
        detect_tasks: Vec::new(),
        object_tasks: Vec::new(),
    }
}

/// Requests a task until one is granted; panics after about a minute.
pub(crate) async fn lease(client: &mut Client, worker: &str) -> Attempt {
    for _ in 0..10_000 {
        let request = proto::LeaseRequest { worker: worker.into(), backend: BACKEND.into(), ..Default::default() };
        match client.lease(request).await.unwrap().into_inner().reply.unwrap() {
            Reply::Grant(grant) => return grant.attempt.unwrap(),
            Reply::WaitMillis(millis) => tokio::time::sleep(Duration::from_millis(millis.into())).await,
            Reply::Drained(_) => panic!("drained"),
        }
    }
    panic!("no task was granted");
}

/// A worker's options.
pub(crate) fn worker_options(coordinator_url: String, name: &str) -> worker::Options {
    let (worker_id, backend) = (name.into(), BACKEND.into());
    worker::Options { coordinator_url, access: Access::default(), worker_id, backend, memory_bytes: 0 }
}

type Work =
    dyn Fn(&TaskOrder, &mut (dyn FnMut(Report) -> Flow + Send)) -> Result<ArtefactId, ExecuteError> + Send + Sync;

/// Executes a function of the test, and records its orders.
pub(crate) struct FakeExecutor {
    work: Box<Work>,
    pub(crate) orders: Mutex<Vec<TaskOrder>>,
}

impl Execute for FakeExecutor {
    fn execute(
        &self,
        order: &TaskOrder,
        report: &mut (dyn FnMut(Report) -> Flow + Send),
    ) -> Result<ArtefactId, ExecuteError> {
        self.orders.lock().unwrap().push(order.clone());
        (self.work)(order, report)
    }
}

/// An executor of this function.
pub(crate) fn fake(
    work: impl Fn(&TaskOrder, &mut (dyn FnMut(Report) -> Flow + Send)) -> Result<ArtefactId, ExecuteError>
    + Send
    + Sync
    + 'static,
) -> Arc<FakeExecutor> {
    Arc::new(FakeExecutor { work: Box::new(work), orders: Mutex::default() })
}

/// A result that is a function of the plan and the task's inputs alone, as in training.
pub(crate) fn result_of(order: &TaskOrder) -> ArtefactId {
    ArtefactId::of(format!("{} {} {:?}", order.plan, order.task, order.inputs).as_bytes())
}
