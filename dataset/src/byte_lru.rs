//! An LRU cache bounded by bytes.

use std::hash::Hash;

use lru::LruCache;

/// Values by key. Inserting evicts the least recently used values until the new value fits the limit. Sizes are those that
/// the caller gives; keys are not counted.
#[derive(Debug)]
pub struct ByteLru<K: Hash + Eq, V> {
    /// Size in bytes and value.
    entries: LruCache<K, (usize, V)>,
    bytes: usize,
    limit: usize,
}

impl<K: Hash + Eq, V> ByteLru<K, V> {
    /// An empty cache of at most `limit` bytes.
    pub fn new(limit: usize) -> Self {
        Self { entries: LruCache::unbounded(), bytes: 0, limit }
    }

    /// The limit in bytes.
    pub fn limit(&self) -> usize {
        self.limit
    }

    /// The current size in bytes.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Whether there is a value under this key. Does not count as a use.
    pub fn contains(&self, key: &K) -> bool {
        self.entries.contains(key)
    }

    /// The value under this key, which becomes the most recently used.
    pub fn get(&mut self, key: &K) -> Option<&V> {
        self.entries.get(key).map(|(_, value)| value)
    }

    /// Inserts a value that takes `bytes` bytes. Does nothing if the key has a value already, which then stays as old as it
    /// was, or if the value alone exceeds the limit.
    pub fn insert_if_absent(&mut self, key: K, value: V, bytes: usize) {
        if bytes > self.limit || self.entries.contains(&key) {
            return;
        }
        while self.bytes + bytes > self.limit
            && let Some((_, (evicted, _))) = self.entries.pop_lru()
        {
            self.bytes -= evicted;
        }
        self.bytes += bytes;
        self.entries.put(key, (bytes, value));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_recently_used_is_evicted_first() {
        let mut cache = ByteLru::new(100);
        cache.insert_if_absent('a', 1, 40);
        cache.insert_if_absent('b', 2, 40);
        assert_eq!(cache.get(&'a'), Some(&1));
        cache.insert_if_absent('c', 3, 40);
        assert_eq!(['a', 'b', 'c'].map(|key| cache.contains(&key)), [true, false, true]);
        cache.insert_if_absent('d', 4, 101);
        assert_eq!((cache.get(&'d').copied(), cache.bytes()), (None, 80), "a value over the limit evicts nothing");
        cache.insert_if_absent('a', 5, 1);
        assert_eq!((cache.get(&'a').copied(), cache.bytes()), (Some(1), 80));
        cache.insert_if_absent('e', 6, 100);
        assert_eq!((cache.contains(&'a'), cache.get(&'e').copied(), cache.bytes()), (false, Some(6), 100));
    }
}
