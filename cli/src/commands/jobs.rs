//! `plat jobs`, `status`, `cancel`, `pause`, `resume`, `retry`, `forget`, `logs`: query and control the jobs of a cluster.

use proto::control_request::What;
use proto::{Client, ControlRequest, LogsRequest, Outcome, StatusReply, StatusRequest};
use serde::Serialize;

use crate::args::{Connection, JobArgs, JobsArgs, LogsArgs, RetryArgs, StatusArgs, TaskName};
use crate::failure::Failure;
use crate::live_status::{LiveStatus, TaskNames, map};
use crate::output::{Output, print};
use crate::remote::{Remote, result_of};

/// Pause between two queries of the log.
const FOLLOW_PERIOD: std::time::Duration = std::time::Duration::from_millis(500);

/// A job in the JSON of these commands.
#[derive(Debug, Serialize)]
struct Job {
    job: u64,
    plan: String,
    /// running, paused, done, incomplete or cancelled.
    state: &'static str,
    priority: u32,
    weight: u32,
    tasks: u32,
    waiting: u32,
    ready: u32,
    leased: u32,
    done: u32,
    failed: u32,
    quarantined: u32,
}

impl Job {
    fn of(status: &StatusReply) -> Self {
        let state = match status.outcome.map(|_| status.outcome()) {
            Some(Outcome::Done) => "done",
            Some(Outcome::Incomplete) => "incomplete",
            Some(Outcome::Cancelled) => "cancelled",
            None if status.paused => "paused",
            None => "running",
        };
        let StatusReply { waiting, ready, leased, done, failed, quarantined, .. } = *status;
        Self {
            job: status.job,
            plan: status.plan.iter().map(|byte| format!("{byte:02x}")).collect(),
            state,
            priority: status.priority,
            weight: status.weight,
            tasks: waiting + ready + leased + done + failed + quarantined,
            waiting,
            ready,
            leased,
            done,
            failed,
            quarantined,
        }
    }

    fn line(&self) -> String {
        let Self { job, state, tasks, done, leased, ready, waiting, .. } = self;
        let failed = self.failed + self.quarantined;
        format!(
            "{job:>5}  {state:<10} {done} of {tasks} done, {leased} running, {ready} ready, {waiting} waiting, {failed} failed"
        )
    }
}

pub(crate) fn list(args: &JobsArgs, output: &Output) -> Result<(), Failure> {
    #[derive(Serialize)]
    struct Listed {
        command: &'static str,
        jobs: Vec<Job>,
    }
    let mut remote = Remote::open(&args.connection)?;
    let reply = remote.call(async |client: &mut Client| client.jobs(proto::JobsRequest {}).await)?;
    let jobs: Vec<Job> = reply.jobs.iter().map(Job::of).collect();
    let lines: Vec<String> = jobs.iter().map(Job::line).collect();
    let text = if lines.is_empty() { "no jobs".into() } else { lines.join("\n") };
    output.result(&Listed { command: "jobs", jobs }, &text)
}

/// A task in the JSON of `plat status`.
#[derive(Debug, Serialize)]
struct Task {
    task: u32,
    block: Option<String>,
    attempt: u32,
    worker: String,
    message: String,
}

#[derive(Debug, Serialize)]
struct Status {
    command: &'static str,
    #[serde(flatten)]
    job: Job,
    /// The first hundred running tasks.
    running: Vec<Task>,
    /// The first hundred that failed or are quarantined.
    failures: Vec<Task>,
}

pub(crate) fn status(args: &StatusArgs, output: &Output) -> Result<(), Failure> {
    let mut remote = Remote::open(&args.connection)?;
    let mut reply = status_of(&mut remote, args.job)?;
    // If the plan cannot be read from the store, only the map is missing.
    let names = remote.names(args.job).unwrap_or_default();
    let mut ended = Ok(());
    let mut drawing = String::new();
    if args.watch {
        let mut live = LiveStatus::new(args.job, &names, output);
        let tasks = Job::of(&reply).tasks;
        let followed = remote.follow(args.job, tasks, output, |results, update| live.update(results, update))?;
        if let Some((outcome, results)) = followed {
            ended = result_of(args.job, outcome, &results);
            drawing = map(&names.blocks, results.tasks(), false).join("\n") + "\n";
        }
        reply = status_of(&mut remote, args.job)?;
    }
    let tasks = |tasks: &[proto::TaskChanged]| -> Vec<Task> {
        let task = |of: &proto::TaskChanged| Task {
            task: of.task,
            block: names.blocks.get(of.task as usize).map(ToString::to_string),
            attempt: of.attempt,
            worker: of.worker.clone(),
            message: of.message.clone(),
        };
        tasks.iter().map(task).collect()
    };
    let status = Status {
        command: "status",
        job: Job::of(&reply),
        running: tasks(&reply.running),
        failures: tasks(&reply.failures),
    };
    let mut text = format!("{drawing}{}\n", status.job.line());
    for of in &reply.running {
        text += &format!("  {} with {}, attempt {}\n", names.name(of.task), of.worker, of.attempt);
    }
    for of in &reply.failures {
        text += &format!("  {} failed: {}\n", names.name(of.task), proto::one_line(&of.message));
    }
    output.result(&status, &text)?;
    ended
}

fn status_of(remote: &mut Remote, job: u64) -> Result<StatusReply, Failure> {
    remote.call(async |client: &mut Client| client.status(StatusRequest { job }).await)
}

/// Result of the commands that change a job.
#[derive(Debug, Serialize)]
struct Changed {
    command: &'static str,
    #[serde(flatten)]
    job: Job,
}

fn changed(mut remote: Remote, command: &'static str, job: u64, output: &Output) -> Result<(), Failure> {
    let job = Job::of(&status_of(&mut remote, job)?);
    let text = job.line();
    output.result(&Changed { command, job }, &text)
}

pub(crate) fn cancel(args: &JobArgs, output: &Output) -> Result<(), Failure> {
    let mut remote = Remote::open(&args.connection)?;
    let job = args.job;
    remote.call(async |client: &mut Client| client.cancel(proto::CancelRequest { job }).await)?;
    changed(remote, "cancel", job, output)
}

pub(crate) fn pause(args: &JobArgs, output: &Output) -> Result<(), Failure> {
    control("pause", args.job, &args.connection, What::Pause(proto::Pause {}), output)
}

pub(crate) fn resume(args: &JobArgs, output: &Output) -> Result<(), Failure> {
    control("resume", args.job, &args.connection, What::Resume(proto::Resume {}), output)
}

pub(crate) fn retry(args: &RetryArgs, output: &Output) -> Result<(), Failure> {
    let task = match args.task {
        TaskName::Number(task) => task,
        TaskName::Block(block) => {
            let names = Remote::open(&args.connection)?.names(args.job)?;
            let found = names.blocks.iter().position(|of| *of == block);
            let missing =
                || Failure::Input(format!("{}: is not in job {}; plat status lists its tasks", args.task, args.job));
            u32::try_from(found.ok_or_else(missing)?).unwrap_or(u32::MAX)
        }
    };
    control("retry", args.job, &args.connection, What::RetryTask(task), output)
}

fn control(
    command: &'static str,
    job: u64,
    connection: &Connection,
    what: What,
    output: &Output,
) -> Result<(), Failure> {
    let mut remote = Remote::open(connection)?;
    let request = ControlRequest { job, what: Some(what) };
    remote.call(async |client: &mut Client| client.control(request).await)?;
    changed(remote, command, job, output)
}

pub(crate) fn forget(args: &JobArgs, output: &Output) -> Result<(), Failure> {
    #[derive(Serialize)]
    struct Forgotten {
        command: &'static str,
        job: u64,
        /// Number of artefacts.
        deleted: u32,
    }
    let mut remote = Remote::open(&args.connection)?;
    let request = ControlRequest { job: args.job, what: Some(What::Forget(proto::Forget {})) };
    let deleted = remote.call(async |client: &mut Client| client.control(request).await)?.deleted;
    let text = format!("job {} and {deleted} artefacts were deleted", args.job);
    output.result(&Forgotten { command: "forget", job: args.job, deleted }, &text)
}

/// A line of the log in the JSON of `plat logs`.
#[derive(Debug, Serialize)]
struct LogLine {
    seconds_ago: f64,
    task: Option<u32>,
    block: Option<String>,
    attempt: Option<u32>,
    worker: Option<String>,
    what: String,
}

pub(crate) fn logs(args: &LogsArgs, output: &Output) -> Result<(), Failure> {
    #[derive(Serialize)]
    struct Logs {
        command: &'static str,
        job: u64,
        lines: Vec<LogLine>,
    }
    let mut remote = Remote::open(&args.connection)?;
    let job = args.job;
    let names = remote.names(job).unwrap_or_default();
    let (mut lines, mut after) = (Vec::new(), 0);
    loop {
        // Queried before the page, so that the log of a job that has ended is read to its end.
        let has_ended = status_of(&mut remote, job)?.outcome.is_some();
        let page = remote.call(async |client: &mut Client| client.logs(LogsRequest { job, after }).await)?.lines;
        let Some(last) = page.last() else {
            if has_ended || !args.follow {
                break;
            }
            std::thread::sleep(FOLLOW_PERIOD);
            continue;
        };
        after = last.number;
        for line in page {
            let block = line.task.and_then(|task| names.blocks.get(task as usize)).map(ToString::to_string);
            let line = LogLine {
                seconds_ago: line.millis_ago as f64 * 1e-3,
                task: line.task,
                block,
                attempt: Some(line.attempt).filter(|attempt| *attempt > 0),
                worker: Some(line.worker).filter(|worker| !worker.is_empty()),
                what: proto::one_line(&line.what),
            };
            if output.is_json() {
                lines.push(line);
            } else {
                print(&describe(&line, &names))?;
            }
        }
    }
    if output.is_json() { output.result(&Logs { command: "logs", job, lines }, "") } else { Ok(()) }
}

/// A log line as text: age, message, worker.
fn describe(line: &LogLine, names: &TaskNames) -> String {
    let seconds = line.seconds_ago as u64;
    let mut text = format!("-{:02}:{:02}:{:02}  ", seconds / 3600, seconds / 60 % 60, seconds % 60);
    if let Some(task) = line.task {
        text += &names.name(task);
        line.attempt.iter().for_each(|attempt| text += &format!(", attempt {attempt}"));
        text += ": ";
    }
    text += &line.what;
    line.worker.iter().for_each(|worker| text += &format!(" ({worker})"));
    text + "\n"
}
