//! The commands of a cluster: who hosts it, who works for it, and who asks it for something.

use std::fmt;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::str::FromStr;

use clap::{Args, ValueEnum};
use scene::BlockId;

use super::{Auto, Backend, PlanOptions, seconds};

/// Which coordinator, and how to prove oneself to it.
#[derive(Debug, Clone, Args)]
pub(crate) struct Connection {
    /// The coordinator: http://host:port, https://host:port with --tls-ca, or the URL of its store, which says who leads
    #[arg(long, value_name = "URL")]
    pub(crate) coordinator: String,
    /// Certificates to trust the coordinator by, PEM
    #[arg(long, value_name = "FILE")]
    pub(crate) tls_ca: Option<PathBuf>,
    /// Own certificate, PEM, for a coordinator that asks for one
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    pub(crate) tls_cert: Option<PathBuf>,
    /// Its private key, PEM
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    pub(crate) tls_key: Option<PathBuf>,
    /// File with the coordinator's token
    #[arg(long, value_name = "FILE")]
    pub(crate) token_file: Option<PathBuf>,
}

/// What a program tells of itself that runs for days.
#[derive(Debug, Clone, Copy, Args)]
pub(crate) struct Told {
    /// Answer Prometheus at GET /metrics of this address, or of this port of this machine alone. Whoever reaches it may read; it
    /// says numbers, and what workers compute with
    #[arg(long, value_name = "ADDR|PORT", value_parser = metrics_address)]
    pub(crate) metrics: Option<SocketAddr>,
    /// Lines of the log, on stderr; RUST_LOG chooses which
    #[arg(long, value_enum, value_name = "FORMAT", default_value = "text")]
    pub(crate) log_format: LogFormat,
}

/// What a line of the log looks like.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogFormat {
    /// For people
    Text,
    /// An object a line
    Json,
}

fn metrics_address(text: &str) -> Result<SocketAddr, String> {
    let local = text.parse().ok().map(|port: u16| SocketAddr::from((Ipv4Addr::LOCALHOST, port)));
    let address = local.or_else(|| text.parse().ok());
    address.ok_or_else(|| "give a port, such as 9464, or an address with one, such as 0.0.0.0:9464".into())
}

#[derive(Debug, Clone, Args)]
pub(crate) struct CoordinatorArgs {
    /// Store of plans, photos, results and the jobs' state, which the workers reach under the same URL: a folder, file:// or s3://
    #[arg(long, value_name = "URL")]
    pub(crate) store: String,
    /// Where to listen. Beyond this machine it takes --tls-cert, --tls-key and --token-file
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:7287")]
    pub(crate) listen: SocketAddr,
    /// How others reach this coordinator, where it is not as it listens: http://host:port or https://host:port
    #[arg(long, value_name = "URL")]
    pub(crate) advertise: Option<String>,
    /// Certificate to encrypt with, PEM
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    pub(crate) tls_cert: Option<PathBuf>,
    /// Its private key, PEM
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    pub(crate) tls_key: Option<PathBuf>,
    /// Only let in whose certificate these signed, PEM
    #[arg(long, value_name = "FILE")]
    pub(crate) tls_client_ca: Option<PathBuf>,
    /// File with the token that whoever calls has to show: 16 to 512 printable characters
    #[arg(long, value_name = "FILE")]
    pub(crate) token_file: Option<PathBuf>,
    /// A worker that is silent for so long has lost its task
    #[arg(long, value_name = "SECONDS", default_value_t = 30.0, value_parser = lease)]
    pub(crate) lease_seconds: f64,
    /// Write down what the scheduler hears, as its simulator replays it
    #[arg(long, value_name = "FILE")]
    pub(crate) journal: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) told: Told,
}

fn lease(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|seconds: &f64| (0.5..=86_400.0).contains(seconds));
    value.ok_or_else(|| "give seconds from 0.5 to 86400, such as 30".into())
}

#[derive(Debug, Clone, Args)]
pub(crate) struct WorkerArgs {
    #[command(flatten)]
    pub(crate) connection: Connection,
    /// What computes
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Threads; auto takes all cores
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) threads: Auto<u32>,
    /// Memory that it may take: it is given no block that is thought to need more, and leaves one that turns out to, which goes to
    /// a worker that may take more. auto: what this machine has, or the container that it runs in; give each its part where several
    /// workers share a machine
    #[arg(long, value_name = "MIB|auto", default_value_t)]
    pub(crate) memory: Auto<u64>,
    /// The part of it that photos may take, decoded
    #[arg(long, value_name = "MIB", default_value_t = 128, value_parser = clap::value_parser!(u32).range(1..=1 << 20))]
    pub(crate) cache: u32,
    /// Its name, unlike any other worker's; by default the machine's and the process's number
    #[arg(long, value_name = "NAME")]
    pub(crate) name: Option<String>,
    /// Seconds between two checkpoints of a block, from which any worker goes on
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0, value_parser = seconds)]
    pub(crate) checkpoint_every: f64,
    #[command(flatten)]
    pub(crate) told: Told,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct SubmitArgs {
    /// Folder of the capture: COLMAP or transforms.json
    pub(crate) capture: PathBuf,
    #[command(flatten)]
    pub(crate) connection: Connection,
    #[command(flatten)]
    pub(crate) plan: PlanOptions,
    /// What is to compute; auto takes what most workers have
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: Backend,
    /// Wait for the end, show what happens, and say by the exit code how it went
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
    /// Stay until the job is over and show its blocks as they are trained; the exit code says how it went
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
    /// Stay until the job is over
    #[arg(long)]
    pub(crate) follow: bool,
}

/// A task as a person names it.
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
