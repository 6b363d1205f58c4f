//! The dashboard's server: shows jobs and models in a browser, and serves what `plat export` writes.
//!
//! ```text
//! coordinator ──follow──┐                      ┌── /api/events     every change, to all browsers
//!                       ├── board ── feed ─────┼── /api/jobs/...   one job, block, photo, model
//! folder ──────folder───┘                      └── /status         for people without JavaScript
//! ```
//!
//! docs/src/dashboard.md describes the interface; [`views`] has its types.
//!
//! Architecture invariant: read-only but for `POST /api/jobs/N/control`, which makes the calls of the command line. A browser never
//! delays the scheduler: the board is a copy, fed by the same calls that the command line makes.

mod access;
mod assets;
mod block_files;
mod board;
mod control;
mod curve;
mod feed;
mod folder;
mod follow;
mod job;
mod project;
mod refused;
mod results;
mod router;
mod server;
mod static_files;
mod status_page;
#[cfg(test)]
mod testing;
mod views;

use std::future::Future;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;

use proto::{KeyPair, Token};
use scene::BadInput;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::board::Board;
pub use crate::feed::Clock;
use crate::feed::Feed;
pub use crate::follow::Find;
use crate::router::App;
pub use crate::views::{Coordinator, Kind, Server};

/// How to serve.
#[derive(Clone)]
pub struct Options {
    /// Enables TLS.
    pub identity: Option<KeyPair>,
    /// The token that browsers must send. Beyond the loopback it is required, and TLS.
    pub token: Option<Token>,
    /// A folder whose files are served under `/files/`: models, exports.
    pub files: Option<PathBuf>,
    /// A folder of result lines for the page "Speed and accuracy".
    pub results: Option<PathBuf>,
    /// Whether pages of other sites may read.
    pub cors: bool,
    /// Wall clock.
    pub clock: Clock,
}

/// What is shown.
pub enum Source {
    /// The jobs of a coordinator.
    Coordinator {
        /// How to find it.
        find: Find,
        /// The name of its job, where there is one only.
        name: Option<String>,
        /// [`Kind::Train`] if it runs in this process for one job.
        kind: Kind,
    },
    /// Folders that `plat train` wrote, as jobs from 1 on.
    Folders(Vec<PathBuf>),
    /// Only files.
    Files,
}

/// A running server; it ends when this is dropped.
pub struct Serving {
    /// The URL to open.
    pub url: String,
    feed: Arc<Feed>,
    following: CancellationToken,
    serving: JoinHandle<()>,
    _guard: DropGuard,
}

impl Serving {
    /// Shows a folder instead of the coordinator that wrote it, which has ended.
    ///
    /// # Errors
    /// A folder without a plan.
    pub async fn show_folder(&self, folder: PathBuf) -> Result<(), BadInput> {
        self.following.cancel();
        let feed = self.feed.clone();
        let loaded = tokio::task::spawn_blocking(move || folder::finish(&feed, &folder)).await;
        loaded.unwrap_or(Ok(()))
    }

    /// Waits until the server ends, which it does not by itself.
    pub async fn wait(&mut self) {
        let _ = (&mut self.serving).await;
    }
}

/// Serves on `listener` in the background.
///
/// # Errors
/// An address beyond the loopback without TLS and token, an invalid certificate, a folder that cannot be shown.
pub fn serve(
    listener: TcpListener,
    options: Options,
    source: Source,
) -> Pin<Box<dyn Future<Output = Result<Serving, BadInput>> + Send>> {
    // Behind a pointer, so that it is compiled once, in this crate; as `coordinator::serve`.
    Box::pin(start(listener, options, source))
}

async fn start(listener: TcpListener, options: Options, source: Source) -> Result<Serving, BadInput> {
    let unusable =
        |error: std::io::Error| BadInput::new("the server", error.to_string(), "free disk space, or set TMPDIR");
    let address = listener.local_addr().map_err(unusable)?;
    let access = access::Access::new(address, options.token.clone(), options.identity.is_some())?;
    let tls = options.identity.as_ref().map(server::tls).transpose()?;
    let scheme = if tls.is_some() { "https" } else { "http" };
    let kind = match &source {
        Source::Coordinator { kind, .. } => *kind,
        Source::Folders(_) | Source::Files => Kind::Folder,
    };
    let about = Server {
        version: env!("CARGO_PKG_VERSION"),
        kind,
        controls: matches!(source, Source::Coordinator { .. }),
        store_url: None,
        coordinator: None,
    };
    let feed = Arc::new(Feed::new(Board::new(about), options.clock.clone()));
    let (stop, following) = (CancellationToken::new(), CancellationToken::new());
    let guard = stop.clone().drop_guard();
    let find = match source {
        Source::Coordinator { find, name, .. } => {
            let until = following.clone();
            let following = follow::follow(feed.clone(), find.clone(), name, until);
            let stopped = stop.clone();
            tokio::spawn(async move {
                tokio::select! { () = stopped.cancelled() => {}, () = following => {} }
            });
            Some(find)
        }
        Source::Folders(folders) => {
            for (job, folder) in (folder::JOB..).zip(folders) {
                folder::show(feed.clone(), job, folder, stop.clone())?;
            }
            None
        }
        Source::Files => None,
    };
    tokio::spawn(feed.clone().run(stop.clone()));
    let Options { files, results, cors, .. } = options;
    let app = App::new(feed.clone(), find, (files, results)).map_err(unusable)?;
    let router = router::router(app, access, cors);
    let serving = tokio::spawn(server::run(listener, tls, router, stop));
    Ok(Serving { url: url_of(scheme, address), feed, following, serving, _guard: guard })
}

/// The URL of the dashboard on this machine.
fn url_of(scheme: &str, address: SocketAddr) -> String {
    let host = if address.ip().is_unspecified() { "localhost".into() } else { address.ip().to_string() };
    let host = if host.contains(':') { format!("[{host}]") } else { host };
    format!("{scheme}://{host}:{}/", address.port())
}
