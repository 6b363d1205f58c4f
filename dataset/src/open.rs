//! Opens a capture of any supported format: validates its files, finds its photos, reads their headers and replaces their lenses
//! by ideal pinholes. No pixel is decoded.
//!
//! A capture without sparse points gets points sampled from the overlap of its views ([`frustum_points`]), from which training
//! can start.
//!
//! Files are opened only inside the capture's folder: a path that leads out of it, by `..` or by a symbolic link, is refused.
//! Missing photos are skipped and reported, because captures are often shared without all of them.

mod annotated_boxes;
mod colmap;
mod depths;
mod dgp;
mod files;
mod frustum_points;
mod kitti;
mod kitti360;
mod kitti_raw;
mod label_maps;
mod masks;
mod nuscenes;
mod opensfm;
mod parsed;
mod sweeps;
mod tracks;
mod transforms;
mod truth;
mod waymo;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::DVec3;
use rayon::prelude::*;
use scene::transforms::{Focal, Intrinsics};
use scene::{BadInput, Camera, CameraModel, Capture, GeoOrigin, Pinhole, View};

use self::files::{CaptureRoot, Found};
pub(crate) use self::label_maps::LabelMapFiles;
pub use self::parsed::{LabelledBox, OpenOptions};
use self::parsed::{ParsedCapture, PosedImage};
pub(crate) use self::truth::{truth_boxes, truth_folder, truth_instances};
use crate::depth_maps::DepthFile;
use crate::lidar::seeds::{Seeds, seeds};
use crate::lidar::{Scan, Sweep};
use crate::radar::{self, RoadStrip};
use crate::undistortion;

/// The file behind a view.
#[derive(Debug, Clone, PartialEq)]
pub struct Photo {
    /// Canonical path of the image file, inside the capture.
    pub path: PathBuf,
    /// If the file is a table of photos, the row of this one.
    pub row: Option<u64>,
    /// Canonical path of the mask, of the photo's size: bright pixels are usable, dark ones excluded.
    pub mask: Option<PathBuf>,
    /// The lens, in pixels of this file.
    pub model: CameraModel,
    /// Width of the file in pixels.
    pub width: u32,
    /// Height of the file in pixels.
    pub height: u32,
    /// Its depth map, if it has one that is used.
    pub depth: Option<DepthFile>,
    /// The annotated objects that it may show. Those that move are left out like masked pixels.
    pub boxes: Vec<LabelledBox>,
}

impl Photo {
    /// The boxes of the objects that move: corners in the camera's axes.
    pub fn moving(&self) -> Vec<[DVec3; 8]> {
        self.boxes.iter().filter(|of| of.moves).map(|of| of.corners).collect()
    }

    /// Its file, and its row if it is in a table, for messages.
    pub(crate) fn shown(&self) -> String {
        let file = files::show(&self.path);
        self.row.map_or_else(|| file.clone(), |row| format!("{file} (row {row})"))
    }
}

/// An opened capture: everything but the pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Source {
    /// Views sorted by name, with ideal pinhole cameras and without mips.
    pub capture: Capture,
    /// One per view.
    pub photos: Vec<Photo>,
    /// Names of the capture's images that are not used, with the reason.
    pub left_out: Vec<(String, String)>,
    /// `colmap`, `transforms`, `opensfm`, `dgp`, `nuscenes`, `kitti`, `kitti360`, `kitti-raw` or `waymo`, followed by ` without points` if its points were
    /// sampled from the overlap of its views.
    pub format: &'static str,
    /// Lidar sweeps. The last [`seeds`](Self::seeds) points of the capture come from them.
    pub sweeps: Vec<Sweep>,
    /// The road that a car with a radar drove over. Points of the capture come from it, as from lidar.
    pub road: Vec<RoadStrip>,
    /// For each of the points that come from lidar and radar, the view that colours it.
    pub seeds: Vec<u32>,
    /// Number of annotated boxes by class.
    pub labels: BTreeMap<String, usize>,
}

impl Source {
    /// Uses all pixels of all photos: forgets masks, and that labelled objects move.
    pub fn unmask(&mut self) {
        for (view, photo) in self.capture.views.iter_mut().zip(&mut self.photos) {
            photo.mask = None;
            photo.boxes.iter_mut().for_each(|of| of.moves = false);
            view.masked = false;
        }
    }

    /// Whether its views have target depths from lidar, radar or depth maps.
    pub fn is_measured(&self) -> bool {
        self.depth_maps() > 0 || self.roads() > 0 || self.sweeps.iter().any(|sweep| !sweep.views.is_empty())
    }

    /// The number of radar sweeps after which there is a road, to the next one.
    pub fn roads(&self) -> usize {
        self.road.iter().filter(|strip| !strip.is_empty()).count()
    }

    /// The number of photos with a depth map.
    pub fn depth_maps(&self) -> usize {
        self.photos.iter().filter(|photo| photo.depth.is_some()).count()
    }
}

/// Opens a capture: a folder, the path of a `transforms.json` or `reconstruction.json`, or `FOLDER/NAME` for a scene of
/// nuScenes or a segment of Waymo.
///
/// # Errors
/// The invalid file, its defect, and advice.
pub fn open(path: &Path, options: &OpenOptions) -> Result<Source, BadInput> {
    let (named, segment) = (nuscenes::named_scene(path), waymo::named_segment(path));
    let root = CaptureRoot::new(named.or(segment).map_or(path, |(folder, _)| folder))?;
    let ParsedCapture { mut format, images, points, origin, left_out: unused, sweeps, labels, objects, root: other } =
        match (named, segment) {
            (Some((_, scene)), _) => nuscenes::read(&root, Some(scene), options)?,
            (None, Some((_, segment))) => waymo::read(&root, Some(segment), options)?,
            (None, None) => parse(&root, path, options)?,
        };
    let root = other.unwrap_or(root);
    let (images, photos, mut left_out) = find_photos(&root, images, options)?;
    left_out.extend(unused);
    let mut views = views(&images, &photos)?;
    let mut objects = objects;
    if let Some(found) = tracks::find(&root)? {
        views.iter_mut().for_each(|view| view.seconds = tracks::seconds(&found, &view.name).or(view.seconds));
        objects = found.objects;
    }
    let mut points = points.with_view_indices(images.iter().map(|image| image.id));
    let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
    let sweeps = match sweeps {
        _ if !options.lidar => Vec::new(),
        none if none.is_empty() => sweeps::of_lidar(&root, &views)?,
        parsed => sweeps::with_views(parsed, &images),
    };
    let road = if options.radar { radar::road::strips(sweeps::of_radar(&root, &views)?, &points)? } else { Vec::new() };
    let of_lidar = sweeps.iter().map(|sweep| sweep as &dyn Scan);
    let scans: Vec<&dyn Scan> = of_lidar.chain(road.iter().map(|strip| strip as &dyn Scan)).collect();
    let Seeds { points: measured, best_view: seeds } = seeds(&scans, &cameras, points.len())?;
    points.append(measured);
    if points.is_empty() && !options.cameras_only {
        points = frustum_points::sample(&cameras).ok_or_else(|| {
            let advice = "run structure from motion that writes points, as training starts from them";
            BadInput::new(files::show(path), "has no sparse points, and its views do not overlap", advice)
        })?;
        format = match format {
            "colmap" => "colmap without points",
            "transforms" => "transforms without points",
            "opensfm" => "opensfm without points",
            "dgp" => "dgp without points",
            "nuscenes" => "nuscenes without points",
            "kitti" => "kitti without points",
            "kitti-raw" => "kitti-raw without points",
            "waymo" => "waymo without points",
            _ => "kitti360 without points",
        };
    }
    let capture = Capture { views, points, geo_origin: geo_origin(&root)?.or(origin), objects };
    Ok(Source { capture, photos, left_out, format, sweeps, road, seeds, labels })
}

/// Detects the format of a capture and parses it.
fn parse(root: &CaptureRoot, path: &Path, options: &OpenOptions) -> Result<ParsedCapture, BadInput> {
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
    if let Some(scene) = dgp::find(root) {
        return dgp::read(root, &scene, options);
    }
    if nuscenes::is_present(root) {
        return nuscenes::read(root, None, options);
    }
    if let Some(sequence) = kitti::find(root)? {
        return kitti::read(root, &sequence, options);
    }
    if kitti360::is_present(root) {
        return kitti360::read(root, options);
    }
    if let Some(drive) = kitti_raw::find(root)? {
        return kitti_raw::read(drive, options);
    }
    if waymo::is_present(root) {
        return waymo::read(root, None, options);
    }
    if let Some(folder) = colmap::find(root, &["colmap/sparse/0"]) {
        return colmap::read(root, &folder, options);
    }
    if files::has_photos(root) {
        let problem = "has photos but no camera poses";
        let advice = "make them with COLMAP or pycolmap, which write sparse/0; the chapter Captures of plat's book has the commands";
        return Err(BadInput::new(files::show(path), problem, advice));
    }
    let problem = "has neither a COLMAP model in sparse/0 nor a transforms.json, a reconstruction.json, or the files of DGP, \
                   nuScenes, KITTI, KITTI-360, KITTI raw or Waymo";
    Err(BadInput::new(files::show(path), problem, "give a folder that has one of them"))
}

/// Images, their photos, and the images left out with the reason.
type Photos = (Vec<PosedImage>, Vec<Photo>, Vec<(String, String)>);

/// Finds the photos of images. Images are sorted by name.
fn find_photos(root: &CaptureRoot, mut images: Vec<PosedImage>, options: &OpenOptions) -> Result<Photos, BadInput> {
    images.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = images.windows(2).find(|pair| pair[0].name == pair[1].name) {
        let advice = "remove one of them from the capture";
        return Err(BadInput::new(format!("image {}", pair[0].name), "is in the capture twice", advice));
    }
    let masks = masks::folders(root);
    let maps = options.depths.as_ref().map(|options| depths::Maps::new(root, options)).transpose()?;
    // All results first, then the first error by name, whichever thread is faster.
    let photos: Vec<_> = images.par_iter().map(|image| photo(root, image, &masks, maps.as_ref(), options)).collect();
    let (mut kept, mut found, mut left_out) = (Vec::new(), Vec::new(), Vec::new());
    for (image, photo) in images.into_iter().zip(photos) {
        match photo? {
            Some(photo) => {
                kept.push(image);
                found.push(photo);
            }
            None => left_out.push((image.name, format!("there is no file {}", image.file))),
        }
    }
    match left_out.first() {
        Some((_, reason)) if kept.is_empty() => {
            let problem = format!("has none of its {} images: {reason}", left_out.len());
            Err(BadInput::new(root.to_string(), problem, "put the photos there"))
        }
        _ => {
            let count = found.iter().filter(|photo: &&Photo| photo.depth.is_some()).count();
            maps.map_or(Ok(()), |maps| maps.check(count, &kept))?;
            Ok((kept, found, left_out))
        }
    }
}

/// The photo of an image, `None` if its file is missing.
fn photo(
    root: &CaptureRoot,
    image: &PosedImage,
    masks: &[&str],
    maps: Option<&depths::Maps>,
    options: &OpenOptions,
) -> Result<Option<Photo>, BadInput> {
    let path = match root.image(&image.file)? {
        Found::File(path) => path,
        Found::Missing => {
            let Some((width, height)) = image.intrinsics.size.filter(|_| options.cameras_only) else { return Ok(None) };
            files::check_size(&root.path(&image.file), width, height)?;
            let model = image.intrinsics.model(width, height);
            return Ok(Some(Photo {
                path: root.path(&image.file),
                row: None,
                mask: None,
                model,
                width,
                height,
                depth: None,
                boxes: Vec::new(),
            }));
        }
    };
    let (width, height) = match (image.row, image.intrinsics.size) {
        // Its calibration gives the size, so that no photo of the table is read.
        (Some(_), Some((width, height))) => files::check_size(&path, width, height).map(|()| (width, height))?,
        _ => files::image_size(&path)?,
    };
    let model = scaled_model(&image.intrinsics, width, height).ok_or_else(|| {
        let (w, h) = image.intrinsics.size.unwrap_or_default();
        let problem = format!("has {width}×{height} pixels, its camera {w}×{h}, which is another shape");
        BadInput::new(files::show(&path), problem, "use the photos that the poses were computed from")
    })?;
    let mask = match &image.mask {
        Some(mask) => match root.image(mask)? {
            Found::File(path) => Some(path),
            Found::Missing => {
                let problem = format!("has no mask {mask}, which the capture names");
                return Err(BadInput::new(files::show(&path), problem, "put the mask there or take it out"));
            }
        },
        None if image.row.is_some() => masks::find(root, masks, &image.name, Path::new(&image.name), options),
        None => masks::find(root, masks, &image.file, &path, options),
    };
    let depth = maps.map(|maps| maps.find(root, image)).transpose()?.flatten();
    Ok(Some(Photo { path, row: image.row, mask, model, width, height, depth, boxes: image.boxes.clone() }))
}

/// The lens in pixels of a photo of this size. The photo may be a uniformly scaled copy of the camera's image; `None` for another
/// aspect ratio.
fn scaled_model(intrinsics: &Intrinsics, width: u32, height: u32) -> Option<CameraModel> {
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

fn views(images: &[PosedImage], photos: &[Photo]) -> Result<Vec<View>, BadInput> {
    let mut pinholes: BTreeMap<([u64; 12], bool, u32, u32), Option<Pinhole>> = BTreeMap::new();
    let view = |(image, photo): (&PosedImage, &Photo)| {
        let mut key = [0; 12];
        let parameters = photo.model.focal_and_centre().into_iter().chain(photo.model.distortion());
        key.iter_mut().zip(parameters).for_each(|(key, parameter)| *key = parameter.to_bits());
        let pinhole = *pinholes
            .entry((key, photo.model.is_fisheye(), photo.width, photo.height))
            .or_insert_with(|| undistortion::ideal_pinhole(&photo.model, photo.width, photo.height));
        let pinhole = pinhole.ok_or_else(|| {
            let problem = "was taken with a lens whose distortion cannot be inverted inside the photo";
            BadInput::new(photo.shown(), problem, "check the parameters of its camera")
        })?;
        let camera = Camera { pinhole, camera_from_world: image.camera_from_world };
        Ok(View {
            name: image.name.clone(),
            camera,
            mips: Vec::new(),
            masked: photo.mask.is_some() || photo.boxes.iter().any(|of| of.moves),
            depth: None,
            seconds: image.seconds,
        })
    };
    images.iter().zip(photos).map(view).collect()
}

/// The largest JSON file that may give a capture's origin.
const MAX_ORIGIN_FILE_BYTES: u64 = 1 << 20;

/// The origin from OpenSfM's `reference_lla.json`, or the `gps_origin_lat_lon_alt` of an `info.json`.
fn geo_origin(root: &CaptureRoot) -> Result<Option<GeoOrigin>, BadInput> {
    let json = |name: &str| -> Result<Option<(String, serde_json::Value)>, BadInput> {
        let Some(path) = root.file(name) else { return Ok(None) };
        // Parsed JSON values take many times the file's length in memory.
        if path.metadata().is_ok_and(|data| data.len() > MAX_ORIGIN_FILE_BYTES) {
            let problem = format!("is larger than {} MB, the limit for such a file", MAX_ORIGIN_FILE_BYTES >> 20);
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
    let origin = match origin {
        [Some(latitude_degrees), Some(longitude_degrees), Some(altitude_metres)] => {
            Some(GeoOrigin { latitude_degrees, longitude_degrees, altitude_metres }).filter(GeoOrigin::is_sane)
        }
        _ => None,
    };
    match origin {
        Some(origin) => Ok(Some(origin)),
        None => {
            Err(BadInput::new(file, "has no latitude, longitude and altitude in range", "correct or remove the file"))
        }
    }
}

#[cfg(test)]
pub(crate) mod tests;
