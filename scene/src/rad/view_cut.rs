//! Which nodes a viewer draws: those that look largest are replaced by their children, until a budget is spent.
//!
//! That is Spark's rule (`lod_tree.rs` of sparkjsdev/spark). What lies outside the picture counts for less, so that turning the head shows
//! something at once.

use std::collections::BinaryHeap;

use glam::DVec3;

use super::Rad;
use super::gaussian::{Gaussian, push};
use crate::camera::Camera;
use crate::splats::Splats;

/// Nodes that look smaller than this stay, pixels.
const LEAST_PIXELS: f64 = 1.0;
/// What a node counts for that lies outside the picture by 30 degrees or more, and behind the camera. The dashboard's viewer has the same values.
const OUTSIDE: f64 = 0.1;
const BEHIND: f64 = 0.05;
const MARGIN: f64 = 30.0 * std::f64::consts::PI / 180.0;
/// Nearest distance that counts, metres.
const NEAREST: f64 = 1e-3;

impl Rad {
    /// The nodes that a viewer draws from this camera, at most `budget`, one at least; the tree's places are relative to `origin` (world metres).
    pub fn cut(&self, camera: &Camera, origin: DVec3, budget: usize) -> Vec<u32> {
        let (eye, ahead) = (camera.centre() - origin, camera.forward());
        let k = &camera.pinhole;
        let corner = f64::from(k.width).hypot(f64::from(k.height)) / 2.0;
        let half = (corner / k.fx.min(k.fy)).atan();
        let pixels = |node: u32| {
            let gaussian = &self.nodes[node as usize];
            let to = gaussian.mean.as_dvec3() - eye;
            let distance = to.length().max(NEAREST);
            // The angle between the picture's cone and the nearest part of the splat.
            let size = f64::from(gaussian.size());
            let outside = (to.dot(ahead) / distance).clamp(-1.0, 1.0).acos() - (size / distance).atan() - half;
            k.fx * size / distance * weight(outside)
        };
        let mut open = BinaryHeap::from([Largest(pixels(0), 0)]);
        let (mut count, mut drawn) = (1, Vec::new());
        while let Some(Largest(size, node)) = open.pop() {
            let (start, children) = self.children[node as usize];
            let grown = count + usize::from(children).saturating_sub(1);
            if children == 0 || size < LEAST_PIXELS || grown > budget {
                drawn.push(node);
                continue;
            }
            count = grown;
            open.extend((start..start + u32::from(children)).map(|child| Largest(pixels(child), child)));
        }
        drawn.sort_unstable();
        drawn
    }

    /// These nodes as splats about `origin`. A merged node that covers more than its area is drawn larger, with the same coverage.
    pub fn splats(&self, nodes: &[u32], origin: DVec3) -> Splats {
        let mut splats = Splats::new(self.sh_degree);
        for &node in nodes {
            let of = self.nodes[node as usize];
            let mean = (of.mean.as_dvec3() + origin).as_vec3();
            push(&mut splats, &Gaussian { mean, scale: of.scale * of.opacity.max(1.0).sqrt(), ..of });
        }
        splats
    }
}

/// What a node counts for, by the angle between it and the picture.
fn weight(outside: f64) -> f64 {
    match outside {
        angle if angle <= 0.0 => 1.0,
        angle if angle < MARGIN => 1.0 + (OUTSIDE - 1.0) * angle / MARGIN,
        angle => OUTSIDE + (BEHIND - OUTSIDE) * ((angle - MARGIN) / std::f64::consts::PI).min(1.0),
    }
}

/// A node by how large it looks; ties go to the lower index.
#[derive(Debug, Clone, Copy)]
struct Largest(f64, u32);

impl Ord for Largest {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0).then(other.1.cmp(&self.1))
    }
}

impl PartialOrd for Largest {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Largest {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Largest {}

#[cfg(test)]
mod tests {
    use glam::{DQuat, Vec3};

    use super::*;
    use crate::camera::{Pinhole, Rigid};
    use crate::rad::{read, write};
    use crate::splats::Splat;

    /// A camera at the origin that looks along z, and a wall of splats at 10 m in front and one behind.
    fn scene() -> (Rad, Camera) {
        let mut splats = Splats::new(0);
        for i in 0..400u16 {
            let z = if i % 2 == 0 { 10.0 } else { -10.0 };
            let at = Vec3::new(f32::from(i / 2 % 20) - 9.5, f32::from(i / 40) - 4.5, z);
            splats.push(&Splat::round(at, -1.5, Vec3::splat(f32::from(i % 7) / 7.0), 0.8));
        }
        let pinhole = Pinhole { width: 200, height: 100, fx: 100.0, fy: 100.0, cx: 100.0, cy: 50.0 };
        let camera =
            Camera { pinhole, camera_from_world: Rigid { rotation: DQuat::IDENTITY, translation: DVec3::ZERO } };
        (read(&write(&splats, DVec3::ZERO, None).unwrap()).unwrap(), camera)
    }

    #[test]
    fn budgets_are_kept_and_spent_on_what_is_seen() {
        let (rad, camera) = scene();
        let mut before = 0;
        for budget in [1, 50, 200, 300, 10_000] {
            let cut = rad.cut(&camera, DVec3::ZERO, budget);
            assert!(cut.len() <= budget && cut.len() >= before, "{budget}: {}", cut.len());
            before = cut.len();
            // Each leaf is stood for once: by itself or by one node above it.
            let mut stands = vec![0; rad.nodes.len()];
            cut.iter().for_each(|&node| stands[node as usize] = 1);
            for node in 0..rad.nodes.len() {
                let (start, count) = rad.children[node];
                let above = stands[node];
                (start..start + u32::from(count)).for_each(|child| stands[child as usize] += above);
            }
            let leaves = rad.children.iter().zip(&stands).filter(|((_, count), _)| *count == 0);
            assert!(leaves.into_iter().all(|(_, &times)| times == 1), "{budget}");
        }
        let seen = |cut: &[u32]| cut.iter().filter(|&&node| rad.nodes[node as usize].mean.z > 0.0).count();
        let cut = rad.cut(&camera, DVec3::ZERO, 250);
        assert!(seen(&cut) >= 200 && cut.len() - seen(&cut) < 60, "{} of {}", seen(&cut), cut.len());
        assert_eq!(rad.splats(&cut, DVec3::X).len(), cut.len());
    }
}
