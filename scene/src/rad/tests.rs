use glam::{Quat, Vec3};
use proptest::prelude::*;

use super::*;
use crate::{SH_C0, Splat, column, random};

const ORIGIN: DVec3 = DVec3::new(100_000.0, -2_000.0, 30.0);

fn splats(count: usize, sh_degree: u8, seed: u64) -> Splats {
    let mut counter = 0;
    let mut between = |from: f32, to: f32| {
        counter += 1;
        from + (to - from) * random::uniform(seed, counter)
    };
    let mut splats = Splats::new(sh_degree);
    for _ in 0..count {
        let mut splat = Splat::round(Vec3::ZERO, 0.0, Vec3::ZERO, 0.5);
        splat.mean = ORIGIN.as_vec3() + Vec3::from_array([(); 3].map(|()| between(-50.0, 50.0)));
        splat.log_scale = Vec3::from_array([(); 3].map(|()| between(-6.0, 0.0)));
        splat.quat = [(); 4].map(|()| between(-1.0, 1.0));
        splat.opacity_logit = between(-3.0, 4.0);
        splat.sh = [(); 16].map(|()| [(); 3].map(|()| between(-0.9, 0.9)));
        splats.push(&splat);
    }
    splats
}

/// Asserts that each splat is a leaf of the file within its steps; leaves are found by their places, which are kept. SH coefficients
/// are clipped to the range of their degree, which one in a thousand of the nodes may exceed at either end.
fn assert_leaves(splats: &Splats, rad: &Rad) {
    let leaves = rad.leaves();
    assert_eq!(leaves.len(), splats.len());
    let key = |mean: Vec3| mean.to_array().map(f32::to_bits);
    let mut by_place: Vec<usize> = (0..leaves.len()).collect();
    by_place.sort_by_key(|&i| key(leaves.mean(i)));
    let mut wanted: Vec<usize> = (0..splats.len()).collect();
    let own = |i: usize| Gaussian::of(splats, i, ORIGIN);
    wanted.sort_by_key(|&i| key(own(i).mean));
    let degree = |k: usize| (k / 3).isqrt();
    let mut ranges = [[f32::MAX, f32::MIN]; 4];
    for i in 0..leaves.len() {
        for (k, value) in Gaussian::of(&leaves, i, DVec3::ZERO).sh.as_flattened().iter().enumerate() {
            let [low, high] = &mut ranges[degree(k)];
            (*low, *high) = (low.min(*value), high.max(*value));
        }
    }
    let (mut numbers, mut clipped) = (0, 0);
    for (leaf, wanted) in by_place.into_iter().zip(wanted) {
        let (leaf, wanted) = (Gaussian::of(&leaves, leaf, DVec3::ZERO), own(wanted));
        assert_eq!(leaf.mean, wanted.mean);
        assert!(((leaf.scale / wanted.scale).map(f32::ln)).abs().max_element() < 0.06);
        assert!(leaf.quat.dot(wanted.quat).abs() > 0.02f32.cos());
        assert!((leaf.opacity - wanted.opacity).abs() < 5e-4);
        for (k, (a, b)) in leaf.sh.as_flattened().iter().zip(wanted.sh.as_flattened()).enumerate() {
            let ([low, high], step) = (ranges[degree(k)], if k < 3 { 0.004 / SH_C0 } else { 0.005 });
            assert!((a - b.clamp(low, high)).abs() < step, "{a} for {b}, clipped to {low}..{high}");
            numbers += 1;
            clipped += usize::from((a - b).abs() >= step);
        }
    }
    // Leaves are half of the nodes.
    assert!(clipped <= numbers / 250, "{clipped} of {numbers}");
}

/// Asserts that every node but the root is the child of one that comes before it.
fn assert_tree(rad: &Rad) {
    let mut parents = vec![0; rad.nodes.len()];
    for (index, &(start, count)) in rad.children.iter().enumerate() {
        for child in start..start + u32::from(count) {
            assert!(child as usize > index);
            parents[child as usize] += 1;
        }
    }
    assert_eq!(parents[0], 0);
    assert!(parents[1..].iter().all(|&parents| parents == 1));
    assert!(rad.nodes.iter().all(|node| node.opacity > 0.0 && node.opacity <= 2.0));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn leaves_are_the_splats_and_nodes_make_a_tree(count in 1usize..400, sh_degree in 0u8..=3, seed: u64) {
        let splats = splats(count, sh_degree, seed);
        let bytes = write(&splats, ORIGIN, Some("{}")).unwrap();
        prop_assert_eq!(&bytes, &write(&splats, ORIGIN, Some("{}")).unwrap());
        let rad = read(&bytes).unwrap();
        prop_assert_eq!((rad.sh_degree, rad.comment.as_deref()), (sh_degree, Some("{}")));
        assert_tree(&rad);
        assert_leaves(&splats, &rad);
    }

    #[test]
    fn damaged_files_are_errors(at in 0usize..4000, to: u8, cut in 0usize..4000) {
        let mut bytes = write(&splats(40, 1, 1), ORIGIN, None).unwrap();
        let (at, cut) = (at % bytes.len(), cut % bytes.len());
        prop_assert!(read(&bytes[..cut]).is_err());
        bytes[at] = to;
        if let Ok(rad) = read(&bytes) {
            prop_assert!(rad.nodes.iter().all(Gaussian::is_finite));
        }
    }
}

#[test]
fn several_chunks_are_laid_out_as_viewers_read_them() {
    let splats = splats(60_000, 0, 3);
    let bytes = write(&splats, ORIGIN, None).unwrap();
    let rad = read(&bytes).unwrap();
    assert!(rad.nodes.len() > CHUNK_NODES && rad.nodes.len() < 2 * splats.len());
    assert_tree(&rad);
    assert_leaves(&splats, &rad);
    let length = u32::from_le_bytes(bytes[4..8].try_into().unwrap()) as usize;
    let meta: serde_json::Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
    let start = 8 + length.next_multiple_of(8);
    assert_eq!(meta["allChunkBytes"], (bytes.len() - start) as u64);
    let mut nodes = 0;
    for (index, chunk) in meta["chunks"].as_array().unwrap().iter().enumerate() {
        let at = start + chunk["offset"].as_u64().unwrap() as usize;
        assert!(at.is_multiple_of(8) && bytes[at..].starts_with(b"RADC"));
        let length = u32::from_le_bytes(bytes[at + 4..at + 8].try_into().unwrap()) as usize;
        let chunk: serde_json::Value = serde_json::from_slice(&bytes[at + 8..at + 8 + length]).unwrap();
        let (base, count) = (chunk["base"].as_u64().unwrap(), chunk["count"].as_u64().unwrap());
        assert_eq!(base, (index * CHUNK_NODES) as u64);
        match index {
            0 => assert!((FIRST_NODES as u64 - 64..=FIRST_NODES as u64).contains(&count)),
            _ => assert_eq!(count, (meta["count"].as_u64().unwrap() - base).min(CHUNK_NODES as u64)),
        }
        nodes += count;
    }
    assert_eq!(nodes, rad.nodes.len() as u64);
    // Sizes fall along the file, so that what is large is loaded first.
    let mean = |nodes: &[Gaussian]| nodes.iter().map(Gaussian::size).sum::<f32>() / nodes.len() as f32;
    assert!(mean(&rad.nodes[..1000]) > 4.0 * mean(&rad.nodes[CHUNK_NODES..]));
}

#[test]
fn a_long_first_chunk_has_the_same_nodes() {
    let splats = splats(60_000, 1, 4);
    let (top, nodes) = tree(&splats, ORIGIN).unwrap();
    let long = Order { top, below: nodes.len() as u64 - top, head: CHUNK_NODES as u64 };
    let bytes = encode(&nodes, long, 1, None).unwrap();
    assert_eq!((long.chunks().count(), long.numbers().unwrap() as usize), (2, nodes.len()));
    assert_eq!(read(&bytes).unwrap(), read(&write(&splats, ORIGIN, None).unwrap()).unwrap());
}

#[test]
fn siblings_are_in_one_chunk_or_follow_each_other() {
    let leaf = |start, count| {
        let gaussian = Gaussian::of(&splats(1, 0, 1), 0, ORIGIN);
        Node { gaussian, children: Children { start, count, part: Part::Below } }
    };
    // The file has what was handed out last first: 30 children whose last comes `before` nodes after the end of the first chunk.
    let order = |before: u64| {
        let below = 200_000;
        Order::new(1, below, &[leaf(0, 0), leaf(below - FIRST_NODES as u64 - before + 1, 30)])
    };
    for (before, head) in [(0, 0), (1, 29), (29, 1), (30, 0)] {
        let order = order(before);
        assert_eq!(order.head, FIRST_NODES as u64 - head, "{before}");
        let chunks: Vec<_> = order.chunks().collect();
        assert_eq!(
            (chunks[0].clone(), chunks[1].start, chunks.last().unwrap().end),
            (0..order.head, order.head, 200_001)
        );
        assert_eq!((order.number(order.head - 1), order.number(order.head)), (order.head - 1, CHUNK_NODES as u64));
    }
    let one = Order::new(1, CHUNK_NODES as u64 - 1, &[]);
    assert!(one.chunks().eq(std::iter::once(0..one.nodes())));
    assert_eq!(one.numbers().unwrap(), CHUNK_NODES as u32);
    assert_eq!(Order::new(0, 0, &[]).chunks().count(), 0);
}

#[test]
fn equal_tiny_and_far_splats_have_a_root() {
    let mut splats = Splats::new(0);
    let mut push = |at: Vec3, log_scale: f32| splats.push(&Splat::round(at, log_scale, Vec3::ONE, 0.9));
    (0..300).for_each(|_| push(ORIGIN.as_vec3(), -3.0));
    (0..100).for_each(|i| push(ORIGIN.as_vec3(), -60.0 + i as f32));
    [-1e30, -1e9, 1e9, 1e30].into_iter().for_each(|x| push(Vec3::X * x, 1.0));
    let rad = read(&write(&splats, ORIGIN, None).unwrap()).unwrap();
    assert_tree(&rad);
    assert_eq!(rad.leaves().len(), splats.len());
    assert!(rad.children.iter().all(|(_, count)| *count < 200));
}

#[test]
fn what_cannot_be_written_is_refused() {
    assert!(write(&Splats::new(0), ORIGIN, None).is_err());
    let mut splats = splats(3, 0, 1);
    splats.columns_mut()[column::MEAN][1] = f32::NAN;
    assert!(write(&splats, ORIGIN, None).unwrap_err().0.contains("splat 1"));
    assert!(Order::new(1, u64::from(u32::MAX), &[]).numbers().is_err());
    let bounds = Bounds::new().encoding();
    assert!(header(Order::new(1, 1 << 31, &[]), &[9; 40_000], &bounds, 0, None).is_err());
}

#[test]
fn a_node_stands_for_its_children() {
    let rad = read(&write(&splats(2000, 0, 5), ORIGIN, None).unwrap()).unwrap();
    for (node, &(start, count)) in rad.nodes.iter().zip(&rad.children).filter(|(_, (_, count))| *count > 0) {
        let children = &rad.nodes[start as usize..][..usize::from(count)];
        let least = children.iter().fold(Vec3::INFINITY, |least, child| least.min(child.mean));
        let most = children.iter().fold(Vec3::NEG_INFINITY, |most, child| most.max(child.mean));
        assert!(node.mean.cmpge(least - 1e-3).all() && node.mean.cmple(most + 1e-3).all());
        assert!(node.quat.is_normalized() && Quat::IDENTITY.is_normalized());
    }
}
