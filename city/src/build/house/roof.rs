//! Roofs: gable, hip, mansard and flat.

use glam::{Affine3A, Vec2, Vec3};

use super::openings::{around, pane};
use super::style::{HouseKind, Style};
use crate::build::Builder;
use crate::materials::{self as m, Surface};

pub(super) fn roof(b: &mut Builder, style: &mut Style, width: f32, depth: f32) {
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
