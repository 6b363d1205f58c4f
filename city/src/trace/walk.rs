//! How a ray walks a tree: in `obvhs`' order, with the eight boxes of a node tested at once where the machine can.
//!
//! Half of what a photo of a generated city costs is this walk. Compiled for any x86-64 it counts bits in software and widens
//! the boxes' bytes one by one; with AVX2 the same arithmetic, in the same order and so with the same results, is a fifth of
//! the instructions. Everything between [`Moment::cast`](super::Moment::cast) and here is inlined into one function for each
//! instruction set.

use obvhs::{cwbvh::node::CwBvhNode, ray::Ray};

/// Which of a node's eight children a ray meets.
pub(super) trait Boxes {
    /// Their bits, in the order in which `obvhs` visits them.
    fn met(node: &CwBvhNode, ray: &Ray, octant: u32) -> u32;
}

/// Whatever the machine.
pub(super) struct Portable;

impl Boxes for Portable {
    #[inline(always)]
    fn met(node: &CwBvhNode, ray: &Ray, octant: u32) -> u32 {
        node.intersect_ray(ray, octant)
    }
}

/// For functions compiled with `avx2` and the bit instructions that come with it.
#[cfg(target_arch = "x86_64")]
pub(super) struct Avx2;

#[cfg(target_arch = "x86_64")]
impl Boxes for Avx2 {
    #[inline(always)]
    fn met(node: &CwBvhNode, ray: &Ray, octant: u32) -> u32 {
        use std::arch::x86_64::*;
        /// Nothing nearer is met, as in `obvhs`.
        const NEAREST: f32 = 1e-4;
        let step = node.compute_extent() * ray.inv_direction;
        let (origin, inverse) = (ray.origin, ray.inv_direction);
        let first =
            [(node.p.x - origin.x) * inverse.x, (node.p.y - origin.y) * inverse.y, (node.p.z - origin.z) * inverse.z];
        let step = [step.x, step.y, step.z];
        let down = [ray.direction.x < 0.0, ray.direction.y < 0.0, ray.direction.z < 0.0];
        let sides = [
            (&node.child_min_x, &node.child_max_x),
            (&node.child_min_y, &node.child_max_y),
            (&node.child_min_z, &node.child_max_z),
        ];
        // SAFETY: functions that this is inlined into run only where AVX2 was detected (see the module), and the eight bytes
        // that are read are those of an array of eight.
        let mut met = unsafe {
            let mut near = _mm256_set1_ps(NEAREST);
            let mut far = _mm256_set1_ps(ray.tmax);
            for axis in 0..3 {
                let (low, high) = sides[axis];
                let (enter, leave) = if down[axis] { (high, low) } else { (low, high) };
                let (step, first) = (_mm256_set1_ps(step[axis]), _mm256_set1_ps(first[axis]));
                let widened =
                    |side: &[u8; 8]| _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64(side.as_ptr().cast())));
                near = _mm256_max_ps(near, _mm256_add_ps(_mm256_mul_ps(widened(enter), step), first));
                far = _mm256_min_ps(far, _mm256_add_ps(_mm256_mul_ps(widened(leave), step), first));
            }
            _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(near, far)) as u32
        };
        let (bits, places) = node.get_child_and_index_bits(octant);
        let mut all = 0;
        while met != 0 {
            let child = 8 * met.trailing_zeros();
            all |= ((bits >> child) as u32 & 0xFF) << ((places >> child) as u32 & 0xFF);
            met &= met - 1;
        }
        all
    }
}

/// Walks a tree along a ray, the near children of a node first. `walk!(boxes, bvh, ray, i => body)`: the body is run for each
/// primitive `i`, in the order of the tree, whose box the ray meets before `ray.tmax`, which the body may lower; it may
/// `break` out of the loop around it by a label.
macro_rules! walk {
    ($boxes:ty, $bvh:expr, $ray:ident, $i:ident => $body:block) => {{
        #[allow(unused_imports)]
        use glam_of_obvhs::UVec2;
        let bvh = &$bvh;
        let mut state = bvh.new_traversal($ray.direction);
        let mut node;
        obvhs::traverse!(bvh, node, state, <$boxes>::met(node, &$ray, state.oct_inv4), {
            let $i = state.primitive_id as usize;
            $body
        });
    }};
}
pub(super) use walk;
