use image::{ImageFormat, Luma};
use scene::{CameraModel, Pinhole};

use super::*;
use crate::photo::tests::encoded;

const WIDTH: u32 = 40;
const HEIGHT: u32 = 30;

fn file(name: &str, bytes: &[u8], options: &DepthMapOptions) -> (tempfile::TempDir, DepthFile) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    (folder, DepthFile::new(path, options))
}

fn read(name: &str, bytes: &[u8], options: &DepthMapOptions) -> Result<DepthMap, String> {
    let (_folder, file) = file(name, bytes, options);
    file.read(WIDTH, HEIGHT).map_err(|error| error.to_string())
}

/// A map of these sides whose values are `10 + column + row / 4`, with one value replaced.
fn npy_map(width: u32, height: u32, at: (u32, u32), value: f32) -> Vec<u8> {
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let values: Vec<f32> = pixels.map(|p| if p == at { value } else { 10.0 + p.0 as f32 + p.1 as f32 / 4.0 }).collect();
    npy::write_f32(&[height as usize, width as usize], &values)
}

fn png(width: u32, height: u32) -> Vec<u8> {
    let image = image::ImageBuffer::from_fn(width, height, |x, y| Luma([(1000 * x + y) as u16]));
    encoded(DynamicImage::ImageLuma16(image), ImageFormat::Png)
}

#[test]
fn units_are_metres_for_npy_and_millimetres_for_png_unless_given() {
    let default = DepthMapOptions::default();
    let map = read("a.npy", &npy_map(WIDTH, HEIGHT, (3, 2), 0.0), &default).unwrap();
    assert_eq!((map.width, map.height, map.values[0], map.values[83]), (WIDTH, HEIGHT, 10.0, 0.0));
    let png = png(WIDTH, HEIGHT);
    assert_eq!(read("a.png", &png, &default).unwrap().values[45], 5.001);
    // KITTI's unit.
    let kitti = DepthMapOptions { unit: Some(1.0 / 256.0), ..default.clone() };
    assert_eq!(read("a.png", &png, &kitti).unwrap().values[45], 5001.0 / 256.0);
    let inverse = DepthMapOptions { kind: DepthKind::Inverse, ..default };
    assert_eq!(read("a.png", &png, &inverse).unwrap().values[45], 5001.0);
    let negative = npy_map(WIDTH, HEIGHT, (0, 0), -1.0);
    assert_eq!(read("a.npy", &negative, &inverse).unwrap().values[0], -1.0);
    // Axes of length one, and doubles.
    let with_channel = npy::write(&[30, 40, 1], &vec![2.0f64; 1200]);
    assert_eq!(read("a.npy", &with_channel, &inverse).unwrap().values, [2.0; 1200]);
}

#[test]
fn damaged_maps_are_refused_in_one_line_that_names_them() {
    let good = npy_map(WIDTH, HEIGHT, (0, 0), 1.0);
    let grey8 = encoded(image::GrayImage::new(WIDTH, HEIGHT), ImageFormat::Png);
    let png = png(WIDTH, HEIGHT);
    let many = npy::write_f32(&[300_000], &vec![1.0; 300_000]);
    for (name, bytes, word) in [
        ("a.npy", npy_map(WIDTH, HEIGHT, (7, 5), f32::NAN), "the value NaN at column 7 of row 5"),
        ("a.npy", npy_map(WIDTH, HEIGHT, (7, 5), f32::INFINITY), "the value inf"),
        ("a.npy", npy_map(WIDTH, HEIGHT, (7, 5), -2.0), "the value -2"),
        ("a.npy", good[..good.len() - 4].to_vec(), "does not match"),
        ("a.npy", good[..20].to_vec(), "cut short"),
        ("a.npy", npy_map(HEIGHT, WIDTH, (0, 0), 1.0), "30×40 pixels, its photo 40×30"),
        ("a.npy", npy_map(2 * WIDTH, 2 * HEIGHT, (0, 0), 1.0), "larger"),
        ("a.npy", npy::write_f32(&[1200], &[1.0; 1200]), "instead of rows and columns"),
        ("a.npy", npy::write_f32(&[0, 0], &[]), "0×0"),
        ("a.npy", many, "is larger than a depth map of 40×30 pixels can be"),
        ("a.png", good, "is not an image"),
        ("a.png", grey8, "not a 16-bit grey PNG"),
        ("a.png", png[..png.len() / 2].to_vec(), "cut short"),
        ("a.png", self::png(20, 20), "20×20 pixels"),
    ] {
        let line = read(name, &bytes, &DepthMapOptions::default()).unwrap_err();
        assert!(line.contains(word) && line.contains(name) && !line.contains('\n'), "{word}: {line}");
    }
}

#[test]
fn the_sampler_follows_the_lens_and_the_divisor() {
    // Each value of the map is its column, so that a value says where it was taken.
    let values: Vec<f32> = (0..100 * 80).map(|i| 1.0 + (i % 100) as f32).collect();
    let map = DepthMap { width: 100, height: 80, values };
    let lens = CameraModel::OpenCv([150.0, 150.0, 100.0, 80.0, -0.1, 0.02, 0.0, 0.0]);
    let undistorter = Undistorter::new(&lens, 200, 160).unwrap();
    let sampler = Sampler { map: &map, undistorter: &undistorter, photo: DVec2::new(200.0, 160.0), downscale: 2 };
    let Pinhole { width, height, fx, cx, .. } = undistorter.pinhole();
    let taken: Vec<(u32, u32, f32)> = sampler.grid(width / 2, height / 2).collect();
    assert_eq!(taken.len() as u32, (width / 2) * (height / 2), "every pixel lies in the photo");
    let along: Vec<&(u32, u32, f32)> = taken.iter().filter(|sample| sample.1 == height / 4).collect();
    for &&(x, _, value) in &along {
        let ideal = (2.0 * (f64::from(x) + 0.5) - cx) / fx;
        let bent = 150.0 * ideal * (1.0 - 0.1 * ideal * ideal + 0.02 * ideal.powi(4)) + 100.0;
        assert!((f64::from(value) - 0.5 - bent / 2.0).abs() < 0.6, "{x}: {value} {bent}");
    }
    // 20 times 262,144 pixels: every eighth is taken in each direction.
    let large = Sampler { downscale: 1, ..sampler };
    assert!(large.grid(2560, 2048).all(|(x, y, _)| x % 8 == 4 && y % 8 == 4));
}
