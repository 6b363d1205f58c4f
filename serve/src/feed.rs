//! The stream of events: every delta is made and written as text once, whatever the number of browsers, and kept for those that reconnect.
//!
//! A browser that cannot keep up is told to start over; nothing waits for it.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use futures::Stream;
use futures::stream;
use serde::Serialize;
use tokio::sync::broadcast::{self, error::RecvError};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::sync::CancellationToken;

use crate::board::Board;

/// Milliseconds since 1970.
pub type Clock = Arc<dyn Fn() -> u64 + Send + Sync>;

/// Interval of deltas.
const PERIOD: Duration = Duration::from_millis(400);
/// Deltas kept for browsers that reconnect, and their bytes.
const KEPT: usize = 256;
const KEPT_BYTES: usize = 16 << 20;
/// Deltas that a browser may lag behind.
const LAG: usize = 32;
/// Browsers at a time.
const STREAMS_LIMIT: usize = 256;
/// Without anything else, a browser hears this often that the server is alive.
const TICK: Duration = Duration::from_secs(1);

/// The board, and the browsers that follow it.
pub(crate) struct Feed {
    board: Mutex<Board>,
    sent: Mutex<Sent>,
    news: broadcast::Sender<Bytes>,
    streams: Arc<Semaphore>,
    clock: Clock,
}

/// The deltas that were sent.
#[derive(Default)]
struct Sent {
    seq: u64,
    deltas: VecDeque<(u64, Bytes)>,
    bytes: usize,
}

impl Feed {
    pub(crate) fn new(board: Board, clock: Clock) -> Self {
        // A restarted server numbers on from its time, so that no browser takes its deltas for those of the one before.
        let sent = Sent { seq: clock(), ..Sent::default() };
        let (news, _) = broadcast::channel(LAG);
        let streams = Arc::new(Semaphore::new(STREAMS_LIMIT));
        Self { board: Mutex::new(board), sent: Mutex::new(sent), news, streams, clock }
    }

    pub(crate) fn now(&self) -> u64 {
        (self.clock)()
    }

    /// The state; held for as long as a request takes to copy from it.
    pub(crate) fn board(&self) -> MutexGuard<'_, Board> {
        self.board.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn sent(&self) -> MutexGuard<'_, Sent> {
        self.sent.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads the board together with the number of the last delta.
    pub(crate) fn read<T>(&self, of: impl FnOnce(&Board, u64) -> T) -> T {
        let sent = self.sent();
        let board = self.board();
        of(&board, sent.seq)
    }

    /// Sends deltas until `stop`.
    pub(crate) async fn run(self: Arc<Self>, stop: CancellationToken) {
        let mut period = tokio::time::interval(PERIOD);
        period.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                () = stop.cancelled() => return,
                _ = period.tick() => self.send(),
            }
        }
    }

    /// Sends what has changed.
    pub(crate) fn send(&self) {
        let now = self.now();
        // In this order everywhere: a snapshot has exactly the changes up to its number.
        let mut sent = self.sent();
        let Some(delta) = self.board().take_delta(now) else { return };
        sent.seq += 1;
        let text = message("delta", Some(sent.seq), &delta);
        sent.bytes += text.len();
        let seq = sent.seq;
        sent.deltas.push_back((seq, text.clone()));
        while sent.deltas.len() > KEPT || (sent.bytes > KEPT_BYTES && sent.deltas.len() > 1) {
            if let Some((_, oldest)) = sent.deltas.pop_front() {
                sent.bytes -= oldest.len();
            }
        }
        // Nobody may be listening.
        let _ = self.news.send(text);
    }

    /// The state as JSON.
    pub(crate) fn snapshot(&self) -> Vec<u8> {
        let sent = self.sent();
        self.snapshot_at(sent.seq)
    }

    fn snapshot_at(&self, seq: u64) -> Vec<u8> {
        serde_json::to_vec(&self.board().snapshot(seq, self.now())).unwrap_or_default()
    }

    /// A browser's stream: what it missed after delta `last`, or a snapshot, then the deltas. `None` if too many are open.
    pub(crate) fn stream(
        &self,
        last: Option<u64>,
    ) -> Option<impl Stream<Item = Result<Bytes, std::io::Error>> + use<>> {
        let permit = self.streams.clone().try_acquire_owned().ok()?;
        let sent = self.sent();
        let news = self.news.subscribe();
        let is_kept = |last: u64| last == sent.seq || sent.deltas.iter().any(|(seq, _)| *seq == last + 1);
        let backlog: VecDeque<Bytes> = match last.filter(|&last| is_kept(last)) {
            Some(last) => sent.deltas.iter().filter(|(seq, _)| *seq > last).map(|(_, text)| text.clone()).collect(),
            None => {
                let json = self.snapshot_at(sent.seq);
                VecDeque::from([framed("snapshot", Some(sent.seq), &json)])
            }
        };
        drop(sent);
        let reader = Reader { backlog, news, clock: self.clock.clone(), over: false, _permit: permit };
        Some(stream::unfold(reader, |mut reader| async move {
            let text = reader.next().await?;
            Some((Ok(text), reader))
        }))
    }
}

struct Reader {
    backlog: VecDeque<Bytes>,
    news: broadcast::Receiver<Bytes>,
    clock: Clock,
    over: bool,
    _permit: OwnedSemaphorePermit,
}

impl Reader {
    async fn next(&mut self) -> Option<Bytes> {
        if self.over {
            return None;
        }
        if let Some(text) = self.backlog.pop_front() {
            return Some(text);
        }
        match tokio::time::timeout(TICK, self.news.recv()).await {
            Ok(Ok(text)) => Some(text),
            Ok(Err(RecvError::Lagged(_))) => {
                self.over = true;
                Some(framed("resync", None, b"{}"))
            }
            Ok(Err(RecvError::Closed)) => None,
            Err(_) => Some(message("tick", None, &serde_json::json!({"now_unix_ms": (self.clock)()}))),
        }
    }
}

fn message(event: &str, id: Option<u64>, data: &impl Serialize) -> Bytes {
    framed(event, id, &serde_json::to_vec(data).unwrap_or_default())
}

/// A server-sent event; JSON of serde has no line breaks.
fn framed(event: &str, id: Option<u64>, json: &[u8]) -> Bytes {
    let id = id.map_or(String::new(), |id| format!("id: {id}\n"));
    [format!("{id}event: {event}\ndata: ").as_bytes(), json, b"\n\n"].concat().into()
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use futures::StreamExt;

    use super::*;
    use crate::testing::{event, server};

    fn feed() -> Feed {
        let time = AtomicU64::new(1000);
        Feed::new(Board::new(server()), Arc::new(move || time.fetch_add(1, Ordering::Relaxed)))
    }

    fn say(feed: &Feed, what: &str) {
        feed.board().event(event(what));
        feed.send();
    }

    async fn texts(feed: &Feed, last: Option<u64>, count: usize) -> Vec<String> {
        let stream = feed.stream(last).unwrap();
        let texts = stream.take(count).map(|text| String::from_utf8(text.unwrap().to_vec()).unwrap());
        texts.collect().await
    }

    #[tokio::test]
    async fn a_browser_that_reconnects_gets_what_it_missed() {
        let feed = feed();
        feed.send();
        let first = feed.read(|_, seq| seq);
        for what in ["one", "two", "three"] {
            say(&feed, what);
        }
        let [snapshot] = &texts(&feed, None, 1).await[..] else { panic!() };
        assert!(snapshot.starts_with(&format!("id: {}\nevent: snapshot\ndata: {{", first + 3)), "{snapshot}");
        assert!(snapshot.contains("three") && snapshot.ends_with("}\n\n"));
        let missed = texts(&feed, Some(first + 1), 2).await;
        assert!(missed[0].contains("event: delta") && missed[0].contains("two") && missed[1].contains("three"));
        // A number that was never given, or is no longer kept.
        for last in [first + 9, first.wrapping_sub(5)] {
            assert!(texts(&feed, Some(last), 1).await[0].contains("event: snapshot"));
        }
        for _ in 0..2 * KEPT {
            say(&feed, "more");
        }
        assert!(texts(&feed, Some(first + 1), 1).await[0].contains("event: snapshot"));
    }

    #[tokio::test]
    async fn a_slow_browser_starts_over_and_too_many_are_refused() {
        let feed = feed();
        let stream = feed.stream(None).unwrap();
        for _ in 0..2 * LAG {
            say(&feed, "news");
        }
        let texts: Vec<_> = stream.map(|text| String::from_utf8(text.unwrap().to_vec()).unwrap()).collect().await;
        assert!(texts.len() == 2 && texts[1].starts_with("event: resync\n"), "{texts:?}");
        let open: Vec<_> = (0..STREAMS_LIMIT).map(|_| feed.stream(None).unwrap()).collect();
        assert!(feed.stream(None).is_none());
        drop(open);
        assert!(feed.stream(None).is_some());
    }

    #[tokio::test(start_paused = true)]
    async fn without_news_there_are_ticks() {
        let feed = feed();
        assert!(texts(&feed, None, 2).await[1].starts_with("event: tick\ndata: {\"now_unix_ms\":"));
    }
}
