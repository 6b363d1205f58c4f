use std::path::Path;

use city::{CitySettings, Traffic};
use glam::DVec3;
use image::{GrayImage, RgbImage};

use super::*;

mod drives;
mod formats;
mod kitti_raw;
mod nuscenes;
mod reprojection;
mod waymo;

use crate::synth::{self, Settings};

fn city() -> tempfile::TempDir {
    city_of(24)
}

fn city_of(views: u32) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    // Nothing moves, so that photos have no masks.
    let city = CitySettings { traffic: Traffic::None, ..CitySettings::default() };
    let settings = Settings { city, views, width: 48, height: 32, ..Settings::default() };
    synth::write(folder.path(), &settings, &|_, _, _| ()).unwrap();
    folder
}

fn opened(path: &Path) -> Result<Source, BadInput> {
    open(path, &OpenOptions::default())
}

fn refused(path: &Path, words: &[&str]) {
    let error = opened(path).unwrap_err().to_string();
    assert!(words.iter().all(|word| error.contains(word)) && !error.contains('\n'), "{error}");
}

/// Share of the entries of tracks whose point lies in front of the camera and inside the image.
fn tracked_inside(capture: &Capture) -> f64 {
    let (mut inside, mut all) = (0.0, 0.0);
    for i in 0..capture.points.len() {
        for &view in capture.points.track(i).unwrap_or_default() {
            let camera = &capture.views[view as usize].camera;
            let (pixel, depth) = camera.project(capture.points.positions[i]);
            let (w, h) = (f64::from(camera.pinhole.width), f64::from(camera.pinhole.height));
            let hit = depth > 0.0 && (0.0..w).contains(&pixel.x) && (0.0..h).contains(&pixel.y);
            inside += f64::from(u8::from(hit));
            all += 1.0;
        }
    }
    inside / all
}

#[test]
fn a_synthetic_city_is_opened() {
    let folder = city();
    let source = opened(folder.path()).unwrap();
    assert_eq!((source.format, source.capture.views.len(), source.photos.len()), ("colmap", 24, 24));
    assert!(source.capture.views.is_sorted_by(|a, b| a.name < b.name) && source.left_out.is_empty());
    assert!(tracked_inside(&source.capture) > 0.99);
    let points = &source.capture.points;
    assert!(points.len() > 100 && points.track_start.len() == points.len() + 1);
    assert_eq!(
        opened(&folder.path().join("nothing")).unwrap_err().subject,
        folder.path().join("nothing").display().to_string()
    );
}

#[test]
fn missing_photos_are_left_out_of_views_and_tracks() {
    let folder = city();
    let whole = opened(folder.path()).unwrap();
    let gone = whole.capture.views[5].name.clone();
    std::fs::remove_file(&whole.photos[5].path).unwrap();
    let source = opened(folder.path()).unwrap();
    assert_eq!(source.capture.views.len(), 23);
    assert!(source.left_out.len() == 1 && source.left_out[0].0 == gone);
    assert!(tracked_inside(&source.capture) > 0.99);
    std::fs::remove_dir_all(folder.path().join("images")).unwrap();
    refused(folder.path(), &["none of its 24 images", &whole.capture.views[0].name]);
    let cameras = open(folder.path(), &OpenOptions { cameras_only: true, ..Default::default() }).unwrap();
    assert_eq!(cameras.capture.views, whole.capture.views);
}

#[test]
fn scaled_photos_scale_their_cameras_and_other_aspect_ratios_are_refused() {
    let folder = city();
    let before = opened(folder.path()).unwrap();
    let path = &before.photos[2].path;
    RgbImage::new(24, 16).save(path).unwrap();
    let half = opened(folder.path()).unwrap().capture.views[2].camera.pinhole;
    let whole = before.capture.views[2].camera.pinhole;
    assert!((half.fx * 2.0 - whole.fx).abs() < 1e-12 && half.cy * 2.0 == whole.cy && half.width == 24);
    RgbImage::new(32, 48).save(path).unwrap();
    refused(folder.path(), &["32×48", "48×32", &before.capture.views[2].name]);
    std::fs::write(path, b"no image").unwrap();
    refused(folder.path(), &["not an image", &before.capture.views[2].name]);
}

#[test]
fn masks_beside_the_images_are_found() {
    let folder = city();
    let names: Vec<String> = opened(folder.path()).unwrap().capture.views.into_iter().map(|view| view.name).collect();
    let masks = folder.path().join("masks");
    std::fs::create_dir(&masks).unwrap();
    GrayImage::new(48, 32).save(masks.join(format!("{}.png", names[0]))).unwrap();
    GrayImage::new(48, 32).save(masks.join(&names[1])).unwrap();
    let source = opened(folder.path()).unwrap();
    let masked: Vec<bool> = source.photos.iter().map(|photo| photo.mask.is_some()).collect();
    assert!(masked[..3] == [true, true, false] && source.capture.views[0].masked);
}

#[test]
fn the_origin_comes_from_either_file() {
    let folder = city();
    std::fs::remove_file(folder.path().join("reference_lla.json")).unwrap();
    let origin = |name: &str, text: &str| {
        std::fs::write(folder.path().join(name), text).unwrap();
        opened(folder.path()).map(|source| source.capture.geo_origin)
    };
    assert_eq!(origin("info.json", "{}").unwrap(), None);
    let nested = origin("info.json", r#"{"numbers": {"gps_origin_lat_lon_alt": [1, 2.5, 3]}}"#).unwrap().unwrap();
    assert_eq!((nested.latitude_degrees, nested.longitude_degrees, nested.altitude_metres), (1.0, 2.5, 3.0));
    let text = r#"{"latitude": 48.1, "longitude": 11.5, "altitude": 500}"#;
    assert_eq!(origin("reference_lla.json", text).unwrap().unwrap().latitude_degrees, 48.1);
    assert!(origin("reference_lla.json", r#"{"latitude": 91, "longitude": 0, "altitude": 0}"#).is_err());
}

/// A folder with a transforms.json of these frames, one photo and two points.
fn transforms(frames: &[&str]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let matrix = r#""transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"#;
    let frames: Vec<String> = frames.iter().map(|frame| format!("{{{frame}, {matrix}}}")).collect();
    let text = format!(r#"{{"fl_x": 20, "w": 48, "h": 32, "frames": [{}]}}"#, frames.join(","));
    std::fs::create_dir(folder.path().join("images")).unwrap();
    RgbImage::new(48, 32).save(folder.path().join("images/a.png")).unwrap();
    std::fs::write(folder.path().join("transforms.json"), text).unwrap();
    let ply = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
               property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0 0 -3 1 2 3\n1 0 -3 4 5 6\n";
    std::fs::write(folder.path().join("sparse_pc.ply"), ply).unwrap();
    folder
}

#[test]
fn transforms_are_opened_by_folder_or_file() {
    let folder = transforms(&[r#""file_path": "./images/a""#, r#""file_path": "images/b.png""#]);
    let source = opened(folder.path()).unwrap();
    assert_eq!(source, opened(&folder.path().join("transforms.json")).unwrap());
    assert_eq!((source.format, source.capture.views.len(), source.left_out.len()), ("transforms", 1, 1));
    assert_eq!(source.capture.points.colours, [[1, 2, 3], [4, 5, 6]]);
    assert_eq!(source.capture.points.track(0), None);
    let (pixel, depth) = source.capture.views[0].camera.project(DVec3::new(0.0, 0.0, -3.0));
    assert!(pixel == glam::DVec2::new(24.0, 16.0) && depth == 3.0);
    std::fs::remove_file(folder.path().join("sparse_pc.ply")).unwrap();
    refused(folder.path(), &["no sparse points", "do not overlap"]);
}

#[test]
fn files_outside_of_the_capture_are_not_opened() {
    for file in ["../a.png", "/a.png", "images/../../a.png"] {
        let folder = transforms(&[&format!(r#""file_path": "{file}""#)]);
        refused(folder.path(), &["outside of the capture", file]);
    }
    let folder = transforms(&[r#""file_path": "images/../images/a.png""#]);
    assert!(opened(folder.path()).is_ok());
    #[cfg(unix)]
    {
        let (folder, other) = (transforms(&[r#""file_path": "images/link.png""#]), transforms(&[]));
        std::os::unix::fs::symlink(other.path().join("images/a.png"), folder.path().join("images/link.png")).unwrap();
        refused(folder.path(), &["outside of the capture", "link.png"]);
    }
}

#[test]
fn damaged_files_are_named() {
    let folder = city();
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        let path = folder.path().join("sparse/0").join(name);
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        refused(folder.path(), &[name, "cut short"]);
        std::fs::write(&path, bytes).unwrap();
    }
    refused(&folder.path().join("images"), &["no camera poses", "sparse/0"]);
}

/// A real capture of `../shared/data`; without it a line says that the test is skipped.
pub(crate) fn shared(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("PLAT_SHARED")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared")), PathBuf::from);
    let path = root.join("data").join(name);
    if !path.is_dir() {
        println!("skipped: ../shared/data not present");
        return None;
    }
    Some(path)
}

#[test]
fn real_captures_open_with_points_inside_their_views() {
    for (name, views, geo) in [
        ("fox/pinhole_270", 50, false),
        ("fox/opencv_270", 50, false),
        ("street_lund", 29, true),
        ("aerial_caliterra", 75, true),
        ("building_sceaux", 11, false),
        ("drive_kitti_odom_1", 51, false),
        ("drive_kitti_sfnd_lidar", 78, false),
    ] {
        let Some(path) = shared(name) else { return };
        let source = opened(&path).unwrap();
        let capture = &source.capture;
        assert_eq!((capture.views.len(), capture.geo_origin.is_some()), (views, geo), "{name}");
        assert!(source.left_out.is_empty() && capture.points.len() > 1000, "{name}");
        if name == "drive_kitti_sfnd_lidar" {
            assert!(capture.points.track_start.is_empty());
        } else {
            let share = tracked_inside(capture);
            assert!(share > 0.95, "{name}: {share}");
        }
    }
}

/// Pearson correlation between the green of points and of the pixels that they project to, over all tracks.
fn colour_agreement(path: &Path) -> f64 {
    let source = opened(path).unwrap();
    let (mut pairs, mut photos) = (Vec::new(), Vec::new());
    for photo in &source.photos {
        let rgb = image::open(&photo.path).unwrap().into_rgb8().into_raw();
        let undistorter = crate::undistortion::Undistorter::new(&photo.model, photo.width, photo.height).unwrap();
        photos.push(if undistorter.is_identity() { rgb } else { undistorter.rgb(&rgb) });
    }
    let points = &source.capture.points;
    for i in 0..points.len() {
        for &view in points.track(i).unwrap() {
            let camera = &source.capture.views[view as usize].camera;
            let k = camera.pinhole;
            let (pixel, _) = camera.project(points.positions[i]);
            let (x, y) = (pixel.x.floor(), pixel.y.floor());
            if (0.0..f64::from(k.width)).contains(&x) && (0.0..f64::from(k.height)).contains(&y) {
                let at = 3 * (y as usize * k.width as usize + x as usize) + 1;
                pairs.push((f64::from(photos[view as usize][at]), f64::from(points.colours[i][1])));
            }
        }
    }
    let n = pairs.len() as f64;
    let (ma, mb) = pairs.iter().fold((0.0, 0.0), |(a, b), pair| (a + pair.0 / n, b + pair.1 / n));
    let moment = |f: &dyn Fn(f64, f64) -> f64| pairs.iter().map(|&(a, b)| f(a - ma, b - mb)).sum::<f64>();
    moment(&|a, b| a * b) / (moment(&|a, _| a * a) * moment(&|_, b| b * b)).sqrt()
}

#[test]
fn undistorted_photos_agree_with_points_as_well_as_ideal_ones() {
    let Some(path) = shared("fox") else { return };
    let (ideal, undistorted) =
        (colour_agreement(&path.join("pinhole_270")), colour_agreement(&path.join("opencv_270")));
    assert!(ideal > 0.9 && undistorted > ideal - 0.01, "{ideal} {undistorted}");
}
