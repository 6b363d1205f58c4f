//! Made by `tests/expected.py`: what pycocotools gives for boxes of a generator.

/// Seed, views, classes, mAP@[.5:.95], mAP@.5.
#[rustfmt::skip]
pub(super) const EXPECTED: &[(u64, usize, usize, f64, f64)] = &[
    (1, 1, 1, 0.154455445545, 0.257425742574),
    (2, 4, 2, 0.181689535712, 0.469644217169),
    (3, 12, 3, 0.139436352544, 0.392891899080),
    (4, 40, 5, 0.125684885770, 0.333646225437),
    (5, 80, 1, 0.142778554902, 0.386787163904),
];
