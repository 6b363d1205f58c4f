//! Cameras: posed ideal pinholes, their mips and windows, and the lens models of captures.

use glam::{DMat3, DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// A rigid transform `x_to = rotation · x_from + translation`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rigid {
    /// Unit quaternion.
    pub rotation: DQuat,
    /// Translation in metres.
    pub translation: DVec3,
}

impl Rigid {
    /// The identity.
    pub const IDENTITY: Self = Self { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// Applies the transform to a point.
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// `self ∘ inner`: applies `inner` first.
    pub fn compose(&self, inner: &Self) -> Self {
        Self { rotation: self.rotation * inner.rotation, translation: self.apply(inner.translation) }
    }

    /// The inverse transform.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// This transform applied after `first`.
    pub fn after(&self, first: &Self) -> Self {
        let rotation = (self.rotation * first.rotation).normalize();
        Self { rotation, translation: self.apply(first.translation) }
    }

    /// This share of the way to `other`, 0 to 1: straight, and by slerp.
    #[must_use]
    pub fn between(&self, other: &Self, share: f64) -> Self {
        let rotation = self.rotation.slerp(other.rotation, share).normalize();
        Self { rotation, translation: self.translation.lerp(other.translation, share) }
    }

    /// True if every number is finite and the quaternion has unit length within 1e-3.
    pub fn is_sane(&self) -> bool {
        self.translation.is_finite() && self.rotation.is_finite() && (self.rotation.length() - 1.0).abs() < 1e-3
    }
}

/// A half-open rectangle of pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Rect {
    /// Left edge.
    pub x: u32,
    /// Top edge.
    pub y: u32,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
}

impl Rect {
    /// The number of pixels.
    pub fn area(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }
}

/// Ideal pinhole intrinsics, in pixels; the principal point is measured from the image's top left corner.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pinhole {
    /// Image width.
    pub width: u32,
    /// Image height.
    pub height: u32,
    /// Horizontal focal length.
    pub fx: f64,
    /// Vertical focal length.
    pub fy: f64,
    /// Principal point, x.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
}

/// Depth of the plane that boxes are cut at, metres.
const NEAR_METRES: f64 = 0.1;

impl Pinhole {
    /// The same pinhole with both focal lengths multiplied.
    #[must_use]
    pub fn with_focal_factor(self, factor: f64) -> Self {
        Self { fx: self.fx * factor, fy: self.fy * factor, ..self }
    }

    /// Pixels whose convex hull is the picture of a box: of its part before the camera. `corners` are in the camera's axes, numbered by
    /// the bits of their signs along the three sides. Empty for a box behind the camera.
    pub fn outline(&self, corners: &[DVec3; 8]) -> Vec<DVec2> {
        let pixel = |p: DVec3| DVec2::new(self.fx * p.x / p.z + self.cx, self.fy * p.y / p.z + self.cy);
        let mut points: Vec<DVec2> = corners.iter().filter(|p| p.z >= NEAR_METRES).map(|p| pixel(*p)).collect();
        for (i, a) in corners.iter().enumerate() {
            for bit in [1, 2, 4].into_iter().filter(|bit| i & bit == 0) {
                let b = corners[i | bit];
                if (a.z < NEAR_METRES) != (b.z < NEAR_METRES) {
                    points.push(pixel(a.lerp(b, (NEAR_METRES - a.z) / (b.z - a.z)).with_z(NEAR_METRES)));
                }
            }
        }
        points
    }
}

/// A posed pinhole.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Intrinsics.
    pub pinhole: Pinhole,
    /// Pose: OpenCV camera axes from world axes.
    pub camera_from_world: Rigid,
}

impl Camera {
    /// The optical centre in the world.
    pub fn centre(&self) -> DVec3 {
        self.camera_from_world.inverse().translation
    }

    /// The viewing direction in the world (unit).
    pub fn forward(&self) -> DVec3 {
        self.camera_from_world.rotation.inverse() * DVec3::Z
    }

    /// Projects a world point: pixel and depth in metres. The pixel is meaningless where the depth is not positive.
    pub fn project(&self, point: DVec3) -> (DVec2, f64) {
        let p = self.camera_from_world.apply(point);
        let k = &self.pinhole;
        (DVec2::new(k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy), p.z)
    }

    /// The camera of mip `m`. A pixel covers `2^m × 2^m` pixels of mip 0, a remainder at the right and bottom is
    /// dropped, and each side is at least one pixel.
    pub fn mip(&self, m: u8) -> Self {
        let k = &self.pinhole;
        let scale = 1.0 / f64::from(1u32 << m);
        let pinhole = Pinhole {
            width: (k.width >> m).max(1),
            height: (k.height >> m).max(1),
            fx: k.fx * scale,
            fy: k.fy * scale,
            cx: k.cx * scale,
            cy: k.cy * scale,
        };
        Self { pinhole, ..*self }
    }

    /// The camera of this rectangle of the image.
    pub fn window(&self, rect: Rect) -> Self {
        let k = &self.pinhole;
        let pinhole = Pinhole {
            width: rect.width,
            height: rect.height,
            cx: k.cx - f64::from(rect.x),
            cy: k.cy - f64::from(rect.y),
            ..*k
        };
        Self { pinhole, ..*self }
    }

    /// The rectangle of the whole image.
    pub fn full(&self) -> Rect {
        Rect { x: 0, y: 0, width: self.pinhole.width, height: self.pinhole.height }
    }

    /// Rotation matrix of `camera_from_world`.
    pub fn rotation(&self) -> DMat3 {
        DMat3::from_quat(self.camera_from_world.rotation)
    }
}

/// COLMAP's perspective lens models, and the fisheye of OpenCV, with their parameters in COLMAP's order
/// (`sensor/models.h`).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum CameraModel {
    /// f, cx, cy
    SimplePinhole([f64; 3]),
    /// fx, fy, cx, cy
    Pinhole([f64; 4]),
    /// f, cx, cy, k
    SimpleRadial([f64; 4]),
    /// f, cx, cy, k1, k2
    Radial([f64; 5]),
    /// fx, fy, cx, cy, k1, k2, p1, p2
    OpenCv([f64; 8]),
    /// fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6
    FullOpenCv([f64; 12]),
    /// fx, fy, cx, cy, k1, k2, k3, k4
    OpenCvFisheye([f64; 8]),
}

impl CameraModel {
    /// fx, fy, cx, cy.
    pub fn focal_and_centre(&self) -> [f64; 4] {
        match *self {
            Self::SimplePinhole([f, cx, cy]) => [f, f, cx, cy],
            Self::Pinhole(p) => p,
            Self::SimpleRadial([f, cx, cy, _]) | Self::Radial([f, cx, cy, ..]) => [f, f, cx, cy],
            Self::OpenCv([fx, fy, cx, cy, ..])
            | Self::FullOpenCv([fx, fy, cx, cy, ..])
            | Self::OpenCvFisheye([fx, fy, cx, cy, ..]) => [fx, fy, cx, cy],
        }
    }

    /// k1, k2, p1, p2, k3, k4, k5, k6 of the OpenCV rational model, which contains the other perspective models. For a
    /// fisheye k1, k2, k3, k4 and zeros.
    pub fn distortion(&self) -> [f64; 8] {
        match *self {
            Self::SimplePinhole(_) | Self::Pinhole(_) => [0.0; 8],
            Self::SimpleRadial([.., k]) => [k, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            Self::Radial([.., k1, k2]) => [k1, k2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            Self::OpenCv([.., k1, k2, p1, p2]) => [k1, k2, p1, p2, 0.0, 0.0, 0.0, 0.0],
            Self::FullOpenCv([.., k1, k2, p1, p2, k3, k4, k5, k6]) => [k1, k2, p1, p2, k3, k4, k5, k6],
            Self::OpenCvFisheye([.., k1, k2, k3, k4]) => [k1, k2, k3, k4, 0.0, 0.0, 0.0, 0.0],
        }
    }

    /// True if the model distorts points.
    pub fn is_distorted(&self) -> bool {
        self.is_fisheye() || self.distortion().iter().any(|&k| k != 0.0)
    }

    /// True for fisheyes, whose image radius is a function of the angle to the axis instead of its tangent.
    pub fn is_fisheye(&self) -> bool {
        matches!(self, Self::OpenCvFisheye(_))
    }

    /// Distorts a point of the ideal image plane (`x/z, y/z`); source: OpenCV, "Camera Calibration and 3D
    /// Reconstruction", rational model with tangential terms, and "Fisheye camera model".
    pub fn distort(&self, ideal: DVec2) -> DVec2 {
        if let Self::OpenCvFisheye([.., k1, k2, k3, k4]) = *self {
            let radius = ideal.length();
            let angle = radius.atan();
            let a2 = angle * angle;
            let distorted = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))));
            return if radius > 1e-12 { ideal * (distorted / radius) } else { ideal };
        }
        let [k1, k2, p1, p2, k3, k4, k5, k6] = self.distortion();
        let (x, y) = (ideal.x, ideal.y);
        let r2 = ideal.length_squared();
        let radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
        DVec2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera {
            pinhole: Pinhole { width: 101, height: 50, fx: 80.0, fy: 90.0, cx: 50.0, cy: 24.0 },
            camera_from_world: Rigid { rotation: DQuat::from_rotation_y(0.3), translation: DVec3::new(1.0, 2.0, 3.0) },
        }
    }

    #[test]
    fn mips_and_windows_project_like_the_image() {
        let (camera, point) = (camera(), DVec3::new(0.3, -0.4, 5.0));
        let (pixel, depth) = camera.project(point);
        let (small, _) = camera.mip(2).project(point);
        assert!((small * 4.0 - pixel).length() < 1e-9);
        assert_eq!(camera.mip(2).pinhole.width, 25);
        let (cropped, same) = camera.window(Rect { x: 7, y: 9, width: 20, height: 20 }).project(point);
        assert!((cropped + DVec2::new(7.0, 9.0) - pixel).length() < 1e-9 && same == depth);
    }

    #[test]
    fn composed_transforms_apply_one_after_the_other() {
        let (a, point) = (camera().camera_from_world, DVec3::new(0.3, -0.4, 5.0));
        let b = Rigid { rotation: DQuat::from_rotation_z(0.7), translation: DVec3::new(-1.0, 0.5, 2.0) };
        assert!((b.after(&a).apply(point) - b.apply(a.apply(point))).length() < 1e-12);
        assert!(a.inverse().after(&a).translation.length() < 1e-12);
    }

    #[test]
    fn centre_projects_to_depth_zero() {
        let camera = camera();
        assert!(camera.camera_from_world.apply(camera.centre()).length() < 1e-12);
    }
}
