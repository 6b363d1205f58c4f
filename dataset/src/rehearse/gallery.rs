//! One picture of what rehearsals can show: every layout, every kind of label, every fault.

use city::faults::{self, Fault, Kind};
use city::random::bits;
use city::sense::rig::{Rig, drive};
use city::sense::{Shot, looking, pinhole};
use city::trace::{Frame, Options, World, frame};
use city::{City, CitySettings, Layout};
use font8x8::legacy::BASIC_LEGACY;
use glam::{DVec3, Vec3};
use image::{Rgb, RgbImage};

use super::views::views;
use super::{Progress, RehearseError, Settings, impossible};

/// Tiles in a row.
const COLUMNS: u32 = 6;
/// Height of the line above each tile, pixels.
const CAPTION: u32 = 12;

/// Draws the gallery of a city's settings, its tiles as large as the photos.
///
/// # Errors
/// Settings out of range.
pub fn gallery(settings: &Settings, progress: Progress) -> Result<RgbImage, RehearseError> {
    settings.check()?;
    let (mut tiles, total) = (Vec::new(), 2 * Layout::ALL.len() + 8 + Kind::ALL.len());
    let add = |tiles: &mut Vec<(String, RgbImage)>, name: String, tile| {
        tiles.push((name, tile));
        progress("gallery", tiles.len(), total);
    };
    for &layout in Layout::ALL {
        let city = City::generate(&CitySettings { layout, ..settings.city })?;
        let world = World::new(&city).map_err(|e| impossible(&e))?;
        for (from, shot) in [("above", above(&city, settings)?), ("the street", street(&city, settings)?)] {
            add(&mut tiles, format!("{layout} from {from}"), photo(&take(&world, &shot, &[])?));
        }
    }
    let city = City::generate(&settings.city)?;
    let world = World::new(&city).map_err(|e| impossible(&e))?;
    let shot = street(&city, settings)?;
    let taken = take(&world, &shot, &[])?;
    for (name, tile) in labels(&taken) {
        add(&mut tiles, name.to_owned(), tile);
    }
    for &kind in Kind::ALL {
        let faults = [Fault { kind, strength: 1.0, seed: settings.city.seed }];
        let tile = match kind {
            Kind::PoseNoise | Kind::SparseViews | Kind::SensorDropout => map(&world, settings, &faults)?,
            Kind::MovingUnmasked => over(&take(&world, &shot, &faults)?, |frame, i| frame.mask[i] != 0),
            _ => {
                let spoilt = faults::spoil_shots(vec![shot.clone()], &faults);
                photo(&take(&world, spoilt.first().unwrap_or(&shot), &faults)?)
            }
        };
        add(&mut tiles, kind.to_string(), tile);
    }
    Ok(sheet(settings, &tiles))
}

fn take(world: &World, shot: &Shot, faults: &[Fault]) -> Result<Frame, RehearseError> {
    let options = Options { samples: 3, faults: faults.to_vec(), ..Options::default() };
    Ok(frame(world, shot, &options).map_err(|e| impossible(&e))?)
}

/// The city from a corner, all of it.
fn above(city: &City, settings: &Settings) -> Result<Shot, RehearseError> {
    let lens = pinhole(settings.width, settings.height, 60.0).map_err(|e| impossible(&e))?;
    let from = city.extent_metres * DVec3::new(-0.62, -0.62, 0.6);
    Ok(Shot::new("above".into(), "above", 5.0, looking(lens, from, -from.with_z(from.z * 1.08), DVec3::Z)))
}

/// Ahead from a car that is a third of its way along the longest street.
fn street(city: &City, settings: &Settings) -> Result<Shot, RehearseError> {
    let mut rig = Rig { width: settings.width, height: settings.height, fleet: true, ..Rig::default() };
    rig.cameras.truncate(1);
    rig.field_degrees = 80.0;
    let shots = drive(city, &rig).map_err(|e| impossible(&e))?;
    // shots of a street are named by it: front-left-STREET-NUMBER
    let of = |shot: &Shot| shot.name.rsplit('-').nth(1).map(str::to_owned);
    let longest = shots.chunk_by(|a, b| of(a) == of(b)).max_by_key(|leg| leg.len());
    let shot = longest.and_then(|leg| leg.get(leg.len() / 3)).cloned();
    shot.map_or_else(|| above(city, settings), Ok)
}

fn picture(frame: &Frame, pixel: impl Fn(usize) -> [u8; 3]) -> RgbImage {
    RgbImage::from_fn(frame.width, frame.height, |x, y| Rgb(pixel((y * frame.width + x) as usize)))
}

fn photo(frame: &Frame) -> RgbImage {
    picture(frame, |i| [0, 1, 2].map(|c| frame.rgb[3 * i + c]))
}

/// The photo with something in red.
fn over(frame: &Frame, is_red: impl Fn(&Frame, usize) -> bool) -> RgbImage {
    picture(frame, |i| {
        let [r, g, b] = [0, 1, 2].map(|c| frame.rgb[3 * i + c]);
        if is_red(frame, i) { [255, g / 3, b / 3] } else { [r, g, b] }
    })
}

/// A colour for a number; black for nothing.
fn colour(n: u32, nothing: u32) -> [u8; 3] {
    let [r, g, b, ..] = bits(11, u64::from(n)).to_le_bytes();
    if n == nothing { [0; 3] } else { [r, g, b].map(|c| 48 + c / 5 * 4) }
}

fn labels(frame: &Frame) -> [(&'static str, RgbImage); 8] {
    let near = |depth: f32| if depth > 0.0 { [(255.0 / (1.0 + depth / 12.0)) as u8; 3] } else { [0; 3] };
    let direction = |normal: [f32; 3]| {
        let n = Vec3::from(normal);
        if n == Vec3::ZERO { [0; 3] } else { (127.5 * (n + 1.0)).to_array().map(|c| c as u8) }
    };
    let (first, behind) = (&frame.first, &frame.behind);
    [
        ("photo", photo(frame)),
        ("depth", picture(frame, |i| near(first.depth[i]))),
        ("normals", picture(frame, |i| direction(frame.normals[i]))),
        ("semantic", picture(frame, |i| colour(first.semantic[i].into(), city::Class::Sky as u32))),
        ("instance", picture(frame, |i| colour(first.instance[i], 0))),
        ("material", picture(frame, |i| colour(first.material[i].into(), u32::from(u16::MAX)))),
        ("behind glass", picture(frame, |i| colour(behind.material[i].into(), u32::from(u16::MAX)))),
        ("what moves", over(frame, |frame, i| frame.moves[i] != 0)),
    ]
}

/// The city from straight above with the places of cameras: white as it was planned, red as it is reported.
fn map(world: &World, settings: &Settings, faults: &[Fault]) -> Result<RgbImage, RehearseError> {
    let lens = pinhole(settings.width, settings.height, 60.0).map_err(|e| impossible(&e))?;
    let height = 0.6 * world.city().extent_metres * lens.fx / f64::from(lens.height.min(lens.width));
    let nadir = looking(lens, DVec3::Z * height * 1.2, DVec3::NEG_Z, DVec3::Y);
    let mut map = photo(&take(world, &Shot::new("map".into(), "map", 5.0, nadir), &[])?);
    let planned = views(world, settings)?.shots;
    let reported = faults::spoil_shots(planned.clone(), faults);
    let white = planned.iter().map(|shot| (shot.camera.centre(), [255; 3]));
    let red = reported.iter().map(|shot| (shot.reported.centre(), [255, 0, 0]));
    for (place, colour) in white.chain(red) {
        let (pixel, _) = nadir.project(place.with_z(0.0));
        for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
            if let Some(dot) = map.get_pixel_mut_checked((pixel.x + dx).max(0.0) as u32, (pixel.y + dy).max(0.0) as u32)
            {
                *dot = Rgb(colour);
            }
        }
    }
    Ok(map)
}

fn sheet(settings: &Settings, tiles: &[(String, RgbImage)]) -> RgbImage {
    let (width, height) = (settings.width + 2, settings.height + CAPTION);
    let rows = (tiles.len() as u32).div_ceil(COLUMNS);
    let mut sheet = RgbImage::from_pixel(COLUMNS * width, rows * height, Rgb([24; 3]));
    for (i, (name, tile)) in (0..).zip(tiles) {
        let (left, top) = (i % COLUMNS * width, i / COLUMNS * height);
        image::imageops::replace(&mut sheet, tile, left.into(), (top + CAPTION).into());
        for (letter, at) in name.chars().zip(0..settings.width / 8) {
            for (y, row) in (0..).zip(BASIC_LEGACY[letter as usize & 127]) {
                for x in (0..8).filter(|x| row >> x & 1 == 1) {
                    sheet.put_pixel(left + 8 * at + x, top + 2 + y, Rgb([230; 3]));
                }
            }
        }
    }
    sheet
}
