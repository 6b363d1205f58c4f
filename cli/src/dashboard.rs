//! The dashboard of a training in this process. It has a thread of its own, so that browsers and training do not wait for each other.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use proto::Access;
use scene::BadInput;
use serve::{Kind, Options, Serving, Source};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

use crate::clock::unix_ms;
use crate::failure::Failure;
use crate::output::Output;
use crate::signals::until_signalled;

/// Results for the page "Speed and accuracy", in a checkout.
const RESULTS: &str = "bench/results";

/// A running dashboard.
pub(crate) struct Dashboard {
    runtime: Runtime,
    serving: Serving,
    /// The coordinator of the job, once it runs.
    coordinator: Arc<OnceLock<String>>,
    out: PathBuf,
}

impl Dashboard {
    /// Starts it for the training of a capture of this name into `out`.
    pub(crate) fn open(address: SocketAddr, name: String, out: &Path, output: &Output) -> Result<Self, Failure> {
        if !address.ip().is_loopback() {
            let problem = "is reachable from other machines";
            let advice =
                "give a port or a loopback address, or run plat serve with --tls-cert, --tls-key and --token-file";
            return Err(BadInput::new(format!("--serve {address}"), problem, advice).into());
        }
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.map_err(|error| Failure::Work(format!("cannot start threads: {error}")))?;
        let coordinator: Arc<OnceLock<String>> = Arc::default();
        let named = coordinator.clone();
        let find: serve::Find = Arc::new(move || {
            let url = named.get().cloned();
            Box::pin(async move {
                let url = url.ok_or("the job has not begun")?;
                let client = proto::connect(&url, &Access::default()).map_err(|error| error.to_string())?;
                Ok((client, url))
            })
        });
        let serving = runtime.block_on(async {
            let listener = listen("--serve", address).await?;
            let files = Some(out.to_path_buf());
            let options = Options { files, ..options() };
            serve::serve(listener, options, Source::Coordinator { find, name: Some(name), kind: Kind::Train }).await
        })?;
        output.note(format!("dashboard at {}", serving.url));
        Ok(Self { runtime, serving, coordinator, out: out.to_path_buf() })
    }

    /// The job's coordinator has started.
    pub(crate) fn follow(&self, coordinator_url: &str) {
        // The first one is the only one.
        let _ = self.coordinator.set(coordinator_url.to_owned());
    }

    /// The job is over: shows what it left, until a signal.
    pub(crate) fn stay(self, output: &Output) -> Result<(), Failure> {
        self.runtime.block_on(async {
            self.serving.show_folder(self.out.clone()).await?;
            output.note(format!("the model is at {} until Ctrl-C", self.serving.url));
            let stop = CancellationToken::new();
            let signals = tokio::spawn(until_signalled(stop.clone()));
            stop.cancelled().await;
            signals.abort();
            Ok(())
        })
    }
}

/// Listens, or says why not.
pub(crate) async fn listen(flag: &str, address: SocketAddr) -> Result<TcpListener, BadInput> {
    TcpListener::bind(address).await.map_err(|error| {
        let advice = "choose another address, or stop the program that uses it";
        BadInput::new(format!("{flag} {address}"), format!("cannot be listened on ({error})"), advice)
    })
}

/// For the loopback, with nothing but results to read.
pub(crate) fn options() -> Options {
    let results = Some(PathBuf::from(RESULTS)).filter(|folder| folder.is_dir());
    Options { identity: None, token: None, files: None, results, cors: false, clock: Arc::new(unix_ms) }
}
