//! Ready tasks in the order in which they are to be granted, and the first of them that fits a worker's memory.
//!
//! A treap over the keys in which every node knows the least memory below it (Seidel and Aragon, "Randomized search trees",
//! 1996); the heat of a node is a hash of its key, so that the same keys give the same tree. All operations take
//! `O(log tasks)` expected.

const NIL: u32 = u32::MAX;

#[derive(Debug, Clone)]
struct Node {
    key: u64,
    memory: u64,
    /// The least memory of this node and all below.
    least: u64,
    left: u32,
    right: u32,
}

/// Keys with the memory that each needs.
#[derive(Debug, Clone)]
pub(crate) struct Queue {
    nodes: Vec<Node>,
    free: Vec<u32>,
    root: u32,
}

impl Default for Queue {
    fn default() -> Self {
        Self { nodes: Vec::new(), free: Vec::new(), root: NIL }
    }
}

impl Queue {
    pub(crate) fn is_empty(&self) -> bool {
        self.root == NIL
    }

    /// The least memory that any of them needs.
    pub(crate) fn least_memory(&self) -> Option<u64> {
        self.at(self.root).map(|node| node.least)
    }

    /// Adds a key that is not there yet; keys are below `u64::MAX`.
    pub(crate) fn insert(&mut self, key: u64, memory: u64) {
        let node = Node { key, memory, least: memory, left: NIL, right: NIL };
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

    /// Takes a key out, if it is there.
    pub(crate) fn remove(&mut self, key: u64) {
        let (before, rest) = self.split(self.root, key);
        let (found, after) = self.split(rest, key + 1);
        if found != NIL {
            self.free.push(found);
        }
        self.root = self.join(before, after);
    }

    /// The first key from `from` on that needs no more than this memory.
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
        let node = self.at(at).filter(|node| node.least <= memory)?;
        if node.key < from {
            return self.find(node.right, from, memory);
        }
        let here = || (node.memory <= memory).then_some(node.key);
        self.find(node.left, from, memory).or_else(here).or_else(|| self.find(node.right, from, memory))
    }

    fn at(&self, place: u32) -> Option<&Node> {
        self.nodes.get(place as usize)
    }

    /// Parts the tree into keys below `key` and the rest.
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

    /// Makes one tree of two, all keys of the first being smaller.
    fn join(&mut self, first: u32, second: u32) -> u32 {
        let (Some(a), Some(b)) = (self.at(first), self.at(second)) else {
            return if first == NIL { second } else { first };
        };
        if heat(a.key) > heat(b.key) {
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
        let below = |place: u32| self.at(place).map_or(u64::MAX, |node| node.least);
        self.nodes[at as usize].least = node.memory.min(below(node.left)).min(below(node.right));
    }
}

/// SplitMix64's last mix.
fn heat(key: u64) -> u64 {
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
        fn it_is_a_map_that_finds_what_fits(steps in prop::collection::vec((0u64..40, 0u64..20, any::<bool>()), 0..200)) {
            let (mut queue, mut map) = (Queue::default(), BTreeMap::new());
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
                prop_assert_eq!(queue.least_memory(), map.values().min().copied());
                let expected = map.range(key..).find(|(_, m)| **m <= memory).map(|(k, _)| *k);
                prop_assert_eq!(queue.next_within(key, memory), expected);
            }
        }
    }
}
