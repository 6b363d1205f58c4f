//! Heights of the surface that splats form, seen from above.
//!
//! A vertical line meets a splat where its density along the line is largest, with the opacity that it has there. These are
//! blended from above, as a pixel blends splats along its ray, and the surface is where half of the light is gone.

use std::collections::BTreeMap;

use glam::{DMat3, DQuat, DVec2, DVec3};
use scene::Splats;

use crate::ALPHA_MIN;

/// Side of a cell of the index, metres.
const CELL_METRES: f64 = 1.0;
/// Splats over more cells are looked at for every line.
const MAX_CELLS: i64 = 64;
/// Share of the light that is left at the surface.
const LEFT: f64 = 0.5;
/// Added to variances across the line, m²: a wall has none.
const MIN_VARIANCE: f64 = 1e-8;

/// What a vertical line meets of a splat, in ground axes (z up), metres.
struct Footprint {
    middle: DVec3,
    /// The inverse of its covariance across the line: xx, xy, yy.
    inverse: [f64; 3],
    /// How much higher its densest place lies for a metre along x and y.
    slope: DVec2,
    opacity: f64,
}

/// Splats, found by their place on the ground.
pub struct Surface {
    ground_from_world: DQuat,
    footprints: Vec<Footprint>,
    cells: BTreeMap<(i64, i64), Vec<u32>>,
    /// Those that are too large for cells.
    large: Vec<u32>,
}

impl Surface {
    /// Of the splats whose means lie where `is_near` says so; `ground_from_world` turns up to z. Ground axes have the world's origin.
    pub fn new(splats: &Splats, ground_from_world: DQuat, is_near: impl Fn(DVec3) -> bool) -> Self {
        let mut surface = Self { ground_from_world, footprints: Vec::new(), cells: BTreeMap::new(), large: Vec::new() };
        for i in (0..splats.len()).filter(|&i| splats.is_finite(i)) {
            let splat = splats.get(i);
            let middle = ground_from_world * splat.mean.as_dvec3();
            let opacity = 1.0 / (1.0 + f64::from(-splat.opacity_logit).exp());
            if opacity < f64::from(ALPHA_MIN) || !is_near(middle) {
                continue;
            }
            let [w, x, y, z] = splat.quat.map(f64::from);
            let rotation = ground_from_world * DQuat::from_xyzw(x, y, z, w).normalize();
            let axes = DMat3::from_quat(rotation) * DMat3::from_diagonal(splat.log_scale.as_dvec3().exp());
            let covariance = axes * axes.transpose();
            let (xx, xy, yy) =
                (covariance.x_axis.x + MIN_VARIANCE, covariance.x_axis.y, covariance.y_axis.y + MIN_VARIANCE);
            let determinant = xx * yy - xy * xy;
            let inverse = [yy / determinant, -xy / determinant, xx / determinant];
            let along = DVec2::new(covariance.z_axis.x, covariance.z_axis.y);
            let slope =
                DVec2::new(inverse[0] * along.x + inverse[1] * along.y, inverse[1] * along.x + inverse[2] * along.y);
            // Beyond this many sigmas its opacity is under that which counts.
            let reach = (2.0 * (opacity / f64::from(ALPHA_MIN)).ln()).max(0.0).sqrt();
            let (half_x, half_y) = (reach * xx.sqrt(), reach * yy.sqrt());
            if !(inverse.iter().all(|value| value.is_finite()) && slope.is_finite() && half_x.is_finite()) {
                continue;
            }
            surface.insert(Footprint { middle, inverse, slope, opacity }, DVec2::new(half_x, half_y));
        }
        surface
    }

    fn insert(&mut self, footprint: Footprint, half: DVec2) {
        let number = self.footprints.len() as u32;
        let cell = |place: f64| (place / CELL_METRES).floor() as i64;
        let low = footprint.middle.truncate() - half;
        let high = footprint.middle.truncate() + half;
        let (columns, rows) = (cell(low.x)..=cell(high.x), cell(low.y)..=cell(high.y));
        let count = |cells: &std::ops::RangeInclusive<i64>| cells.end() - cells.start() + 1;
        if count(&columns).saturating_mul(count(&rows)) > MAX_CELLS {
            self.large.push(number);
        } else {
            for x in columns {
                rows.clone().for_each(|y| self.cells.entry((x, y)).or_default().push(number));
            }
        }
        self.footprints.push(footprint);
    }

    /// Number of the splats.
    pub fn len(&self) -> usize {
        self.footprints.len()
    }

    /// Whether there is no splat.
    pub fn is_empty(&self) -> bool {
        self.footprints.is_empty()
    }

    /// Turns world axes to ground axes.
    pub fn ground_from_world(&self) -> DQuat {
        self.ground_from_world
    }

    /// The height of the surface below a place in ground axes, at most `depth` metres below it; `None` where more than half of the
    /// light passes.
    pub fn height_below(&self, place: DVec3, depth: f64) -> Option<f64> {
        let cell = |at: f64| (at / CELL_METRES).floor() as i64;
        let here = self.cells.get(&(cell(place.x), cell(place.y))).map_or(&[][..], Vec::as_slice);
        let met = here.iter().chain(&self.large).filter_map(|&i| {
            let Footprint { middle, inverse: [xx, xy, yy], slope, opacity } = &self.footprints[i as usize];
            let off = place.truncate() - middle.truncate();
            let squared = xx * off.x * off.x + 2.0 * xy * off.x * off.y + yy * off.y * off.y;
            let alpha = opacity * (-0.5 * squared).exp();
            let height = middle.z + slope.dot(off);
            let counts = alpha >= f64::from(ALPHA_MIN) && height <= place.z && height >= place.z - depth;
            counts.then_some((height, alpha))
        });
        let mut met: Vec<(f64, f64)> = met.collect();
        met.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut light = 1.0;
        met.into_iter().find_map(|(height, alpha)| {
            light *= 1.0 - alpha;
            (light <= LEFT).then_some(height)
        })
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use scene::Splat;

    use super::*;

    /// Flat splats on the plane z = 0.1 x, a wall, and one that floats and is nearly clear.
    fn street() -> Splats {
        let mut splats = Splats::new(0);
        let turn = DQuat::from_rotation_arc(DVec3::Z, DVec3::new(-0.1, 0.0, 1.0).normalize()).as_quat();
        for i in 0..400u32 {
            let (x, y) = (0.5 * (i % 20) as f32, 0.5 * (i / 20) as f32);
            let mut splat = Splat::round(Vec3::new(x, y, 0.1 * x), 0.4f32.ln(), Vec3::splat(0.5), 0.9);
            splat.log_scale.z = 0.01f32.ln();
            splat.quat = [turn.w, turn.x, turn.y, turn.z];
            splats.push(&splat);
        }
        let mut wall = Splat::round(Vec3::new(5.0, 5.0, 3.0), 1.0, Vec3::splat(0.5), 0.9);
        wall.log_scale.x = -30.0;
        splats.push(&wall);
        splats.push(&Splat::round(Vec3::new(2.0, 2.0, 1.0), 0.0, Vec3::splat(0.5), 0.2));
        splats.push(&Splat::round(Vec3::new(1.0, f32::NAN, 1.0), 0.0, Vec3::splat(0.5), 0.9));
        splats
    }

    #[test]
    fn lines_meet_the_surface_below_them() {
        for ground_from_world in [DQuat::IDENTITY, DQuat::from_rotation_x(0.7)] {
            let mut splats = street();
            // The same street in a world of other axes.
            let back = ground_from_world.inverse();
            for i in 0..splats.len() {
                let mut splat = splats.get(i);
                let [w, x, y, z] = splat.quat.map(f64::from);
                let turned = (back * DQuat::from_xyzw(x, y, z, w)).as_quat();
                splat.mean = (back * splat.mean.as_dvec3()).as_vec3();
                splat.quat = [turned.w, turned.x, turned.y, turned.z];
                splats.set(i, &splat);
            }
            let surface = Surface::new(&splats, ground_from_world, |_| true);
            for (x, y) in [(1.0, 1.0), (2.1, 2.2), (7.3, 8.8), (5.0, 2.0)] {
                let height = surface.height_below(DVec3::new(x, y, 2.0), 3.0).unwrap();
                assert!((height - 0.1 * x).abs() < 0.02, "{height} at {x} {y}");
            }
            // Nothing there, too far below, and beside the street.
            let none = [
                (DVec3::new(1.0, 1.0, -1.0), 3.0),
                (DVec3::new(1.0, 1.0, 5.0), 2.0),
                (DVec3::new(50.0, 1.0, 2.0), 9.0),
            ];
            assert!(none.iter().all(|(place, depth)| surface.height_below(*place, *depth).is_none()));
        }
        let near = Surface::new(&street(), DQuat::IDENTITY, |place| place.x < 3.0);
        assert!(near.height_below(DVec3::new(1.0, 1.0, 2.0), 3.0).is_some());
        assert!(near.height_below(DVec3::new(7.0, 1.0, 2.0), 3.0).is_none());
    }
}
