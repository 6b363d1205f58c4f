//! Undistortion: resamples photos of a distorting lens to an ideal pinhole camera.
//!
//! The pinhole keeps the focal lengths and the pixel grid of the photo, so that pixels near the principal point hardly change.
//! Its image is the largest rectangle around the principal point without a pixel outside the photo; for a fisheye, which may
//! see more than a half space, at most 55° to either side. Source positions are computed per pixel: a table of them would be
//! larger than the photo.

use glam::{DMat2, DVec2};
use scene::{CameraModel, Pinhole};

/// The ideal image extends at most this many times as far from the principal point as the photo, on each side.
const MAX_GROWTH: f64 = 2.0;
/// A lens that leaves less than this share of the photo's width or height is refused.
const MIN_SHARE: f64 = 0.25;
/// Tangent of the half field of view kept of a fisheye along each axis. Beyond 55° a pinhole stretches pixels to more than
/// three times their width.
const FISHEYE_MAX_TANGENT: f64 = 1.428;
/// Largest angle to the axis, radians, that the fisheye inversion searches: the ideal plane ends at a right angle.
const FISHEYE_MAX_ANGLE: f64 = 1.55;
/// Points on each edge of the photo that are undistorted to find its extent on the ideal plane.
const EDGE_SAMPLES: u32 = 200;

/// The ideal pinhole camera of a lens; the same intrinsics if the lens has no distortion. `None` if a focal length is not
/// positive, the principal point of a distorted lens lies outside the photo, or its distortion folds over inside.
pub fn ideal_pinhole(model: &CameraModel, width: u32, height: u32) -> Option<Pinhole> {
    Undistorter::new(model, width, height).map(|undistorter| undistorter.pinhole)
}

/// Inverse of [`CameraModel::distort`]: the point of the ideal image plane (`x/z, y/z`) that the lens maps to `distorted`. `None`
/// if none is found, or only one beyond the radius at which the model folds over.
pub fn undistort(model: &CameraModel, distorted: DVec2) -> Option<DVec2> {
    if !model.is_distorted() {
        return Some(distorted);
    }
    if let CameraModel::OpenCvFisheye([.., k1, k2, k3, k4]) = *model {
        return undistort_fisheye([k1, k2, k3, k4], distorted).filter(|&ideal| !folds(model, ideal));
    }
    // Damped Newton: a step that does not reduce the error is halved.
    let mut ideal = distorted;
    let mut error = model.distort(ideal) - distorted;
    for _ in 0..50 {
        if error.length() <= 1e-14 * distorted.length().max(1.0) {
            break;
        }
        let slope = jacobian(model, ideal);
        if slope.determinant().abs() < 1e-12 {
            return None;
        }
        let step = slope.inverse() * error;
        let better = (0..10).map(|halvings| ideal - step * 0.5f64.powi(halvings)).find_map(|next| {
            let next_error = model.distort(next) - distorted;
            (next_error.length() < error.length()).then_some((next, next_error))
        });
        let Some((next, next_error)) = better else { break };
        (ideal, error) = (next, next_error);
    }
    (error.length() < 1e-10 * distorted.length().max(1.0) && !folds(model, ideal)).then_some(ideal)
}

/// Inverts the fisheye polynomial of the angle by bisection.
fn undistort_fisheye([k1, k2, k3, k4]: [f64; 4], distorted: DVec2) -> Option<DVec2> {
    let bent = distorted.length();
    let bend = |a: f64| {
        let a2 = a * a;
        a * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
    };
    if bent < 1e-12 {
        return Some(distorted);
    }
    // The first angle that reaches the radius, in case the polynomial is not monotonic.
    const STEPS: u32 = 64;
    let angle = |step: u32| FISHEYE_MAX_ANGLE * f64::from(step) / f64::from(STEPS);
    let step = (1..=STEPS).find(|&step| bend(angle(step)) >= bent)?;
    let (mut low, mut high) = (angle(step - 1), angle(step));
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        *(if bend(middle) < bent { &mut low } else { &mut high }) = middle;
    }
    Some(distorted * ((0.5 * (low + high)).tan() / bent))
}

/// The derivative of [`CameraModel::distort`] of a fisheye: along the radius and across it.
fn fisheye_jacobian([k1, k2, k3, k4]: [f64; 4], ideal: DVec2) -> DMat2 {
    let radius = ideal.length();
    if radius < 1e-9 {
        return DMat2::IDENTITY;
    }
    let angle = radius.atan();
    let a2 = angle * angle;
    let across = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) / radius;
    let along = (1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)))) / (1.0 + radius * radius);
    let unit = ideal / radius;
    DMat2::IDENTITY * across + DMat2::from_cols(unit * unit.x, unit * unit.y) * (along - across)
}

/// The derivative of [`CameraModel::distort`], from its formula.
fn jacobian(model: &CameraModel, ideal: DVec2) -> DMat2 {
    if let CameraModel::OpenCvFisheye([.., k1, k2, k3, k4]) = *model {
        return fisheye_jacobian([k1, k2, k3, k4], ideal);
    }
    let [k1, k2, p1, p2, k3, k4, k5, k6] = model.distortion();
    let DVec2 { x, y } = ideal;
    let r2 = ideal.length_squared();
    let above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
    let radial = above / below;
    // derivative of `radial` by r²
    let slope = ((k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)) - radial * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) / below;
    let cross = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
    DMat2::from_cols(
        DVec2::new(radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x, cross),
        DVec2::new(cross, radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x),
    )
}

/// Whether the distortion folds the image over somewhere between the principal point and `ideal`: the determinant or the trace
/// of its Jacobian is not positive there.
fn folds(model: &CameraModel, ideal: DVec2) -> bool {
    const STEPS: u32 = 16;
    let is_unfolded = |step| {
        let slope = jacobian(model, ideal * (f64::from(step) / f64::from(STEPS)));
        slope.determinant() > 1e-6 && slope.col(0).x + slope.col(1).y > 0.0
    };
    !(1..=STEPS).all(is_unfolded)
}

/// Resamples the photos of one lens to its ideal pinhole.
#[derive(Debug, Clone)]
pub struct Undistorter {
    model: CameraModel,
    width: u32,
    height: u32,
    pinhole: Pinhole,
}

impl Undistorter {
    /// For photos of this size taken through this lens; `None` as [`ideal_pinhole`].
    pub fn new(model: &CameraModel, width: u32, height: u32) -> Option<Self> {
        let [fx, fy, cx, cy] = model.focal_and_centre();
        let finite = [fx, fy, cx, cy].iter().chain(&model.distortion()).all(|v| v.is_finite());
        if !finite || fx <= 0.0 || fy <= 0.0 || width == 0 || height == 0 {
            return None;
        }
        let pinhole = Pinhole { width, height, fx, fy, cx, cy };
        let mut this = Self { model: *model, width, height, pinhole };
        if model.is_distorted() {
            this.pinhole = this.largest()?;
        }
        Some(this)
    }

    /// The camera of the result.
    pub fn pinhole(&self) -> Pinhole {
        self.pinhole
    }

    /// Whether the lens has no distortion, so that the result equals the photo.
    pub fn is_identity(&self) -> bool {
        !self.model.is_distorted()
    }

    /// Resamples interleaved RGB (`3 · width · height` bytes of the photo) to `3 · area` bytes of the pinhole,
    /// bilinearly.
    pub fn rgb(&self, photo: &[u8]) -> Vec<u8> {
        let mut target = Vec::with_capacity(3 * self.area());
        self.for_each_source(|x, y| {
            let (x0, y0) = (x as usize, y as usize);
            let (x1, y1) = ((x0 + 1).min(self.width as usize - 1), (y0 + 1).min(self.height as usize - 1));
            let (u, v) = (x.fract() as f32, y.fract() as f32);
            let pixel = |x: usize, y: usize| &photo[3 * (y * self.width as usize + x)..][..3];
            let corners = [pixel(x0, y0), pixel(x1, y0), pixel(x0, y1), pixel(x1, y1)];
            let weights = [(1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v];
            target.extend((0..3).map(|c| {
                let value: f32 = corners.iter().zip(weights).map(|(corner, w)| w * f32::from(corner[c])).sum();
                (value + 0.5) as u8
            }));
        });
        target
    }

    /// Resamples a mask or labels (`width · height` values of the photo) to `area` values of the pinhole, by nearest
    /// neighbour.
    pub fn nearest<T: Copy>(&self, photo: &[T]) -> Vec<T> {
        let mut target = Vec::with_capacity(self.area());
        self.for_each_source(|x, y| {
            target.push(photo[y.round() as usize * self.width as usize + x.round() as usize]);
        });
        target
    }

    fn area(&self) -> usize {
        self.pinhole.width as usize * self.pinhole.height as usize
    }

    /// Calls `each` for each pixel of the result, by rows, with the position of its centre in the photo, in pixels from the centre
    /// of the first pixel, clamped to `0 ..= width - 1` and `0 ..= height - 1`.
    fn for_each_source(&self, mut each: impl FnMut(f64, f64)) {
        let last = DVec2::new(f64::from(self.width - 1), f64::from(self.height - 1));
        for y in 0..self.pinhole.height {
            for x in 0..self.pinhole.width {
                let source = self.source(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)) - 0.5;
                let source = source.clamp(DVec2::ZERO, last);
                each(source.x, source.y);
            }
        }
    }

    /// The position in the photo of a position in the ideal image, both in pixels.
    pub(crate) fn source(&self, ideal: DVec2) -> DVec2 {
        let [fx, fy, cx, cy] = self.model.focal_and_centre();
        let k = &self.pinhole;
        let bent = self.model.distort(DVec2::new((ideal.x - k.cx) / k.fx, (ideal.y - k.cy) / k.fy));
        DVec2::new(fx * bent.x + cx, fy * bent.y + cy)
    }

    /// The largest pinhole around the principal point without a pixel outside the photo.
    fn largest(&self) -> Option<Pinhole> {
        let Pinhole { width, height, fx, fy, cx, cy } = self.pinhole;
        let (w, h) = (f64::from(width), f64::from(height));
        if !(1.0..w - 1.0).contains(&cx) || !(1.0..h - 1.0).contains(&cy) {
            return None;
        }
        // Extent of the photo to the left, right, top and bottom of the principal point on the ideal plane, pixels.
        let mut reach = [MAX_GROWTH * cx, MAX_GROWTH * (w - cx), MAX_GROWTH * cy, MAX_GROWTH * (h - cy)];
        if self.model.is_fisheye() {
            let [x, y] = [FISHEYE_MAX_TANGENT * fx, FISHEYE_MAX_TANGENT * fy];
            reach.iter_mut().zip([x, x, y, y]).for_each(|(reach, most)| *reach = reach.min(most));
        }
        let mut limit = |x: f64, y: f64, side: usize| {
            if let Some(ideal) = undistort(&self.model, DVec2::new((x - cx) / fx, (y - cy) / fy)) {
                let distance = [-ideal.x * fx, ideal.x * fx, -ideal.y * fy, ideal.y * fy][side];
                reach[side] = reach[side].min(distance);
            }
        };
        for i in 0..=EDGE_SAMPLES {
            let along = f64::from(i) / f64::from(EDGE_SAMPLES);
            let (x, y) = (0.5 + along * (w - 1.0), 0.5 + along * (h - 1.0));
            limit(0.5, y, 0);
            limit(w - 0.5, y, 1);
            limit(x, 0.5, 2);
            limit(x, h - 0.5, 3);
        }
        // Pixels may still lie outside, between the samples or where the lens folds over near the corners.
        let mut shrink = 0.5;
        for _ in 0..60 {
            let [left, right, top, bottom] = reach;
            // The first and last pixel centres within reach, on the photo's grid.
            let (x0, x1) = ((cx - left - 0.5).ceil(), (cx + right - 0.5).floor());
            let (y0, y1) = ((cy - top - 0.5).ceil(), (cy + bottom - 0.5).floor());
            let (wide, high) = (x1 - x0 + 1.0, y1 - y0 + 1.0);
            if wide < (MIN_SHARE * w).max(1.0) || high < (MIN_SHARE * h).max(1.0) {
                break;
            }
            let pinhole = Pinhole { width: wide as u32, height: high as u32, fx, fy, cx: cx - x0, cy: cy - y0 };
            if (Self { pinhole, ..self.clone() }).is_inside() {
                return Some(pinhole);
            }
            reach = reach.map(|r| r - shrink);
            shrink *= 1.2;
        }
        None
    }

    /// Whether every pixel on the border of the ideal image comes from inside the photo, without a fold on the way.
    fn is_inside(&self) -> bool {
        let Pinhole { width, height, fx, fy, cx, cy } = self.pinhole;
        let inside = |x: u32, y: u32| {
            let centre = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let source = self.source(centre);
            let ideal = DVec2::new((centre.x - cx) / fx, (centre.y - cy) / fy);
            (0.5 - 1e-6..=f64::from(self.width) - 0.5 + 1e-6).contains(&source.x)
                && (0.5 - 1e-6..=f64::from(self.height) - 0.5 + 1e-6).contains(&source.y)
                && !folds(&self.model, ideal)
        };
        (0..width).all(|x| inside(x, 0) && inside(x, height - 1))
            && (0..height).all(|y| inside(0, y) && inside(width - 1, y))
    }
}

#[cfg(test)]
mod tests;
