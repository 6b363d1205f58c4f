//! What changes a job: the calls of the command line, made for a browser.

use proto::control_request::What;
use proto::{CancelRequest, ControlRequest, Pause, Reprioritise, Resume};
use serde::Deserialize;
use tonic::Code;

use crate::follow::Find;

/// Tasks of one request at most.
const TASKS_LIMIT: usize = 10_000;

/// The body of `POST /api/jobs/N/control`.
#[derive(Debug, Deserialize)]
#[serde(tag = "what", rename_all = "lowercase", deny_unknown_fields)]
pub(crate) enum Request {
    Pause,
    Resume,
    Cancel,
    Retry {
        tasks: Vec<u32>,
    },
    Priority {
        priority: u32,
        #[serde(default)]
        weight: u32,
    },
}

/// Carries out a request; the error has what to tell, and whether it is the browser's.
pub(crate) async fn carry_out(find: &Find, job: u64, request: Request) -> Result<(), (bool, String)> {
    let whats = match request {
        Request::Pause => vec![What::Pause(Pause {})],
        Request::Resume => vec![What::Resume(Resume {})],
        Request::Priority { priority, weight } => vec![What::Reprioritise(Reprioritise { priority, weight })],
        Request::Retry { tasks } if tasks.is_empty() || tasks.len() > TASKS_LIMIT => {
            return Err((true, format!("name 1 to {TASKS_LIMIT} tasks to retry")));
        }
        Request::Retry { tasks } => tasks.into_iter().map(What::RetryTask).collect(),
        Request::Cancel => Vec::new(),
    };
    let failed = |status: tonic::Status| {
        let own = matches!(status.code(), Code::InvalidArgument | Code::FailedPrecondition | Code::NotFound);
        (own, proto::explain(&status))
    };
    let (mut client, _) = find().await.map_err(|problem| (false, problem))?;
    if whats.is_empty() {
        client.cancel(CancelRequest { job }).await.map_err(failed)?;
    }
    for what in whats {
        client.control(ControlRequest { job, what: Some(what) }).await.map_err(failed)?;
    }
    Ok(())
}
