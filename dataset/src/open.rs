//! Opens a capture of any known format: what it says is checked, photos are found and their headers read, lenses become
//! ideal pinholes. No pixel is decoded.
//!
//! A capture without sparse points gets some where its views overlap ([`frusta`]), as training has to start somewhere.
//!
//! What a capture names is looked for inside its own folder only: a path that leads out, by `..` or by a link, is
//! refused. Photos that are missing are left out and reported, as captures often travel without all of them.

mod colmap;
mod files;
mod frusta;
mod kitti360;
mod masks;
mod opensfm;
mod transforms;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use scene::transforms::{Focal, Intrinsics};
use scene::{BadInput, Camera, CameraModel, Capture, GeoOrigin, Pinhole, Rigid, SparsePoints, View};

use self::files::{Found, Root};
use crate::lens;

/// How to open a capture.
#[derive(Debug, Clone, Default)]
pub struct OpenOptions {
    /// Folder of the photos, relative to the capture; `None` finds it.
    pub images: Option<String>,
    /// Only cameras are wanted: neither photos nor points need to be there.
    pub cameras_only: bool,
}

/// The file behind a view.
#[derive(Debug, Clone, PartialEq)]
pub struct Photo {
    /// Canonical path of the image file, inside the capture.
    pub path: PathBuf,
    /// Canonical path of the mask, as large as the photo: bright is usable, dark is left out.
    pub mask: Option<PathBuf>,
    /// The lens, in pixels of this file.
    pub model: CameraModel,
    /// Width of the file in pixels.
    pub width: u32,
    /// Height of the file in pixels.
    pub height: u32,
}

/// An opened capture: everything but the pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Source {
    /// Views sorted by name, with ideal pinhole cameras and without mips.
    pub capture: Capture,
    /// One per view.
    pub photos: Vec<Photo>,
    /// Images that the capture names and that are not used, and why.
    pub left_out: Vec<(String, String)>,
    /// What the capture was: `colmap`, `transforms`, `opensfm` or `kitti360`, and ` without points` if its points were
    /// made from the overlap of its views.
    pub format: &'static str,
}

/// Opens a capture: a folder, or the path of a `transforms.json` or `reconstruction.json`.
///
/// # Errors
/// What is wrong with which file, and what to do.
pub fn open(path: &Path, options: &OpenOptions) -> Result<Source, BadInput> {
    let root = Root::new(path)?;
    let Contents { mut format, posed, points, origin, left_out: unused } = read(&root, path, options)?;
    let (posed, photos, mut left_out) = find_photos(&root, posed, options)?;
    left_out.extend(unused);
    let views = views(&posed, &photos)?;
    let mut points = points.with_views(posed.iter().map(|posed| posed.id));
    if points.is_empty() && !options.cameras_only {
        let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
        points = frusta::points(&cameras).ok_or_else(|| {
            let advice = "run structure from motion that writes points, as training starts from them";
            BadInput::new(files::show(path), "has no sparse points, and its views do not overlap", advice)
        })?;
        format = match format {
            "colmap" => "colmap without points",
            "transforms" => "transforms without points",
            "opensfm" => "opensfm without points",
            _ => "kitti360 without points",
        };
    }
    let capture = Capture { views, points, geo_origin: geo_origin(&root)?.or(origin) };
    Ok(Source { capture, photos, left_out, format })
}

/// What the files of a capture say, before its photos were looked for.
struct Contents {
    format: &'static str,
    posed: Vec<Posed>,
    points: Points,
    origin: Option<GeoOrigin>,
    /// Images that are not used, and why.
    left_out: Vec<(String, String)>,
}

/// Finds out what the capture is, and reads it.
fn read(root: &Root, path: &Path, options: &OpenOptions) -> Result<Contents, BadInput> {
    if path.is_file() {
        return match path.file_name() {
            Some(name) if name == opensfm::FILE => opensfm::read(root, path),
            _ => transforms::read(root, &[path.to_path_buf()]),
        };
    }
    if let Some(folder) = colmap::find(root, &["sparse/0", "sparse", "."]) {
        return colmap::read(root, &folder, options);
    }
    let transforms = transforms::find(root);
    if !transforms.is_empty() {
        return transforms::read(root, &transforms);
    }
    if let Some(path) = opensfm::find(root) {
        return opensfm::read(root, &path);
    }
    if kitti360::is_there(root) {
        return kitti360::read(root, options);
    }
    if let Some(folder) = colmap::find(root, &["colmap/sparse/0"]) {
        return colmap::read(root, &folder, options);
    }
    let problem =
        "has neither a COLMAP model in sparse/0 nor a transforms.json, reconstruction.json or KITTI-360's data_poses";
    Err(BadInput::new(files::show(path), problem, "give a folder that has one of them"))
}

/// An image as the capture describes it.
struct Posed {
    id: u32,
    name: String,
    /// Where the image file is, relative to the capture.
    file: String,
    /// Where its mask has to be, if the capture says so.
    mask: Option<String>,
    intrinsics: Intrinsics,
    camera_from_world: Rigid,
}

/// Sparse points whose tracks are ids of [`Posed`] images.
#[derive(Default)]
struct Points(SparsePoints);

impl Points {
    /// Tracks of ids become sorted tracks of indices; views that were left out drop from them.
    fn with_views(self, ids: impl Iterator<Item = u32>) -> SparsePoints {
        let index: BTreeMap<u32, u32> = ids.zip(0..).collect();
        let mut points = SparsePoints { track_start: vec![0], seen_by: Vec::new(), ..self.0 };
        let tracks = SparsePoints { track_start: self.0.track_start, seen_by: self.0.seen_by, ..Default::default() };
        for i in 0..points.len() {
            let ids = tracks.track(i).unwrap_or_default();
            let mut track: Vec<u32> = ids.iter().filter_map(|id| index.get(id).copied()).collect();
            track.sort_unstable();
            track.dedup();
            points.seen_by.extend(track);
            points.track_start.push(points.seen_by.len() as u32);
        }
        if points.seen_by.is_empty() {
            points.track_start.clear();
        }
        points
    }
}

type Photos = (Vec<Posed>, Vec<Photo>, Vec<(String, String)>);

/// The images whose files are there, sorted by name.
fn find_photos(root: &Root, mut posed: Vec<Posed>, options: &OpenOptions) -> Result<Photos, BadInput> {
    posed.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = posed.windows(2).find(|pair| pair[0].name == pair[1].name) {
        let advice = "remove one of them from the capture";
        return Err(BadInput::new(format!("image {}", pair[0].name), "is named twice by the capture", advice));
    }
    let masks = masks::folders(root);
    // All answers first, then the first error by name, whichever thread is faster.
    let photos: Vec<_> = posed.par_iter().map(|posed| photo(root, posed, &masks, options)).collect();
    let (mut kept, mut found, mut left_out) = (Vec::new(), Vec::new(), Vec::new());
    for (posed, photo) in posed.into_iter().zip(photos) {
        match photo? {
            Some(photo) => {
                kept.push(posed);
                found.push(photo);
            }
            None => left_out.push((posed.name, format!("there is no file {}", posed.file))),
        }
    }
    match left_out.first() {
        Some((_, reason)) if kept.is_empty() => {
            let problem = format!("has none of its {} images: {reason}", left_out.len());
            Err(BadInput::new(root.to_string(), problem, "put the photos there"))
        }
        _ => Ok((kept, found, left_out)),
    }
}

/// The photo of an image, `None` where its file is missing.
fn photo(root: &Root, posed: &Posed, masks: &[&str], options: &OpenOptions) -> Result<Option<Photo>, BadInput> {
    let path = match root.image(&posed.file)? {
        Found::File(path) => path,
        Found::Missing => {
            let Some((width, height)) = posed.intrinsics.size.filter(|_| options.cameras_only) else { return Ok(None) };
            files::check_size(&root.path(&posed.file), width, height)?;
            let model = posed.intrinsics.model(width, height);
            return Ok(Some(Photo { path: root.path(&posed.file), mask: None, model, width, height }));
        }
    };
    let (width, height) = files::image_size(&path)?;
    let model = fitted(&posed.intrinsics, width, height).ok_or_else(|| {
        let (w, h) = posed.intrinsics.size.unwrap_or_default();
        let problem = format!("has {width}×{height} pixels, its camera {w}×{h}, which is another shape");
        BadInput::new(files::show(&path), problem, "use the photos that the poses were computed from")
    })?;
    let mask = match &posed.mask {
        Some(mask) => match root.image(mask)? {
            Found::File(path) => Some(path),
            Found::Missing => {
                let problem = format!("has no mask {mask}, which the capture names");
                return Err(BadInput::new(files::show(&path), problem, "put the mask there or take it out"));
            }
        },
        None => masks::find(root, masks, &posed.file, &path, options),
    };
    Ok(Some(Photo { path, mask, model, width, height }))
}

/// The lens in pixels of a photo of this size, which may be the camera's image uniformly scaled; `None` if it is not.
fn fitted(intrinsics: &Intrinsics, width: u32, height: u32) -> Option<CameraModel> {
    let (w, h) = intrinsics.size.unwrap_or((width, height));
    let model = intrinsics.model(w, h);
    if (w, h) == (width, height) {
        return Some(model);
    }
    let (x, y) = (f64::from(width) / f64::from(w), f64::from(height) / f64::from(h));
    if (f64::from(h) * x - f64::from(height)).abs() > 1.0 && (f64::from(w) * y - f64::from(width)).abs() > 1.0 {
        return None;
    }
    let [fx, fy, cx, cy] = model.focal_and_centre();
    let scaled = Intrinsics {
        size: Some((width, height)),
        focal: [Some(Focal::Pixels(fx * x)), Some(Focal::Pixels(fy * y))],
        centre: [Some(cx * x), Some(cy * y)],
        distortion: model.distortion(),
        fisheye: model.is_fisheye(),
    };
    Some(scaled.model(width, height))
}

fn views(posed: &[Posed], photos: &[Photo]) -> Result<Vec<View>, BadInput> {
    let mut known: BTreeMap<([u64; 12], bool, u32, u32), Option<Pinhole>> = BTreeMap::new();
    let view = |(posed, photo): (&Posed, &Photo)| {
        let mut key = [0; 12];
        let parameters = photo.model.focal_and_centre().into_iter().chain(photo.model.distortion());
        key.iter_mut().zip(parameters).for_each(|(key, parameter)| *key = parameter.to_bits());
        let pinhole = *known
            .entry((key, photo.model.is_fisheye(), photo.width, photo.height))
            .or_insert_with(|| lens::ideal_pinhole(&photo.model, photo.width, photo.height));
        let pinhole = pinhole.ok_or_else(|| {
            let problem = "was taken with a lens whose distortion cannot be undone inside the photo";
            BadInput::new(files::show(&photo.path), problem, "check the parameters of its camera")
        })?;
        let camera = Camera { pinhole, camera_from_world: posed.camera_from_world };
        Ok(View { name: posed.name.clone(), camera, mips: Vec::new(), masked: photo.mask.is_some() })
    };
    posed.iter().zip(photos).map(view).collect()
}

/// The largest file that says where a capture lies.
const INFO_BYTES: u64 = 1 << 20;

/// From OpenSfM's `reference_lla.json`, or the `gps_origin_lat_lon_alt` of an `info.json`.
fn geo_origin(root: &Root) -> Result<Option<GeoOrigin>, BadInput> {
    let json = |name: &str| -> Result<Option<(String, serde_json::Value)>, BadInput> {
        let Some(path) = root.file(name) else { return Ok(None) };
        // As values, JSON takes many times its length.
        if path.metadata().is_ok_and(|data| data.len() > INFO_BYTES) {
            let problem = format!("is larger than {} MB, which no such file is", INFO_BYTES >> 20);
            return Err(BadInput::new(files::show(&path), problem, "correct or remove the file"));
        }
        Ok(serde_json::from_slice(&files::read(&path)?).ok().map(|value| (files::show(&path), value)))
    };
    let reference = match json("reference_lla.json")? {
        None => json("opensfm/reference_lla.json")?,
        found => found,
    };
    let (file, origin) = if let Some((file, value)) = reference {
        (file, ["latitude", "longitude", "altitude"].map(|key| value[key].as_f64()))
    } else if let Some((file, value)) = json("info.json")? {
        let key = "gps_origin_lat_lon_alt";
        let origin = [&value[key], &value["numbers"][key]].into_iter().find(|origin| !origin.is_null());
        let Some(origin) = origin else { return Ok(None) };
        (file, [0, 1, 2].map(|i| origin[i].as_f64()))
    } else {
        return Ok(None);
    };
    match origin {
        [Some(latitude_degrees), Some(longitude_degrees), Some(altitude_metres)]
            if latitude_degrees.abs() <= 90.0 && longitude_degrees.abs() <= 360.0 && altitude_metres.abs() < 1e6 =>
        {
            Ok(Some(GeoOrigin { latitude_degrees, longitude_degrees, altitude_metres }))
        }
        _ => Err(BadInput::new(file, "has no latitude, longitude and altitude in range", "correct or remove the file")),
    }
}

#[cfg(test)]
mod tests;
