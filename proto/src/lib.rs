//! The gRPC protocol between coordinator, workers and command line: the messages and the service of `proto/plat.proto`, message limits,
//! authentication (`access`, `tls`), and checked conversions.
//!
//! Architecture invariant: bulk data never goes through here, and generated types never enter floors 0 to 2.

#[allow(missing_docs, unreachable_pub, clippy::all)]
mod generated {
    tonic::include_proto!("plat.v1");
}

mod access;
pub mod leader;
mod tls;

pub use access::{
    Access, CALL_TIMEOUT, Client, Credentials, Guard, KEEP_ALIVE, KEEP_ALIVE_TIMEOUT, KeyPair, Token, VERSION_HEADER,
    client, connect, explain, root_cause,
};
pub use generated::*;
pub use tls::rejected_certificate;

use std::collections::BTreeMap;

use scene::ArtefactId;
use tonic::Status;
use tonic::service::interceptor::InterceptedService;

/// The service's full name, as health checks name it.
pub const SERVICE_NAME: &str = coordinator_server::SERVICE_NAME;

/// The protocol version of this program. It grows when an older peer would misunderstand a newer one.
pub const VERSION: u32 = 2;
/// The oldest protocol version that a coordinator still serves. (The first version did not send its number.)
pub const MIN_VERSION: u32 = 2;
/// The largest message that either side accepts, in bytes. The largest in regular use is a grant: 40 bytes for each block of its
/// context, or for each block of a model that is evaluated.
pub const MESSAGE_BYTES_LIMIT: usize = 4 << 20;
/// The longest name of a worker or of a backend, in bytes.
pub const NAME_BYTES_LIMIT: usize = 128;
/// The longest error message that is kept, in bytes; longer ones are truncated.
pub const ERROR_BYTES_LIMIT: usize = 4096;
/// The largest number of reports in one call.
pub const REPORTS_LIMIT: usize = 1024;

/// A server of calls that the guard admits, with limited message sizes.
pub fn server<S: coordinator_server::Coordinator>(
    service: S,
    guard: Guard,
) -> InterceptedService<coordinator_server::CoordinatorServer<S>, Guard> {
    let server = coordinator_server::CoordinatorServer::new(service)
        .max_decoding_message_size(MESSAGE_BYTES_LIMIT)
        .max_encoding_message_size(MESSAGE_BYTES_LIMIT);
    InterceptedService::new(server, guard)
}

/// An artefact's name from a message.
///
/// # Errors
/// `InvalidArgument` if it is not 32 bytes.
pub fn artefact_id(bytes: &[u8]) -> Result<ArtefactId, Status> {
    let id = bytes.try_into().map_err(|_| {
        Status::invalid_argument(format!("an artefact's name has 32 bytes, this one has {}", bytes.len()))
    })?;
    Ok(ArtefactId(id))
}

/// The key of a task's result and checkpoints in the store: the hash of what determines the result, which is the plan (it names the
/// backend), the task, and the task's inputs by task.
pub fn result_key(plan: ArtefactId, task: u32, inputs: &BTreeMap<u32, ArtefactId>) -> ArtefactId {
    let inputs: Vec<String> = inputs.iter().map(|(task, id)| format!("{task}={id}")).collect();
    ArtefactId::of(format!("{plan}/{task}/{}", inputs.join(",")).as_bytes())
}

/// Checks a worker's or a backend's name from a message: 1 to [`NAME_BYTES_LIMIT`] printable ASCII characters without spaces, so that
/// it can be logged as it is.
///
/// # Errors
/// `InvalidArgument` otherwise.
pub fn check_name(what: &str, name: &str) -> Result<(), Status> {
    if name.is_empty() || name.len() > NAME_BYTES_LIMIT || !name.bytes().all(|byte| byte.is_ascii_graphic()) {
        let advice = format!("a {what}'s name has 1 to {NAME_BYTES_LIMIT} printable ASCII characters and no space");
        return Err(Status::invalid_argument(advice));
    }
    Ok(())
}

/// An error message as one printable line of at most [`ERROR_BYTES_LIMIT`] bytes.
pub fn one_line(message: &str) -> String {
    let mut line = String::new();
    for character in message.chars() {
        let printable = if character.is_control() { ' ' } else { character };
        if line.len() + printable.len_utf8() > ERROR_BYTES_LIMIT {
            break;
        }
        line.push(printable);
    }
    line
}

impl Report {
    /// Whether all numbers are finite, which the protocol requires.
    pub fn is_finite(&self) -> bool {
        let optional = [self.loss, self.psnr, self.aligned_loss, self.aligned_cpu_seconds];
        let all = [self.cpu_seconds, self.wall_seconds].into_iter().chain(optional.into_iter().flatten());
        all.into_iter().all(f64::is_finite)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_from_messages_are_checked() {
        assert_eq!(artefact_id(&[7; 32]).unwrap(), ArtefactId([7; 32]));
        assert!(artefact_id(&[7; 31]).is_err());
        assert!(check_name("worker", "local-0").is_ok());
        for bad in ["", "two words", "line\nbreak", "ümlaut", &"x".repeat(129)] {
            assert!(check_name("worker", bad).is_err(), "{bad}");
        }
        assert_eq!(one_line("no\nway\u{1b}[0m"), "no way [0m");
        assert!(one_line(&"ü".repeat(ERROR_BYTES_LIMIT)).len() <= ERROR_BYTES_LIMIT);
        assert!(Report { loss: Some(0.5), ..Report::default() }.is_finite());
        assert!(!Report { psnr: Some(f64::NAN), ..Report::default() }.is_finite());
    }

    /// Fields and calls never change; new ones are added to `wire.txt` with the change that needs them.
    #[test]
    fn the_protocol_only_grows() {
        let [kept, now] = [include_str!("../wire.txt"), include_str!(concat!(env!("OUT_DIR"), "/wire.txt"))];
        for line in kept.lines() {
            assert!(now.lines().any(|other| other == line), "'{line}' is no longer in the protocol");
        }
        for line in now.lines() {
            assert!(kept.lines().any(|other| other == line), "'{line}' is new: add it to proto/wire.txt");
        }
    }
}
