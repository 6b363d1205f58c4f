//! Cuts splats into blocks and merges blocks into one model.
//!
//! `merge(cut(s)) == s`, up to the order of rows, for all splats with finite means. Both directions use the same
//! ownership rule, [`Ground::block_at`], so no splat is lost or duplicated. Splats whose mean is not finite have no
//! owner and are dropped.

use std::borrow::Borrow;
use std::collections::BTreeMap;

use scene::{BlockId, Splats};

use crate::ground::Ground;
use crate::lod::Cut;

/// The splats of each block of `level`, by owner. Blocks without splats are absent.
pub fn cut(splats: &Splats, ground: &Ground, level: u8) -> BTreeMap<BlockId, Splats> {
    let mut rows: BTreeMap<BlockId, Vec<u32>> = BTreeMap::new();
    for i in 0..splats.len() {
        let mean = splats.mean(i).as_dvec3();
        if mean.is_finite() {
            rows.entry(ground.block_at(level, mean)).or_default().push(i as u32);
        }
    }
    rows.into_iter().map(|(block, rows)| (block, splats.select(&rows))).collect()
}

/// The splats in the block's core, in their original order.
pub fn keep_core(splats: &Splats, ground: &Ground, block: BlockId) -> Splats {
    splats.filter(|i| ground.owns(block, splats.mean(i).as_dvec3()))
}

/// Concatenates all parts in the order of their blocks, independent of the order of arrival. The result has the highest
/// SH degree of the parts.
pub fn merge(parts: impl IntoIterator<Item = (BlockId, Splats)>) -> Splats {
    let mut parts: Vec<(BlockId, Splats)> = parts.into_iter().collect();
    parts.sort_by_key(|(block, _)| *block);
    let mut merged = Splats::new(parts.iter().map(|(_, splats)| splats.sh_degree()).max().unwrap_or(0));
    merged.reserve(parts.iter().map(|(_, splats)| splats.len()).sum());
    // Each part is dropped after it is appended, to limit peak memory.
    for (_, splats) in parts {
        merged.append(&splats);
    }
    merged
}

/// The model of a cut of the tree: from each part the splats that its block owns in the cut.
///
/// # Errors
/// The first error among `parts`.
pub fn merge_cut<S: Borrow<Splats>, E>(
    cut: &Cut,
    ground: &Ground,
    parts: impl IntoIterator<Item = Result<(BlockId, S), E>>,
) -> Result<Splats, E> {
    let owned = |(block, splats): (BlockId, S)| (block, cut.keep(splats.borrow(), ground, block));
    Ok(merge(parts.into_iter().map(|part| part.map(owned)).collect::<Result<Vec<_>, E>>()?))
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec2, Vec3};
    use proptest::prelude::*;
    use scene::Splat;

    use super::*;

    /// All rows as bits, sorted, to compare splats independent of their order.
    fn rows(splats: &Splats) -> Vec<Vec<u32>> {
        let row = |i: usize| splats.columns().iter().map(|c| c[i].to_bits()).collect();
        let mut rows: Vec<Vec<u32>> = (0..splats.len()).map(row).collect();
        rows.sort();
        rows
    }

    /// Coordinates on faces of the quadtree, at the rim, beyond it, tiny and huge.
    fn coordinate() -> impl Strategy<Value = f32> {
        prop_oneof![
            -60.0f32..60.0,
            (-40i32..40).prop_map(|k| k as f32 * 0.25),
            Just(f32::MAX),
            Just(f32::MIN),
            Just(-0.0),
            Just(f32::MIN_POSITIVE),
            -1e20f32..1e20,
        ]
    }

    fn splats() -> impl Strategy<Value = Splats> {
        prop::collection::vec((coordinate(), coordinate(), coordinate()), 0..60).prop_map(|places| {
            let mut splats = Splats::new(1);
            for (i, (x, y, z)) in places.into_iter().enumerate() {
                splats.push(&Splat::round(Vec3::new(x, y, z), -1.0, Vec3::splat(i as f32 / 60.0), 0.5));
            }
            splats
        })
    }

    fn ground() -> impl Strategy<Value = Ground> {
        let turn = prop_oneof![Just(DQuat::IDENTITY), Just(DQuat::from_rotation_x(1.1))];
        (turn, -9i32..3, prop_oneof![Just(8.0), 0.1f64..30.0]).prop_map(|(ground_from_world, min, edge_metres)| {
            Ground {
                ground_from_world,
                min: DVec2::splat(f64::from(min)),
                edge_metres,
                height_metres: 0.0,
                near_metres: 1e300,
            }
        })
    }

    proptest! {
        #[test]
        fn merge_inverts_cut(s in splats(), ground in ground(), level in 0u8..7) {
            let parts = cut(&s, &ground, level);
            for (block, part) in &parts {
                prop_assert!(!part.is_empty());
                prop_assert_eq!(&keep_core(part, &ground, *block), part);
                prop_assert_eq!(&keep_core(&s, &ground, *block), part);
            }
            prop_assert_eq!(rows(&merge(parts)), rows(&s));
        }

        #[test]
        fn merge_is_independent_of_the_order_of_parts(s in splats(), ground in ground()) {
            let parts = cut(&s, &ground, 3);
            prop_assert_eq!(merge(parts.clone()), merge(parts.into_iter().rev()));
        }
    }

    #[test]
    fn splats_with_non_finite_means_are_dropped() {
        let ground = Ground {
            ground_from_world: DQuat::IDENTITY,
            min: DVec2::ZERO,
            edge_metres: 1.0,
            height_metres: 0.0,
            near_metres: 1e300,
        };
        let mut s = Splats::new(0);
        for x in [0.5, f32::NAN, f32::INFINITY] {
            s.push(&Splat::round(Vec3::new(x, 0.5, 0.0), 0.0, Vec3::ONE, 0.5));
        }
        assert_eq!(merge(cut(&s, &ground, 2)).len(), 1);
        assert_eq!(keep_core(&s, &ground, BlockId::ROOT).len(), 1);
    }
}
