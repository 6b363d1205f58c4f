//! Difficult random scenes, and the comparison of a frame with the f64 reference.

use render::Frame;
use scene::{Camera, Splats};

use super::{Random, Scene, camera};

/// Tolerance of every unambiguous pixel.
pub(crate) const TOLERANCE: f64 = 2e-3;

/// Image sizes, most of them not a multiple of the tile size.
pub(crate) const SIZES: [(u32, u32); 6] = [(1, 1), (3, 5), (16, 16), (17, 33), (64, 4), (250, 187)];

/// A camera with the same field of view at every size.
pub(crate) fn camera_of(width: u32, height: u32) -> Camera {
    camera(width, height, 0.9 * f64::from(width.max(height)))
}

/// The special kind of splats in a scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Kind {
    Common,
    Tiny,
    Huge,
    Needle,
    Disc,
    Behind,
    Outside,
    Opaque,
    Close,
    Far,
}

pub(crate) const KINDS: [Kind; 10] = [
    Kind::Common,
    Kind::Tiny,
    Kind::Huge,
    Kind::Needle,
    Kind::Disc,
    Kind::Behind,
    Kind::Outside,
    Kind::Opaque,
    Kind::Close,
    Kind::Far,
];

/// A random scene in which every third splat is of this kind, the others common.
pub(crate) fn mixture(random: &mut Random, camera: &Camera, kind: Kind, count: usize) -> Splats {
    let (width, height) = (camera.pinhole.width as f32, camera.pinhole.height as f32);
    let mut splats = Splats::new(2);
    for n in 0..count {
        let kind = if n % 3 == 0 { kind } else { Kind::Common };
        let mut pixel = [random.range(-0.1, 1.1) * width, random.range(-0.1, 1.1) * height];
        let mut z = random.range(1.0, 20.0);
        let mut sigma = random.range(0.3, 0.04 * width.max(height) + 1.0);
        match kind {
            Kind::Tiny => sigma = random.range(1e-4, 0.05),
            Kind::Huge => sigma = random.range(0.5, 20.0) * width.max(height),
            Kind::Behind => z = -z,
            Kind::Outside => pixel[0] += (if n % 2 == 0 { 2.0 } else { -2.0 }) * width,
            Kind::Close => z = random.range(0.5, 3.0) * render::NEAR_METRES,
            Kind::Far => z *= 1e4,
            _ => {}
        }
        let mut splat = random.splat(camera, pixel, z, sigma);
        match kind {
            Kind::Needle => splat.log_scale[n % 2] += random.range(3.0, 6.0),
            Kind::Disc => splat.log_scale[n % 2] -= random.range(3.0, 12.0),
            Kind::Outside => splat.log_scale += 3.0,
            Kind::Opaque => splat.opacity_logit = random.range(5.0, 15.0),
            _ => {}
        }
        splats.push(&splat);
    }
    splats
}

/// Counts of pixels that differ from the reference.
#[derive(Default)]
pub(crate) struct Tally {
    pub(crate) pixels: usize,
    /// Pixels within 0.1 % of a threshold (α cut, clamp, early stop, depth order), where f32 may decide differently.
    pub(crate) ambiguous: usize,
    pub(crate) off: usize,
    pub(crate) off_unambiguous: usize,
    pub(crate) worst_unambiguous: f64,
}

impl Tally {
    pub(crate) fn add(&mut self, frame: &Frame, scene: &Scene) {
        let image = scene.render();
        let area = image.transmittance.len();
        // Depth errors are relative to the largest depth.
        let far = image.depth.iter().fold(1.0, |m: f64, &d| m.max(d));
        for i in 0..area {
            let difference = |a: &[f32], b: &[f64], i: usize| (f64::from(a[i]) - b[i]).abs();
            let mut error = (0..3).map(|c| difference(&frame.colour, &image.colour, c * area + i)).fold(0.0, f64::max);
            error = error.max(difference(&frame.transmittance, &image.transmittance, i));
            error = error.max(difference(&frame.trainable_alpha, &image.trainable_alpha, i));
            error = error.max(difference(&frame.depth, &image.depth, i) / far);
            self.pixels += 1;
            let ambiguous = image.margin[i] < 1e-3;
            self.ambiguous += usize::from(ambiguous);
            let off = error.is_nan() || error > TOLERANCE;
            self.off += usize::from(off);
            if !ambiguous {
                self.off_unambiguous += usize::from(off);
                self.worst_unambiguous = self.worst_unambiguous.max(error);
            }
        }
    }
}
