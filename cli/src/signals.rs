//! When a program that runs until it is told to stop is told so: Ctrl-C, or SIGTERM as Kubernetes, Slurm and systemd send it.

use tokio_util::sync::CancellationToken;

/// Cancels the token at the first such signal. The second ends the program at once.
pub(crate) async fn until_told(stop: CancellationToken) {
    told().await;
    stop.cancel();
    told().await;
    std::process::exit(1);
}

#[cfg(unix)]
async fn told() {
    use tokio::signal::unix::{SignalKind, signal};
    // Without a handler the signal ends the process, as it would have without this function.
    let Ok(mut terminate) = signal(SignalKind::terminate()) else { return std::future::pending().await };
    tokio::select! {
        _ = terminate.recv() => {}
        _ = tokio::signal::ctrl_c() => {}
    }
}

#[cfg(not(unix))]
async fn told() {
    let _ = tokio::signal::ctrl_c().await;
}
