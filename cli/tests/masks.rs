//! Objects on photos with the pixels that are theirs: the labels of a generated city, and the same ones from files.

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use city::{CitySettings, Layout, Traffic};
use common::{command, done, refused, stopped};
use dataset::synth::{self, Settings};
use image::{ImageBuffer, Luma};
use serde_json::{Value, json};

const SIZE: [u32; 2] = [96, 64];
const TRAIN: [&str; 9] = ["train", "city", "--steps", "60", "--budget", "600", "--levels", "1", "--quiet"];

/// Streets with parked and moving cars, seen from cars, with the truth of every pixel.
fn street(at: &Path) {
    let city = CitySettings { seed: 3, layout: Layout::Grid, traffic: Traffic::Light, ..CitySettings::default() };
    let [width, height] = SIZE;
    let settings = Settings { city, views: 16, width, height, aerial: 0.25, truth: true, ..Settings::default() };
    synth::write(&at.join("city"), &settings, &|_, _, _| ()).unwrap();
}

/// For each photo the class and the pixels of its labelled objects, by instance.
fn objects(at: &Path) -> BTreeMap<String, BTreeMap<u32, (String, Vec<bool>)>> {
    let file: Value = serde_json::from_slice(&fs::read(at.join("city/boxes3d.json")).unwrap()).unwrap();
    let of_photo = |photo: &Value| {
        let name = photo["image"].as_str().unwrap().trim_start_matches("images/").to_owned();
        let ids = image::open(at.join("city/instance").join(&name)).unwrap().into_rgb8();
        let ids: Vec<u32> = ids.pixels().map(|p| u32::from_le_bytes([p.0[0], p.0[1], p.0[2], 0])).collect();
        let object = |of: &Value| {
            let instance = of["instance"].as_u64().unwrap() as u32;
            (instance, (of["class"].as_str().unwrap().to_owned(), ids.iter().map(|id| *id == instance).collect()))
        };
        (name, photo["boxes"].as_array().unwrap().iter().map(object).collect())
    };
    file["images"].as_array().unwrap().iter().map(of_photo).collect()
}

/// The number of a class in the files made here.
fn number(classes: &[String], class: &str) -> usize {
    13 + classes.iter().position(|name| name == class).unwrap()
}

#[test]
fn a_citys_labels_are_the_same_zones_from_every_source() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    street(at);
    let objects = objects(at);
    let mut classes: Vec<String> = objects.values().flatten().map(|(_, (class, _))| class.clone()).collect();
    classes.sort();
    classes.dedup();

    // Label maps: class × 1000 + number.
    fs::create_dir(at.join("maps")).unwrap();
    let lines: Vec<String> = classes.iter().map(|class| format!("{} {class}", number(&classes, class))).collect();
    fs::write(at.join("maps/classes.txt"), lines.join("\n")).unwrap();
    for (name, objects) in &objects {
        let mut ids = vec![7u16; (SIZE[0] * SIZE[1]) as usize];
        for (i, (class, pixels)) in objects.values().enumerate() {
            let id = (1000 * number(&classes, class) + i) as u16;
            ids.iter_mut().zip(pixels).filter(|(_, is_inside)| **is_inside).for_each(|(at, _)| *at = id);
        }
        let map: ImageBuffer<Luma<u16>, _> = ImageBuffer::from_raw(SIZE[0], SIZE[1], ids).unwrap();
        map.save(at.join("maps").join(name)).unwrap();
    }

    // COCO: run lengths by columns.
    let runs = |pixels: &[bool]| {
        let [width, height] = SIZE.map(|side| side as usize);
        let (mut counts, mut is_inside) = (vec![0], false);
        for pixel in (0..width * height).map(|i| pixels[i % height * width + i / height]) {
            if pixel != is_inside {
                (counts, is_inside) = ([counts, vec![0]].concat(), pixel);
            }
            *counts.last_mut().unwrap() += 1;
        }
        json!({"size": [height, width], "counts": counts})
    };
    let numbered = || objects.iter().enumerate();
    let annotations = numbered().flat_map(|(id, (_, objects))| {
        let annotation = |(class, pixels): &(String, Vec<bool>)| {
            json!({"image_id": id, "category_id": number(&classes, class), "segmentation": runs(pixels)})
        };
        objects.values().map(annotation).collect::<Vec<_>>()
    });
    let image = |(id, (name, _)): (usize, (&String, _))| json!({"id": id, "file_name": name, "width": SIZE[0], "height": SIZE[1]});
    let category = |class: &String| json!({"id": number(&classes, class), "name": class});
    let coco = json!({
        "images": numbered().map(image).collect::<Vec<_>>(),
        "annotations": annotations.collect::<Vec<_>>(),
        "categories": classes.iter().map(category).collect::<Vec<_>>(),
    });
    fs::write(at.join("coco.json"), coco.to_string()).unwrap();

    let found = |zones: &str| done(at, &["inspect", "city", "--zones", zones])["objects"].clone();
    let labels = found("@labels");
    let cars = &labels["classes"]["car"];
    assert!(cars["objects"].as_u64() > Some(3) && cars["pixels"].as_u64() > Some(20), "{labels}");
    assert_eq!([found("maps"), found("coco.json")], [labels.clone(), labels.clone()]);
    let total: usize = objects.values().map(BTreeMap::len).sum();
    let kept: u64 = labels["classes"].as_object().unwrap().values().map(|of| of["objects"].as_u64().unwrap()).sum();
    assert!(kept < total as u64, "what moves is masked, and left out: {kept} of {total}");

    // The same weights, so the same bytes; with boxes alone other ones.
    let train = |out: &str, more: &[&str]| {
        done(at, &[&TRAIN[..], &["--out", out], more].concat());
        fs::read(at.join(out).join("merged.ply")).unwrap()
    };
    let masked = train("labels", &["--zones", "@labels"]);
    assert!(train("again", &["--zones", "@labels", "--threads", "1", "--workers", "2"]) == masked);
    assert!(train("configured", &["--config", "labels/config.toml"]) == masked);
    assert!(
        train("maps-out", &["--zones", "maps"]) == masked && train("coco-out", &["--zones", "coco.json"]) == masked
    );
    fs::rename(at.join("city/instance"), at.join("instance")).unwrap();
    refused(at, &["inspect", "city", "--zones", "@labels"], "has no folder instance");
    let manifest = fs::read_to_string(at.join("city/manifest.json")).unwrap();
    fs::write(at.join("city/manifest.json"), manifest.replace("\"truth\": true", "\"truth\": false")).unwrap();
    let boxes = found("@labels");
    assert!(boxes["classes"]["car"]["pixels"].as_u64() > cars["pixels"].as_u64(), "{boxes}");
    assert!(train("boxes", &["--zones", "@labels"]) != masked);
    fs::remove_file(at.join("city/boxes3d.json")).unwrap();
    refused(at, &["inspect", "city", "--zones", "@labels"], "has no labels of its own");

    // Pictures.
    let drawn = done(at, &["inspect", "city", "--zones", "maps", "--draw", "pictures", "--store", "labels/store"]);
    assert_eq!(drawn["objects"], labels);
    for name in objects.keys() {
        let (photo, picture) = (at.join("city/images").join(name), at.join("pictures").join(name));
        let [photo, picture] = [photo, picture].map(|path| image::open(path).unwrap().into_rgb8());
        assert_eq!(photo.dimensions(), picture.dimensions());
    }
    let sheet = image::open(at.join("pictures/objects.png")).unwrap();
    assert!(sheet.width() > 1000 && sheet.height() > 1000);
    let text = common::plat(at, &["inspect", "city", "--zones", "maps"]);
    let text = String::from_utf8(text.stdout).unwrap();
    assert!(["objects: ", " car, ", " of 16 photos"].iter().all(|words| text.contains(words)), "{text}");
}

#[test]
fn label_maps_that_do_not_fit_are_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    common::city(at, 16, 96, 64);
    fs::create_dir(at.join("maps")).unwrap();
    let inspect = ["inspect", "city", "--zones", "maps", "--quiet"];
    refused(at, &inspect, "has no label map of any photo");
    refused(at, &["inspect", "city", "--draw", "pictures"], "--zones");
    refused(at, &["inspect", "city", "--zones", "missing"], "missing: cannot be read");

    let transforms: Value = serde_json::from_slice(&fs::read(at.join("city/transforms.json")).unwrap()).unwrap();
    let name = transforms["frames"][3]["file_path"].as_str().unwrap().trim_start_matches("images/");
    let map = at.join("maps").join(name);
    let save = |width, height, id: &dyn Fn(u32) -> u16| {
        ImageBuffer::from_fn(width, height, |x, y| Luma([id(y * width + x)])).save(&map).unwrap();
    };
    save(64, 96, &|_| 26_001);
    refused(at, &inspect, "has 64×96 pixels, its photo 96×64");
    save(96, 64, &|_| 0);
    refused(at, &inspect, "shows no object of the classes person, rider, car");
    save(96, 64, &|i| i as u16);
    fs::write(at.join("maps/classes.json"), "{\"5\": \"five\", \"0\": \"none\"}").unwrap();
    // 5 and 5000 to 5999 are of class 5, below 1000 there are two classes.
    refused(at, &inspect, "has more than 1000 objects");
    save(96, 64, &|i| if i < 96 { 5 } else { 9 });
    let found = done(at, &inspect)["objects"].clone();
    assert_eq!(found, json!({"classes": {"five": {"objects": 1, "pixels": 96}}, "photos": 1}));
    let draw = [&inspect[..], &["--draw", "city/transforms.json"]].concat();
    stopped(&mut command(at, &draw), 1, "transforms.json: cannot be made");
    fs::write(at.join("maps/classes.json"), "{}").unwrap();
    refused(at, &inspect, "classes.json: names 0 classes");
    fs::write(at.join("maps/classes.json"), "[").unwrap();
    refused(at, &inspect, "classes.json: has no names by id");
    fs::remove_file(at.join("maps/classes.json")).unwrap();
    let bytes = fs::read(&map).unwrap();
    fs::write(&map, &bytes[..bytes.len() / 2]).unwrap();
    refused(at, &inspect, "is no PNG that can be read");
    fs::write(&map, "no picture").unwrap();
    refused(at, &inspect, "is not an image");
}
