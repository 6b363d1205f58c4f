//! Props: the shared assets. Each kind of house, tree, vehicle, person and street furniture is one asset for all its
//! actors.

use crate::build::furniture::Piece;
use crate::build::house::{self, HouseKind, WIDTHS};
use crate::build::person;
use crate::build::tree;
use crate::build::vehicle::{self, VehicleKind};
use crate::random::Random;
use crate::types::{Asset, Class};

/// Key of a shared asset.
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
    /// A pedestrian in a phase of the gait.
    Walker {
        build: u8,
        phase: u8,
    },
    Furniture(Piece),
}

impl Prop {
    /// Class of the prop as a whole.
    pub(crate) fn class(self) -> Class {
        match self {
            Self::House { .. } => Class::Building,
            Self::Tree(_) | Self::Hedge => Class::Vegetation,
            Self::Vehicle(kind, _) => kind.class(),
            Self::Walker { .. } => Class::Person,
            Self::Furniture(piece) => piece.class(),
        }
    }

    /// Whether actors of this prop get an instance number: all but hedges, fences and walls, which are pieces of 2 m.
    pub(crate) fn is_counted(self) -> bool {
        !matches!(self, Self::Hedge | Self::Furniture(Piece::Fence | Piece::Wall))
    }

    /// Builds the asset; the same seed gives the same asset.
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
