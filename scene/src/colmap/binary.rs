//! COLMAP's binary files: little endian, a count followed by the entries.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};

use super::model::{self, ColmapCamera, ColmapImage, ColmapPoints, MODELS, Reconstruction};
use crate::camera::CameraModel;
use crate::error::CodecError;

/// Reads `cameras.bin`.
///
/// # Errors
/// Truncated or padded files, unsupported lens models, parameters out of range.
pub fn read_cameras_bin(bytes: &[u8]) -> Result<BTreeMap<u32, ColmapCamera>, CodecError> {
    let mut from = Reader(bytes);
    let mut cameras = BTreeMap::new();
    for _ in 0..from.count(24)? {
        let (id, model, width, height) = (from.u32()?, from.u32()?, from.u64()?, from.u64()?);
        let unknown = format!("number {model}");
        let name = MODELS.get(model as usize).copied().unwrap_or(&unknown);
        let parameters = (0..model::parameter_count(name, id)?).map(|_| from.f64());
        let parameters = parameters.collect::<Result<Vec<_>, _>>()?;
        model::insert_camera(&mut cameras, id, model::camera(id, name, width, height, &parameters)?)?;
    }
    from.end(cameras)
}

/// Reads `images.bin`.
///
/// # Errors
/// Truncated or padded files, images without a name or a finite pose.
pub fn read_images_bin(bytes: &[u8]) -> Result<Vec<ColmapImage>, CodecError> {
    images(bytes, |_, _| ())
}

/// Reads the 2D observations of `images.bin`: by image id, pixel in the distorted image and point id.
///
/// # Errors
/// As [`read_images_bin`].
pub fn read_keypoints_bin(bytes: &[u8]) -> Result<BTreeMap<u32, Vec<(DVec2, u64)>>, CodecError> {
    let mut keypoints = BTreeMap::new();
    images(bytes, |image, observations| {
        let (observations, _) = observations.as_chunks::<24>();
        let keypoint = |bytes: &[u8; 24]| {
            let [x, y, point] = [0, 8, 16].map(|at| bytes[at..at + 8].try_into().expect("eight bytes"));
            (DVec2::new(f64::from_le_bytes(x), f64::from_le_bytes(y)), u64::from_le_bytes(point))
        };
        // Features without a point have the highest id.
        let observed = observations.iter().map(keypoint).filter(|&(_, point)| point != u64::MAX).collect();
        keypoints.insert(image, observed);
    })?;
    Ok(keypoints)
}

/// Reads images and passes each id with its observations (24 bytes each) to `observed`.
fn images<'a>(bytes: &'a [u8], mut observed: impl FnMut(u32, &'a [u8])) -> Result<Vec<ColmapImage>, CodecError> {
    let mut from = Reader(bytes);
    let mut images = Vec::new();
    for _ in 0..from.count(73)? {
        let id = from.u32()?;
        let mut pose = [0.0; 7];
        for value in &mut pose {
            *value = from.f64()?;
        }
        let camera_id = from.u32()?;
        let name = from.text()?;
        images.push(model::image(id, pose, camera_id, name)?);
        let observations = from.count(24)?;
        observed(id, from.take(24 * observations)?);
    }
    model::check_unique_ids(from.end(images)?)
}

/// Reads `points3D.bin`.
///
/// # Errors
/// Truncated or padded files, positions that are not finite.
pub fn read_points_bin(bytes: &[u8]) -> Result<ColmapPoints, CodecError> {
    let mut from = Reader(bytes);
    let mut points = ColmapPoints::default();
    for _ in 0..from.count(51)? {
        let id = from.u64()?;
        let position = DVec3::new(from.f64()?, from.f64()?, from.f64()?);
        let colour = from.array()?;
        from.f64()?; // the reprojection error
        let length = from.count(8)?;
        let track = from.take(8 * length)?.as_chunks::<8>().0.iter();
        points.push(id, position, colour, track.map(|&[a, b, c, d, ..]| u32::from_le_bytes([a, b, c, d])))?;
    }
    from.end(points)
}

/// Encodes `cameras.bin`.
pub fn write_cameras_bin(model: &Reconstruction) -> Vec<u8> {
    let mut to = Writer::counted(model.cameras.len());
    for (&id, camera) in &model.cameras {
        let (lens, parameters): (u32, &[f64]) = match &camera.model {
            CameraModel::SimplePinhole(p) => (0, p),
            CameraModel::Pinhole(p) => (1, p),
            CameraModel::SimpleRadial(p) => (2, p),
            CameraModel::Radial(p) => (3, p),
            CameraModel::OpenCv(p) => (4, p),
            CameraModel::OpenCvFisheye(p) => (5, p),
            CameraModel::FullOpenCv(p) => (6, p),
        };
        to.u32(id).u32(lens).u64(u64::from(camera.width)).u64(u64::from(camera.height)).f64s(parameters);
    }
    to.0
}

/// Encodes `images.bin`. Each image observes the points whose tracks contain it, in point order, at their projections.
pub fn write_images_bin(model: &Reconstruction) -> Vec<u8> {
    let index: BTreeMap<u32, usize> = model.images.iter().enumerate().map(|(i, image)| (image.id, i)).collect();
    let mut observed: Vec<Vec<usize>> = vec![Vec::new(); model.images.len()];
    for i in 0..model.points.len() {
        for image in model.points.track(i).iter().filter_map(|id| index.get(id)) {
            observed[*image].push(i);
        }
    }
    let mut to = Writer::counted(model.images.len());
    for (image, observed) in model.images.iter().zip(observed) {
        let pose = &image.camera_from_world;
        let q = pose.rotation;
        to.u32(image.id).f64s(&[q.w, q.x, q.y, q.z]).f64s(&pose.translation.to_array()).u32(image.camera_id);
        to.0.extend(image.name.bytes().filter(|&b| b != 0).chain([0]));
        to.u64(observed.len() as u64);
        for point in observed {
            let point_in_camera = pose.apply(model.points.positions[point]);
            let pixel = model.cameras.get(&image.camera_id).map_or(DVec2::ZERO, |camera| {
                let [fx, fy, cx, cy] = camera.model.focal_and_centre();
                camera.model.distort(point_in_camera.truncate() / point_in_camera.z) * DVec2::new(fx, fy)
                    + DVec2::new(cx, cy)
            });
            to.f64s(&pixel.to_array()).u64(model.points.ids[point]);
        }
    }
    to.0
}

/// Encodes `points3D.bin`, with tracks that refer to the observations of [`write_images_bin`].
pub fn write_points_bin(model: &Reconstruction) -> Vec<u8> {
    let points = &model.points;
    let mut observations: BTreeMap<u32, u32> = BTreeMap::new();
    let mut to = Writer::counted(points.len());
    for i in 0..points.len() {
        to.u64(points.ids[i]).f64s(&points.positions[i].to_array());
        to.0.extend(points.colours[i]);
        to.f64s(&[0.0]).u64(points.track(i).len() as u64);
        for &image in points.track(i) {
            let observation = observations.entry(image).or_default();
            to.u32(image).u32(*observation);
            *observation += 1;
        }
    }
    to.0
}

struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take(&mut self, length: usize) -> Result<&'a [u8], CodecError> {
        let (taken, rest) = self.0.split_at_checked(length).ok_or_else(|| CodecError::new("is cut short"))?;
        self.0 = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], CodecError> {
        Ok(self.take(N)?.try_into().expect("as many bytes as were taken"))
    }

    fn u32(&mut self) -> Result<u32, CodecError> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, CodecError> {
        self.array().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64, CodecError> {
        self.array().map(f64::from_le_bytes)
    }

    /// A count of entries of at least `size` bytes each, checked against the remaining bytes before anything is
    /// allocated.
    fn count(&mut self, size: usize) -> Result<usize, CodecError> {
        let count = self.u64()?;
        match usize::try_from(count) {
            Ok(count) if count <= self.0.len() / size => Ok(count),
            _ => Err(CodecError::new(format!("is cut short: {count} entries do not fit the file"))),
        }
    }

    /// Zero-terminated UTF-8.
    fn text(&mut self) -> Result<&'a str, CodecError> {
        let length = self.0.iter().position(|&b| b == 0).ok_or_else(|| CodecError::new("is cut short in a name"))?;
        let text = self.take(length + 1)?;
        std::str::from_utf8(&text[..length]).map_err(|_| CodecError::new("has an image name that is not UTF-8"))
    }

    fn end<T>(self, value: T) -> Result<T, CodecError> {
        match self.0.len() {
            0 => Ok(value),
            extra => Err(CodecError::new(format!("has {extra} extra bytes at its end"))),
        }
    }
}

struct Writer(Vec<u8>);

impl Writer {
    fn counted(count: usize) -> Self {
        Self((count as u64).to_le_bytes().to_vec())
    }

    fn u32(&mut self, value: u32) -> &mut Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u64(&mut self, value: u64) -> &mut Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn f64s(&mut self, values: &[f64]) -> &mut Self {
        self.0.extend(values.iter().flat_map(|v| v.to_le_bytes()));
        self
    }
}
