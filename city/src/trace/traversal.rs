//! BVH traversal in the order of `obvhs`, with the eight child boxes of a node tested at once where the CPU has AVX2.
//!
//! About half of the time of a rendered image is spent here. A build for any x86-64 counts bits in software and
//! converts the boxes' bytes one by one. With AVX2 the same arithmetic in the same order, so with identical results,
//! takes a fifth of the instructions. All code between [`Moment::cast`](super::Moment::cast) and this module is inlined
//! into one function per instruction set.

use obvhs::{cwbvh::node::CwBvhNode, ray::Ray};

/// Tests a ray against the child boxes of a node.
pub(super) trait NodeTest {
    /// The bits of the children whose box the ray enters, in the visiting order of `obvhs`.
    fn intersect_children(node: &CwBvhNode, ray: &Ray, octant: u32) -> u32;
}

/// For any CPU.
pub(super) struct Portable;

impl NodeTest for Portable {
    #[inline(always)]
    fn intersect_children(node: &CwBvhNode, ray: &Ray, octant: u32) -> u32 {
        node.intersect_ray(ray, octant)
    }
}

/// For functions compiled with `avx2` and the bit instructions that come with it.
#[cfg(target_arch = "x86_64")]
pub(super) struct Avx2;

#[cfg(target_arch = "x86_64")]
impl NodeTest for Avx2 {
    #[inline(always)]
    fn intersect_children(node: &CwBvhNode, ray: &Ray, octant: u32) -> u32 {
        use std::arch::x86_64::*;
        /// Smallest distance of a box, as in `obvhs`.
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
        // SAFETY: the functions that this is inlined into run only where AVX2 was detected (see the module docs), and
        // the eight bytes that are read are those of an array of eight.
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

/// Traverses a BVH along a ray, near children first. `traverse_bvh!(node_test, bvh, ray, i => body)` runs the body for
/// each primitive `i` whose box the ray enters before `ray.tmax`. The body may lower `ray.tmax`, and may leave the
/// traversal by breaking to a label outside.
macro_rules! traverse_bvh {
    ($node_test:ty, $bvh:expr, $ray:ident, $i:ident => $body:block) => {{
        #[allow(unused_imports)]
        use glam_of_obvhs::UVec2;
        let bvh = &$bvh;
        let mut state = bvh.new_traversal($ray.direction);
        let mut node;
        obvhs::traverse!(bvh, node, state, <$node_test>::intersect_children(node, &$ray, state.oct_inv4), {
            let $i = state.primitive_id as usize;
            $body
        });
    }};
}
pub(super) use traverse_bvh;
