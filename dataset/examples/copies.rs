//! A capture of any number of 12-megapixel photos, to see that memory does not grow with their number.
//!
//! ```text
//! cargo run --release -p dataset --example copies -- --out DIR --count 2000      # writes the capture
//! cargo run --release -p dataset --example copies -- --out DIR --ingest STORE    # ingests it, prints peak memory
//! ```
//!
//! All photos are one JPEG, made different by a comment, so that each has to be decoded and their mips are one set in
//! the store. Cameras look down from a grid through a lens with distortion, points lie on the ground below: COLMAP
//! text in `sparse/0`.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::{Context, Result, bail};
use dataset::ingest::{IngestOptions, ingest};
use dataset::open::{OpenOptions, open};
use glam::{DVec2, DVec3};
use image::{ImageFormat, Rgb, RgbImage};
use scene::CameraModel;

const WIDTH: u32 = 4000;
const HEIGHT: u32 = 3000;
const SPACING_METRES: f64 = 20.0;
const FLIGHT_METRES: f64 = 60.0;
const POINTS: usize = 4000;
const LENS: [f64; 8] = [3000.0, 3000.0, 2000.0, 1500.0, -0.03, 0.01, 0.0005, -0.0003];

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let (mut out, mut count, mut store, mut threads) = (None, None, None, 2);
    while let Some(flag) = arguments.next() {
        let value = arguments.next().with_context(|| format!("{flag} wants a value"))?;
        match flag.as_str() {
            "--out" => out = Some(PathBuf::from(value)),
            "--count" => count = Some(value.parse()?),
            "--ingest" => store = Some(value),
            "--threads" => threads = value.parse()?,
            _ => bail!("{flag} is not one of --out, --count, --ingest, --threads"),
        }
    }
    let out = out.context("--out is missing")?;
    if let Some(count) = count {
        write_capture(&out, count)?;
    }
    if let Some(store) = store {
        measure(&out, &store, threads)?;
    }
    Ok(())
}

fn measure(capture: &Path, store: &str, threads: usize) -> Result<()> {
    let source = open(capture, &OpenOptions::default())?;
    let opened = peak_megabytes();
    let next = AtomicUsize::new(0);
    let progress = |done: usize, of: usize| {
        if 10 * done / of > next.load(Ordering::Relaxed) {
            next.store(10 * done / of, Ordering::Relaxed);
            eprintln!("{done} of {of}, peak {} MB", peak_megabytes());
        }
    };
    let store = store::Store::open(store)?.blocking();
    let ingested = ingest(&source, &store, &IngestOptions { downscale: 1, threads }, &progress)?;
    println!(
        "{} views, {} decoded, {threads} threads, peak {} MB ({opened} MB before ingest), CPU {:.1} s, capture {}",
        ingested.capture.views.len(),
        ingested.decoded,
        peak_megabytes(),
        cpu_seconds(),
        ingested.id
    );
    Ok(())
}

/// The largest resident size so far.
fn peak_megabytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.and_then(|line| line.trim().trim_end_matches("kB").trim().parse::<u64>().ok()).unwrap_or(0) / 1024
}

/// User and system time of all threads, as Linux counts it: hundredths of a second.
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after_name = stat.rsplit(") ").next().unwrap_or_default().to_string();
    after_name.split(' ').skip(11).take(2).filter_map(|ticks| ticks.parse::<f64>().ok()).sum::<f64>() / 100.0
}

fn write_capture(out: &Path, count: usize) -> Result<()> {
    let (images, sparse) = (out.join("images"), out.join("sparse/0"));
    std::fs::create_dir_all(&images)?;
    std::fs::create_dir_all(&sparse)?;
    let jpeg = texture()?;
    for i in 0..count {
        std::fs::write(images.join(name(i)), with_comment(&jpeg, &format!("copy {i}")))?;
    }
    let (images, points) = poses(count)?;
    let lens: Vec<String> = LENS.iter().map(f64::to_string).collect();
    std::fs::write(sparse.join("cameras.txt"), format!("1 OPENCV {WIDTH} {HEIGHT} {}\n", lens.join(" ")))?;
    std::fs::write(sparse.join("images.txt"), images)?;
    std::fs::write(sparse.join("points3D.txt"), points)?;
    println!("{count} photos of {} bytes and {POINTS} points", jpeg.len());
    Ok(())
}

fn name(i: usize) -> String {
    format!("{i:05}.jpg")
}

/// A counter-based random number in 0..1.
fn random(counter: u64) -> f64 {
    let mut x = counter.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (x >> 11) as f64 / (1u64 << 53) as f64
}

/// Value noise of five octaves, about as hard to compress as a photo of gravel and grass.
fn texture() -> Result<Vec<u8>> {
    let noise = |x: u32, y: u32, octave: u32| {
        let (fx, fy) = (f64::from(x) / f64::from(1 << octave), f64::from(y) / f64::from(1 << octave));
        let at = |dx: u64, dy: u64| random(((fx as u64 + dx) << 40) ^ ((fy as u64 + dy) << 16) ^ u64::from(octave));
        let (u, v) = (fx.fract(), fy.fract());
        (at(0, 0) * (1.0 - u) + at(1, 0) * u) * (1.0 - v) + (at(0, 1) * (1.0 - u) + at(1, 1) * u) * v
    };
    let image = RgbImage::from_fn(WIDTH, HEIGHT, |x, y| {
        let value: f64 =
            [(1, 0.12), (3, 0.18), (5, 0.2), (7, 0.25), (9, 0.25)].map(|(o, w)| w * noise(x, y, o)).iter().sum();
        let tint = noise(x, y, 8);
        Rgb([value * (0.8 + 0.2 * tint), value, value * (1.0 - 0.3 * tint)].map(|v| (v * 255.0) as u8))
    });
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.write_to(&mut bytes, ImageFormat::Jpeg)?;
    Ok(bytes.into_inner())
}

/// A JPEG comment segment after the start-of-image marker.
fn with_comment(jpeg: &[u8], text: &str) -> Vec<u8> {
    let length = (text.len() as u16 + 2).to_be_bytes();
    [&jpeg[..2], &[0xff, 0xfe], &length, text.as_bytes(), &jpeg[2..]].concat()
}

/// images.txt and points3D.txt: a square grid of cameras that look straight down, each point seen by up to four.
fn poses(count: usize) -> Result<(String, String)> {
    let side = (count as f64).sqrt().ceil() as usize;
    let centre = |i: usize| DVec2::new((i % side) as f64, (i / side) as f64) * SPACING_METRES;
    let model = CameraModel::OpenCv(LENS);
    let mut seen = vec![String::new(); count];
    let mut seen_count = vec![0usize; count];
    let mut points = String::new();
    for p in 0..POINTS {
        let r = |k: usize| random((7 * p + k) as u64);
        let home = (r(0) * count as f64) as usize;
        let ground = centre(home) + DVec2::new(r(1) - 0.5, r(2) - 0.5) * SPACING_METRES;
        let point = ground.extend(3.0 * r(3));
        let grey = (r(4) * 255.0) as u8;
        write!(points, "{} {} {} {} {grey} {grey} {grey} 0.5", p + 1, point.x, point.y, point.z)?;
        for i in [home, home + 1, home + side, home + side + 1].into_iter().filter(|&i| i < count) {
            let eye = centre(i).extend(FLIGHT_METRES);
            let camera = DVec3::new(point.x - eye.x, eye.y - point.y, eye.z - point.z);
            let bent = model.distort(DVec2::new(camera.x, camera.y) / camera.z);
            let pixel = DVec2::new(LENS[0] * bent.x + LENS[2], LENS[1] * bent.y + LENS[3]);
            if pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < f64::from(WIDTH) && pixel.y < f64::from(HEIGHT) {
                write!(points, " {} {}", i + 1, seen_count[i])?;
                write!(seen[i], "{} {} {} ", pixel.x, pixel.y, p + 1)?;
                seen_count[i] += 1;
            }
        }
        points.push('\n');
    }
    let mut images = String::new();
    for (i, seen) in seen.iter().enumerate() {
        let c = centre(i);
        writeln!(images, "{} 0 1 0 0 {} {} {FLIGHT_METRES} 1 {}\n{}", i + 1, -c.x, c.y, name(i), seen.trim_end())?;
    }
    Ok((images, points))
}
