//! The command lines of the cluster: coordinator, worker, and the commands that query and control jobs.

use std::fmt;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::str::FromStr;

use clap::{Args, ValueEnum};
use scene::BlockId;

use super::plan::PlanOptions;
use super::values::{Auto, Backend, seconds};
use super::zones::{AlignedOptions, ZoneOptions};

/// How to reach a coordinator and authenticate to it.
#[derive(Debug, Clone, Args)]
pub(crate) struct Connection {
    /// The coordinator: http://host:port, https://host:port with --tls-ca, or the URL of its store, which names the leader
    #[arg(long, value_name = "URL")]
    pub(crate) coordinator: String,
    /// CA certificates to verify the coordinator with, PEM
    #[arg(long, value_name = "FILE")]
    pub(crate) tls_ca: Option<PathBuf>,
    /// Client certificate, PEM, for a coordinator that requires one
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    pub(crate) tls_cert: Option<PathBuf>,
    /// Private key of the client certificate, PEM
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    pub(crate) tls_key: Option<PathBuf>,
    /// File with the coordinator's access token
    #[arg(long, value_name = "FILE")]
    pub(crate) token_file: Option<PathBuf>,
}

/// Metrics and log of a server.
#[derive(Debug, Clone, Copy, Args)]
pub(crate) struct TelemetryArgs {
    /// Serve Prometheus metrics at GET /metrics on this address, or on this port of the loopback interface. There is no
    /// authentication; the metrics contain numbers and the names of backends
    #[arg(long, value_name = "ADDR|PORT", value_parser = socket_address)]
    pub(crate) metrics: Option<SocketAddr>,
    /// Format of the log on stderr; RUST_LOG filters it
    #[arg(long, value_enum, value_name = "FORMAT", default_value = "text")]
    pub(crate) log_format: LogFormat,
}

/// Format of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogFormat {
    /// Plain text
    Text,
    /// One JSON object per line
    Json,
}

pub(crate) fn socket_address(text: &str) -> Result<SocketAddr, String> {
    let local = text.parse().ok().map(|port: u16| SocketAddr::from((Ipv4Addr::LOCALHOST, port)));
    let address = local.or_else(|| text.parse().ok());
    address.ok_or_else(|| "give a port, such as 9464, or an address with one, such as 0.0.0.0:9464".into())
}

#[derive(Debug, Clone, Args)]
pub(crate) struct CoordinatorArgs {
    /// Store of plans, photos, results and job state; workers must reach it under the same URL: a folder, file:// or s3://
    #[arg(long, value_name = "URL")]
    pub(crate) store: String,
    /// Address to listen on. An address that other machines reach needs --tls-cert, --tls-key and --token-file
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:7287")]
    pub(crate) listen: SocketAddr,
    /// URL under which others reach this coordinator, if it is not the address it listens on: http://host:port or https://host:port
    #[arg(long, value_name = "URL")]
    pub(crate) advertise: Option<String>,
    /// Server certificate, PEM
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    pub(crate) tls_cert: Option<PathBuf>,
    /// Private key of the server certificate, PEM
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    pub(crate) tls_key: Option<PathBuf>,
    /// Require client certificates signed by these CAs, PEM
    #[arg(long, value_name = "FILE")]
    pub(crate) tls_client_ca: Option<PathBuf>,
    /// File with the token that clients must send: 16 to 512 printable characters
    #[arg(long, value_name = "FILE")]
    pub(crate) token_file: Option<PathBuf>,
    /// Lease of a task: a worker that sends nothing for this long loses it
    #[arg(long, value_name = "SECONDS", default_value_t = 30.0, value_parser = lease)]
    pub(crate) lease_seconds: f64,
    /// Serve the dashboard on this address, with this certificate and token; with --tls-cert, --tls-ca has to verify it
    #[arg(long, value_name = "ADDR|PORT", value_parser = socket_address)]
    pub(crate) dashboard: Option<SocketAddr>,
    /// CA certificates that verify this server's own certificate, PEM: the dashboard calls the coordinator as others do
    #[arg(long, value_name = "FILE")]
    pub(crate) tls_ca: Option<PathBuf>,
    /// Record the scheduler's inputs, for replay in its simulator
    #[arg(long, value_name = "FILE")]
    pub(crate) journal: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) telemetry: TelemetryArgs,
}

fn lease(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|seconds: &f64| (0.5..=86_400.0).contains(seconds));
    value.ok_or_else(|| "give seconds from 0.5 to 86400, such as 30".into())
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ServeArgs {
    /// Folders of models that plat train wrote or writes, which the viewer can compare; or a folder of exported files, or the store
    /// of a cluster (a folder or its URL)
    #[arg(value_name = "DIR|STORE", required_unless_present = "coordinator")]
    pub(crate) paths: Vec<String>,
    /// Show the jobs of this coordinator: http://host:port, https://host:port with --tls-ca
    #[arg(long, value_name = "URL", conflicts_with = "paths")]
    pub(crate) coordinator: Option<String>,
    /// CA certificates to verify the coordinator with, PEM
    #[arg(long, value_name = "FILE")]
    pub(crate) tls_ca: Option<PathBuf>,
    /// Address to listen on, or a port of the loopback interface. An address that other machines reach needs --tls-cert, --tls-key and
    /// --token-file
    #[arg(long, value_name = "ADDR|PORT", value_parser = socket_address, default_value = "7288")]
    pub(crate) listen: SocketAddr,
    /// Server certificate, PEM; also the client certificate for a coordinator that requires one
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    pub(crate) tls_cert: Option<PathBuf>,
    /// Private key of the certificate, PEM
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    pub(crate) tls_key: Option<PathBuf>,
    /// File with the token that browsers must send, as the password of any user; it is also sent to the coordinator
    #[arg(long, value_name = "FILE")]
    pub(crate) token_file: Option<PathBuf>,
    /// Let pages of other sites read, such as viewers that are hosted elsewhere
    #[arg(long)]
    pub(crate) cors: bool,
    /// Folder of result lines for the page "Speed and accuracy"
    #[arg(long, value_name = "DIR", default_value = "bench/results")]
    pub(crate) results: PathBuf,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct WorkerArgs {
    #[command(flatten)]
    pub(crate) connection: Connection,
    /// Backend to train on
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Threads; auto takes all cores
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) threads: Auto<u32>,
    /// Memory budget. The worker gets no block whose estimate exceeds it, and gives up a block that turns out to exceed it; that
    /// block goes to a worker with a larger budget. auto takes the memory of the machine or container; give each worker its
    /// share if several run on one machine
    #[arg(long, value_name = "MIB|auto", default_value_t)]
    pub(crate) memory: Auto<u64>,
    /// Part of the budget for decoded photos
    #[arg(long, value_name = "MIB", default_value_t = 128, value_parser = clap::value_parser!(u32).range(1..=1 << 20))]
    pub(crate) cache: u32,
    /// Unique name of the worker; by default the host name and the process id
    #[arg(long, value_name = "NAME")]
    pub(crate) name: Option<String>,
    /// Seconds between two checkpoints of a block; any worker can resume from them
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0, value_parser = seconds)]
    pub(crate) checkpoint_every: f64,
    #[command(flatten)]
    pub(crate) telemetry: TelemetryArgs,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct SubmitArgs {
    /// Folder of the capture: COLMAP, transforms.json, OpenSfM, DGP, nuScenes, KITTI, KITTI-360, KITTI raw or Waymo
    pub(crate) capture: PathBuf,
    #[command(flatten)]
    pub(crate) connection: Connection,
    #[command(flatten)]
    pub(crate) plan: PlanOptions,
    #[command(flatten)]
    pub(crate) zones: ZoneOptions,
    #[command(flatten)]
    pub(crate) aligned: AlignedOptions,
    /// Backend of the job
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Wait for the job to end, show its progress, and exit with its result
    #[arg(long)]
    pub(crate) wait: bool,
    /// Folder for the model
    #[arg(long, value_name = "DIR", requires = "wait")]
    pub(crate) out: Option<PathBuf>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct JobsArgs {
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct JobArgs {
    /// Number of the job
    pub(crate) job: u64,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct StatusArgs {
    /// Number of the job
    pub(crate) job: u64,
    #[command(flatten)]
    pub(crate) connection: Connection,
    /// Follow the job until it ends, show its blocks as they are trained, and exit with its result
    #[arg(long)]
    pub(crate) watch: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct RetryArgs {
    /// Number of the job
    pub(crate) job: u64,
    /// The task: its number in the plan, or its block as level/x/y
    pub(crate) task: TaskName,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct LogsArgs {
    /// Number of the job
    pub(crate) job: u64,
    #[command(flatten)]
    pub(crate) connection: Connection,
    /// Follow the log until the job ends
    #[arg(long)]
    pub(crate) follow: bool,
}

/// A task, by number or by block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TaskName {
    Number(u32),
    Block(BlockId),
}

impl FromStr for TaskName {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = text.parse().ok().map(Self::Number);
        let name = number.or_else(|| text.parse().ok().map(Self::Block));
        name.ok_or_else(|| "give the number of a task, or its block as level/x/y".into())
    }
}

impl fmt::Display for TaskName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(task) => write!(f, "task {task}"),
            Self::Block(block) => write!(f, "block {block}"),
        }
    }
}
