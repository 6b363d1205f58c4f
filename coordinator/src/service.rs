//! The calls of the wire: checks what came in, asks the owner of the state, answers.

use std::collections::{BTreeMap, BTreeSet};
use std::pin::Pin;

use blocks::{Plan, StepCost};
use cluster::{Failure, FailureKind, JobSpec, Offer, TaskIndex, TaskNode};
use proto::control_request::What;
use proto::coordinator_server::Coordinator;
use proto::{
    AboutReply, AboutRequest, AttemptReply, BlocksReply, BlocksRequest, CancelReply, CancelRequest, CompleteRequest,
    ControlReply, ControlRequest, FailRequest, JobsReply, JobsRequest, LeaseReply, LeaseRequest, LeaveReply,
    LeaveRequest, LogsReply, LogsRequest, ReportReply, ReportRequest, StatusReply, StatusRequest, SubmitReply,
    SubmitRequest, WatchEvent, WatchRequest,
};
use scene::{ArtefactId, BlockId, CodecError};
use store::{Store, StoreError};
use telemetry::TraceParent;
use tokio::sync::{mpsc, oneshot};
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt};
use tonic::{Request, Response, Status};
use tracing::field::Empty;
use tracing::{Instrument, Span};

use crate::jobs::Jobs;
use crate::owner::Call;

/// The largest plan that is read, in bytes: 100,000 tasks with 300 windows each fit twice.
const PLAN_BYTES_LIMIT: u64 = 1 << 30;

/// The wire's side of the coordinator.
#[derive(Clone)]
pub(crate) struct Service {
    store: Store,
    calls: mpsc::Sender<Call>,
}

type Answer<T> = Result<Response<T>, Status>;

impl Service {
    pub(crate) fn new(store: Store, calls: mpsc::Sender<Call>) -> Self {
        Self { store, calls }
    }

    /// Has the owner of the state do this, and waits for its answer until what it says is durable.
    async fn ask<T: Send + 'static>(
        &self,
        what: impl FnOnce(&mut Jobs, u64) -> Result<T, Status> + Send + 'static,
    ) -> Result<T, Status> {
        let (reply, answer) = oneshot::channel();
        let call: Call = Box::new(move |host| match host {
            Ok((jobs, now)) => {
                let said = what(jobs, now);
                // The caller may have hung up; what it asked for is done all the same.
                jobs.once_durable(move || drop(reply.send(said)));
            }
            Err(status) => drop(reply.send(Err(status))),
        });
        self.wait_for(call, answer).await
    }

    /// As [`ask`](Self::ask), for a sign of life, which changes nothing that must be durable.
    async fn ask_at_once<T: Send + 'static>(
        &self,
        what: impl FnOnce(&mut Jobs, u64) -> Result<T, Status> + Send + 'static,
    ) -> Result<T, Status> {
        let (reply, answer) = oneshot::channel();
        let call: Call = Box::new(move |host| drop(reply.send(host.and_then(|(jobs, now)| what(jobs, now)))));
        self.wait_for(call, answer).await
    }

    async fn wait_for<T>(&self, call: Call, answer: oneshot::Receiver<Result<T, Status>>) -> Result<T, Status> {
        let gone = || Status::unavailable("the coordinator is shutting down or leads no more");
        self.calls.send(call).await.map_err(|_| gone())?;
        answer.await.map_err(|_| gone())?
    }

    /// Makes a job of a plan, traced under this span.
    async fn accept(&self, request: SubmitRequest, traced: Option<TraceParent>) -> Result<SubmitReply, Status> {
        if request.store_url != self.store.url() {
            let (theirs, ours) = (proto::one_line(&request.store_url), self.store.url());
            let problem = format!("the plan lies in the store '{theirs}', this coordinator works on '{ours}'");
            return Err(Status::failed_precondition(problem));
        }
        let plan = proto::artefact_id(&request.plan)?;
        let spec = self.read_plan(plan, spec_of).await?;
        let tasks = spec.tasks.len() as u32;
        let job = self.ask(move |jobs, now| jobs.submit(now, plan, spec, traced)).await?;
        Ok(SubmitReply { job, tasks })
    }

    /// Deletes what a job left, then forgets it. Goes on to its end if the caller hangs up.
    async fn forget(&self, job: u64) -> Result<u32, Status> {
        let service = self.clone();
        let work = tokio::spawn(async move {
            let left = service.ask(move |jobs, _| jobs.collect(job)).await?;
            let deleted = left.delete(&service.store).await.map_err(store_status);
            let whole = deleted.is_ok();
            service.ask(move |jobs, now| jobs.collected(now, job, whole)).await?;
            deleted
        });
        work.await.map_err(|_| Status::internal("the store could not be swept"))?
    }

    /// Reads of a plan what `look` finds in it.
    async fn read_plan<T: Send + 'static>(
        &self,
        id: ArtefactId,
        look: impl FnOnce(&Plan) -> Result<T, CodecError> + Send + 'static,
    ) -> Result<T, Status> {
        match self.store.size(id).await.map_err(store_status)? {
            Some(bytes) if bytes > PLAN_BYTES_LIMIT => {
                return Err(Status::invalid_argument(format!("artefact {id} is too large for a plan: {bytes} bytes")));
            }
            _ => {}
        }
        let bytes = self.store.get(id).await.map_err(store_status)?;
        let read = tokio::task::spawn_blocking(move || look(&Plan::from_frame(&bytes)?));
        read.await
            .map_err(|_| Status::internal("the plan could not be read"))?
            .map_err(|error: CodecError| Status::invalid_argument(format!("artefact {id}: {error}")))
    }
}

/// A plan as the scheduler sees it.
fn spec_of(plan: &Plan) -> Result<JobSpec, CodecError> {
    Ok(JobSpec { backend: plan.backend.clone(), priority: 0, weight: 1, tasks: dag_of(plan)? })
}

/// A task depends on its parent's and its context's tasks.
fn dag_of(plan: &Plan) -> Result<Vec<TaskNode>, CodecError> {
    let index: BTreeMap<BlockId, u32> = plan.tasks.iter().map(|task| task.block).zip(0..).collect();
    let node = |task: &blocks::Task| {
        let needed = task.parent.iter().chain(&task.context);
        let found = needed.map(|block| {
            let missing = || CodecError::new(format!("task {} needs block {block}, which has no task", task.block));
            index.get(block).copied().map(TaskIndex).ok_or_else(missing)
        });
        Ok(TaskNode {
            dependencies: found.collect::<Result<_, CodecError>>()?,
            work: work_of(task),
            memory_bytes: task.memory_bytes,
        })
    };
    plan.tasks.iter().map(node).collect()
}

/// About the CPU milliseconds that a task takes. What counts are the ratios between tasks; speeds are learnt in the same measure.
fn work_of(task: &blocks::Task) -> u64 {
    // `as` saturates: a plan may ask for any number of steps.
    (f64::from(task.steps) * StepCost::of(task).total() * StepCost::CPU_SECONDS * 1e3) as u64
}

fn store_status(error: StoreError) -> Status {
    match error {
        StoreError::Missing { .. } => Status::not_found(error.to_string()),
        StoreError::Corrupt { .. } => Status::data_loss(error.to_string()),
        _ => Status::unavailable(error.to_string()),
    }
}

/// A span under the caller's. Who is not traced gets none: it would be a trace of its own.
fn span_of(parent: Option<TraceParent>, span: impl FnOnce() -> Span) -> Span {
    let Some(parent) = parent else { return Span::none() };
    let span = span();
    parent.adopt(&span);
    span
}

/// Who asks for a task, what it offers, and the highest epoch that it knows of.
fn offer_of(request: LeaseRequest) -> Result<(String, Offer, u64), Status> {
    let LeaseRequest { worker, backend, memory_bytes, cached, epoch } = request;
    proto::check_name("worker", &worker)?;
    proto::check_name("backend", &backend)?;
    if cached.len() > cluster::CACHED_LIMIT {
        let problem = format!("a call names {} cached artefacts, at most {}", cached.len(), cluster::CACHED_LIMIT);
        return Err(Status::invalid_argument(problem));
    }
    let cached = cached.iter().map(|id| proto::artefact_id(id)).collect::<Result<BTreeSet<_>, Status>>()?;
    Ok((worker, Offer { backend, memory_bytes, cached: cached.into_iter().collect() }, epoch))
}

fn attempt_of(attempt: Option<proto::Attempt>) -> Result<proto::Attempt, Status> {
    attempt.ok_or_else(|| Status::invalid_argument("the call names no attempt"))
}

#[tonic::async_trait]
impl Coordinator for Service {
    async fn about(&self, _: Request<AboutRequest>) -> Answer<AboutReply> {
        let backends = self.ask(|jobs, _| Ok(jobs.backends())).await?;
        let (store_url, version) = (self.store.url().to_string(), env!("CARGO_PKG_VERSION").to_string());
        Ok(Response::new(AboutReply { store_url, version, backends }))
    }

    async fn submit(&self, request: Request<SubmitRequest>) -> Answer<SubmitReply> {
        let span = tracing::info_span!("accept", otel.kind = "server", job = Empty, tasks = Empty);
        let parent = TraceParent::of_header(request.metadata());
        parent.iter().for_each(|parent| parent.adopt(&span));
        // A coordinator that exports nothing hands on what it heard.
        let traced = TraceParent::of(&span).or(parent);
        let reply = self.accept(request.into_inner(), traced).instrument(span.clone()).await?;
        span.record("job", reply.job).record("tasks", reply.tasks);
        Ok(Response::new(reply))
    }

    async fn lease(&self, request: Request<LeaseRequest>) -> Answer<LeaseReply> {
        let (worker, offer, epoch) = offer_of(request.into_inner())?;
        let reply = self.ask(move |jobs, now| jobs.lease(now, &worker, offer, epoch)).await?;
        Ok(Response::new(LeaseReply { reply: Some(reply) }))
    }

    async fn report(&self, request: Request<ReportRequest>) -> Answer<ReportReply> {
        let ReportRequest { attempt, reports } = request.into_inner();
        let attempt = attempt_of(attempt)?;
        if reports.len() > proto::REPORTS_LIMIT || !reports.iter().all(proto::Report::is_finite) {
            let advice = format!("a call carries at most {} reports, of finite numbers", proto::REPORTS_LIMIT);
            return Err(Status::invalid_argument(advice));
        }
        let accepted = self.ask_at_once(move |jobs, now| jobs.report(now, attempt, reports)).await?;
        Ok(Response::new(ReportReply { cancelled: !accepted }))
    }

    async fn complete(&self, request: Request<CompleteRequest>) -> Answer<AttemptReply> {
        let parent = TraceParent::of_header(request.metadata());
        let CompleteRequest { attempt, artefact, then } = request.into_inner();
        let (attempt, artefact) = (attempt_of(attempt)?, proto::artefact_id(&artefact)?);
        let then = then.map(offer_of).transpose()?;
        let span = span_of(parent, || {
            let proto::Attempt { job, task, number: attempt, .. } = attempt;
            tracing::info_span!("commit", otel.kind = "server", job, task, attempt, %artefact, accepted = Empty)
        });
        let work = self.ask(move |jobs, now| {
            let accepted = jobs.complete(now, attempt, artefact)?;
            // That the result counts is said in any case; why there is nothing next, to whoever asks.
            let next = then.and_then(|(worker, offer, epoch)| jobs.lease(now, &worker, offer, epoch).ok());
            Ok((accepted, next))
        });
        let (accepted, next) = work.instrument(span.clone()).await?;
        span.record("accepted", accepted);
        Ok(Response::new(AttemptReply { accepted, next: next.map(|reply| LeaseReply { reply: Some(reply) }) }))
    }

    async fn fail(&self, request: Request<FailRequest>) -> Answer<AttemptReply> {
        let parent = TraceParent::of_header(request.metadata());
        let request = request.into_inner();
        let kind = match request.kind() {
            proto::FailureKind::Work => FailureKind::Work,
            proto::FailureKind::Input => FailureKind::Input,
            proto::FailureKind::GivenBack => FailureKind::GivenBack,
            proto::FailureKind::Infrastructure => FailureKind::Infrastructure,
            proto::FailureKind::OutOfMemory => FailureKind::OutOfMemory,
            proto::FailureKind::Numeric => FailureKind::Numeric,
        };
        let (attempt, message) = (attempt_of(request.attempt)?, proto::one_line(&request.message));
        let span = span_of(parent, || {
            let proto::Attempt { job, task, number: attempt, .. } = attempt;
            tracing::info_span!("fail", otel.kind = "server", job, task, attempt, ?kind, accepted = Empty)
        });
        let work = self.ask(move |jobs, now| jobs.fail(now, attempt, Failure { kind, message }));
        let accepted = work.instrument(span.clone()).await?;
        span.record("accepted", accepted);
        Ok(Response::new(AttemptReply { accepted, next: None }))
    }

    type WatchStream = Pin<Box<dyn Stream<Item = Result<WatchEvent, Status>> + Send>>;

    async fn watch(&self, request: Request<WatchRequest>) -> Answer<Self::WatchStream> {
        let job = request.into_inner().job;
        let watched = self.ask(move |jobs, _| jobs.watch(job)).await?;
        let snapshot = tokio_stream::iter(watched.snapshot);
        Ok(Response::new(match watched.rest {
            Some(rest) => Box::pin(snapshot.chain(ReceiverStream::new(rest)).map(Ok)),
            None => Box::pin(snapshot.map(Ok)),
        }))
    }

    async fn status(&self, request: Request<StatusRequest>) -> Answer<StatusReply> {
        let job = request.into_inner().job;
        Ok(Response::new(self.ask(move |jobs, _| jobs.status(job)).await?))
    }

    async fn cancel(&self, request: Request<CancelRequest>) -> Answer<CancelReply> {
        let job = request.into_inner().job;
        self.ask(move |jobs, now| jobs.cancel(now, job)).await?;
        Ok(Response::new(CancelReply {}))
    }

    async fn control(&self, request: Request<ControlRequest>) -> Answer<ControlReply> {
        let ControlRequest { job, what } = request.into_inner();
        let what = what.ok_or_else(|| Status::invalid_argument("the call says nothing that this coordinator knows"))?;
        if let What::Forget(_) = what {
            return Ok(Response::new(ControlReply { deleted: self.forget(job).await? }));
        }
        self.ask(move |jobs, now| jobs.control(now, job, what)).await?;
        Ok(Response::new(ControlReply { deleted: 0 }))
    }

    async fn leave(&self, request: Request<LeaveRequest>) -> Answer<LeaveReply> {
        let worker = request.into_inner().worker;
        proto::check_name("worker", &worker)?;
        let left = move |jobs: &mut Jobs, now| {
            jobs.leave(now, &worker);
            Ok(())
        };
        self.ask(left).await?;
        Ok(Response::new(LeaveReply {}))
    }

    async fn jobs(&self, _: Request<JobsRequest>) -> Answer<JobsReply> {
        Ok(Response::new(self.ask(|jobs, _| Ok(jobs.list())).await?))
    }

    async fn blocks(&self, request: Request<BlocksRequest>) -> Answer<BlocksReply> {
        let job = request.into_inner().job;
        let plan = self.ask(move |jobs, _| jobs.plan(job)).await?;
        let columns = |plan: &Plan| {
            let column = |of: fn(BlockId) -> u32| plan.tasks.iter().map(|task| of(task.block)).collect();
            Ok(BlocksReply {
                level: column(|block| block.level.into()),
                x: column(|block| block.x),
                y: column(|block| block.y),
            })
        };
        Ok(Response::new(self.read_plan(plan, columns).await?))
    }

    async fn logs(&self, request: Request<LogsRequest>) -> Answer<LogsReply> {
        let LogsRequest { job, after } = request.into_inner();
        Ok(Response::new(self.ask(move |jobs, now| jobs.logs(now, job, after)).await?))
    }
}
