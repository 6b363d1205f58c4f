//! What is shared: each kind of house, tree, vehicle, person and piece of street furniture is one asset for all its actors.

use crate::build::furniture::Piece;
use crate::build::house::{self, HouseKind, WIDTHS};
use crate::build::person;
use crate::build::tree;
use crate::build::vehicle::{self, VehicleKind};
use crate::random::Random;
use crate::types::{Asset, Class};

/// A shared asset's name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Prop {
    /// A house of a kind and a row of [`WIDTHS`].
    House {
        kind: HouseKind,
        width: u8,
        variant: u8,
    },
    Tree(u8),
    Hedge,
    Vehicle(VehicleKind, u8),
    /// Somebody in a phase of walking.
    Walker {
        build: u8,
        phase: u8,
    },
    Furniture(Piece),
}

impl Prop {
    /// The class of the whole.
    pub(crate) fn class(self) -> Class {
        match self {
            Self::House { .. } => Class::Building,
            Self::Tree(_) | Self::Hedge => Class::Vegetation,
            Self::Vehicle(kind, _) => kind.class(),
            Self::Walker { .. } => Class::Person,
            Self::Furniture(piece) => piece.class(),
        }
    }

    /// Whether it has an instance number: all but what comes in pieces of two metres.
    pub(crate) fn is_counted(self) -> bool {
        !matches!(self, Self::Hedge | Self::Furniture(Piece::Fence | Piece::Wall))
    }

    /// Builds it; the same for the same seed.
    pub(crate) fn build(self, seed: &Random) -> Asset {
        match self {
            Self::House { kind, width, variant } => {
                let random = seed.fork(kind as u64).fork(u64::from(width)).fork(u64::from(variant));
                let width = WIDTHS[usize::from(width)];
                house::house(kind, width, random, format!("house, {kind:?} {width} m, {variant}").to_lowercase())
            }
            Self::Tree(kind) => tree::tree(kind.into(), seed.fork(0x7EE).fork(u64::from(kind))),
            Self::Hedge => tree::hedge(seed.fork(0x4ED6E)),
            Self::Vehicle(kind, paint) => {
                vehicle::vehicle(kind, paint.into(), seed.fork(0xCA4).fork(kind as u64).fork(u64::from(paint)))
            }
            Self::Walker { build, phase } => person::walker(build.into(), phase.into()),
            Self::Furniture(piece) => piece.build(seed.fork(0xF2)),
        }
    }
}
