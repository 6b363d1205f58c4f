//! Hostile captures are opened, ingested and planned. Each gives a capture, perhaps with views left out, or a one-line error with
//! the file, the problem and advice; never a panic.

use std::fs;
use std::io::Cursor;
use std::path::Path;

use city::{CitySettings, Traffic};
use dataset::ingest::{IngestError, IngestOptions, ingest, load_capture};
use dataset::open::{OpenOptions, Source, open};
use dataset::synth::{self, Settings};
use glam::{DQuat, DVec3};
use image::{DynamicImage, ImageFormat, Rgb, RgbImage};
use scene::CameraModel;
use scene::colmap::{self, Reconstruction};
use store::Store;
use tempfile::TempDir;

/// Opens, ingests, loads and plans a capture; a one-line error if it is invalid.
fn run(path: &Path) -> Result<Source, String> {
    let source = open(path, &OpenOptions::default()).map_err(|error| line(error.to_string()))?;
    let store = Store::open("memory://").unwrap().blocking();
    let options = IngestOptions { downscale: 1, threads: 2 };
    let ingested = ingest(&source, &store, &options, &|_, _| ()).map_err(|error| {
        assert!(matches!(error, IngestError::BadInput(_)), "{error}");
        line(error.to_string())
    })?;
    let capture = load_capture(&store, ingested.id).map_err(|error| line(error.to_string()))?;
    let settings = blocks::PlanSettings { budget: 1000, ..Default::default() };
    if let Err(error) = blocks::plan(&capture, ingested.id, &settings, "cpu") {
        line(error.to_string());
    }
    Ok(source)
}

fn line(text: String) -> String {
    assert!(!text.is_empty() && text.len() < 10_000 && !text.contains(char::is_control), "{text:?}");
    text
}

fn refused(path: &Path, words: &[&str]) {
    let error = run(path).map(|source| source.capture.views.len()).unwrap_err();
    assert!(words.iter().all(|word| error.contains(word)) && error.matches("; ").count() >= 1, "{words:?}: {error}");
}

fn city() -> (TempDir, Reconstruction) {
    let folder = tempfile::tempdir().unwrap();
    // Nothing moves, so that photos have no masks.
    let city = CitySettings { traffic: Traffic::None, ..CitySettings::default() };
    let settings = Settings { city, views: 24, width: 48, height: 32, ..Settings::default() };
    synth::write(folder.path(), &settings, &|_, _, _| ()).unwrap();
    let read = |name: &str| fs::read(folder.path().join("sparse/0").join(name)).unwrap();
    let model = Reconstruction {
        cameras: colmap::read_cameras_bin(&read("cameras.bin")).unwrap(),
        images: colmap::read_images_bin(&read("images.bin")).unwrap(),
        points: colmap::read_points_bin(&read("points3D.bin")).unwrap(),
    };
    (folder, model)
}

fn rewrite(folder: &Path, model: &Reconstruction) {
    let sparse = folder.join("sparse/0");
    fs::write(sparse.join("cameras.bin"), colmap::write_cameras_bin(model)).unwrap();
    fs::write(sparse.join("images.bin"), colmap::write_images_bin(model)).unwrap();
    fs::write(sparse.join("points3D.bin"), colmap::write_points_bin(model)).unwrap();
}

#[test]
fn models_with_impossible_numbers_are_refused() {
    let (folder, whole) = city();
    assert!(run(folder.path()).is_ok());
    let with = |words: &[&str], change: &dyn Fn(&mut Reconstruction)| {
        let mut model = whole.clone();
        change(&mut model);
        rewrite(folder.path(), &model);
        if words.is_empty() { drop(run(folder.path())) } else { refused(folder.path(), words) }
    };
    for bad in [f64::NAN, f64::INFINITY] {
        with(&["images.bin", "not finite"], &|m| m.images[3].camera_from_world.translation.y = bad);
        with(&["images.bin", "not finite"], &|m| m.images[3].camera_from_world.rotation.w = bad);
        with(&["points3D.bin", "not finite"], &|m| m.points.positions[7].z = bad);
    }
    with(&["images.bin", "length zero"], &|m| {
        m.images[3].camera_from_world.rotation = DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0);
    });
    with(&["images.bin", "has no name"], &|m| m.images[0].name.clear());
    with(&["camera 77"], &|m| m.images[0].camera_id = 77);
    let camera = |words: &[&str], model: CameraModel, width: u32, height: u32| {
        with(words, &|m| {
            m.cameras.values_mut().for_each(|c| (c.model, c.width, c.height) = (model, width, height));
        });
    };
    for focal in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        camera(&["cameras.bin", "focal length"], CameraModel::Pinhole([40.0, focal, 24.0, 16.0]), 48, 32);
    }
    camera(&["cameras.bin", "0×32"], CameraModel::Pinhole([40.0, 40.0, 24.0, 16.0]), 0, 32);
    camera(&["48×32", "another shape"], CameraModel::Pinhole([40.0, 40.0, 24.0, 16.0]), u32::MAX, 32);
    for k in [1e300, -1e300, 50.0, -50.0] {
        camera(&[], CameraModel::OpenCv([40.0, 40.0, 24.0, 16.0, k, k, k, k]), 48, 32);
        camera(&[], CameraModel::OpenCvFisheye([40.0, 40.0, 24.0, 16.0, k, k, k, k]), 48, 32);
        camera(&[], CameraModel::FullOpenCv([40.0, 40.0, 24.0, 16.0, k, k, k, k, k, k, k, k]), 48, 32);
    }
    for focal in [5e-324, 1e-9, 1e9, 1e308] {
        camera(&[], CameraModel::Pinhole([focal, focal, 1e300, -1e300]), 48, 32);
        camera(&[], CameraModel::OpenCv([focal, focal, 24.0, 16.0, 0.1, 0.1, 0.0, 0.0]), 48, 32);
        camera(&[], CameraModel::OpenCvFisheye([focal, focal, 24.0, 16.0, 0.1, 0.1, 0.0, 0.0]), 48, 32);
    }
    // Finite but extreme values.
    for far in [1e9, 1e160, 1e308] {
        with(&[], &|m| m.images.iter_mut().for_each(|i| i.camera_from_world.translation *= far));
        with(&[], &|m| m.images[0].camera_from_world.translation.x = far);
        with(&[], &|m| m.points.positions.iter_mut().for_each(|p| *p = p.signum() * far));
        with(&[], &|m| m.points = Default::default());
    }
    with(&[], &|m| m.points.positions.iter_mut().for_each(|p| *p = DVec3::ZERO));
    with(&[], &|m| {
        let pose = m.images[0].camera_from_world;
        m.images.iter_mut().for_each(|image| image.camera_from_world = pose);
    });
    // Quaternions are normalised.
    with(&[], &|m| m.images.iter_mut().for_each(|i| i.camera_from_world.rotation *= 3.0));
    let scaled = run(folder.path()).unwrap();
    rewrite(folder.path(), &whole);
    for (a, b) in scaled.capture.views.iter().zip(run(folder.path()).unwrap().capture.views) {
        let [a, b] = [a.camera.camera_from_world, b.camera.camera_from_world];
        assert!(a.is_sane() && a.rotation.dot(b.rotation) > 1.0 - 1e-12);
    }
}

#[test]
fn names_cannot_leave_the_capture() {
    let (folder, whole) = city();
    let outside = tempfile::tempdir().unwrap();
    let secret = outside.path().join("secret.png");
    RgbImage::new(48, 32).save(&secret).unwrap();
    let named = |name: &str| {
        let mut model = whole.clone();
        model.images[2].name = name.into();
        rewrite(folder.path(), &model);
    };
    for name in ["../../etc/passwd", "../../../../../../etc/passwd", "a/../../../x"] {
        named(name);
        refused(folder.path(), &["outside of the capture", name]);
    }
    // No such file below the image folder: left out and reported.
    for name in [
        "/etc/passwd",
        "//etc/passwd",
        secret.to_str().unwrap(),
        "a\nb\u{1b}[2J.png",
        "é\u{202e}gnp.a",
        " ",
        "...",
        "a".repeat(5000).as_str(),
    ] {
        named(name);
        let source = run(folder.path()).unwrap();
        assert!(source.left_out.len() == 1 && source.left_out[0].0 == name);
    }
    named(&whole.images[3].name);
    refused(folder.path(), &["twice"]);
    let path = folder.path().join("sparse/0/images.bin");
    let mut bytes = fs::read(&path).unwrap();
    let at = bytes.windows(4).position(|w| w == b".png").unwrap();
    bytes[at] = 0xff;
    fs::write(&path, bytes).unwrap();
    refused(folder.path(), &["images.bin", "UTF-8"]);
    rewrite(folder.path(), &whole);
    #[cfg(unix)]
    links_and_non_utf8_names(folder.path(), outside.path(), &whole.images[2].name);
}

#[cfg(unix)]
fn links_and_non_utf8_names(folder: &Path, outside: &Path, name: &str) {
    use std::os::unix::ffi::OsStrExt;
    use std::os::unix::fs::symlink;
    let photo = folder.join("images").join(name);
    let bytes = fs::read(&photo).unwrap();
    fs::remove_file(&photo).unwrap();
    symlink(outside.join("secret.png"), &photo).unwrap();
    refused(folder, &["outside of the capture", name]);
    fs::remove_file(&photo).unwrap();
    symlink(&photo, &photo).unwrap(); // a link to itself counts as missing
    assert_eq!(run(folder).unwrap().left_out.len(), 1);
    fs::remove_file(&photo).unwrap();
    fs::create_dir(&photo).unwrap();
    assert_eq!(run(folder).unwrap().left_out.len(), 1);
    fs::remove_dir(&photo).unwrap();
    fs::write(&photo, bytes).unwrap();
    // An unnamed mask outside of the capture is ignored; an invalid one is an error.
    let masks = folder.join("masks");
    fs::create_dir(&masks).unwrap();
    let mask = masks.join(Path::new(name).with_extension("png"));
    fs::create_dir_all(mask.parent().unwrap()).unwrap();
    symlink(outside.join("secret.png"), &mask).unwrap();
    assert!(run(folder).unwrap().photos.iter().all(|photo| photo.mask.is_none()));
    fs::remove_file(&mask).unwrap();
    fs::write(&mask, "no image").unwrap();
    refused(folder, &["masks", "is not a JPEG"]);
    RgbImage::new(32, 48).save(&mask).unwrap();
    refused(folder, &["masks", "32×48"]);
    fs::remove_file(&mask).unwrap();
    // Names that are not UTF-8 are ignored.
    let non_utf8 = std::ffi::OsStr::from_bytes(b"\xff\xfe.png");
    for folder in [folder.to_path_buf(), folder.join("images"), folder.join("sparse/0"), masks] {
        fs::write(folder.join(non_utf8), "?").unwrap();
    }
    assert!(run(folder).unwrap().left_out.is_empty());
    let elsewhere = outside.join(non_utf8);
    fs::rename(folder, &elsewhere).unwrap();
    assert!(run(&elsewhere).unwrap().left_out.is_empty(), "in a folder whose name is not UTF-8");
    // A model behind a link that leaves the capture is ignored.
    fs::create_dir(folder).unwrap();
    symlink(elsewhere.join("sparse"), folder.join("sparse")).unwrap();
    refused(folder, &["neither a COLMAP model"]);
}

/// A capture of two frames without sizes, and two points.
fn frames(head: &str, frame: &str) -> TempDir {
    const MATRIX: &str = r#""transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"#;
    let folder = tempfile::tempdir().unwrap();
    let frame = if frame.contains("transform_matrix") { frame.to_string() } else { format!("{frame}, {MATRIX}") };
    let text = format!(r#"{{{head}, "frames": [{{"file_path": "good.png", {MATRIX}}}, {{{frame}}}]}}"#);
    fs::write(folder.path().join("transforms.json"), text).unwrap();
    texture().save(folder.path().join("good.png")).unwrap();
    let ply = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n\
               0 0 -3\n1 0 -3\n";
    fs::write(folder.path().join("cloud.ply"), ply).unwrap();
    fs::write(folder.path().join("sparse_pc.ply"), ply).unwrap();
    folder
}

fn texture() -> RgbImage {
    RgbImage::from_fn(64, 48, |x, y| Rgb([(x * 5) as u8, (y * 3) as u8, (x ^ y) as u8]))
}

fn encoded(format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    DynamicImage::from(texture()).write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

#[test]
fn frames_with_impossible_numbers_are_refused() {
    let bad = |head: &str, frame: &str, word: &str| {
        let folder = frames(head, frame);
        fs::copy(folder.path().join("good.png"), folder.path().join("a.png")).unwrap();
        if word.is_empty() {
            drop(run(folder.path()));
        } else {
            refused(folder.path(), &[word]);
        }
    };
    let a = r#""file_path": "a.png""#;
    for head in [r#""fl_x": 0"#, r#""fl_x": -3"#, r#""fl_x": 1e999"#, r#""fl_x": NaN"#, r#""fl_y": 0"#] {
        bad(head, a, "transforms.json");
    }
    for size in ["0", "-1", "1.5", "1e12", "1e999", "\"64\""] {
        bad(&format!(r#""fl_x": 50, "w": {size}, "h": 48"#), a, "transforms.json");
    }
    bad(r#""fl_x": 50, "w": 4294967295, "h": 48"#, a, "another shape");
    for angle in ["0", "3.2", "-1"] {
        bad(&format!(r#""camera_angle_x": {angle}"#), a, "transforms.json");
    }
    bad(r#""camera_angle_x": 1e-320"#, a, "");
    for matrix in [
        "[]",
        "[[1,0,0,0]]",
        "[[0,0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,1]]",
        "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,0]]",
        "[[1,0,0,0],[1,0,0,0],[0,0,1,0],[0,0,0,1]]",
        "[[1,0,0,1e999],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
        "[[1,0,0,null],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
    ] {
        bad(r#""fl_x": 50"#, &format!(r#"{a}, "transform_matrix": {matrix}"#), "transforms.json");
    }
    bad(r#""fl_x": 50"#, &format!(r#"{a}, "transform_matrix": [[1,0,0,1e308],[0,1,0,1e308],[0,0,1,0],[0,0,0,1]]"#), "");
    for (key, word) in [("mask_path", "outside"), ("file_path", "outside")] {
        let other = if key == "mask_path" { r#""file_path": "a.png","# } else { "" };
        for path in ["../../etc/passwd", "/etc/passwd", "./../x.png"] {
            bad(r#""fl_x": 50"#, &format!(r#"{other} "{key}": "{path}""#), word);
        }
    }
    bad(r#""fl_x": 50"#, r#""file_path": "a.png", "mask_path": "none\n.png""#, "no mask");
    bad(r#""fl_x": 50, "ply_file_path": "../x.ply""#, a, "outside");
    bad(r#""fl_x": 50, "ply_file_path": "none.ply""#, a, "none.ply");
    bad(&format!(r#""fl_x": 50, "x": {}{}"#, "[".repeat(100_000), "]".repeat(100_000)), a, "");
    bad(r#""fl_x": 50, "fl_x": 60"#, a, "transforms.json");
    bad(r#""fl_x": 50, "ply_file_path": "a.png""#, a, "a.png");
    let folder = frames(r#""fl_x": 50"#, a);
    fs::write(folder.path().join("info.json"), " ".repeat(3 << 20)).unwrap();
    fs::copy(folder.path().join("good.png"), folder.path().join("a.png")).unwrap();
    refused(folder.path(), &["info.json", "larger than 1 MB"]);
}

#[test]
fn photos_with_false_headers_are_refused() {
    let folder = frames(r#""fl_x": 50"#, r#""file_path": "a.jpg""#);
    let photo = folder.path().join("a.jpg");
    let mut pixels = Vec::new();
    // The content determines the format, not the name.
    for format in [ImageFormat::Png, ImageFormat::Tiff, ImageFormat::WebP, ImageFormat::Jpeg] {
        fs::write(&photo, encoded(format)).unwrap();
        let source = run(folder.path()).unwrap();
        assert!(source.left_out.is_empty() && source.photos.len() == 2, "{format:?}");
        pixels.push(source.photos[0].clone());
    }
    assert!(pixels.iter().all(|photo| *photo == pixels[0]));
    let png = encoded(ImageFormat::Png);
    let claiming = |width: u32, height: u32| {
        let mut bytes = png.clone();
        bytes[16..20].copy_from_slice(&width.to_be_bytes());
        bytes[20..24].copy_from_slice(&height.to_be_bytes());
        let mut sum = flate2::Crc::new();
        sum.update(&bytes[12..29]);
        bytes[29..33].copy_from_slice(&sum.sum().to_be_bytes());
        bytes
    };
    for (width, height) in [(100_000, 100_000), (0x7fff_ffff, 1), (1, 0x7fff_ffff), (65_536, 2), (16_383, 16_383)] {
        fs::write(&photo, claiming(width, height)).unwrap();
        refused(folder.path(), &["a.jpg", "claims"]);
    }
    fs::write(&photo, claiming(0, 48)).unwrap();
    refused(folder.path(), &["a.jpg"]);
    let mut jpeg = encoded(ImageFormat::Jpeg);
    let frame = jpeg.windows(2).position(|w| w == [0xff, 0xc0] || w == [0xff, 0xc2]).unwrap();
    jpeg[frame + 5..frame + 9].fill(0xff);
    fs::write(&photo, jpeg).unwrap();
    refused(folder.path(), &["a.jpg", "65535×65535"]);
    for (bytes, word) in [
        (b"".as_slice(), "a.jpg"),
        (b"plain text", "a.jpg"),
        (b"GIF89a\x01\x00\x01\x00\x00\x00\x00;", "a.jpg"),
        (b"BM\x00\x00\x00\x00\x00\x00\x00\x00", "a.jpg"),
        (&png[..20], "a.jpg"),
        (&png[..png.len() / 2], "cut short"),
    ] {
        fs::write(&photo, bytes).unwrap();
        refused(folder.path(), &[word]);
    }
    // A photo of one pixel is accepted.
    RgbImage::new(1, 1).save_with_format(&photo, ImageFormat::Png).unwrap();
    drop(run(folder.path()));
}

#[test]
fn sizes_are_checked_with_cameras_only() {
    let (folder, mut model) = city();
    fs::remove_dir_all(folder.path().join("images")).unwrap();
    let lens = CameraModel::OpenCv([40.0, 40.0, 24.0, 16.0, 0.1, 0.0, 0.0, 0.0]);
    for (width, height) in [(u32::MAX, u32::MAX), (u32::MAX, 3), (1 << 20, 1 << 20)] {
        model.cameras.values_mut().for_each(|c| (c.model, c.width, c.height) = (lens, width, height));
        rewrite(folder.path(), &model);
        let options = OpenOptions { cameras_only: true, ..Default::default() };
        let error = open(folder.path(), &options).map(|_| ()).unwrap_err().to_string();
        assert!(line(error.clone()).contains("claims"), "{error}");
    }
}
