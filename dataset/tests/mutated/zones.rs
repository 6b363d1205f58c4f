//! Files of objects on photos: COCO's JSON, label maps, and the artefact of zones.

use std::fs;
use std::path::PathBuf;

use dataset::ingest::{self, IngestOptions};
use dataset::open::{self, OpenOptions, Source};
use dataset::zones::{self, CocoFile, LabelMaps, ZONES, ZoneSource};
use image::{DynamicImage, ImageBuffer, ImageFormat, Luma, RgbImage};
use scene::transforms::{self, Frame, Intrinsics, Transforms};
use scene::{CameraModel, Capture, MaskBuilder, Rigid, Zone, Zones, frame};
use store::{BlockingStore, Store};

use crate::corpus::{CLOUD, PHOTO, PHOTO_SIZE, PLAIN, Seal, Seed, encoded};
use crate::readers::{Read, Reader};

const COCO: &str = r#"{"images": [{"id": 1, "file_name": "photo.png", "width": 80, "height": 60}],
"annotations": [{"image_id": 1, "category_id": 3, "bbox": [10, 10, 20, 30], "score": 0.5},
{"image_id": 1, "category_id": 3, "segmentation": [[1, 1, 40, 5.5, 30, 50], [2, 2, 9, 2, 9, 9, 2, 9]]},
{"image_id": 1, "category_id": 3, "bbox": [0, 0, 2, 2], "segmentation": {"size": [60, 80], "counts": "Xo0hf3"}},
{"image_id": 1, "category_id": 4, "segmentation": {"size": [60, 80], "counts": [60, 30, 30, 40, 4640]}}],
"categories": [{"id": 3, "name": "car"}, {"id": 4, "name": "bus"}]}"#;

/// Undamaged files.
pub(crate) fn seeds() -> Vec<Seed> {
    let photos = Photos::new();
    let of = |name: &str, bytes: Vec<u8>, reader, seal, budget| Seed { name: name.into(), bytes, reader, seal, budget };
    let id = |x: u32, y: u32| if x / 20 == y / 20 { 26_000 + x / 20 } else { 7 };
    let map = ImageBuffer::from_fn(PHOTO_SIZE.0, PHOTO_SIZE.1, |x, y| Luma([id(x, y) as u16]));
    let map = encoded(DynamicImage::ImageLuma16(map), ImageFormat::Png);
    let mut builder = MaskBuilder::new(PHOTO_SIZE.0);
    (10..40).for_each(|y| builder.push(y, y..2 * y));
    let (mask, corners) = builder.finish().expect("it has pixels");
    let zone = Zone { corners, class: 0, score: 0.5, mask: Some(mask) };
    let found = Zones { classes: vec!["car".into()], of_views: vec![vec![zone.clone(), Zone { mask: None, ..zone }]] };
    vec![
        of("objects.json", COCO.into(), coco(&photos), Seal::None, PLAIN),
        of("label map", map, label_map(photos.clone()), Seal::Png, PHOTO),
        of("zones", frame::encode(ZONES, &found, &[]), zone_frame(&photos), Seal::Frame, PLAIN),
    ]
}

/// Files that claim many times their length.
pub(crate) fn swelling() -> Vec<Seed> {
    let photos = Photos::new();
    let (head, rest) = COCO.split_once("[{\"image_id\"").expect("it has objects");
    let (_, tail) = rest.split_once("}],\n").expect("categories follow");
    let file = |name: &str, annotations: String| {
        let bytes = format!("{head}[{annotations}],\n{tail}").into_bytes();
        Seed { name: name.into(), bytes, reader: coco(&photos), seal: Seal::None, budget: PLAIN }
    };
    let objects = r#"{"image_id":1,"category_id":3},"#.repeat(200_000);
    let one = |segmentation: &str| format!(r#"{{"image_id": 1, "category_id": 3, "segmentation": {segmentation}}}"#);
    let polygons = format!("[{}[1,1]]", "[1,1,1,1,1,99],[],".repeat(200_000));
    let counts = format!(r#"{{"size": [60, 80], "counts": [{}4294967295]}}"#, "0,".repeat(1_000_000));
    let letters = format!(r#"{{"size": [4000000000, 4000000000], "counts": "{}"}}"#, "0".repeat(2_000_000));
    vec![
        file("objects without pixels", objects.trim_end_matches(',').to_owned()),
        file("small polygons", one(&polygons)),
        file("many runs", one(&counts)),
        file("a huge image of runs", one(&letters)),
    ]
}

/// A photo, opened and ingested.
#[derive(Clone)]
struct Photos {
    folder: std::rc::Rc<tempfile::TempDir>,
    source: Source,
    capture: Capture,
    store: BlockingStore,
}

impl Photos {
    fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let frame = Frame {
            file_path: "photo.png".into(),
            mask_path: None,
            depth_file_path: None,
            intrinsics: Intrinsics::from_model(&CameraModel::Pinhole([90.0, 90.0, 40.0, 30.0]), None),
            camera_from_world: Rigid::IDENTITY,
        };
        let file = Transforms { frames: vec![frame], ply_file_path: Some("cloud.ply".into()) };
        let photo = encoded(RgbImage::new(PHOTO_SIZE.0, PHOTO_SIZE.1), ImageFormat::Png);
        for (name, bytes) in [
            ("transforms.json", transforms::write(&file)),
            ("cloud.ply", CLOUD.as_bytes().to_vec()),
            ("photo.png", photo),
        ] {
            fs::write(folder.path().join(name), bytes).expect("written");
        }
        let source = open::open(folder.path(), &OpenOptions::default()).expect("it opens");
        let store = Store::open("memory://").expect("memory").blocking();
        let options = IngestOptions { downscale: 1, threads: 1 };
        let capture = ingest::ingest(&source, &store, &options, &|_, _| ()).expect("it is ingested").capture;
        Self { folder: folder.into(), source, capture, store }
    }

    /// Writes a file into a folder beside the photo.
    fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let folder = self.folder.path().join("maps");
        fs::create_dir_all(&folder).expect("a folder");
        fs::write(folder.join(name), bytes).expect("written");
        folder
    }
}

fn coco(photos: &Photos) -> Read {
    let photos = photos.clone();
    Reader::new("segmentation", move |bytes| {
        let path = photos.write("objects.json", bytes).join("objects.json");
        let file = CocoFile::read(&path).map_err(|error| error.to_string())?;
        let zones = file.zones(&photos.capture).map_err(|error| error.to_string())?;
        zones.check(&photos.capture.views).expect("accepted what it promises to refuse");
        Ok(())
    })
}

fn label_map(photos: Photos) -> Read {
    Reader::new("image", move |bytes| {
        let folder = photos.write("photo.png", bytes);
        let maps = LabelMaps::open(&folder, &photos.source).map_err(|error| error.to_string())?;
        let found = zones::find(&photos.capture, &ZoneSource::LabelMaps(maps), &photos.store, &|_, _| ());
        let (found, id) = found.map_err(|error| error.to_string())?;
        assert_eq!(zones::load(&photos.store, id, &photos.capture).expect("it was stored"), found);
        Ok(())
    })
}

fn zone_frame(photos: &Photos) -> Read {
    let Photos { capture, store, .. } = photos.clone();
    Reader::new("frames", move |bytes| {
        let id = store.put(bytes.to_vec()).expect("memory takes it");
        let zones = zones::load(&store, id, &capture).map_err(|error| error.to_string())?;
        for zone in zones.of(0) {
            let spans: u32 =
                zone.mask.iter().flat_map(|mask| mask.spans(PHOTO_SIZE.0)).map(|(_, x)| x.end - x.start).sum();
            assert!(spans <= PHOTO_SIZE.0 * PHOTO_SIZE.1 && zone.area() > 0.0);
        }
        Ok(())
    })
}
