//! Hosts the scheduler behind gRPC: accepts jobs, grants tasks, commits results, streams updates to watchers.
//!
//! ```text
//! gRPC calls (service) ──▶ one mailbox ──▶ the actor (jobs: one cluster::Scheduler) ──▶ replies, watch streams (watchers)
//!                          leader: election │   ▲
//!                                           ▼   │ once durable
//!                                           state (slatedb on the job's store)
//! ```
//!
//! Architecture invariant: it links no GPU and no trainer and never touches splat bytes; the only artefact that it reads is the plan.
//! One actor owns all state and reads the scheduler's clock (`actor::run_actor`). Jobs live in memory. With [`Options::durable`] they are
//! also in the store, and no reply is sent before the state that it depends on is durable. The job log (`log`) lives in memory only.
//! Beyond the loopback the coordinator listens only with a certificate and a token (`security`).

mod actor;
mod garbage_collection;
mod jobs;
mod leader;
mod local;
mod log;
mod metrics;
mod options;
mod plan_spec;
mod results;
mod security;
mod serve;
mod service;
mod state;
mod watchers;

pub use local::run_local;
pub use metrics::Metrics;
pub use options::{Durable, Options, ServeError};
pub use results::{LocalError, Results, of_status};
pub use security::Security;
pub use serve::serve;
pub use state::StateError;
