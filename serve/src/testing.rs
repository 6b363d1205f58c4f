//! Fixtures of the tests.

use crate::views::{Event, EventKind, Kind, Level, Server};

pub(crate) fn server() -> Server {
    Server { version: "0", kind: Kind::Coordinator, controls: true, store_url: None, coordinator: None }
}

pub(crate) fn event(what: &str) -> Event {
    let (level, kind, what) = (Level::Info, EventKind::Other, what.to_owned());
    Event { number: 0, unix_ms: 0, job: None, task: None, attempt: 0, worker: String::new(), level, kind, what }
}
