//! Seed files of every codec: real ones from `../shared/data`, if present, and files made by plat's writers.

use std::fs;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use city::{CitySettings, Traffic};
use dataset::ingest;
use dataset::mip_tiles;
use dataset::open::{self, OpenOptions};
use dataset::synth::{self, Settings};
use glam::{DMat4, DVec3, Vec3};
use image::{DynamicImage, ImageFormat, Luma, Rgb, RgbImage, Rgba, RgbaImage};
use scene::frame;
use scene::parquet::{Cells, Writer};
use scene::transforms::{Frame, Intrinsics, Transforms};
use scene::{CameraModel, Exposure, Exposures, Pixels, Splat, Splats, Swing};
use scene::{npy, ply, rad, sog, splat_glb, spz, transforms};

use crate::readers::*;
use crate::zones;

/// The checksum or compression of a file, which stops damage early. It is restored after most mutations.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Seal {
    None,
    /// A frame of plat: its checksum.
    Frame,
    /// gzip: the decompressed bytes are damaged.
    Gzip,
    /// PNG: the checksum of each chunk.
    Png,
}

/// Memory that reading may take, bytes: `base` plus `factor` times the file.
#[derive(Clone, Copy)]
pub(crate) struct Budget {
    pub(crate) factor: usize,
    pub(crate) base: usize,
}

pub(crate) const PLAIN: Budget = Budget { factor: 16, base: 16 << 20 };
/// SPZ is compressed: the reader's own limit applies.
const COMPRESSED: Budget = Budget { factor: 20, base: 34 << 20 };
/// SOG: its own limit, and a picture of so many pixels with what its decoder takes.
const PICTURES: Budget = Budget { factor: 80, base: 128 << 20 };
/// Several times a photo's pixels, which `photo::BASE_PIXELS` limits.
pub(crate) const PHOTO: Budget = Budget { factor: 0, base: 256 << 20 };

/// Size of the photos written here, such that an uncompressed TIFF fits a fuzzer's seed.
pub(crate) const PHOTO_SIZE: (u32, u32) = (80, 60);

pub(crate) struct Seed {
    pub(crate) name: String,
    pub(crate) bytes: Vec<u8>,
    pub(crate) reader: Read,
    pub(crate) seal: Seal,
    pub(crate) budget: Budget,
}

/// All seeds, in the same order in every run.
pub(crate) fn seeds() -> Vec<Seed> {
    let mut corpus = Corpus(zones::seeds());
    corpus.written();
    match shared() {
        Some(data) => corpus.real(&data),
        None => println!("skipped the real files: ../shared/data not present"),
    }
    corpus.0
}

/// Decompression bombs: files that claim many times their length. All are refused.
pub(crate) fn swelling() -> Vec<Seed> {
    let mut corpus = Corpus(zones::swelling());
    let ones = |n: usize| "1,".repeat(n) + "1";
    let json = format!(r#"{{"fl_x": 5, "x": [{}], "frames": []}}"#, ones(2_000_000));
    corpus.plain("unknown numbers in transforms.json", json, &transforms_codec());
    let frame = r#"{"file_path":"","transform_matrix":[]},"#.repeat(60_000);
    let json = format!(r#"{{"fl_x": 5, "frames": [{}]}}"#, frame.trim_end_matches(','));
    corpus.plain("empty frames in transforms.json", json, &transforms_codec());
    let json = format!(r#"[{{"x": [{}], "shots": {{}}, "cameras": {{}}}}]"#, ones(2_000_000));
    corpus.plain("unknown numbers in reconstruction.json", json, &opensfm_codec());
    for (codec, row) in nuscenes_codecs().iter().zip(["[[]]", "{}", "1", "\"\"", "null", "[0,0,0]", "true"]) {
        corpus.plain("a table of wrong rows", format!("[{row}{}]", format!(",{row}").repeat(200_000)), codec);
    }
    let matrix = format!(r#"[{{"token": "", "sensor_token": "", "camera_intrinsic": [{}]"#, "[0,0,0],".repeat(200_000));
    corpus.plain("a matrix of many rows", matrix, &nuscenes_codecs()[5]);
    let text = "1 ".repeat(1_000_000);
    let poses = format!(r#"{{"tracks": [{{"class": "", "poses": [{}]"#, "[0,[0,0,0],[0,0,0,0]],".repeat(100_000));
    corpus.plain("poses without end in tracks.json", poses, &tracks_codec());
    let items = |item: &str| format!("<a><tracklets>{}</tracklets></a>", item.repeat(60_000));
    corpus.plain("empty objects in tracklet_labels.xml", items("<item></item>"), &kitti_raw_codecs()[4]);
    corpus.plain("deep elements in tracklet_labels.xml", items("<a>"), &kitti_raw_codecs()[4]);
    corpus.plain(
        "columns without end of a radar",
        format!("range,azimuth,velocity\n{}", "1,x,".repeat(500_000)),
        &radar_codecs()[1],
    );
    corpus.plain("a long line of oxts", text.as_str(), &kitti_raw_codecs()[2]);
    let text = format!("P_rect_00: {text}");
    corpus.plain("a long line in calib_cam_to_cam.txt", text.as_str(), &kitti_raw_codecs()[0]);
    corpus.plain("a long line in perspective.txt", text, &kitti_codecs()[0]);
    for line in ["comment\n", "property char a\n", "obj_info\n"] {
        let text = format!("ply\nformat ascii 1.0\nelement vertex 1\n{}end_header\n1\n", line.repeat(200_000));
        corpus.plain("a long PLY header", text, &ply_codec());
    }
    let count = "element vertex 4000000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    for format in ["ascii", "binary_little_endian"] {
        corpus.plain("vertices that are not there", format!("ply\nformat {format} 1.0\n{count}1 1"), &cloud_codec());
    }
    let mut header = 0x5053_474e_u32.to_le_bytes().to_vec();
    header.extend([3u32, u32::MAX].iter().flat_map(|word| word.to_le_bytes()));
    header.extend([3, 12, 0, 0]);
    for (name, count, body) in [("splats that are not there", u32::MAX, 100), ("a bomb", 1_000_000, 100 << 20)] {
        header[8..12].copy_from_slice(&count.to_le_bytes());
        let mut to = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        std::io::Write::write_all(&mut to, &[header.clone(), vec![0; body]].concat()).expect("memory takes it");
        let bytes = to.finish().expect("memory takes it");
        corpus.put(&format!("{name} in SPZ"), bytes, &spz_codec(), Seal::None, COMPRESSED);
    }
    let mut views = vec![1, 252]; // one view, whose name is of 900 MB
    views.extend(900_000_000u32.to_le_bytes());
    let hash = blake3::hash(&views);
    let lengths = [(views.len() as u32).to_le_bytes().as_slice(), &[0; 8]].concat();
    let kind = [ingest::CAPTURE.0.as_slice(), &ingest::CAPTURE.1.to_le_bytes()].concat();
    let frame = [b"plat".as_slice(), &kind, &lengths, &hash.as_bytes()[..16], &views].concat();
    corpus.put("a name that is not there", frame, &capture_codec(), Seal::None, PLAIN);
    for counts in [[u64::MAX; 2], [1 << 40; 2]] {
        let bytes = counts.iter().flat_map(|count| count.to_le_bytes()).collect::<Vec<_>>();
        colmap_binary().iter().for_each(|codec| corpus.plain("a count of COLMAP", bytes.clone(), codec));
    }
    corpus.0
}

struct Corpus(Vec<Seed>);

impl Corpus {
    fn put(&mut self, name: &str, bytes: Vec<u8>, read: &Read, seal: Seal, budget: Budget) {
        self.0.push(Seed { name: name.into(), bytes, reader: Rc::clone(read), seal, budget });
    }

    fn plain(&mut self, name: &str, bytes: impl Into<Vec<u8>>, read: &Read) {
        self.put(name, bytes.into(), read, Seal::None, PLAIN);
    }

    fn photo(&mut self, name: &str, bytes: Vec<u8>, read: &Read) {
        let seal = if bytes.starts_with(b"\x89PNG") { Seal::Png } else { Seal::None };
        self.put(name, bytes, read, seal, PHOTO);
    }

    /// From `../shared/data`. A missing file fails the test.
    fn real(&mut self, data: &Path) {
        let read = |name: &str| fs::read(data.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"));
        let [cameras, images, points] = colmap_binary();
        for capture in ["building_sceaux", "street_lund", "fox/opencv_270", "drive_kitti_odom_1"] {
            for (name, codec) in [("cameras", &cameras), ("images", &images), ("points3D", &points)] {
                let name = format!("{capture}/sparse/0/{name}.bin");
                self.plain(&name, read(&name), codec);
            }
        }
        for (name, codec) in ["cameras", "images", "points3D"].into_iter().zip(&colmap_text()) {
            let name = format!("drive_kitti_sfnd_lidar/sparse/0/{name}.txt");
            let bytes = read(&name);
            // Also the first lines alone, without the comments that count them: small files go through more cases.
            let lines = bytes.split_inclusive(|&b| b == b'\n').filter(|line| !line.starts_with(b"#"));
            self.plain(&format!("{name} (head)"), lines.take(100).collect::<Vec<_>>().concat(), codec);
            self.plain(&name, bytes, codec);
        }
        let model = read("splats/inria_style_ply/point_cloud/iteration_7000/point_cloud.ply");
        let splats = ply::read(&model).expect("the real model is read");
        let some = splats.select(&(0..splats.len().min(400) as u32).collect::<Vec<_>>());
        self.plain("inria point_cloud.ply", model, &ply_codec());
        self.plain("inria point_cloud.ply (400 splats)", ply::write(&some, &["antialiased"]), &ply_codec());
        for version in [spz::Version::V2, spz::Version::V3] {
            let bytes = spz::write(&some, true, version).expect("the real model is finite");
            self.put(&format!("inria as {version:?} spz"), bytes, &spz_codec(), Seal::Gzip, COMPRESSED);
        }
        self.plain("guitar.compressed.ply", read("splats/playcanvas/guitar.compressed.ply"), &ply_codec());
        // Version 4: zstd streams instead of gzip.
        self.put("biker.spz", read("splats/playcanvas/biker.spz"), &spz_codec(), Seal::None, COMPRESSED);
        let scan = read("drive_kitti_sfnd_lidar/lidar_frontal/0000000010.bin");
        self.plain("0000000010.bin (Velodyne)", scan, &kitti_codecs()[4]);

        let source = open::open(&data.join("fox/opencv_270"), &OpenOptions::default()).expect("the fox opens");
        let frames = source.capture.views.iter().zip(&source.photos).map(|(view, photo)| Frame {
            file_path: format!("images/{}", view.name),
            mask_path: None,
            depth_file_path: None,
            intrinsics: Intrinsics::from_model(&photo.model, Some((photo.width, photo.height))),
            camera_from_world: view.camera.camera_from_world,
        });
        let file = Transforms { frames: frames.collect(), ply_file_path: Some("points.ply".into()) };
        self.plain("the fox's transforms.json", transforms::write(&file), &transforms_codec());
        let capture = frame::encode(ingest::CAPTURE, &source.capture, &[]);
        self.put("the fox as a capture", capture, &capture_codec(), Seal::Frame, PLAIN);

        let photo = photo_codec(false);
        for name in [
            "fox/opencv_270/images/0001.jpg",
            "fox/pinhole_270/images/0001.png",
            "street_lund/images/01.jpg",
            "splats/playcanvas/playbot/6_0/quats.webp",
            "drive_radiate_fog/Navtech_Polar/000001.png",
        ] {
            self.photo(name, read(name), &photo);
        }
    }

    fn written(&mut self) {
        let folder = tempfile::tempdir().expect("a folder");
        let city = CitySettings { traffic: Traffic::None, ..CitySettings::default() };
        let settings = Settings { city, views: 24, width: 48, height: 32, ..Settings::default() };
        synth::write(folder.path(), &settings, &|_, _, _| ()).expect("a city");
        for (name, codec) in ["cameras", "images", "points3D"].into_iter().zip(&colmap_binary()) {
            let bytes = fs::read(folder.path().join(format!("sparse/0/{name}.bin"))).expect("the city has it");
            self.plain(&format!("city {name}.bin"), bytes, codec);
        }
        let [cameras, images, points] = colmap_text();
        self.plain("cameras.txt", "# Number of cameras: 1\n1 OPENCV 48 32 40 41 24 16 0.1 -0.01 0 0\n", &cameras);
        self.plain(
            "images.txt",
            "# c\n1 1 0 0 0 0.5 0 2 1 a b.png\n1 2 -1 3 4 7\n2 0.5 0.5 0.5 0.5 0 0 2 1 c.png\n\n",
            &images,
        );
        self.plain("points3D.txt", "# c\n1 0.5 1e-3 -7 255 0 9 0.1 1 0 2 1\n7 1 2 3 4 5 6 7\n", &points);

        let source = open::open(folder.path(), &OpenOptions::default()).expect("the city opens");
        let frames = (source.capture.views.iter().zip(&source.photos).enumerate()).map(|(i, (view, photo))| Frame {
            file_path: format!("images/{}", view.name),
            mask_path: (i == 1).then(|| "masks/a.png".to_string()),
            depth_file_path: (i == 2).then(|| "depths/a.npy".to_string()),
            intrinsics: Intrinsics::from_model(&lens(i, &photo.model), (i % 2 == 0).then_some((48, 32))),
            camera_from_world: view.camera.camera_from_world,
        });
        let file = Transforms { frames: frames.take(6).collect(), ply_file_path: None };
        self.plain("transforms.json", transforms::write(&file), &transforms_codec());
        self.plain("reconstruction.json", RECONSTRUCTION, &opensfm_codec());
        self.plain("tracks.json", TRACKS, &tracks_codec());
        let [sweeps, detections] = radar_codecs();
        self.plain("radar/poses.jsonl", RADAR_POSES, &sweeps);
        self.plain("radar/NAME.csv", "range,azimuth,velocity,power\n12.5,-0.25,-9.5,31\n7e0,1.0,.5,12\n", &detections);
        let [perspective, cam_to_pose, cam_to_velo, poses, scan] = kitti_codecs();
        self.plain("perspective.txt", PERSPECTIVE, &perspective);
        self.plain("calib_cam_to_pose.txt", CAM_TO_POSE, &cam_to_pose);
        self.plain("calib_cam_to_velo.txt", "0 0 1 0 -1 0 0 0 0 -1 0 -0.5\n", &cam_to_velo);
        self.plain("poses.txt", POSES, &poses);
        let floats = |n: usize| (0..n).flat_map(|i| (i as f32 * 0.7 - 9.0).to_le_bytes()).collect::<Vec<u8>>();
        self.plain("scan.bin", floats(400), &scan);

        for ((name, text), codec) in KITTI_RAW.into_iter().zip(&kitti_raw_codecs()) {
            self.plain(name, text, codec);
        }
        for ((name, table), codec) in NUSCENES.into_iter().zip(&nuscenes_codecs()) {
            self.plain(name, table, codec);
        }

        for (name, columns) in waymo() {
            let mut writer = Writer::default();
            let bytes = [writer.group(columns), writer.finish()].concat();
            self.plain(&format!("{name}.parquet"), bytes, &waymo_codec());
        }
        for (name, bytes) in BY_PYARROW {
            self.put(name, bytes.to_vec(), &waymo_codec(), Seal::None, COMPRESSED);
        }

        for degree in [0, 3] {
            let mut splats = Splats::new(degree);
            (0..200).for_each(|i| splats.push(&splat(i)));
            self.plain("splats.ply", ply::write(&splats, &["a comment"]), &ply_codec());
            for version in [spz::Version::V2, spz::Version::V3] {
                let bytes = spz::write(&splats, degree == 0, version).expect("they are finite");
                self.put("splats.spz", bytes, &spz_codec(), Seal::Gzip, COMPRESSED);
            }
            let bytes = splat_glb::write(&splats, true, DMat4::from_rotation_x(1.0)).expect("they are finite");
            self.put("splats.glb", bytes, &splat_glb_codec(), Seal::None, COMPRESSED);
            let bytes = rad::write(&splats, DVec3::ZERO, None).expect("they are finite");
            self.put("splats.rad", bytes, &rad_codec(), Seal::None, COMPRESSED);
            let files = sog::write(&splats, true).expect("they are finite");
            let bytes = sog::bundle(&files).expect("they are few");
            self.put("splats.sog", bytes, &sog_codec(), Seal::None, PICTURES);
            for file in files.clone() {
                let codec = sog_file_codec(files.clone(), &file.name);
                self.put(&file.name, file.bytes, &codec, Seal::None, PICTURES);
            }
            self.put("splat columns", frame::encode_splats(&splats), &splats_codec(), Seal::Frame, PLAIN);
            let swing = Swing { stride_metres: 1.4, amplitudes: vec![[0.1; scene::swing::NUMBERS]; splats.len()] };
            for swing in [None, Some(&swing)] {
                let object = scene::objects::to_frame(&parked().path, &splats, swing);
                self.put("trained object", object, &object_codec(), Seal::Frame, PLAIN);
            }
            self.put("swing", swing.to_frame(), &swing_codec(splats.len()), Seal::Frame, PLAIN);
        }
        let exposures: Exposures = (0..40).map(|view| (3 * view, Exposure::IDENTITY)).collect();
        self.put("exposures", exposures.to_frame(), &exposures_codec(), Seal::Frame, PLAIN);
        self.plain("packed.compressed.ply", packed(), &ply_codec());
        self.put("plain.glb", plain_glb(), &splat_glb_codec(), Seal::None, COMPRESSED);
        self.plain("cloud.ply", CLOUD, &cloud_codec());
        let [shape, data] = [vec![7, 3], vec![]];
        let numbers: Vec<f32> = (0..21).map(|i| i as f32).collect();
        self.plain("array.npy", npy::write_f32(&shape, &numbers), &npy_codec());
        self.plain("scalar.npy", npy::write_f32(&data, &[1.0]), &npy_codec());

        self.put("capture", frame::encode(ingest::CAPTURE, &source.capture, &[]), &capture_codec(), Seal::Frame, PLAIN);
        let settings = blocks::PlanSettings { levels: Some(2), budget: 1000, evaluate: true, ..Default::default() };
        let id = scene::ArtefactId::of(b"city");
        let plan = blocks::plan(&source.capture, id, &settings, "cpu").expect("a city can be planned");
        self.put("plan", plan.to_frame(), &plan_codec(source.capture.clone()), Seal::Frame, PLAIN);
        // The size that the fuzz target expects.
        let bytes = (0..3 * 150 * 140).map(|i| (i * 7 / 11) as u8).collect();
        let pixels = Pixels { width: 150, height: 140, rgb: bytes, ..Pixels::default() };
        self.plain("mip", mip_tiles::encode(&pixels).expect("an image"), &mip_codec());

        let [photo, mask] = [photo_codec(false), photo_codec(true)];
        let image =
            RgbImage::from_fn(PHOTO_SIZE.0, PHOTO_SIZE.1, |x, y| Rgb([(x * 5) as u8, (y * 3) as u8, (x ^ y) as u8]));
        for format in [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::Tiff, ImageFormat::WebP] {
            self.photo(&format!("photo, {format:?}"), encoded(image.clone(), format), &photo);
        }
        let alpha = RgbaImage::from_fn(PHOTO_SIZE.0, PHOTO_SIZE.1, |x, y| Rgba([x as u8, y as u8, 9, (x + y) as u8]));
        self.photo("photo with alpha", encoded(alpha, ImageFormat::Png), &photo);
        let (width, height) = PHOTO_SIZE;
        let depths: Vec<f32> = (0..width * height).map(|i| 3.0 + 0.01 * (i % 700) as f32).collect();
        let map = npy::write_f32(&[height as usize, width as usize], &depths);
        self.put("depth map, npy", map, &depth_map_codec("npy", "map.npy"), Seal::None, PHOTO);
        let map = image::ImageBuffer::from_fn(width, height, |x, y| Luma([(900 + 31 * x * y) as u16]));
        let map = encoded(DynamicImage::ImageLuma16(map), ImageFormat::Png);
        self.photo("depth map, PNG", map, &depth_map_codec("image", "map.png"));
        self.photo("mask", encoded(DynamicImage::from(image).to_luma8(), ImageFormat::Png), &mask);
    }
}

pub(crate) fn encoded(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.into().write_to(&mut bytes, format).expect("an image is encoded");
    bytes.into_inner()
}

fn shared() -> Option<PathBuf> {
    let root = std::env::var_os("PLAT_SHARED")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared")), PathBuf::from);
    Some(root.join("data")).filter(|data| data.is_dir())
}

fn lens(i: usize, model: &CameraModel) -> CameraModel {
    let [fx, fy, cx, cy] = model.focal_and_centre();
    match i % 3 {
        0 => *model,
        1 => CameraModel::FullOpenCv([fx, fy, cx, cy, 0.1, 0.01, 0.001, 0.002, 0.3, 0.1, 0.1, 0.1]),
        _ => CameraModel::OpenCvFisheye([fx, fy, cx, cy, 0.1, 0.01, 0.001, 0.002]),
    }
}

fn splat(i: u32) -> Splat {
    let at = Vec3::new(i as f32 * 0.3, (i * i % 17) as f32, -3.0);
    let mut splat = Splat::round(at, -2.0, Vec3::new(0.2, 0.5, 0.9), 0.7);
    splat.quat = [0.1, 0.9, i as f32 * 0.01, -0.3];
    splat.sh[(i % 16) as usize] = [0.1, -0.2, 0.3];
    splat
}

/// 300 splats as PlayCanvas packs them, with SH of degree 1.
fn packed() -> Vec<u8> {
    let mut text = "ply\nformat binary_little_endian 1.0\nelement chunk 2\n".to_string();
    for end in ["min", "max"] {
        for axis in ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"] {
            text += &format!("property float {end}_{axis}\n");
        }
    }
    text += "element vertex 300\nproperty uint packed_position\nproperty uint packed_rotation\n\
             property uint packed_scale\nproperty uint packed_color\nelement sh 300\n";
    (0..9).for_each(|k| text += &format!("property uchar f_rest_{k}\n"));
    let mut bytes = (text + "end_header\n").into_bytes();
    bytes.extend((0..2 * 18).flat_map(|i| (i as f32).to_le_bytes()));
    bytes.extend((0..300u32 * 4).flat_map(|i| i.wrapping_mul(2_654_435_761).to_le_bytes()));
    bytes.extend((0..300 * 9).map(|i| i as u8));
    bytes
}

/// Two splats as binary glTF without compression; all attributes share their numbers.
fn plain_glb() -> Vec<u8> {
    let mut text = r#"{"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [
        {"children": [1], "rotation": [0, 0, 1, 0]}, {"mesh": 0, "scale": [2, 2, 2], "translation": [1, 0, 0]}],
        "meshes": [{"primitives": [{"mode": 0, "extensions": {"KHR_gaussian_splatting": {"kernel": "ellipse"}}, "attributes": {
            "POSITION": 0, "KHR_gaussian_splatting:SCALE": 0, "KHR_gaussian_splatting:ROTATION": 1,
            "KHR_gaussian_splatting:OPACITY": 2, "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": 0}}]}], "accessors": [
        {"bufferView": 0, "componentType": 5126, "count": 2, "type": "VEC3"},
        {"bufferView": 0, "byteOffset": 4, "componentType": 5122, "normalized": true, "count": 2, "type": "VEC4"},
        {"bufferView": 0, "byteOffset": 8, "componentType": 5121, "normalized": true, "count": 2, "type": "SCALAR"}],
        "bufferViews": [{"buffer": 0, "byteLength": 24, "byteStride": 12}], "buffers": [{"byteLength": 24}]}"#
        .to_owned();
    text += &" ".repeat(text.len().next_multiple_of(4) - text.len());
    let numbers = [0.5f32, 2.0, 0.25, 1.5, 0.125, 3.0].map(f32::to_le_bytes).concat();
    let [glb, json, bin] = [*b"glTF", *b"JSON", *b"BIN\0"];
    let word = |value: usize| (value as u32).to_le_bytes();
    let head = [glb, word(2), word(28 + text.len() + numbers.len()), word(text.len()), json].concat();
    [head, text.into_bytes(), [word(numbers.len()), bin].concat(), numbers].concat()
}

pub(crate) const CLOUD: &str = "ply\nformat ascii 1.0\ncomment a cloud\nelement vertex 3\nproperty float x\nproperty double y\n\
    property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n\
    0 0 -3 1 2 3\n1 0.5 -3 4 5 6\n-1 1e-3 -4 7 8 9\n";
/// Two objects that move and the times of photos.
const RADAR_POSES: &str = concat!(
    r#"{"name":"a","seconds":0.5,"height":0.6,"velocity":[10,0,0],"photos":["a","b"],"readings":2,"#,
    r#""world_from_sensor":{"rotation":[0,0,0,1],"translation":[1,2,3]}}"#,
    "\n",
);
const TRACKS: &str = r#"{"tracks": [{"id": "van", "class": "car", "low": [-2, -1, 0], "high": [2, 1, 1.5],
    "poses": [[0, [1, 2, 3], [0, 0, 0, 1]], [0.5, [2, 2, 3], [0, 0, 0.1, 0.995]], [3, [4, 2, 3], [0, 0, 0.2, 0.98]]]},
    {"instance": 7, "class": "person", "low": [0, 0, 0], "high": [1, 1, 2], "poses": [[1.5, [0, 0, 0], [1, 0, 0, 0]]]}],
    "seconds": {"a.png": 0.25, "b/c.jpg": 1.5}}"#;

const RECONSTRUCTION: &str = r#"[{"cameras": {
    "v2 a": {"projection_type": "perspective", "width": 4000, "height": 3000, "focal": 0.85, "k1": -0.1, "k2": 0.01},
    "v2 b": {"projection_type": "brown", "width": 3000, "height": 4000, "focal_x": 0.8, "focal_y": 0.81, "c_x": 0.01,
             "c_y": -0.02, "k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.001, "p2": 0.002},
    "v2 c": {"projection_type": "fisheye", "width": 4000, "height": 4000, "focal": 0.3, "k1": 0.1, "k2": 0.2}},
  "shots": {
    "b.jpg": {"camera": "v2 b", "rotation": [0, 0, 1.57], "translation": [1, 2, 3], "gps_dop": 5},
    "a.jpg": {"camera": "v2 a", "rotation": [0.1, 0, 0], "translation": [0, 0, 10], "orientation": 1}},
  "points": {"7": {"color": [255, 0, 12.4], "coordinates": [1, 2, 3]}, "10": {"coordinates": [4, 5, 6]}},
  "reference_lla": {"latitude": 47.5, "longitude": 8.5, "altitude": 400}},
  {"cameras": {}, "shots": {"z.jpg": {"camera": "", "rotation": [0, 0, 0], "translation": [0, 0, 0]}}}]"#;
/// Tables written by pyarrow, from the tests of scene.
const BY_PYARROW: [(&str, &[u8]); 4] = [
    ("brotli.parquet", include_bytes!("../../../scene/src/parquet/by_pyarrow/brotli.parquet")),
    ("gzip.parquet", include_bytes!("../../../scene/src/parquet/by_pyarrow/gzip.parquet")),
    ("snappy.parquet", include_bytes!("../../../scene/src/parquet/by_pyarrow/snappy_v2.parquet")),
    ("zstd.parquet", include_bytes!("../../../scene/src/parquet/by_pyarrow/zstd_v2.parquet")),
];

/// Components of Waymo.
fn waymo() -> Vec<(&'static str, Vec<(&'static str, Cells)>)> {
    let pose = vec![0.0, -1.0, 0.0, 5.0, 1.0, 0.0, 0.0, 6.0, 0.0, 0.0, 1.0, 7.0, 0.0, 0.0, 0.0, 1.0];
    let poses = |rows: usize| Cells::Doubles(vec![pose.clone(); rows]);
    let doubles = |rows: usize| Cells::Double((0..rows).map(|row| 1.0 + row as f64 / 3.0).collect());
    let times = |rows: i64| ("key.frame_timestamp_micros", Cells::Int64((0..rows).collect()));
    let mut cameras = vec![("key.camera_name", Cells::Int8(vec![1, 2]))];
    for name in [
        "[CameraCalibrationComponent].intrinsic.f_u",
        "[CameraCalibrationComponent].intrinsic.f_v",
        "[CameraCalibrationComponent].intrinsic.c_u",
        "[CameraCalibrationComponent].intrinsic.c_v",
        "[CameraCalibrationComponent].intrinsic.k1",
        "[CameraCalibrationComponent].intrinsic.k2",
        "[CameraCalibrationComponent].intrinsic.p1",
        "[CameraCalibrationComponent].intrinsic.p2",
        "[CameraCalibrationComponent].intrinsic.k3",
    ] {
        cameras.push((name, doubles(2)));
    }
    cameras.extend([
        ("[CameraCalibrationComponent].extrinsic.transform", poses(2)),
        ("[CameraCalibrationComponent].width", Cells::Int32(vec![16, 32])),
        ("[CameraCalibrationComponent].height", Cells::Int32(vec![9, 18])),
    ]);
    let photos = vec![
        times(2),
        ("key.camera_name", Cells::Int8(vec![1, 2])),
        ("[CameraImageComponent].image", Cells::Bytes(vec![vec![7; 90]; 2])),
        ("[CameraImageComponent].pose.transform", poses(2)),
        ("[CameraImageComponent].pose_timestamp", doubles(2)),
    ];
    let lasers = vec![
        ("key.laser_name", Cells::Int8(vec![1, 2])),
        ("[LiDARCalibrationComponent].extrinsic.transform", poses(2)),
        ("[LiDARCalibrationComponent].beam_inclination.min", Cells::Double(vec![-0.3, -1.0])),
        ("[LiDARCalibrationComponent].beam_inclination.max", Cells::Double(vec![0.1, 1.0])),
        ("[LiDARCalibrationComponent].beam_inclination.values", Cells::Doubles(vec![vec![-0.3, 0.1], vec![]])),
    ];
    let turns = vec![
        times(2),
        ("key.laser_name", Cells::Int8(vec![1, 2])),
        ("[LiDARComponent].range_image_return1.values", Cells::Floats(vec![vec![3.0; 24], vec![4.0; 8]])),
        ("[LiDARComponent].range_image_return1.shape", Cells::Int32s(vec![vec![2, 3, 4], vec![1, 2, 4]])),
    ];
    let mut boxes = vec![times(2), ("key.laser_object_id", Cells::Text(vec!["a".into(), "bc".into()]))];
    for name in [
        "[LiDARBoxComponent].box.center.x",
        "[LiDARBoxComponent].box.center.y",
        "[LiDARBoxComponent].box.center.z",
        "[LiDARBoxComponent].box.size.x",
        "[LiDARBoxComponent].box.size.y",
        "[LiDARBoxComponent].box.size.z",
        "[LiDARBoxComponent].box.heading",
    ] {
        boxes.push((name, doubles(2)));
    }
    boxes.push(("[LiDARBoxComponent].type", Cells::Int8(vec![1, 4])));
    vec![
        ("camera_calibration", cameras),
        ("camera_image", photos),
        ("vehicle_pose", vec![times(2), ("[VehiclePoseComponent].world_from_vehicle.transform", poses(2))]),
        ("lidar_calibration", lasers),
        ("lidar", turns),
        ("lidar_box", boxes),
    ]
}

/// KITTI raw: a file of each kind.
const KITTI_RAW: [(&str, &str); 5] = [
    (
        "calib_cam_to_cam.txt",
        "calib_time: 09-Jan-2012 13:57:47\nS_rect_00: 80 40\nR_rect_00: 1 0 0 0 1 0 0 0 1\n\
         P_rect_00: 50 0 40 0 0 50 20 0 0 0 1 0\nS_rect_02: 80 40\nP_rect_02: 50 0 40 -3.5 0 50 20 0.2 0 0 1 0.003\n",
    ),
    ("calib_velo_to_cam.txt", "R: 0 -1 0 0 0 -1 1 0 0\nT: 0.1 -0.08 -0.27\ndelta_f: 0 0\n"),
    (
        "0000000000.txt",
        "49.01 8.42 112.8 0.02 1e-05 -1.22 -3.3 1.1 3.5 0.03 -0.03 -0.3 0.04 9.9 -0.3 -0.2 9.9 -0.01 0.02 0.14 -0.01 \
         0.02 0.14 0.5 0.06 4 10 4 4 0\n",
    ),
    ("timestamps.txt", "2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.067\n2011-09-26 13:02:26\n"),
    (
        "tracklet_labels.xml",
        "<?xml version=\"1.0\" encoding=\"UTF-8\" standalone=\"yes\" ?>\n<!DOCTYPE boost_serialization>\n<boost_serialization \
         signature=\"serialization::archive\" version=\"9\"><tracklets><count>1</count><item_version>1</item_version><item \
         class_id=\"1\"><objectType>Car</objectType><h>1.5</h><w>1.8</w><l>4.2</l><first_frame>2</first_frame><poses><count>2\
         </count><item><tx>9.5</tx><ty>-3</ty><tz>-1.6</tz><rx>0</rx><ry>0</ry><rz>-1.57</rz><state>2</state></item><item>\
         <tx>9.9</tx><ty>-3.1</ty><tz>-1.6</tz><rx>0.01</rx><ry>0</ry><rz>-1.5</rz></item></poses><finished>1</finished></item>\
         </tracklets></boost_serialization>\n",
    ),
];
const PERSPECTIVE: &str = "calib_time: x\nS_rect_00: 80 40\nR_rect_00: 1 0 0 0 1 0 0 0 1\n\
    P_rect_00: 50 0 40 0 0 50 20 0 0 0 1 0\nS_rect_01: 80 40\nP_rect_01: 50 0 40 -30 0 50 20 0 0 0 1 0\n";
const CAM_TO_POSE: &str = "image_00: 0 0 1 1 1 0 0 0 0 1 0 0\nimage_01: 0 0 1 1 1 0 0 0.6 0 1 0 0\n";
const POSES: &str = "1 1 0 0 10 0 -1 0 7 0 0 -1 2\n2 1 0 0 20 0 -1 0 7 0 0 -1 2 0 0 0 1\n";
/// Tables of nuScenes: names, samples, data, poses of the vehicle, sensors, their mounting, and boxes.
const NUSCENES: [(&str, &str); 7] = [
    ("scene.json", r#"[{"token": "one", "name": "scene-0001", "description": "Caf\u00e9", "nbr_samples": 2}]"#),
    (
        "sample.json",
        r#"[{"token": "s", "scene_token": "one", "timestamp": 7, "prev": "", "next": ""},
        {"token": "t", "scene_token": "two", "timestamp": 1532402927647951}]"#,
    ),
    (
        "sample_data.json",
        r#"[{"token": "d", "sample_token": "s", "ego_pose_token": "e", "calibrated_sensor_token": "c", "width": 16, "height": 9,
        "filename": "samples/CAM_FRONT/a.jpg", "fileformat": "jpg", "timestamp": 7, "is_key_frame": true},
        {"token": "f", "sample_token": "s", "ego_pose_token": "e", "calibrated_sensor_token": "c", "width": null,
        "filename": "sweeps\/LIDAR_TOP\/a.pcd.bin", "timestamp": 3, "is_key_frame": false}]"#,
    ),
    (
        "ego_pose.json",
        r#"[{"token": "e", "timestamp": 7, "rotation": [0.5720, -0.0016, 0.0118, -0.8201], "translation": [411.3, 1180.8, 0]}]"#,
    ),
    ("sensor.json", r#"[{"token": "x", "channel": "CAM_FRONT", "modality": "camera"}]"#),
    (
        "calibrated_sensor.json",
        r#"[{"token": "c", "sensor_token": "x", "translation": [1.7, 0.01, 1.5], "rotation": [0.5, -0.5, 0.5, -0.5],
        "camera_intrinsic": [[1266.4, 0.0, 816.2], [0.0, 1266.4, 491.5], [0.0, 0.0, 1.0]]},
        {"token": "r", "sensor_token": "y", "translation": [3.4, 0, 0.5], "rotation": [1, 0, 0, 0], "camera_intrinsic": []}]"#,
    ),
    (
        "sample_annotation.json",
        r#"[{"token": "a", "sample_token": "s", "instance_token": "i", "visibility_token": "1", "attribute_tokens": ["m", "p"],
        "translation": [373.2, 1130.4, 0.8], "size": [0.621, 0.669, 1.642], "rotation": [0.98, 0.0, 0.0, -0.199],
        "num_lidar_pts": 5, "num_radar_pts": 0}]"#,
    ),
];
