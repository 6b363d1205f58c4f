//! Draws one overview image of synthetic captures: every layout, every kind of label, every fault. Street views are taken where
//! the most objects are visible.

use std::collections::{BTreeMap, BTreeSet};

use city::faults::{self, Fault, FaultKind};
use city::random::bits;
use city::sense::rig::{Rig, drive};
use city::sense::{Shot, camera_towards, pinhole};
use city::trace::{Frame, RenderOptions, World, render_frame};
use city::{City, CitySettings, Layout};
use font8x8::legacy::BASIC_LEGACY;
use glam::{DVec3, Vec3};
use image::{Rgb, RgbImage};
use rayon::prelude::*;

use super::settings::{Progress, Settings, SynthError, unsupported};
use super::shots;

/// Tiles per row.
const COLUMNS: u32 = 6;
/// Street shots tried for the busiest one.
const CANDIDATES: usize = 64;
/// Height of the caption above each tile, pixels.
const CAPTION_HEIGHT: u32 = 12;

/// Draws the gallery for these settings, with tiles of the photos' size.
///
/// # Errors
/// Settings out of range.
pub fn gallery(settings: &Settings, progress: Progress) -> Result<RgbImage, SynthError> {
    settings.check()?;
    let (mut tiles, total) = (Vec::new(), 2 * Layout::ALL.len() + 8 + FaultKind::ALL.len());
    let add = |tiles: &mut Vec<(String, RgbImage)>, name: String, tile| {
        tiles.push((name, tile));
        progress("gallery", tiles.len(), total);
    };
    for &layout in Layout::ALL {
        let city = City::generate(&CitySettings { layout, ..settings.city })?;
        let world = World::new(&city).map_err(|e| unsupported(&e))?;
        for (from, shot) in [("above", above(&city, settings)?), ("the street", street(&world, settings)?)] {
            add(&mut tiles, format!("{layout} from {from}"), photo(&take(&world, &shot, &[])?));
        }
    }
    let city = City::generate(&settings.city)?;
    let world = World::new(&city).map_err(|e| unsupported(&e))?;
    let shot = street(&world, settings)?;
    let taken = take(&world, &shot, &[])?;
    for (name, tile) in labels(&taken) {
        add(&mut tiles, name.to_owned(), tile);
    }
    for &kind in FaultKind::ALL {
        let faults = [Fault { kind, strength: 1.0, seed: settings.city.seed }];
        let (caption, tile) = match kind {
            FaultKind::ExposureDrift => ("most, least", drift(&world, &shot, &faults)?),
            FaultKind::PoseNoise | FaultKind::ClockSkew | FaultKind::WrongCalibration => {
                ("reported over true", blended_poses(&world, &shot, &faults)?)
            }
            FaultKind::SparseViews | FaultKind::SensorDropout => ("red is lost", map(&world, settings, &faults)?),
            FaultKind::MovingUnmasked => ("red is forgotten", {
                highlighted(&take(&world, &shot, &faults)?, |frame, i| frame.moves[i] != 0 && frame.mask[i] == 0)
            }),
            _ => ("", photo(&take(&world, &spoilt(&shot, &faults), &faults)?)),
        };
        let colon = if caption.is_empty() { "" } else { ": " };
        add(&mut tiles, format!("{kind}{colon}{caption}"), tile);
    }
    Ok(sheet(settings, &tiles))
}

fn take(world: &World, shot: &Shot, faults: &[Fault]) -> Result<Frame, SynthError> {
    let options = RenderOptions { samples: 3, faults: faults.to_vec(), ..RenderOptions::default() };
    Ok(render_frame(world, shot, &options).map_err(|e| unsupported(&e))?)
}

/// The whole city from above a corner.
fn above(city: &City, settings: &Settings) -> Result<Shot, SynthError> {
    let lens = pinhole(settings.width, settings.height, 60.0).map_err(|e| unsupported(&e))?;
    let from = city.extent_metres * DVec3::new(-0.62, -0.62, 0.6);
    Ok(Shot::new("above".into(), "above", 5.0, camera_towards(lens, from, -from.with_z(from.z * 1.08), DVec3::Z)))
}

/// The forward view of a car at the busiest of some positions along all streets.
fn street(world: &World, settings: &Settings) -> Result<Shot, SynthError> {
    let city = world.city();
    let mut rig = Rig { width: settings.width, height: settings.height, fleet: true, ..Rig::default() };
    rig.cameras.truncate(1);
    rig.field_degrees = 80.0;
    let shots = drive(city, &rig).map_err(|e| unsupported(&e))?;
    // Streets extend to the horizon, beyond the city.
    let within = |shot: &&Shot| shot.camera.centre().truncate().abs().max_element() < 0.4 * city.extent_metres;
    let inside: Vec<&Shot> = shots.iter().filter(within).collect();
    let tried: Vec<&Shot> = inside.iter().copied().step_by(inside.len().div_ceil(CANDIDATES).max(1)).collect();
    let lens = pinhole(96, 54, 80.0).map_err(|e| unsupported(&e))?;
    let sketch = RenderOptions { samples: 1, corners: false, ..RenderOptions::default() };
    let activity_of = |shot: &&Shot| -> Result<f64, SynthError> {
        let mut small = (*shot).clone();
        small.camera.pinhole = lens;
        Ok(activity(&render_frame(world, &small, &sketch).map_err(|e| unsupported(&e))?))
    };
    let activities: Vec<f64> = tried.par_iter().map(activity_of).collect::<Result<_, _>>()?;
    let best = tried.iter().zip(&activities).rev().max_by(|a, b| a.1.total_cmp(b.1));
    best.map_or_else(|| above(city, settings), |(&best, _)| Ok(best.clone()))
}

/// A score of the objects visible in a frame. Moving ones count ten times as much as static ones, large ones little more than small
/// ones, and the nth of a class 1/n.
fn activity(frame: &Frame) -> f64 {
    let mut objects: BTreeMap<(u8, u32), (f64, f64)> = BTreeMap::new();
    for (i, &instance) in frame.first.instance.iter().enumerate().filter(|(_, instance)| **instance != 0) {
        let object = objects.entry((frame.first.semantic[i], instance)).or_default();
        object.0 += 1.0;
        object.1 = if frame.moves[i] != 0 { 1.0 } else { 0.1 };
    }
    let mut classes: BTreeMap<u8, Vec<f64>> = BTreeMap::new();
    for ((class, _), (pixels, weight)) in objects {
        classes.entry(class).or_default().push(weight * pixels.sqrt().min(9.0));
    }
    let of_class = |mut all: Vec<f64>| {
        all.sort_by(|a, b| b.total_cmp(a));
        all.iter().zip(1..).map(|(score, nth)| score / f64::from(nth)).sum::<f64>()
    };
    classes.into_values().map(of_class).sum()
}

fn spoilt(shot: &Shot, faults: &[Fault]) -> Shot {
    faults::degrade_shots(vec![shot.clone()], faults).pop().unwrap_or_else(|| shot.clone())
}

/// The shot with the highest exposure gain of two minutes on the left, with the lowest on the right.
fn drift(world: &World, shot: &Shot, faults: &[Fault]) -> Result<RgbImage, SynthError> {
    let later = (0..120).map(|i| Shot { seconds: shot.seconds + f64::from(i), ..shot.clone() }).collect();
    let gains: Vec<f32> = faults::degrade_shots(later, faults).iter().map(|shot| shot.exposure).collect();
    let with = |exposure: Option<f32>| {
        take(world, &Shot { exposure: exposure.unwrap_or(shot.exposure), ..shot.clone() }, &[])
            .map(|frame| photo(&frame))
    };
    let mut tile = with(gains.iter().copied().max_by(f32::total_cmp))?;
    let dark = with(gains.iter().copied().min_by(f32::total_cmp))?;
    let half = i64::from(tile.width() / 2);
    let right = image::imageops::crop_imm(&dark, half as u32, 0, tile.width() - half as u32, tile.height()).to_image();
    image::imageops::replace(&mut tile, &right, half, 0);
    Ok(tile)
}

/// The view of the reported camera blended with that of the true one.
fn blended_poses(world: &World, shot: &Shot, faults: &[Fault]) -> Result<RgbImage, SynthError> {
    let spoilt = spoilt(shot, faults);
    let seen = take(world, &spoilt, &[])?;
    let told = take(world, &Shot { camera: spoilt.reported, ..spoilt }, &[])?;
    Ok(picture(&seen, |i| [0, 1, 2].map(|c| seen.rgb[3 * i + c].midpoint(told.rgb[3 * i + c]))))
}

fn picture(frame: &Frame, pixel: impl Fn(usize) -> [u8; 3]) -> RgbImage {
    RgbImage::from_fn(frame.width, frame.height, |x, y| Rgb(pixel((y * frame.width + x) as usize)))
}

fn photo(frame: &Frame) -> RgbImage {
    picture(frame, |i| [0, 1, 2].map(|c| frame.rgb[3 * i + c]))
}

/// The photo with some pixels in red.
fn highlighted(frame: &Frame, is_red: impl Fn(&Frame, usize) -> bool) -> RgbImage {
    picture(frame, |i| {
        let [r, g, b] = [0, 1, 2].map(|c| frame.rgb[3 * i + c]);
        if is_red(frame, i) { [255, g / 3, b / 3] } else { [r, g, b] }
    })
}

/// A pseudo-random colour for a label; black for `background`.
fn label_colour(n: u32, background: u32) -> [u8; 3] {
    let [r, g, b, ..] = bits(11, u64::from(n)).to_le_bytes();
    if n == background { [0; 3] } else { [r, g, b].map(|c| 48 + c / 5 * 4) }
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
        ("semantic", picture(frame, |i| label_colour(first.semantic[i].into(), city::Class::Sky as u32))),
        ("instance", picture(frame, |i| label_colour(first.instance[i], 0))),
        ("material", picture(frame, |i| label_colour(first.material[i].into(), u32::from(u16::MAX)))),
        ("behind glass", picture(frame, |i| label_colour(behind.material[i].into(), u32::from(u16::MAX)))),
        ("what moves", highlighted(frame, |frame, i| frame.moves[i] != 0)),
    ]
}

/// The city from straight above with the camera positions: white if kept, red if lost to a fault.
fn map(world: &World, settings: &Settings, faults: &[Fault]) -> Result<RgbImage, SynthError> {
    let lens = pinhole(settings.width, settings.height, 60.0).map_err(|e| unsupported(&e))?;
    let height = 0.6 * world.city().extent_metres * lens.fx / f64::from(lens.height.min(lens.width));
    let nadir = camera_towards(lens, DVec3::Z * height * 1.2, DVec3::NEG_Z, DVec3::Y);
    let mut map = photo(&take(world, &Shot::new("map".into(), "map", 5.0, nadir), &[])?);
    let planned = shots::plan(world, settings)?.shots;
    let kept: BTreeSet<String> =
        faults::degrade_shots(planned.clone(), faults).into_iter().map(|shot| shot.name).collect();
    for shot in &planned {
        let colour = if kept.contains(&shot.name) { [255; 3] } else { [255, 0, 0] };
        let (pixel, _) = nadir.project(shot.camera.centre().with_z(0.0));
        for (dx, dy) in (0..9).map(|i| (f64::from(i % 3) - 1.0, f64::from(i / 3) - 1.0)) {
            let (x, y) = ((pixel.x + dx).max(0.0) as u32, (pixel.y + dy).max(0.0) as u32);
            if let Some(dot) = map.get_pixel_mut_checked(x, y) {
                *dot = Rgb(colour);
            }
        }
    }
    Ok(map)
}

fn sheet(settings: &Settings, tiles: &[(String, RgbImage)]) -> RgbImage {
    let (width, height) = (settings.width + 2, settings.height + CAPTION_HEIGHT);
    let rows = (tiles.len() as u32).div_ceil(COLUMNS);
    let mut sheet = RgbImage::from_pixel(COLUMNS * width, rows * height, Rgb([24; 3]));
    for (i, (name, tile)) in (0..).zip(tiles) {
        let (left, top) = (i % COLUMNS * width, i / COLUMNS * height);
        image::imageops::replace(&mut sheet, tile, left.into(), (top + CAPTION_HEIGHT).into());
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
