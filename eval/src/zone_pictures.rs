//! Draws the zones of photos.

use std::collections::BTreeMap;

use image::{Rgb, RgbImage};
use scene::{Zone, Zones};

use crate::label_colours::label_colour;
use crate::sheet::{LINE, draw_text, fill, text_width};

/// Share of a zone's colour in the pixels of its mask.
const TINT: f32 = 0.45;
/// Width of the edges of boxes, pixels.
const EDGE: u32 = 2;
const DARK: Rgb<u8> = Rgb([16, 16, 16]);

/// Draws zones over a photo, mip `m` of a view whose mip 0 has this width: boxes and masks in the colour of their class, its
/// name, and the score where the source was not sure. Large zones lie below small ones, and names that would cover others
/// are left out.
pub fn draw_zones(photo: &mut RgbImage, zones: &[Zone], classes: &[String], width: u32, m: u8) {
    let mut sorted: Vec<&Zone> = zones.iter().collect();
    sorted.sort_by(|a, b| b.area().total_cmp(&a.area()));
    for zone in &sorted {
        draw_shape(photo, zone, width, m);
    }
    let mut taken: Vec<[u32; 4]> = Vec::new();
    for zone in sorted {
        let name = classes.get(usize::from(zone.class)).map_or("", String::as_str);
        let text = if zone.score < 1.0 { format!("{name} {:.2}", zone.score) } else { name.to_owned() };
        let [left, top, ..] = zone.corners.map(|side| side as u32 >> m);
        // Above the box, or inside where the photo ends.
        let line = top.checked_sub(LINE).unwrap_or(top);
        let place = [left, line, left.saturating_add(text_width(&text) + 8), line.saturating_add(LINE)];
        let is_free = |of: &[u32; 4]| of[0] >= place[2] || place[0] >= of[2] || of[1] >= place[3] || place[1] >= of[3];
        if taken.iter().all(is_free) {
            fill(photo, left, line, place[2] - left, LINE, colour(zone));
            draw_text(photo, left.saturating_add(4), line.saturating_add(4), &text, DARK);
            taken.push(place);
        }
    }
}

fn draw_shape(photo: &mut RgbImage, zone: &Zone, width: u32, m: u8) {
    let colour = colour(zone);
    // A pixel is in the mask if its middle is.
    let middle = (1 << m) / 2;
    let rows = zone.mask.iter().flat_map(|mask| mask.spans(width)).filter(|(y, _)| y % (1 << m) == middle);
    for (y, x) in rows {
        for x in (x.start + middle) >> m..(x.end + middle) >> m {
            if let Some(pixel) = photo.get_pixel_mut_checked(x, y >> m) {
                let mixed = |c: usize| f32::from(pixel.0[c]) * (1.0 - TINT) + f32::from(colour.0[c]) * TINT;
                *pixel = Rgb([0, 1, 2].map(|c| mixed(c) as u8));
            }
        }
    }
    let [left, top, right, bottom] = zone.corners.map(|side| side as u32 >> m);
    let (wide, high) = (right.saturating_sub(left).max(EDGE), bottom.saturating_sub(top).max(EDGE));
    fill(photo, left, top, wide, EDGE, colour);
    fill(photo, left, bottom.saturating_sub(EDGE), wide, EDGE, colour);
    fill(photo, left, top, EDGE, high, colour);
    fill(photo, right.saturating_sub(EDGE), top, EDGE, high, colour);
}

/// The colour of a zone's class.
fn colour(zone: &Zone) -> Rgb<u8> {
    Rgb(label_colour(u32::from(zone.class) + 1).to_array().map(|c| (255.0 * c) as u8))
}

/// For each class the number of its zones and of their pixels of mip 0, by name; classes without zones are left out.
pub fn count_zones(zones: &Zones) -> BTreeMap<&str, (u64, u64)> {
    let mut counts = BTreeMap::new();
    for zone in zones.of_views.iter().flatten() {
        let name = zones.classes.get(usize::from(zone.class)).map_or("", String::as_str);
        let (objects, pixels) = counts.entry(name).or_insert((0, 0));
        *objects += 1;
        *pixels += zone.area() as u64;
    }
    counts
}

#[cfg(test)]
mod tests {
    use scene::MaskBuilder;

    use super::*;

    #[test]
    fn boxes_masks_and_names_are_drawn_at_every_size() {
        let mut builder = MaskBuilder::new(200);
        (60..100).for_each(|y| builder.push(y, 50..150));
        let (mask, corners) = builder.finish().unwrap();
        let masked = Zone { corners, class: 1, score: 1.0, mask: Some(mask) };
        let boxed = Zone { corners: [0.0, 0.0, 3.0, 150.0], class: 9, score: 0.5, mask: None };
        let grey = Rgb([100; 3]);
        for m in [0, 1] {
            let mut photo = RgbImage::from_pixel(200 >> m, 150 >> m, grey);
            draw_zones(&mut photo, &[boxed.clone(), masked.clone()], &["car".into(), "bus".into()], 200, m);
            let at = |x: u32, y: u32| *photo.get_pixel(x >> m, y >> m);
            assert!(at(100, 90) != grey && at(180, 90) == grey && at(0, 149) != grey, "mip {m}");
            let edge = at(50, 90);
            assert!(edge != at(100, 90) && edge == at(51, 98), "mip {m}");
        }
        let zones = Zones { classes: vec!["car".into(), "bus".into()], of_views: vec![vec![masked; 2], vec![]] };
        assert_eq!(count_zones(&zones).into_iter().collect::<Vec<_>>(), [("bus", (2, 8000))]);
        // Zones that no photo has are cut off.
        let far = Zone { corners: [0.0, 0.0, 1e9, 1e9], ..boxed };
        draw_zones(&mut RgbImage::new(1, 1), &[far], &[], 1, 0);
    }
}
