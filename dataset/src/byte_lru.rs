//! What is kept of what was read, up to so many bytes.

use std::hash::Hash;

use lru::LruCache;

/// Values by key; where they come to more than so many bytes together, the least recently used goes first.
#[derive(Debug)]
pub struct ByteLru<K: Hash + Eq, V> {
    all: LruCache<K, (usize, V)>,
    bytes: usize,
    limit: usize,
}

impl<K: Hash + Eq, V> ByteLru<K, V> {
    /// Nothing yet, and never more than `limit` bytes.
    pub fn new(limit: usize) -> Self {
        Self { all: LruCache::unbounded(), bytes: 0, limit }
    }

    /// Bytes that it may have at most.
    pub fn limit(&self) -> usize {
        self.limit
    }

    /// Bytes that it has.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Whether it is there; it counts as used as little as before.
    pub fn contains(&self, key: &K) -> bool {
        self.all.contains(key)
    }

    /// What is kept under this key, which is the most recently used from now on.
    pub fn get(&mut self, key: &K) -> Option<&V> {
        self.all.get(key).map(|(_, value)| value)
    }

    /// Keeps a value of so many bytes, unless there is one under this key or it has more than all may have.
    pub fn put(&mut self, key: K, value: V, bytes: usize) {
        if bytes > self.limit || self.all.contains(&key) {
            return;
        }
        while self.bytes + bytes > self.limit
            && let Some((_, (gone, _))) = self.all.pop_lru()
        {
            self.bytes -= gone;
        }
        self.bytes += bytes;
        self.all.put(key, (bytes, value));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_recently_used_goes_first() {
        let mut kept = ByteLru::new(100);
        kept.put('a', 1, 40);
        kept.put('b', 2, 40);
        assert_eq!(kept.get(&'a'), Some(&1));
        kept.put('c', 3, 40);
        assert_eq!(['a', 'b', 'c'].map(|key| kept.contains(&key)), [true, false, true]);
        kept.put('d', 4, 101);
        assert_eq!((kept.get(&'d').copied(), kept.bytes()), (None, 80), "nothing had to go for what has no room");
        kept.put('a', 5, 1);
        assert_eq!((kept.get(&'a').copied(), kept.bytes()), (Some(1), 80));
        kept.put('e', 6, 100);
        assert_eq!((kept.contains(&'a'), kept.get(&'e').copied(), kept.bytes()), (false, Some(6), 100));
    }
}
