//! Accepts connections, a limited number at a time.

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

/// Pause after an accept that failed: out of file descriptors, which is transient.
const PAUSE: Duration = Duration::from_millis(100);

/// Answers connections until `stop` is cancelled, which ends those that are open, too. At most `limit` are answered at a time; further ones wait to
/// be accepted.
pub async fn accept<A: Future<Output = ()> + Send + 'static>(
    listener: TcpListener,
    limit: usize,
    answer: impl Fn(TcpStream) -> A,
    stop: CancellationToken,
) {
    let slots = Arc::new(Semaphore::new(limit));
    loop {
        let accepted = tokio::select! {
            () = stop.cancelled() => return,
            accepted = async {
                let slot = slots.clone().acquire_owned().await;
                (slot, listener.accept().await)
            } => accepted,
        };
        let (slot, Ok((stream, _))) = accepted else {
            tokio::time::sleep(PAUSE).await;
            continue;
        };
        let (answered, stop) = (answer(stream), stop.clone());
        tokio::spawn(async move {
            tokio::select! {
                () = stop.cancelled() => {}
                () = answered => {}
            }
            drop(slot);
        });
    }
}
