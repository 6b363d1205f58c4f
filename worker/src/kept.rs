//! Results that a worker fetched, for the next tasks: the blocks around one block are mostly those around the next, and the root is
//! around all.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use bytes::Bytes;
use scene::ArtefactId;

/// Artefacts as they were read, the least recently used first to go.
#[derive(Debug)]
pub(crate) struct Kept {
    limit: usize,
    /// The latest at the end.
    all: Mutex<VecDeque<(ArtefactId, Bytes)>>,
}

impl Kept {
    /// Of at most so many bytes together.
    pub(crate) fn new(limit: usize) -> Self {
        Self { limit, all: Mutex::default() }
    }

    pub(crate) fn limit(&self) -> usize {
        self.limit
    }

    pub(crate) fn get(&self, id: ArtefactId) -> Option<Bytes> {
        let mut all = self.all.lock().unwrap_or_else(PoisonError::into_inner);
        let at = all.iter().position(|(of, _)| *of == id)?;
        let found = all.remove(at)?;
        let bytes = found.1.clone();
        all.push_back(found);
        Some(bytes)
    }

    pub(crate) fn put(&self, id: ArtefactId, bytes: &Bytes) {
        let mut all = self.all.lock().unwrap_or_else(PoisonError::into_inner);
        if bytes.len() > self.limit || all.iter().any(|(of, _)| *of == id) {
            return;
        }
        let mut taken: usize = all.iter().map(|(_, bytes)| bytes.len()).sum();
        while taken + bytes.len() > self.limit {
            let Some((_, gone)) = all.pop_front() else { break };
            taken -= gone.len();
        }
        all.push_back((id, bytes.clone()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_recently_used_goes_first() {
        let kept = Kept::new(100);
        let some = |n: u8| (ArtefactId::of(&[n]), Bytes::from(vec![n; 40]));
        let [a, b, c] = [1, 2, 3].map(some);
        kept.put(a.0, &a.1);
        kept.put(b.0, &b.1);
        assert_eq!(kept.get(a.0), Some(a.1.clone()));
        kept.put(c.0, &c.1);
        assert_eq!([a.0, b.0, c.0].map(|id| kept.get(id).is_some()), [true, false, true]);
        let large = Bytes::from(vec![0; 101]);
        kept.put(ArtefactId::of(&large), &large);
        assert_eq!(kept.get(ArtefactId::of(&large)), None);
        assert_eq!(kept.get(c.0), Some(c.1), "nothing had to go for what has no room");
    }
}
