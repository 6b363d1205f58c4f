//! House meshes: walls with recessed windows, doors, shops, balconies and roofs.
//!
//! x runs along the street from `-width / 2`, y inwards from the front at 0, z up from the pavement. The plinth goes down
//! four metres, for sloping streets.

use glam::{Affine3A, Vec2, Vec3};

use super::Builder;
use crate::materials::{self as m, Surface};
use crate::random::Random;
use crate::types::{Asset, Class};

/// Kinds of houses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum HouseKind {
    /// Three to six floors in a row.
    Town,
    /// Five to nine floors in a row, along corridors.
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
struct Style {
    kind: HouseKind,
    wall: Surface,
    frame: Surface,
    floors: usize,
    storey: f32,
    ground_storey: f32,
    shop: bool,
    bay: f32,
    window: Vec2,
    sills: bool,
    random: Random,
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
    fn new(kind: HouseKind, mut random: Random) -> Self {
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
    fn level(&self, floor: usize) -> f32 {
        if floor == 0 { 0.0 } else { self.ground_storey + (floor - 1) as f32 * self.storey }
    }

    fn eaves(&self) -> f32 {
        self.level(self.floors) + 0.3
    }
}

/// Builds a house of one of [`WIDTHS`].
pub(crate) fn house(kind: HouseKind, width: f32, random: Random, name: String) -> Asset {
    let mut style = Style::new(kind, random);
    let depth = kind.depth();
    let mut b = Builder::new(Class::Building);
    let half = 0.5 * width;
    let sides = [
        (Vec3::new(-half, 0.0, 0.0), 0.0, width, Wall::Front),
        (Vec3::new(half, 0.0, 0.0), 0.25, depth, Wall::Side),
        (Vec3::new(half, depth, 0.0), 0.5, width, Wall::Back),
        (Vec3::new(-half, depth, 0.0), 0.75, depth, Wall::Side),
    ];
    for (corner, turns, length, wall) in sides {
        let frame = Affine3A::from_translation(corner) * Affine3A::from_rotation_z(turns * std::f32::consts::TAU);
        b.within(frame, |b| facade(b, &mut style, length, wall));
    }
    roof(&mut b, &mut style, width, depth);
    b.finish(name)
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Wall {
    Front,
    Side,
    Back,
}

/// A facade in its own frame: x from 0 to `length`, facing -y.
fn facade(b: &mut Builder, style: &mut Style, length: f32, wall: Wall) {
    b.paint(m::PLINTH).panel([0.0, length], [-PLINTH, 0.0], 0.0);
    let bays = ((length / style.bay) as usize).max(1);
    let bay = length / bays as f32;
    // party walls are blank; some have windows, for houses at corners and gaps
    let open = match wall {
        Wall::Front | Wall::Back => true,
        Wall::Side => style.kind == HouseKind::Villa || style.kind == HouseKind::Tower || style.random.chance(0.3),
    };
    let door = style.random.below(bays);
    let balconies = wall != Wall::Side && style.kind != HouseKind::Tower && style.random.chance(0.4);
    let balcony_bay = style.random.below(bays);
    for floor in 0..style.floors {
        let heights = [style.level(floor), style.level(floor + 1)];
        if !open {
            b.paint(style.wall).panel([0.0, length], heights, 0.0);
            continue;
        }
        if floor == 0 && style.shop && wall == Wall::Front {
            shop(b, style, length, heights[1], bays, door);
            continue;
        }
        for k in 0..bays {
            let across = [k as f32 * bay, (k + 1) as f32 * bay];
            if floor == 0 && wall == Wall::Front && k == door {
                doorway(b, style, across, heights);
            } else {
                window(b, style, across, heights);
            }
        }
        if balconies && floor > 0 {
            balcony(b, style, [balcony_bay as f32 * bay + 0.15, (balcony_bay + 1) as f32 * bay - 0.15], heights[0]);
        }
    }
    b.paint(style.wall).panel([0.0, length], [style.level(style.floors), style.eaves()], 0.0);
}

/// A bay of wall around an opening.
fn around(b: &mut Builder, wall: Surface, [x0, x1]: [f32; 2], [z0, z1]: [f32; 2], low: Vec2, high: Vec2) {
    b.paint(wall);
    b.panel([x0, low.x], [z0, z1], 0.0);
    b.panel([high.x, x1], [z0, z1], 0.0);
    b.panel([low.x, high.x], [z0, low.y], 0.0);
    b.panel([low.x, high.x], [high.y, z1], 0.0);
}

/// The four inner faces of a recess between two depths.
fn recess(b: &mut Builder, low: Vec2, high: Vec2, [y0, y1]: [f32; 2]) {
    let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
    b.quad([p(low.x, y0, low.y), p(low.x, y1, low.y), p(low.x, y1, high.y), p(low.x, y0, high.y)]);
    b.quad([p(high.x, y1, low.y), p(high.x, y0, low.y), p(high.x, y0, high.y), p(high.x, y1, high.y)]);
    b.quad([p(low.x, y0, low.y), p(high.x, y0, low.y), p(high.x, y1, low.y), p(low.x, y1, low.y)]);
    b.quad([p(low.x, y1, high.y), p(high.x, y1, high.y), p(high.x, y0, high.y), p(low.x, y0, high.y)]);
}

/// A framed pane set back from the wall, and a back plane `room` metres behind it.
fn pane(b: &mut Builder, style: &mut Style, low: Vec2, high: Vec2, bars: [usize; 2], behind: Surface, room: f32) {
    const FRAME: f32 = 0.06;
    let inset = if style.kind == HouseKind::Tower { 0.05 } else { style.random.range(0.08, 0.15) };
    b.paint(style.wall);
    recess(b, low, high, [0.0, inset]);
    b.paint(style.frame);
    let (inner_low, inner_high) = (low + FRAME, high - FRAME);
    b.panel([low.x, high.x], [low.y, inner_low.y], inset);
    b.panel([low.x, high.x], [inner_high.y, high.y], inset);
    b.panel([low.x, inner_low.x], [inner_low.y, inner_high.y], inset);
    b.panel([inner_high.x, high.x], [inner_low.y, inner_high.y], inset);
    let size = inner_high - inner_low;
    for k in 1..=bars[0] {
        let x = inner_low.x + size.x * k as f32 / (bars[0] + 1) as f32;
        b.panel([x - 0.025, x + 0.025], [inner_low.y, inner_high.y], inset);
    }
    for k in 1..=bars[1] {
        let z = inner_low.y + size.y * k as f32 / (bars[1] + 1) as f32;
        b.panel([inner_low.x, inner_high.x], [z - 0.025, z + 0.025], inset - 0.002);
    }
    b.paint(m::GLASS).panel([inner_low.x, inner_high.x], [inner_low.y, inner_high.y], inset + 0.02);
    b.paint(if behind == m::GOODS { m::ROOM_WARM } else { m::ROOM_DARK });
    recess(b, low, high, [inset, inset + room]);
    b.paint(behind).panel([low.x, high.x], [low.y, high.y], inset + room);
}

fn window(b: &mut Builder, style: &mut Style, across: [f32; 2], heights: [f32; 2]) {
    let middle = 0.5 * (across[0] + across[1]);
    let half = (0.5 * style.window.x).min(0.5 * (across[1] - across[0]) - 0.12);
    let sill = if style.kind == HouseKind::Tower { 0.6 } else { 0.9 };
    let top = (heights[0] + sill + style.window.y).min(heights[1] - 0.25);
    let (low, high) = (Vec2::new(middle - half, heights[0] + sill), Vec2::new(middle + half, top));
    around(b, style.wall, across, heights, low, high);
    let behind = *style.random.one_of(&[m::CURTAIN, m::CURTAIN, m::ROOM_DARK, m::ROOM_DARK, m::ROOM_WARM]);
    let room = if behind == m::CURTAIN { 0.3 } else { style.random.range(0.6, 1.0) };
    let bars = if style.kind == HouseKind::Tower { [0, 0] } else { [1, usize::from(style.frame == m::FRAME_WHITE)] };
    pane(b, style, low, high, bars, behind, room);
    if style.sills {
        b.paint(m::CONCRETE_SMOOTH);
        b.cuboid(Vec3::new(low.x - 0.08, -0.08, low.y - 0.07), Vec3::new(high.x + 0.08, 0.0, low.y));
    }
}

fn doorway(b: &mut Builder, style: &mut Style, across: [f32; 2], heights: [f32; 2]) {
    let middle = 0.5 * (across[0] + across[1]);
    let (low, high) = (Vec2::new(middle - 0.5, heights[0] + 0.02), Vec2::new(middle + 0.5, heights[0] + 2.2));
    around(b, style.wall, across, heights, low, high);
    b.paint(style.wall);
    recess(b, low, high, [0.0, 0.2]);
    let leaf = *style.random.one_of(&[m::DOOR_GREEN, m::DOOR_RED, m::TIMBER, m::FRAME_DARK]);
    b.paint(leaf).panel([low.x, high.x], [low.y, high.y], 0.2);
    b.paint(m::RIM).cuboid(Vec3::new(high.x - 0.14, 0.14, low.y + 1.0), Vec3::new(high.x - 0.1, 0.2, low.y + 1.12));
}

/// A shop front with a door and a name plate.
fn shop(b: &mut Builder, style: &mut Style, length: f32, height: f32, bays: usize, door: usize) {
    let bay = length / bays as f32;
    for k in 0..bays {
        let across = [k as f32 * bay, (k + 1) as f32 * bay];
        if k == door {
            doorway(b, style, across, [0.0, height]);
            continue;
        }
        let (low, high) = (Vec2::new(across[0] + 0.12, 0.45), Vec2::new(across[1] - 0.12, 2.75));
        around(b, style.wall, across, [0.0, height], low, high);
        pane(b, style, low, high, [0, 0], m::GOODS, 0.9);
    }
    let half = (0.5 * length - 0.4).min(3.2);
    let middle = 0.5 * length;
    b.paint(m::FRAME_DARK).cuboid(Vec3::new(middle - half, -0.08, 2.95), Vec3::new(middle + half, 0.0, 3.6));
    b.paint(m::shop_name(&mut style.random));
    let p = |x: f32, z: f32| Vec3::new(middle + x * (half - 0.06), -0.085, z);
    b.plate([p(-1.0, 3.0), p(1.0, 3.0), p(1.0, 3.55), p(-1.0, 3.55)]);
    if style.kind != HouseKind::Old && style.random.chance(0.4) {
        b.paint(m::AWNING_RED);
        let p = |x: f32, y: f32, z: f32| Vec3::new(middle + x * half, y, z);
        b.plank([p(-1.0, -1.1, 2.5), p(1.0, -1.1, 2.5), p(1.0, -0.02, 2.9), p(-1.0, -0.02, 2.9)], 0.03);
    }
}

fn balcony(b: &mut Builder, style: &mut Style, [x0, x1]: [f32; 2], z: f32) {
    let out = if style.kind == HouseKind::Old { 0.55 } else { 1.1 };
    b.paint(m::CONCRETE).cuboid(Vec3::new(x0, -out, z - 0.12), Vec3::new(x1, 0.0, z + 0.04));
    b.paint(m::IRON);
    let mut rail = |from: Vec2, to: Vec2| {
        let (a, c) = (from.min(to), from.max(to));
        b.cuboid((a - 0.02).extend(z + 1.0), (c + 0.02).extend(z + 1.05));
        let count = ((to - from).length() / 0.22).ceil() as usize;
        for k in 0..count {
            let p = from.lerp(to, k as f32 / count as f32);
            b.block((p - 0.01).extend(z + 0.04), (p + 0.01).extend(z + 1.0));
        }
    };
    let front = 0.04 - out;
    rail(Vec2::new(x0 + 0.03, -0.03), Vec2::new(x0 + 0.03, front));
    rail(Vec2::new(x0 + 0.03, front), Vec2::new(x1 - 0.03, front));
    rail(Vec2::new(x1 - 0.03, front), Vec2::new(x1 - 0.03, -0.03));
}

fn roof(b: &mut Builder, style: &mut Style, width: f32, depth: f32) {
    let tiles = *style.random.one_of(&[m::TILES_RED, m::TILES_RED, m::TILES_DARK, m::SLATE]);
    let pick = style.random.unit();
    match style.kind {
        HouseKind::Tower => flat(b, style, width, depth),
        HouseKind::Villa if pick < 0.45 => hip(b, style, tiles, width, depth),
        HouseKind::Villa if pick < 0.9 => gable(b, style, tiles, width, depth),
        HouseKind::Old if pick < 0.75 => gable(b, style, tiles, width, depth),
        HouseKind::Town if pick < 0.4 => gable(b, style, tiles, width, depth),
        HouseKind::Town | HouseKind::Tall if pick < 0.7 => mansard(b, style, width, depth),
        _ => flat(b, style, width, depth),
    }
}

/// A gable roof with its ridge along the street.
fn gable(b: &mut Builder, style: &mut Style, tiles: Surface, width: f32, depth: f32) {
    let (half, eaves) = (0.5 * width, style.eaves());
    let rise = style.random.range(0.33, 0.5) * depth;
    let ridge = eaves + rise;
    let slope = rise / (0.5 * depth);
    b.paint(style.wall);
    for x in [-half, half] {
        let (low, high) = if x < 0.0 { (depth, 0.0) } else { (0.0, depth) };
        b.triangle([Vec3::new(x, low, eaves), Vec3::new(x, high, eaves), Vec3::new(x, 0.5 * depth, ridge)]);
    }
    b.paint(tiles);
    let over = 0.35;
    let side = if style.kind == HouseKind::Villa { 0.3 } else { 0.02 };
    let (low, x) = (eaves - over * slope + 0.12, half + side);
    let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
    let top = ridge + 0.12;
    b.plank([p(-x, -over, low), p(x, -over, low), p(x, 0.5 * depth, top), p(-x, 0.5 * depth, top)], 0.12);
    let back = depth + over;
    b.plank([p(x, back, low), p(-x, back, low), p(-x, 0.5 * depth, top), p(x, 0.5 * depth, top)], 0.12);
    gutter(b, half, -over - 0.05, low - 0.1);
    let y = 0.5 * depth + style.random.range(-1.0, 1.0);
    chimney(b, style, half, y, ridge);
}

fn gutter(b: &mut Builder, half: f32, y: f32, z: f32) {
    b.paint(m::ZINC).cuboid(Vec3::new(-half, y - 0.05, z - 0.05), Vec3::new(half, y + 0.06, z + 0.05));
    b.tube(Vec3::new(half - 0.2, -0.06, 0.0), Vec3::new(half - 0.2, -0.06, z), [0.045, 0.045], 6);
}

fn chimney(b: &mut Builder, style: &mut Style, half: f32, y: f32, ridge: f32) {
    for _ in 0..1 + style.random.below(2) {
        let at = Vec2::new(style.random.range(0.6 - half, half - 0.6), y);
        let size = Vec2::new(style.random.range(0.25, 0.5), 0.3);
        b.paint(m::BRICK_BROWN).block((at - size).extend(ridge - 1.2), (at + size).extend(ridge + 0.8));
        b.paint(m::CONCRETE).cuboid((at - size - 0.06).extend(ridge + 0.8), (at + size + 0.06).extend(ridge + 0.9));
        b.paint(m::BRICK_RED).tube(at.extend(ridge + 0.9), at.extend(ridge + 1.3), [0.13, 0.11], 8);
    }
}

/// A hip roof.
fn hip(b: &mut Builder, style: &mut Style, tiles: Surface, width: f32, depth: f32) {
    let (over, eaves) = (0.45, style.eaves());
    let (half, rise) = (0.5 * width, 0.4 * depth.min(width));
    let inset = 0.48 * depth.min(width);
    let low = [Vec2::new(-half - over, -over), Vec2::new(half + over, depth + over)];
    let spread = Vec2::splat(inset + over);
    let high = [low[0] + spread, (low[1] - spread).max(low[0] + spread + 0.02)];
    b.paint(tiles).tapered(low, eaves, high, eaves + rise);
    b.paint(m::FRAME_WHITE);
    let [l, h] = low;
    let p = |x: f32, y: f32| Vec3::new(x, y, eaves);
    b.quad([p(l.x, h.y), p(h.x, h.y), p(h.x, l.y), p(l.x, l.y)]);
    chimney(b, style, 0.5 * half + 0.6, 0.5 * depth, eaves + 0.8 * rise);
}

/// A mansard roof: steep with dormers, flat on top.
fn mansard(b: &mut Builder, style: &mut Style, width: f32, depth: f32) {
    let (half, eaves, rise) = (0.5 * width, style.eaves(), 2.9);
    b.paint(m::STONE).cuboid(Vec3::new(-half, -0.25, eaves - 0.25), Vec3::new(half, 0.0, eaves));
    let low = [Vec2::new(-half, 0.0), Vec2::new(half, depth)];
    let inset = Vec2::new(0.02, 1.1);
    b.paint(m::SLATE).tapered(low, eaves, [low[0] + inset, low[1] - inset], eaves + rise);
    let dormers = ((width / 3.2) as usize).max(1);
    for k in 0..dormers {
        let x = -half + width * (k as f32 + 0.5) / dormers as f32;
        let frame = Affine3A::from_translation(Vec3::new(x - 0.75, 0.22, eaves + 0.15));
        b.within(frame, |b| {
            let (low, high) = (Vec2::new(0.2, 0.4), Vec2::new(1.3, 1.75));
            let wall = style.wall;
            around(b, wall, [0.0, 1.5], [0.0, 2.0], low, high);
            pane(b, style, low, high, [1, 0], m::CURTAIN, 0.3);
            let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
            b.paint(m::ZINC);
            b.quad([p(1.5, 0.0, 0.0), p(1.5, 1.0, 0.0), p(1.5, 1.0, 2.0), p(1.5, 0.0, 2.0)]);
            b.quad([p(0.0, 1.0, 0.0), p(0.0, 0.0, 0.0), p(0.0, 0.0, 2.0), p(0.0, 1.0, 2.0)]);
            b.plank([p(-0.1, -0.15, 2.06), p(1.6, -0.15, 2.06), p(1.6, 1.2, 2.16), p(-0.1, 1.2, 2.16)], 0.06);
        });
    }
    chimney(b, style, half, depth - 1.6, eaves + rise);
}

/// A flat roof with parapet, equipment, stair hut and mast.
fn flat(b: &mut Builder, style: &mut Style, width: f32, depth: f32) {
    let (half, eaves, thick) = (0.5 * width, style.eaves(), 0.25);
    let top = eaves + style.random.range(0.4, 1.0);
    let (low, high) = (Vec2::new(-half, 0.0), Vec2::new(half, depth));
    b.paint(style.wall);
    b.block(low.extend(eaves), Vec3::new(high.x, low.y + thick, top));
    b.block(Vec3::new(low.x, high.y - thick, eaves), high.extend(top));
    b.block(Vec3::new(low.x, low.y + thick, eaves), Vec3::new(low.x + thick, high.y - thick, top));
    b.block(Vec3::new(high.x - thick, low.y + thick, eaves), Vec3::new(high.x, high.y - thick, top));
    let p = |x: f32, y: f32| Vec3::new(x, y, eaves + 0.05);
    b.paint(m::ROOFING).quad([p(low.x, low.y), p(high.x, low.y), p(high.x, high.y), p(low.x, high.y)]);
    for _ in 0..2 + style.random.below(3) {
        let size = Vec2::new(style.random.range(0.5, 1.1), style.random.range(0.5, 1.1));
        let at = style.random.between(low + size + 0.4, high - size - 0.4);
        let tall = style.random.range(0.6, 1.5);
        b.paint(m::STEEL).block((at - size).extend(eaves), (at + size).extend(eaves + tall));
    }
    let hut = style.random.between(low + 2.0, high - 2.0);
    b.paint(style.wall).block((hut - 1.4).extend(eaves), (hut + 1.4).extend(eaves + 2.4));
    let mast = style.random.between(low + 0.5, high - 0.5);
    b.paint(m::STEEL).tube(mast.extend(eaves), mast.extend(top + 2.5), [0.03, 0.02], 5);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pane_has_a_back_plane_within_a_metre_and_lies_in_the_wall() {
        for kind in [HouseKind::Town, HouseKind::Tall, HouseKind::Old, HouseKind::Villa, HouseKind::Tower] {
            let width = WIDTHS[4];
            let mesh = house(kind, width, Random::new(3), "house".to_owned()).mesh;
            let corners = |k: usize| mesh.triangles[k].map(|i| mesh.positions[i as usize]);
            let normal = |[a, b, c]: [Vec3; 3]| (b - a).cross(c - a).normalize();
            let panes: Vec<usize> = (0..mesh.triangles.len()).filter(|&k| mesh.materials[k] == m::GLASS.0).collect();
            assert!(panes.len() > 10, "{kind:?}");
            for &pane in &panes {
                assert_eq!(mesh.classes[pane], Class::Building);
                let (out, middle) = (normal(corners(pane)), corners(pane).iter().sum::<Vec3>() / 3.0);
                let behind = (0..mesh.triangles.len()).filter(|&k| mesh.materials[k] != m::GLASS.0).any(|k| {
                    let [a, b, c] = corners(k);
                    let gap = (middle - a).dot(normal([a, b, c]));
                    let hit = middle - gap * out;
                    let inside = |p: Vec3, q: Vec3| (q - p).cross(hit - p).dot(out) > -1e-4;
                    let parallel = normal([a, b, c]).dot(out) > 0.99;
                    parallel && (0.2..1.2).contains(&gap) && inside(a, b) && inside(b, c) && inside(c, a)
                });
                assert!(behind, "{kind:?}: nothing behind the pane at {middle}");
            }
        }
    }

    #[test]
    fn houses_keep_to_their_lot_at_walking_height() {
        for (kind, width) in [(HouseKind::Town, 0), (HouseKind::Old, 3), (HouseKind::Tower, 6), (HouseKind::Villa, 2)] {
            let mesh = house(kind, WIDTHS[width], Random::new(9), "house".to_owned()).mesh;
            let half = 0.5 * WIDTHS[width] + 0.13;
            for p in mesh.positions.iter().filter(|p| p.z < 2.2) {
                assert!(p.x.abs() <= half && p.y >= -0.13 && p.y <= kind.depth() + 0.13, "{kind:?} sticks out at {p}");
            }
        }
    }
}
