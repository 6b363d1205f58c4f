//! The ready queue: ready tasks in grant order, with a search for the first one that fits a worker's memory.
//!
//! A treap over the keys in which every node stores the minimum memory of its subtree (Seidel and Aragon, "Randomized
//! search trees", 1996). The priority of a node is a hash of its key, so that equal keys give equal trees. All
//! operations take expected `O(log tasks)` time.

const NIL: u32 = u32::MAX;

#[derive(Debug, Clone)]
struct Node {
    key: u64,
    memory: u64,
    /// The minimum memory in the subtree of this node.
    min_below: u64,
    left: u32,
    right: u32,
}

/// An ordered set of keys with the memory that each task needs.
#[derive(Debug, Clone)]
pub(crate) struct ReadyQueue {
    nodes: Vec<Node>,
    free: Vec<u32>,
    root: u32,
}

impl Default for ReadyQueue {
    fn default() -> Self {
        Self { nodes: Vec::new(), free: Vec::new(), root: NIL }
    }
}

impl ReadyQueue {
    pub(crate) fn is_empty(&self) -> bool {
        self.root == NIL
    }

    /// The minimum memory of all entries.
    pub(crate) fn min_memory(&self) -> Option<u64> {
        self.at(self.root).map(|node| node.min_below)
    }

    /// Inserts a key that is not present. Keys are below `u64::MAX`.
    pub(crate) fn insert(&mut self, key: u64, memory: u64) {
        let node = Node { key, memory, min_below: memory, left: NIL, right: NIL };
        let place = match self.free.pop() {
            Some(place) => {
                self.nodes[place as usize] = node;
                place
            }
            None => {
                self.nodes.push(node);
                (self.nodes.len() - 1) as u32
            }
        };
        let (before, after) = self.split(self.root, key);
        let front = self.join(before, place);
        self.root = self.join(front, after);
    }

    /// Removes a key, if present.
    pub(crate) fn remove(&mut self, key: u64) {
        let (before, rest) = self.split(self.root, key);
        let (found, after) = self.split(rest, key + 1);
        if found != NIL {
            self.free.push(found);
        }
        self.root = self.join(before, after);
    }

    /// The first key from `from` on that needs at most this memory.
    pub(crate) fn next_within(&self, from: u64, memory: u64) -> Option<u64> {
        self.find(self.root, from, memory)
    }

    /// All keys with their memory, in order.
    pub(crate) fn entries(&self) -> Vec<(u64, u64)> {
        let (mut entries, mut above, mut at) = (Vec::new(), Vec::new(), self.root);
        loop {
            while let Some(node) = self.at(at) {
                above.push(at);
                at = node.left;
            }
            let Some(node) = above.pop().and_then(|place| self.at(place)) else { return entries };
            entries.push((node.key, node.memory));
            at = node.right;
        }
    }

    fn find(&self, at: u32, from: u64, memory: u64) -> Option<u64> {
        let node = self.at(at).filter(|node| node.min_below <= memory)?;
        if node.key < from {
            return self.find(node.right, from, memory);
        }
        let here = || (node.memory <= memory).then_some(node.key);
        self.find(node.left, from, memory).or_else(here).or_else(|| self.find(node.right, from, memory))
    }

    fn at(&self, place: u32) -> Option<&Node> {
        self.nodes.get(place as usize)
    }

    /// Splits the tree into keys below `key` and the rest.
    fn split(&mut self, at: u32, key: u64) -> (u32, u32) {
        let Some(node) = self.at(at) else { return (NIL, NIL) };
        if node.key < key {
            let (below, rest) = self.split(node.right, key);
            self.nodes[at as usize].right = below;
            self.refresh(at);
            (at, rest)
        } else {
            let (below, rest) = self.split(node.left, key);
            self.nodes[at as usize].left = rest;
            self.refresh(at);
            (below, at)
        }
    }

    /// Joins two trees; all keys of the first are smaller.
    fn join(&mut self, first: u32, second: u32) -> u32 {
        let (Some(a), Some(b)) = (self.at(first), self.at(second)) else {
            return if first == NIL { second } else { first };
        };
        if priority(a.key) > priority(b.key) {
            self.nodes[first as usize].right = self.join(a.right, second);
            self.refresh(first);
            first
        } else {
            self.nodes[second as usize].left = self.join(first, b.left);
            self.refresh(second);
            second
        }
    }

    fn refresh(&mut self, at: u32) {
        let node = &self.nodes[at as usize];
        let below = |place: u32| self.at(place).map_or(u64::MAX, |node| node.min_below);
        self.nodes[at as usize].min_below = node.memory.min(below(node.left)).min(below(node.right));
    }
}

/// The treap priority of a key: the finaliser of SplitMix64.
fn priority(key: u64) -> u64 {
    let mut z = key.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    proptest! {
        #[test]
        fn behaves_like_a_map_with_a_search_by_memory(steps in prop::collection::vec((0u64..40, 0u64..20, any::<bool>()), 0..200)) {
            let (mut queue, mut map) = (ReadyQueue::default(), BTreeMap::new());
            for (key, memory, insert) in steps {
                if insert && !map.contains_key(&key) {
                    queue.insert(key, memory);
                    map.insert(key, memory);
                } else {
                    queue.remove(key);
                    map.remove(&key);
                }
                prop_assert_eq!(queue.entries(), map.clone().into_iter().collect::<Vec<_>>());
                prop_assert_eq!(queue.is_empty(), map.is_empty());
                prop_assert_eq!(queue.min_memory(), map.values().min().copied());
                let expected = map.range(key..).find(|(_, m)| **m <= memory).map(|(k, _)| *k);
                prop_assert_eq!(queue.next_within(key, memory), expected);
            }
        }
    }
}
