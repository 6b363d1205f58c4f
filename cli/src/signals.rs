//! Waits for the signals that stop a server: Ctrl-C, or SIGTERM as sent by Kubernetes, Slurm and systemd.

use tokio_util::sync::CancellationToken;

/// Cancels the token at the first signal and ends the program at the second.
pub(crate) async fn until_signalled(stop: CancellationToken) {
    signalled().await;
    stop.cancel();
    signalled().await;
    std::process::exit(1);
}

#[cfg(unix)]
async fn signalled() {
    use tokio::signal::unix::{SignalKind, signal};
    // Without a handler, SIGTERM ends the process by default.
    let Ok(mut terminate) = signal(SignalKind::terminate()) else { return std::future::pending().await };
    tokio::select! {
        _ = terminate.recv() => {}
        _ = tokio::signal::ctrl_c() => {}
    }
}

#[cfg(not(unix))]
async fn signalled() {
    let _ = tokio::signal::ctrl_c().await;
}
