//! House meshes: walls with recessed windows, doors, shops, balconies and roofs.
//!
//! x runs along the street from `-width / 2`, y inwards from the front at 0, z up from the pavement. The plinth goes
//! down four metres, for sloping streets.

mod openings;
mod roof;
mod style;

use glam::{Affine3A, Vec3};

use super::Builder;
use crate::materials as m;
use crate::random::Random;
use crate::types::{Asset, Class};
use openings::{balcony, doorway, shop, window};
use roof::roof;
use style::Style;
pub(crate) use style::{HouseKind, PLINTH, WIDTHS};

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
