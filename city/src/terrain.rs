//! Terrain height: gentle hills, a flat plain in the west, rising slopes beyond the city.
//!
//! Waves are long against the 4 m at which ground meshes are sampled (curvature under 0.0016 / m). The mesh therefore
//! stays within millimetres of the function, and actors placed on the function stand on the mesh.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};

use crate::random::Random;
use crate::settings::Layout;

/// A plane sine wave.
#[derive(Debug, Clone, Copy)]
struct Wave {
    /// Wave vector, radians per metre.
    direction: DVec2,
    phase: f64,
    amplitude: f64,
}

/// The terrain of a city.
#[derive(Debug, Clone)]
pub(crate) struct Terrain {
    waves: Vec<Wave>,
    half_extent: f64,
    /// x of the east edge of the plain.
    plain_edge: f64,
}

impl Terrain {
    pub(crate) fn new(random: &Random, layout: Layout, half_extent: f64, plain_edge: f64) -> Self {
        let mut random = random.fork(0x7E44);
        let heights: &[(f64, f64)] = match layout {
            Layout::Winding => &[(10.0, 800.0), (6.0, 520.0), (2.2, 340.0)],
            Layout::Mixed => &[(8.0, 900.0), (3.5, 520.0)],
            Layout::CurvedCorridor => &[(5.0, 800.0), (1.5, 400.0)],
            _ => &[(4.0, 800.0), (1.0, 360.0)],
        };
        let waves = heights
            .iter()
            .map(|&(amplitude, length)| {
                let heading = f64::from(random.range(0.0, std::f32::consts::TAU));
                let phase = f64::from(random.range(0.0, std::f32::consts::TAU));
                Wave { direction: DVec2::from_angle(heading) * TAU / length, phase, amplitude }
            })
            .collect();
        Self { waves, half_extent, plain_edge }
    }

    /// Height of the ground at a point, metres.
    pub(crate) fn height(&self, p: DVec2) -> f64 {
        let hills: f64 = self.waves.iter().map(|w| w.amplitude * (w.direction.dot(p) + w.phase).sin()).sum();
        // hills grow over 150 m from the plain's edge
        let flat = ((self.plain_edge + 30.0 - p.x) / 150.0).clamp(0.0, 1.0);
        let hills = hills * (1.0 - flat * flat * (3.0 - 2.0 * flat));
        let beyond = (p.abs() - self.half_extent).max(DVec2::ZERO).length();
        hills + 40.0 * beyond * beyond / (beyond * beyond + 1e5)
    }

    /// The point on the ground.
    pub(crate) fn at(&self, p: DVec2) -> DVec3 {
        p.extend(self.height(p))
    }
}
