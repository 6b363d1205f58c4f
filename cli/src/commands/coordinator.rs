//! `plat coordinator`: schedules the jobs of a cluster until it is stopped. Of several coordinators on one store one is the leader, the
//! others are on standby.

use std::net::SocketAddr;
use std::path::Path;

use coordinator::{Durable, Options, Security, ServeError, serve};
use proto::Access;
use scene::BadInput;
use serde::Serialize;
use store::Store;
use store::file::append;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use crate::args::CoordinatorArgs;
use crate::clock::unix_ms;
use crate::failure::{Failure, cannot};
use crate::output::Output;
use crate::remote::{finder_in, key_pair, pem, runtime, token};
use crate::signals::until_signalled;
use crate::telemetry_setup::MetricsListener;

/// Capacity of the journal's queue, lines.
const JOURNAL_QUEUE: usize = 100_000;

#[derive(Serialize)]
struct Hosted {
    command: &'static str,
    listen: String,
    /// The URL in its lease.
    address: String,
    store: String,
}

pub(crate) fn run(args: &CoordinatorArgs, output: &Output) -> Result<(), Failure> {
    let client_authority = args.tls_client_ca.as_deref().map(|path| pem("--tls-client-ca", path, "CERTIFICATE"));
    let security = Security {
        identity: key_pair(&args.tls_cert, &args.tls_key)?,
        client_authority: client_authority.transpose()?,
        token: token(&args.token_file)?,
    };
    let runtime = runtime()?;
    let hosted = runtime.block_on(async {
        let listener = TcpListener::bind(args.listen).await.map_err(|error| {
            let advice = "choose another address, or stop the program that uses it";
            BadInput::new(format!("--listen {}", args.listen), format!("cannot be listened on ({error})"), advice)
        })?;
        let address = listener.local_addr().map_err(ServeError::Listen).map_err(serve_failure)?;
        security.check(address)?;
        let metrics = MetricsListener::bind(&args.telemetry).await?;
        let store = Store::open(&absolute(&args.store)?)?;
        let advertised = advertised_url(args, address, security.identity.is_some())?;
        let durable = Some(Durable::new(&advertised)?);
        let mut options = Options { durable, security, wall_clock: unix_ms, ..Options::new(store.clone()) };
        options.settings.lease_millis = (args.lease_seconds * 1e3) as u64;
        let journal = match &args.journal {
            None => None,
            Some(path) => {
                let (sender, lines) = mpsc::channel(JOURNAL_QUEUE);
                options.journal = Some(sender);
                Some(keep_journal(path, lines)?)
            }
        };
        output.note(format!("listening on {address}, advertised as {advertised}, store {}", store.url()));
        let _served = metrics.serve(output, |registry| options.metrics.register(registry));
        let _dashboard = match args.dashboard {
            Some(address) => Some(dashboard(args, address, &options, output).await?),
            None => None,
        };
        let stop = CancellationToken::new();
        let signals = tokio::spawn(until_signalled(stop.clone()));
        let served = serve(listener, options, stop.cancelled_owned()).await.map_err(serve_failure);
        signals.abort();
        if let Some(journal) = journal {
            // Ends after the last line, as the sender is dropped.
            journal.await.map_err(|error| Failure::Work(error.to_string()))??;
        }
        let listen = address.to_string();
        let hosted = Hosted { command: "coordinator", listen, address: advertised, store: store.url().into() };
        served.map(|()| hosted)
    })?;
    let text = format!("stopped listening on {}", hosted.listen);
    output.result(&hosted, &text)
}

/// Serves the dashboard. It follows whoever leads, which may be another coordinator, and calls as other clients do.
async fn dashboard(
    args: &CoordinatorArgs,
    address: SocketAddr,
    options: &Options,
    output: &Output,
) -> Result<serve::Serving, Failure> {
    let authority = args.tls_ca.as_deref().map(|path| pem("--tls-ca", path, "CERTIFICATE")).transpose()?;
    let Security { identity, token, .. } = options.security.clone();
    if identity.is_some() && authority.is_none() {
        let problem = "shows a coordinator with a certificate, which it has to verify";
        return Err(BadInput::new("--dashboard", problem, "give --tls-ca the CA that signed --tls-cert").into());
    }
    let access = Access { authority, identity: identity.clone(), token: token.clone() };
    let find = finder_in(options.store.clone(), access);
    let shown = serve::Options { identity, token, ..crate::dashboard::options() };
    let listener = crate::dashboard::listen("--dashboard", address).await?;
    let source = serve::Source::Coordinator { find, name: None, kind: serve::Kind::Coordinator };
    let serving = serve::serve(listener, shown, source).await?;
    output.note(format!("dashboard at {}", serving.url));
    Ok(serving)
}

fn serve_failure(error: ServeError) -> Failure {
    match error {
        ServeError::Input(error) => error.into(),
        other => Failure::Work(other.to_string()),
    }
}

/// The URL under which workers and other coordinators find this one.
fn advertised_url(args: &CoordinatorArgs, address: SocketAddr, encrypted: bool) -> Result<String, Failure> {
    match &args.advertise {
        Some(url) => Ok(url.clone()),
        None if address.ip().is_unspecified() => {
            let problem = "is the address of no machine, so others cannot connect to it";
            let advice = "give --advertise https://NAME:PORT with a name of the certificate";
            Err(BadInput::new(format!("--listen {}", args.listen), problem, advice).into())
        }
        None => Ok(format!("{}://{address}", if encrypted { "https" } else { "http" })),
    }
}

/// The store's URL with an absolute path, so that it is valid for every process of the machine.
fn absolute(url: &str) -> Result<String, Failure> {
    if url.contains("://") || url.is_empty() {
        return Ok(url.into());
    }
    let path = std::path::absolute(url).map_err(cannot("found", Path::new(url)))?;
    Ok(path.display().to_string())
}

/// Writes the scheduler's journal, line by line. After a write error the jobs go on; the error is reported at the end.
fn keep_journal(
    path: &Path,
    mut lines: mpsc::Receiver<String>,
) -> Result<tokio::task::JoinHandle<Result<(), Failure>>, Failure> {
    let mut file = std::fs::File::create(path).map_err(cannot("written", path))?;
    let path = path.to_path_buf();
    Ok(tokio::task::spawn_blocking(move || {
        while let Some(line) = lines.blocking_recv() {
            append(&mut file, (line + "\n").as_bytes()).map_err(cannot("written", &path))?;
        }
        Ok(())
    }))
}
