//! Openings of facades: windows, doors, shop fronts and balconies.

use glam::{Vec2, Vec3};

use super::style::{HouseKind, Style};
use crate::build::Builder;
use crate::materials::{self as m, Surface};

/// A bay of wall around an opening.
pub(super) fn around(b: &mut Builder, wall: Surface, [x0, x1]: [f32; 2], [z0, z1]: [f32; 2], low: Vec2, high: Vec2) {
    b.paint(wall);
    b.panel([x0, low.x], [z0, z1], 0.0);
    b.panel([high.x, x1], [z0, z1], 0.0);
    b.panel([low.x, high.x], [z0, low.y], 0.0);
    b.panel([low.x, high.x], [high.y, z1], 0.0);
}

/// The four inner faces of a recess between two depths.
pub(super) fn recess(b: &mut Builder, low: Vec2, high: Vec2, [y0, y1]: [f32; 2]) {
    let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
    b.quad([p(low.x, y0, low.y), p(low.x, y1, low.y), p(low.x, y1, high.y), p(low.x, y0, high.y)]);
    b.quad([p(high.x, y1, low.y), p(high.x, y0, low.y), p(high.x, y0, high.y), p(high.x, y1, high.y)]);
    b.quad([p(low.x, y0, low.y), p(high.x, y0, low.y), p(high.x, y1, low.y), p(low.x, y1, low.y)]);
    b.quad([p(low.x, y1, high.y), p(high.x, y1, high.y), p(high.x, y0, high.y), p(low.x, y0, high.y)]);
}

/// A framed pane set back from the wall, and a back plane `room` metres behind it.
pub(super) fn pane(
    b: &mut Builder,
    style: &mut Style,
    low: Vec2,
    high: Vec2,
    bars: [usize; 2],
    behind: Surface,
    room: f32,
) {
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

pub(super) fn window(b: &mut Builder, style: &mut Style, across: [f32; 2], heights: [f32; 2]) {
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

pub(super) fn doorway(b: &mut Builder, style: &mut Style, across: [f32; 2], heights: [f32; 2]) {
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
pub(super) fn shop(b: &mut Builder, style: &mut Style, length: f32, height: f32, bays: usize, door: usize) {
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

pub(super) fn balcony(b: &mut Builder, style: &mut Style, [x0, x1]: [f32; 2], z: f32) {
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
