//! The gRPC service: validates requests, passes them to the actor, and replies.

use std::collections::BTreeSet;
use std::pin::Pin;

use blocks::Plan;
use cluster::{Failure, FailureKind, Offer};
use proto::control_request::What;
use proto::coordinator_server::Coordinator;
use proto::{
    AboutReply, AboutRequest, AttemptReply, BlocksReply, BlocksRequest, CancelReply, CancelRequest, CompleteRequest,
    ControlReply, ControlRequest, FailRequest, JobsReply, JobsRequest, LeaseReply, LeaseRequest, LeaveReply,
    LeaveRequest, LogsReply, LogsRequest, ReportReply, ReportRequest, StatusReply, StatusRequest, SubmitReply,
    SubmitRequest, WatchEvent, WatchRequest, WorkersReply, WorkersRequest,
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

use crate::actor::Call;
use crate::jobs::Jobs;
use crate::plan_spec::spec_of;

/// The largest plan that is read, in bytes: twice the size of one of 100,000 tasks with 300 windows each.
const PLAN_BYTES_LIMIT: u64 = 1 << 30;

/// The gRPC service of the coordinator.
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

    /// Executes a call on the actor and returns its reply once the reply's state is durable.
    async fn call<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Jobs, u64) -> Result<T, Status> + Send + 'static,
    ) -> Result<T, Status> {
        let (reply, answer) = oneshot::channel();
        let call: Call = Box::new(move |host| match host {
            Ok((jobs, now)) => {
                let result = work(jobs, now);
                // The client may have disconnected; its call is executed nevertheless.
                jobs.after_durable(move || drop(reply.send(result)));
            }
            Err(status) => drop(reply.send(Err(status))),
        });
        self.wait_for(call, answer).await
    }

    /// As [`call`](Self::call), without waiting: for heartbeats and for what changes nothing durable.
    async fn call_at_once<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Jobs, u64) -> Result<T, Status> + Send + 'static,
    ) -> Result<T, Status> {
        let (reply, answer) = oneshot::channel();
        let call: Call = Box::new(move |host| drop(reply.send(host.and_then(|(jobs, now)| work(jobs, now)))));
        self.wait_for(call, answer).await
    }

    async fn wait_for<T>(&self, call: Call, answer: oneshot::Receiver<Result<T, Status>>) -> Result<T, Status> {
        let gone = || Status::unavailable("the coordinator is shutting down or no longer leads");
        self.calls.send(call).await.map_err(|_| gone())?;
        answer.await.map_err(|_| gone())?
    }

    /// Creates a job from a plan, traced under this span.
    async fn accept(&self, request: SubmitRequest, traced: Option<TraceParent>) -> Result<SubmitReply, Status> {
        if request.store_url != self.store.url() {
            let (theirs, ours) = (proto::one_line(&request.store_url), self.store.url());
            let problem = format!("the plan is in the store '{theirs}', this coordinator uses '{ours}'");
            return Err(Status::failed_precondition(problem));
        }
        let plan = proto::artefact_id(&request.plan)?;
        let spec = self.read_plan(plan, spec_of).await?;
        let tasks = spec.tasks.len() as u32;
        let job = self.call(move |jobs, now| jobs.submit(now, plan, spec, traced)).await?;
        Ok(SubmitReply { job, tasks })
    }

    /// Deletes a job's objects, then forgets the job. Runs to its end if the client disconnects.
    async fn forget(&self, job: u64) -> Result<u32, Status> {
        let service = self.clone();
        let work = tokio::spawn(async move {
            let garbage = service.call(move |jobs, _| jobs.begin_collection(job)).await?;
            let deleted = garbage.delete(&service.store).await.map_err(store_status);
            let is_deleted = deleted.is_ok();
            service.call(move |jobs, now| jobs.end_collection(now, job, is_deleted)).await?;
            deleted
        });
        work.await.map_err(|_| Status::internal("the garbage collection failed"))?
    }

    /// Reads a plan and returns what `extract` takes from it.
    async fn read_plan<T: Send + 'static>(
        &self,
        id: ArtefactId,
        extract: impl FnOnce(&Plan) -> Result<T, CodecError> + Send + 'static,
    ) -> Result<T, Status> {
        match self.store.size(id).await.map_err(store_status)? {
            Some(bytes) if bytes > PLAN_BYTES_LIMIT => {
                return Err(Status::invalid_argument(format!("artefact {id} is too large for a plan: {bytes} bytes")));
            }
            _ => {}
        }
        let bytes = self.store.get(id).await.map_err(store_status)?;
        let read = tokio::task::spawn_blocking(move || extract(&Plan::from_frame(&bytes)?));
        read.await
            .map_err(|_| Status::internal("the plan could not be read"))?
            .map_err(|error: CodecError| Status::invalid_argument(format!("artefact {id}: {error}")))
    }
}

fn store_status(error: StoreError) -> Status {
    match error {
        StoreError::Missing { .. } => Status::not_found(error.to_string()),
        StoreError::Corrupt { .. } => Status::data_loss(error.to_string()),
        _ => Status::unavailable(error.to_string()),
    }
}

/// A child span of the caller's. Without a parent there is no span, as it would start a trace of its own.
fn span_of(parent: Option<TraceParent>, span: impl FnOnce() -> Span) -> Span {
    let Some(parent) = parent else { return Span::none() };
    let span = span();
    parent.adopt(&span);
    span
}

/// The worker of a lease request, its offer, and the highest epoch that it knows.
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
        let backends = self.call(|jobs, _| Ok(jobs.backends())).await?;
        let (store_url, version) = (self.store.url().to_string(), env!("CARGO_PKG_VERSION").to_string());
        Ok(Response::new(AboutReply { store_url, version, backends }))
    }

    async fn submit(&self, request: Request<SubmitRequest>) -> Answer<SubmitReply> {
        let span = tracing::info_span!("accept", otel.kind = "server", job = Empty, tasks = Empty);
        let parent = TraceParent::of_header(request.metadata());
        parent.iter().for_each(|parent| parent.adopt(&span));
        // Without an exporter of its own, the coordinator passes the client's span on.
        let traced = TraceParent::of(&span).or(parent);
        let reply = self.accept(request.into_inner(), traced).instrument(span.clone()).await?;
        span.record("job", reply.job).record("tasks", reply.tasks);
        Ok(Response::new(reply))
    }

    async fn lease(&self, request: Request<LeaseRequest>) -> Answer<LeaseReply> {
        let (worker, offer, epoch) = offer_of(request.into_inner())?;
        let reply = self.call(move |jobs, now| jobs.lease(now, &worker, offer, epoch)).await?;
        Ok(Response::new(LeaseReply { reply: Some(reply) }))
    }

    async fn report(&self, request: Request<ReportRequest>) -> Answer<ReportReply> {
        let ReportRequest { attempt, reports } = request.into_inner();
        let attempt = attempt_of(attempt)?;
        if reports.len() > proto::REPORTS_LIMIT || !reports.iter().all(proto::Report::is_finite) {
            let advice = format!("a call carries at most {} reports, of finite numbers", proto::REPORTS_LIMIT);
            return Err(Status::invalid_argument(advice));
        }
        let accepted = self.call_at_once(move |jobs, now| jobs.report(now, attempt, reports)).await?;
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
        let work = self.call(move |jobs, now| {
            let accepted = jobs.complete(now, attempt, artefact)?;
            // The result is acknowledged in any case. A failed lease is reported when the worker calls Lease.
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
        let work = self.call(move |jobs, now| jobs.fail(now, attempt, Failure { kind, message }));
        let accepted = work.instrument(span.clone()).await?;
        span.record("accepted", accepted);
        Ok(Response::new(AttemptReply { accepted, next: None }))
    }

    type WatchStream = Pin<Box<dyn Stream<Item = Result<WatchEvent, Status>> + Send>>;

    async fn watch(&self, request: Request<WatchRequest>) -> Answer<Self::WatchStream> {
        let job = request.into_inner().job;
        let watched = self.call(move |jobs, _| jobs.watch(job)).await?;
        let snapshot = tokio_stream::iter(watched.snapshot);
        Ok(Response::new(match watched.updates {
            Some(updates) => Box::pin(snapshot.chain(ReceiverStream::new(updates)).map(Ok)),
            None => Box::pin(snapshot.map(Ok)),
        }))
    }

    async fn status(&self, request: Request<StatusRequest>) -> Answer<StatusReply> {
        let job = request.into_inner().job;
        Ok(Response::new(self.call(move |jobs, _| jobs.status(job)).await?))
    }

    async fn cancel(&self, request: Request<CancelRequest>) -> Answer<CancelReply> {
        let job = request.into_inner().job;
        self.call(move |jobs, now| jobs.cancel(now, job)).await?;
        Ok(Response::new(CancelReply {}))
    }

    async fn control(&self, request: Request<ControlRequest>) -> Answer<ControlReply> {
        let ControlRequest { job, what } = request.into_inner();
        let what =
            what.ok_or_else(|| Status::invalid_argument("the call has no request that this coordinator knows"))?;
        if let What::Forget(_) = what {
            return Ok(Response::new(ControlReply { deleted: self.forget(job).await? }));
        }
        self.call(move |jobs, now| jobs.control(now, job, what)).await?;
        Ok(Response::new(ControlReply { deleted: 0 }))
    }

    async fn leave(&self, request: Request<LeaveRequest>) -> Answer<LeaveReply> {
        let worker = request.into_inner().worker;
        proto::check_name("worker", &worker)?;
        let left = move |jobs: &mut Jobs, now| {
            jobs.leave(now, &worker);
            Ok(())
        };
        self.call(left).await?;
        Ok(Response::new(LeaveReply {}))
    }

    async fn jobs(&self, _: Request<JobsRequest>) -> Answer<JobsReply> {
        Ok(Response::new(self.call(|jobs, _| Ok(jobs.list())).await?))
    }

    async fn blocks(&self, request: Request<BlocksRequest>) -> Answer<BlocksReply> {
        let job = request.into_inner().job;
        let plan = self.call(move |jobs, _| jobs.plan(job)).await?;
        let columns = |plan: &Plan| {
            let column = |of: fn(BlockId) -> u32| plan.tasks.iter().map(|task| of(task.block)).collect();
            Ok(BlocksReply {
                level: column(|block| block.level.into()),
                x: column(|block| block.x),
                y: column(|block| block.y),
                first_detection: if plan.detect_tasks.is_empty() { 0 } else { plan.first_detection() as u32 },
                first_object: if plan.object_tasks.is_empty() { 0 } else { plan.first_object() as u32 },
            })
        };
        Ok(Response::new(self.read_plan(plan, columns).await?))
    }

    async fn logs(&self, request: Request<LogsRequest>) -> Answer<LogsReply> {
        let LogsRequest { job, after } = request.into_inner();
        Ok(Response::new(self.call(move |jobs, now| jobs.logs(now, job, after)).await?))
    }

    async fn workers(&self, _: Request<WorkersRequest>) -> Answer<WorkersReply> {
        Ok(Response::new(self.call_at_once(|jobs, now| Ok(jobs.workers(now))).await?))
    }
}
