//! What is shared: each kind of house, tree, vehicle, person and piece of street furniture is one asset for all its actors.

use crate::build::house::{self, HouseKind, WIDTHS};
use crate::random::Random;
use crate::words::{Asset, Class};

/// A shared asset's name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Prop {
    House { kind: HouseKind, width: u8, variant: u8 },
}

impl Prop {
    /// The class of the whole.
    pub(crate) fn class(self) -> Class {
        match self {
            Self::House { .. } => Class::Building,
        }
    }

    /// Builds it; the same for the same seed.
    pub(crate) fn build(self, seed: &Random) -> Asset {
        match self {
            Self::House { kind, width, variant } => {
                let random = seed.fork(kind as u64).fork(u64::from(width)).fork(u64::from(variant));
                let width = WIDTHS[usize::from(width)];
                house::house(kind, width, random, format!("house, {kind:?} {width} m, {variant}").to_lowercase())
            }
        }
    }
}
