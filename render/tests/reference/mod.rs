//! A reference renderer in f64: project, sort, blend pixel by pixel.
//!
//! It is written from the definition and the papers, independently of the backends: covariances are matrix products,
//! spherical harmonics come from Legendre polynomials, every pixel visits every splat. It also reports how close each
//! pixel is to a threshold (α cut, clamp, early stop, depth order): near a threshold f32 may decide differently, and
//! central differences are invalid.

#![allow(dead_code)] // each test binary uses a part

pub(crate) mod mixture;
pub(crate) mod tensors;

use glam::{DMat3, DQuat, DVec2, DVec3};
use render::{ALPHA_MAX, ALPHA_MIN, LOW_PASS, NEAR_METRES, Options, TRANSMITTANCE_MIN};
use scene::{Camera, Pinhole, Rigid, Splat, Splats, column};

/// A scene in f64, which allows central differences with steps of 1e-6.
#[derive(Debug, Clone)]
pub(crate) struct Scene {
    /// As in [`scene::Splats`], trainable splats first, then the context.
    pub(crate) columns: Vec<Vec<f64>>,
    /// The number of trainable splats.
    pub(crate) trainable: usize,
    /// Added to the projected means, pixels.
    pub(crate) shift: Vec<DVec2>,
    pub(crate) camera: Camera,
    pub(crate) options: Options,
}

/// A [`render::Frame`] in f64 with statistics.
#[derive(Debug, Clone, Default)]
pub(crate) struct Image {
    pub(crate) colour: Vec<f64>,
    pub(crate) transmittance: Vec<f64>,
    pub(crate) depth: Vec<f64>,
    pub(crate) trainable_alpha: Vec<f64>,
    /// Σ αT of each splat.
    pub(crate) weight: Vec<f64>,
    /// Relative distance of each pixel to the nearest threshold.
    pub(crate) margin: Vec<f64>,
    /// The same for thresholds evaluated once per splat: near plane, clamped Jacobian, colour clamped at 0.
    pub(crate) splat_margin: f64,
}

/// A projected splat.
struct Ellipse {
    index: usize,
    z: f64,
    mean: DVec2,
    /// Inverse of the covariance after the low-pass filter: xx, xy, yy.
    conic: [f64; 3],
    opacity: f64,
    colour: DVec3,
}

impl Scene {
    pub(crate) fn new(splats: &Splats, context: Option<&Splats>, camera: &Camera, options: &Options) -> Self {
        let mut all = splats.clone();
        if let Some(context) = context {
            all.append(context);
        }
        let columns = all.columns().iter().map(|c| c.iter().map(|&v| f64::from(v)).collect()).collect();
        Self {
            columns,
            trainable: splats.len(),
            shift: vec![DVec2::ZERO; all.len()],
            camera: *camera,
            options: *options,
        }
    }

    pub(crate) fn render(&self) -> Image {
        let (width, height) = (self.camera.pinhole.width as usize, self.camera.pinhole.height as usize);
        let (area, n) = (width * height, self.columns[0].len());
        let mut image = Image {
            colour: vec![0.0; 3 * area],
            transmittance: vec![0.0; area],
            depth: vec![0.0; area],
            trainable_alpha: vec![0.0; area],
            weight: vec![0.0; n],
            margin: vec![f64::INFINITY; area],
            splat_margin: f64::INFINITY,
        };
        let mut ellipses: Vec<Ellipse> = (0..n).filter_map(|i| self.project(i, &mut image.splat_margin)).collect();
        ellipses.sort_by(|a, b| a.z.total_cmp(&b.z)); // stable: ties keep index order
        for pixel in 0..area {
            let centre = DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
            self.blend(&ellipses, centre, pixel, &mut image);
        }
        image
    }

    fn project(&self, i: usize, margin: &mut f64) -> Option<Ellipse> {
        let value = |k: usize| self.columns[k][i];
        let vector = |k: usize| DVec3::new(value(k), value(k + 1), value(k + 2));
        let k = &self.camera.pinhole;
        let pose = &self.camera.camera_from_world;
        let w = DMat3::from_quat(pose.rotation);
        let p = w * vector(column::MEAN) + pose.translation;
        let near = f64::from(NEAR_METRES);
        *margin = margin.min((p.z / near - 1.0).abs());
        if p.z <= near {
            return None;
        }
        // Jacobian of the projection at the centre, clamped to the view and 15 % of the image beyond.
        let mut clamped = |ratio: f64, centre: f64, length: u32, focal: f64| {
            let length = f64::from(length);
            let (low, high) = ((-centre - 0.15 * length) / focal, (length - centre + 0.15 * length) / focal);
            *margin = margin.min((ratio - low).abs()).min((ratio - high).abs());
            ratio.clamp(low, high)
        };
        let u = clamped(p.x / p.z, k.cx, k.width, k.fx);
        let v = clamped(p.y / p.z, k.cy, k.height, k.fy);
        let jacobian = DMat3::from_cols(
            DVec3::new(k.fx / p.z, 0.0, 0.0),
            DVec3::new(0.0, k.fy / p.z, 0.0),
            DVec3::new(-k.fx * u / p.z, -k.fy * v / p.z, 0.0),
        );
        let q = DQuat::from_xyzw(
            value(column::QUAT + 1),
            value(column::QUAT + 2),
            value(column::QUAT + 3),
            value(column::QUAT),
        );
        let r = DMat3::from_quat(q.normalize());
        let s = vector(column::LOG_SCALE);
        let m = r * DMat3::from_diagonal(DVec3::new(s.x.exp(), s.y.exp(), s.z.exp()));
        let a = jacobian * w * m;
        let cov = a * a.transpose();
        let (xx, xy, yy) = (cov.x_axis.x, cov.x_axis.y, cov.y_axis.y);
        // The determinant of A·Aᵀ as a sum of squares (Cauchy-Binet), which does not cancel for needles.
        let minor = |c: usize, d: usize| (a.col(c).x * a.col(d).y - a.col(c).y * a.col(d).x).powi(2);
        let det0 = minor(0, 1) + minor(0, 2) + minor(1, 2);
        let low_pass = f64::from(LOW_PASS);
        let det1 = det0 + low_pass * (xx + yy) + low_pass * low_pass;
        let mut opacity = 1.0 / (1.0 + (-value(column::OPACITY)).exp());
        if self.options.antialiased {
            opacity *= (det0 / det1).sqrt();
        }

        let direction = (vector(column::MEAN) - self.camera.centre()).normalize();
        let mut colour = DVec3::splat(0.5);
        let mut coefficient = 0;
        for l in 0..=i64::from(self.options.sh_degree) {
            for m in -l..=l {
                colour += harmonic(l, m, direction) * vector(column::SH + 3 * coefficient);
                coefficient += 1;
            }
        }
        *margin = margin.min(colour.abs().min_element());
        Some(Ellipse {
            index: i,
            z: p.z,
            mean: DVec2::new(k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy) + self.shift[i],
            conic: [(yy + low_pass) / det1, -xy / det1, (xx + low_pass) / det1],
            opacity,
            colour: colour.max(DVec3::ZERO),
        })
    }

    fn blend(&self, ellipses: &[Ellipse], centre: DVec2, pixel: usize, image: &mut Image) {
        let (alpha_min, alpha_max) = (f64::from(ALPHA_MIN), f64::from(ALPHA_MAX));
        let stop = f64::from(TRANSMITTANCE_MIN);
        let (mut transmittance, mut colour, mut last_z) = (1.0, DVec3::ZERO, 0.0);
        let mut nearest: f64 = f64::INFINITY;
        for e in ellipses {
            let d = centre - e.mean;
            let power = 0.5 * (e.conic[0] * d.x * d.x + e.conic[2] * d.y * d.y) + e.conic[1] * d.x * d.y;
            if power > 7.0 {
                continue; // exp(-7) is a quarter of ALPHA_MIN
            }
            let raw = e.opacity * (-power).exp();
            nearest = nearest.min((raw / alpha_min - 1.0).abs()).min((raw / alpha_max - 1.0).abs());
            if raw < alpha_min {
                continue;
            }
            let alpha = raw.min(alpha_max);
            let next = transmittance * (1.0 - alpha);
            nearest = nearest.min((next / stop - 1.0).abs()).min(10.0 * (e.z / last_z - 1.0)); // f32 depths are accurate to far less than this
            if next <= stop {
                break;
            }
            let weight = alpha * transmittance;
            colour += weight * e.colour;
            image.depth[pixel] += weight * e.z;
            image.weight[e.index] += weight;
            if e.index < self.trainable {
                image.trainable_alpha[pixel] += weight;
            }
            (transmittance, last_z) = (next, e.z);
        }
        colour += transmittance * DVec3::from_array(self.options.background.map(f64::from));
        let area = image.transmittance.len();
        for c in 0..3 {
            image.colour[c * area + pixel] = colour[c];
        }
        image.transmittance[pixel] = transmittance;
        image.margin[pixel] = nearest;
    }
}

impl Image {
    /// Distance of the whole image to the nearest threshold.
    pub(crate) fn nearest(&self) -> f64 {
        self.margin.iter().fold(self.splat_margin, |a, &b| a.min(b))
    }
}

/// The real spherical harmonic Y_lm, with the Condon-Shortley phase, of a unit vector: the Legendre polynomial's m-th
/// derivative along z times (x + iy)^m.
fn harmonic(l: i64, m: i64, d: DVec3) -> f64 {
    let order = m.unsigned_abs() as usize;
    let mut legendre: Vec<f64> = match l {
        0 => vec![1.0],
        1 => vec![0.0, 1.0],
        2 => vec![-0.5, 0.0, 1.5],
        _ => vec![0.0, -1.5, 0.0, 2.5],
    };
    let (mut re, mut im) = (1.0, 0.0);
    for _ in 0..order {
        legendre = legendre.iter().enumerate().skip(1).map(|(power, c)| power as f64 * c).collect();
        (re, im) = (re * d.x - im * d.y, re * d.y + im * d.x);
    }
    let along_z = legendre.iter().rev().fold(0.0, |sum, c| sum * d.z + c);
    let factorial = |n: i64| (1..=n).product::<i64>() as f64;
    let order = order as i64;
    let mut norm = (2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) * factorial(l - order) / factorial(l + order);
    if order > 0 {
        norm *= 2.0;
    }
    let phase = if order % 2 == 1 { -1.0 } else { 1.0 };
    phase * norm.sqrt() * along_z * if m < 0 { im } else { re }
}

/// Random numbers by SplitMix64, the same on every machine.
#[derive(Debug, Clone)]
pub(crate) struct Random(pub(crate) u64);

impl Random {
    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub(crate) fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * (self.bits() >> 40) as f32 / (1u64 << 24) as f32
    }

    pub(crate) fn plane(&mut self, len: usize) -> Vec<f32> {
        (0..len).map(|_| self.range(-1.0, 1.0)).collect()
    }

    /// A splat at a pixel and depth with about this size in pixels, with random rotation, stretch and colour.
    pub(crate) fn splat(&mut self, camera: &Camera, pixel: [f32; 2], z: f32, sigma_pixels: f32) -> Splat {
        let k = &camera.pinhole;
        let z = f64::from(z);
        let p = DVec3::new((f64::from(pixel[0]) - k.cx) / k.fx * z, (f64::from(pixel[1]) - k.cy) / k.fy * z, z);
        let size = (f64::from(sigma_pixels) * z / k.fx) as f32;
        let mut sh = [[0.0; 3]; 16];
        for (b, channels) in sh.iter_mut().enumerate() {
            let reach = if b == 0 { 1.5 } else { 0.4 };
            *channels = [(); 3].map(|()| self.range(-reach, reach));
        }
        Splat {
            mean: camera.camera_from_world.inverse().apply(p).as_vec3(),
            log_scale: glam::Vec3::from_array([(); 3].map(|()| size.ln() + self.range(-0.7, 0.7))),
            quat: [(); 4].map(|()| self.range(-1.0, 1.0)),
            opacity_logit: self.range(-1.0, 3.0),
            sh,
        }
    }
}

/// A rotated camera with an off-centre principal point and non-square pixels.
pub(crate) fn camera(width: u32, height: u32, focal: f64) -> Camera {
    Camera {
        pinhole: Pinhole {
            width,
            height,
            fx: focal,
            fy: focal * 1.1,
            cx: 0.47 * f64::from(width),
            cy: 0.56 * f64::from(height),
        },
        camera_from_world: Rigid {
            rotation: DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -0.9, 0.25),
            translation: DVec3::new(0.7, -0.4, 1.3),
        },
    }
}
