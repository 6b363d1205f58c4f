//! Levels of detail: splats merged from the leaves up, the two most alike of a neighbourhood at a time.
//!
//! ```text
//! step 2^k     splats of that size or less are active
//! cells        of that edge; a splat looks for the most alike one in its own and the cells around, the largest first
//! pairs        merge; what has grown beyond the step waits for the next
//! ```
//!
//! A binary tree has nodes that hardly differ from their parts. Those are left out afterwards, and their parts belong to the node above.

use std::cmp::Ordering;
use std::collections::{BinaryHeap, HashMap};

use super::gaussian::{Gaussian, Shape};
use super::{Children, Node};

/// A node covers at least this many times what the largest of its children does, else it is left out.
const GROWTH: f64 = 1.75;
/// Children of a node at most, unless a root has more.
const MAX_CHILDREN: usize = 64;
/// Step at least, as the exponent of 2: what is smaller than a micrometre is merged as if it were not.
const FINEST_STEP: i32 = -20;
/// Step at most: what still is apart is merged whatever its distance.
const COARSEST_STEP: i32 = 40;
/// Cells along an axis at most, from the origin on.
const MAX_CELL: f32 = 1e9;

/// Splats that are merged. Roots are those that belong to no other.
pub struct Forest {
    nodes: Vec<Node>,
    shapes: Vec<Shape>,
    /// The two that each merged one stands for.
    parts: Vec<Option<[u32; 2]>>,
    is_root: Vec<bool>,
    roots: usize,
}

impl Forest {
    /// A forest of roots only; each may have children of its own already.
    pub fn new(nodes: Vec<Node>) -> Self {
        let (count, shapes) = (nodes.len(), nodes.iter().map(|node| Shape::of(&node.gaussian)).collect());
        Self { nodes, shapes, parts: vec![None; count], is_root: vec![true; count], roots: count }
    }

    /// Merges until there are at most this many roots, one at least.
    pub fn merge(&mut self, at_most: usize) {
        let at_most = at_most.max(1);
        let mut waiting: Vec<BySize> = (0..self.nodes.len() as u32).map(|i| self.sized(i)).collect();
        // Smallest last, so that the next to become active are popped.
        waiting.sort_unstable_by(|a, b| b.cmp(a));
        let smallest = waiting.last().map_or(1.0, |smallest| smallest.size);
        let first = (smallest.max(1e-6).log2().ceil() as i32).clamp(FINEST_STEP, COARSEST_STEP);
        let mut active: Vec<u32> = Vec::new();
        for exponent in first..=COARSEST_STEP {
            if self.roots <= at_most {
                return;
            }
            let step = 2f32.powi(exponent);
            while waiting.last().is_some_and(|next| next.size <= step || exponent == COARSEST_STEP) {
                active.extend(waiting.pop().map(|next| next.index));
            }
            active = self.merge_level(active, step, at_most);
        }
        // What is left lies too far apart for cells, or merging makes it no larger.
        while self.roots > at_most {
            let mut roots = (0..self.nodes.len() as u32).filter(|&i| self.is_root[i as usize]);
            let (Some(a), Some(b)) = (roots.next(), roots.next()) else { return };
            self.join(a, b);
        }
    }

    /// Merges what is active on one step; returns what is active on the next.
    fn merge_level(&mut self, mut active: Vec<u32>, step: f32, at_most: usize) -> Vec<u32> {
        // Some found no partner on the last step, and then became that of another.
        active.retain(|&i| self.is_root[i as usize]);
        let mut cells: HashMap<[i32; 3], Vec<u32>> = HashMap::new();
        for &i in &active {
            cells.entry(self.cell(i, step)).or_default().push(i);
        }
        let mut next = Vec::new();
        let mut open: BinaryHeap<BySize> = active.into_iter().map(|i| self.sized(i)).collect();
        while let Some(BySize { index, .. }) = open.pop() {
            if !self.is_root[index as usize] {
                continue;
            }
            let cell = self.cell(index, step);
            let Some((other, at)) = self.most_alike(index, cell, &cells).filter(|_| self.roots > at_most) else {
                next.push(index);
                continue;
            };
            for (cell, gone) in [(cell, index), (at, other)] {
                if let Some(of_cell) = cells.get_mut(&cell) {
                    of_cell.retain(|&i| i != gone);
                }
            }
            let merged = self.join(index, other);
            let sized = self.sized(merged);
            if sized.size > step {
                next.push(merged);
            } else {
                cells.entry(self.cell(merged, step)).or_default().push(merged);
                open.push(sized);
            }
        }
        next
    }

    fn most_alike(&self, index: u32, cell: [i32; 3], cells: &HashMap<[i32; 3], Vec<u32>>) -> Option<(u32, [i32; 3])> {
        let shape = &self.shapes[index as usize];
        let mut best: Option<(f64, u32, [i32; 3])> = None;
        for around in 0..27 {
            let at = [cell[0] + around % 3 - 1, cell[1] + around / 3 % 3 - 1, cell[2] + around / 9 - 1];
            for &other in cells.get(&at).into_iter().flatten().filter(|&&other| other != index) {
                let distance = shape.distance(&self.shapes[other as usize]);
                if best.is_none_or(|(least, by, _)| (distance, other) < (least, by)) {
                    best = Some((distance, other, at));
                }
            }
        }
        best.map(|(_, other, at)| (other, at))
    }

    fn join(&mut self, a: u32, b: u32) -> u32 {
        let gaussian = Gaussian::merged(&self.nodes[a as usize].gaussian, &self.nodes[b as usize].gaussian);
        self.is_root[a as usize] = false;
        self.is_root[b as usize] = false;
        self.shapes.push(Shape::of(&gaussian));
        self.nodes.push(Node { gaussian, children: Children::NONE });
        self.parts.push(Some([a, b]));
        self.is_root.push(true);
        self.roots -= 1;
        self.nodes.len() as u32 - 1
    }

    fn sized(&self, index: u32) -> BySize {
        BySize { size: self.nodes[index as usize].gaussian.size(), index }
    }

    fn cell(&self, index: u32, step: f32) -> [i32; 3] {
        let at = self.nodes[index as usize].gaussian.mean / step;
        at.clamp(glam::Vec3::splat(-MAX_CELL), glam::Vec3::splat(MAX_CELL)).floor().to_array().map(|x| x as i32)
    }

    /// Hands out all nodes but the roots, siblings together and before their parents, fine ones first. `emit` returns where it put the
    /// first of them. Returns the roots, in the order in which they were given or made.
    ///
    /// # Errors
    /// What `emit` returns.
    pub fn finish<E>(mut self, mut emit: impl FnMut(&[Node]) -> Result<Children, E>) -> Result<Vec<Node>, E> {
        let children = self.children();
        // From the roots down, the largest first; that list backwards has what is small first.
        let roots: Vec<u32> = (0..self.nodes.len() as u32).filter(|&i| self.is_root[i as usize]).collect();
        let mut open: BinaryHeap<BySize> = roots.iter().map(|&i| self.sized(i)).collect();
        let mut parents = Vec::new();
        while let Some(BySize { index, .. }) = open.pop() {
            if !children[index as usize].is_empty() {
                parents.push(index);
                open.extend(children[index as usize].iter().map(|&child| self.sized(child)));
            }
        }
        let mut group = Vec::new();
        for &parent in parents.iter().rev() {
            group.clear();
            group.extend(children[parent as usize].iter().map(|&child| self.nodes[child as usize]));
            self.nodes[parent as usize].children = emit(&group)?;
        }
        Ok(roots.into_iter().map(|root| self.nodes[root as usize]).collect())
    }

    /// The children of each node that stays.
    fn children(&self) -> Vec<Vec<u32>> {
        let mut children: Vec<Vec<u32>> = vec![Vec::new(); self.nodes.len()];
        // What a node passes to the node above it: itself, or its children if it is left out.
        let mut passed: Vec<(f64, Vec<u32>)> = Vec::with_capacity(self.nodes.len());
        for (index, parts) in self.parts.iter().enumerate() {
            let weight = self.nodes[index].gaussian.weight();
            let Some(parts) = parts else {
                passed.push((weight, vec![index as u32]));
                continue;
            };
            let [(a, mut below), (b, more)] = parts.map(|part| std::mem::take(&mut passed[part as usize]));
            below.extend(more);
            if self.is_root[index] || weight >= GROWTH * a.max(b) || below.len() > MAX_CHILDREN {
                children[index] = below;
                passed.push((weight, vec![index as u32]));
            } else {
                passed.push((a.max(b), below));
            }
        }
        children
    }
}

/// A node by its size, then its index.
#[derive(Debug, Clone, Copy)]
struct BySize {
    size: f32,
    index: u32,
}

impl Ord for BySize {
    fn cmp(&self, other: &Self) -> Ordering {
        self.size.total_cmp(&other.size).then(self.index.cmp(&other.index))
    }
}

impl PartialOrd for BySize {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for BySize {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for BySize {}
