//! Kinds and architectural styles of houses.

use glam::Vec2;

use crate::materials::{self as m, Surface};
use crate::random::Random;

/// Kinds of houses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum HouseKind {
    /// Three to six floors in a row.
    Town,
    /// Six to nine floors in a row, along corridors.
    Tall,
    /// Two to four floors, narrow.
    Old,
    /// One or two floors, with windows all around.
    Villa,
    /// Offices, ten floors and more.
    Tower,
}

/// Widths of houses, metres.
pub(crate) const WIDTHS: [f32; 7] = [6.0, 7.5, 9.0, 10.5, 12.0, 14.0, 17.0];

/// Depth of the plinth below the pavement, metres.
pub(crate) const PLINTH: f32 = 4.0;

impl HouseKind {
    /// From the front to the back, metres.
    pub(crate) fn depth(self) -> f32 {
        match self {
            Self::Town => 11.0,
            Self::Tall => 12.5,
            Self::Old => 7.5,
            Self::Villa => 9.0,
            Self::Tower => 17.0,
        }
    }
}

/// The architectural style of a house.
pub(super) struct Style {
    pub(super) kind: HouseKind,
    pub(super) wall: Surface,
    pub(super) frame: Surface,
    pub(super) floors: usize,
    pub(super) storey: f32,
    pub(super) ground_storey: f32,
    pub(super) shop: bool,
    pub(super) bay: f32,
    pub(super) window: Vec2,
    pub(super) sills: bool,
    pub(super) random: Random,
}

const WALLS: [Surface; 12] = [
    m::BRICK_RED,
    m::BRICK_BROWN,
    m::BRICK_YELLOW,
    m::RENDER_WHITE,
    m::RENDER_WHITE,
    m::RENDER_CREAM,
    m::RENDER_GREY,
    m::RENDER_OCHRE,
    m::RENDER_ROSE,
    m::RENDER_GREEN,
    m::RENDER_BLUE,
    m::STONE,
];

impl Style {
    pub(super) fn new(kind: HouseKind, mut random: Random) -> Self {
        let (low, high) = match kind {
            HouseKind::Town => (3, 6),
            HouseKind::Tall => (6, 9),
            HouseKind::Old => (2, 4),
            HouseKind::Villa => (1, 2),
            HouseKind::Tower => (10, 16),
        };
        let shop = random.chance(match kind {
            HouseKind::Town | HouseKind::Tall => 0.5,
            HouseKind::Old => 0.3,
            HouseKind::Tower => 1.0,
            HouseKind::Villa => 0.0,
        });
        let tower = kind == HouseKind::Tower;
        let tower_walls = [m::CLADDING, m::CONCRETE, m::CONCRETE_SMOOTH];
        Self {
            kind,
            wall: *random.one_of(if tower { &tower_walls[..] } else { &WALLS[..] }),
            frame: *random.one_of(&[m::FRAME_WHITE, m::FRAME_WHITE, m::FRAME_DARK, m::TIMBER]),
            floors: low + random.below(high - low + 1),
            storey: random.range(2.8, 3.4),
            ground_storey: if shop { 3.9 } else { random.range(3.0, 3.5) },
            shop,
            bay: if tower { 1.9 } else { random.range(2.3, 3.1) },
            window: if tower {
                Vec2::new(1.5, 1.9)
            } else {
                Vec2::new(random.range(0.95, 1.35), random.range(1.35, 1.7))
            },
            sills: !tower && random.chance(0.7),
            random,
        }
    }

    /// Height of a floor.
    pub(super) fn level(&self, floor: usize) -> f32 {
        if floor == 0 { 0.0 } else { self.ground_storey + (floor - 1) as f32 * self.storey }
    }

    pub(super) fn eaves(&self) -> f32 {
        self.level(self.floors) + 0.3
    }
}
