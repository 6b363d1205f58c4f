//! Draws contact sheets: photo, render and error map side by side, with figures.

use font8x8::legacy::BASIC_LEGACY;
use image::imageops::{self, FilterType};
use image::{Rgb, RgbImage};

/// Width of each of a row's three pictures, pixels.
const COLUMN: u32 = 480;
const GAP: u32 = 8;
/// Size of one of a letter's 8×8 dots, pixels.
const DOT: u32 = 2;
pub(crate) const LINE: u32 = 8 * DOT + 8;
const HEADER: u32 = 8 + LINE;
pub(crate) const INK: Rgb<u8> = Rgb([232, 232, 232]);
const DIM: Rgb<u8> = Rgb([150, 150, 150]);
pub(crate) const PAPER: Rgb<u8> = Rgb([24, 26, 30]);
/// Mean absolute difference over channels, 0..1, at which the heat map is saturated.
const MAX_ERROR: f32 = 0.25;
/// Colours of the heat map, evenly spaced from no error to [`MAX_ERROR`]; brightness increases monotonically.
const HEAT: [[f32; 3]; 6] = [
    [0.0, 0.0, 4.0],
    [66.0, 10.0, 104.0],
    [147.0, 38.0, 103.0],
    [221.0, 81.0, 58.0],
    [252.0, 165.0, 10.0],
    [252.0, 255.0, 164.0],
];

/// One view of a contact sheet.
#[derive(Debug, Clone)]
pub(crate) struct SheetRow {
    /// The view's name.
    pub(crate) label: String,
    /// The photo.
    pub(crate) photo: RgbImage,
    /// The render; normally as large as the photo.
    pub(crate) render: RgbImage,
    /// dB.
    pub(crate) psnr: Option<f64>,
    /// 0..1.
    pub(crate) ssim: Option<f64>,
    /// SSIMULACRA2, up to 100.
    pub(crate) perceptual: Option<f64>,
}

/// Draws photo | render | error, a row per view, under a header with the error's legend. Pictures are scaled to one width.
/// If a render differs in size from its photo, the row shows no error map and says so.
pub(crate) fn contact_sheet(rows: &[SheetRow]) -> RgbImage {
    let width = 3 * COLUMN + 4 * GAP;
    let heights: Vec<u32> = rows.iter().map(|row| scaled_height(&row.photo)).collect();
    let height = HEADER + heights.iter().map(|h| h + LINE + GAP).sum::<u32>();
    let mut sheet = RgbImage::from_pixel(width, height, PAPER);
    let column = |i: u32| GAP + i * (COLUMN + GAP);

    for (i, title) in ["photo", "render", "error"].iter().enumerate() {
        draw_text(&mut sheet, column(i as u32), 8, title, INK);
    }
    legend(&mut sheet, column(2) + 6 * 8 * DOT, 8);

    let mut y = HEADER;
    for (row, height) in rows.iter().zip(heights) {
        draw_text(&mut sheet, column(0), y + 4, &caption(row), INK);
        y += LINE;
        place(&mut sheet, &row.photo, column(0), y, height);
        place(&mut sheet, &row.render, column(1), y, height);
        match error_map(&row.photo, &row.render) {
            Some(error) => place(&mut sheet, &error, column(2), y, height),
            None => draw_text(&mut sheet, column(2), y + 4, "sizes differ", DIM),
        }
        y += height + GAP;
    }
    sheet
}

/// Mean absolute difference over channels as a heat map; `None` if the sizes differ.
pub(crate) fn error_map(photo: &RgbImage, render: &RgbImage) -> Option<RgbImage> {
    if photo.dimensions() != render.dimensions() {
        return None;
    }
    let mut map = RgbImage::new(photo.width(), photo.height());
    for ((out, a), b) in map.pixels_mut().zip(photo.pixels()).zip(render.pixels()) {
        let sum: u32 = a.0.iter().zip(b.0).map(|(&a, b)| u32::from(a.abs_diff(b))).sum();
        *out = heat(sum as f32 / (3.0 * 255.0) / MAX_ERROR);
    }
    Some(map)
}

/// Draws captioned pictures in three columns, scaled to one width. Those of a row share its height.
pub fn gallery(pictures: &[(String, RgbImage)]) -> RgbImage {
    let rows: Vec<(u32, &[(String, RgbImage)])> = pictures
        .chunks(3)
        .map(|row| (row.iter().map(|(_, picture)| scaled_height(picture)).max().unwrap_or_default(), row))
        .collect();
    let height = GAP + rows.iter().map(|(height, _)| height + LINE + GAP).sum::<u32>();
    let mut sheet = RgbImage::from_pixel(3 * COLUMN + 4 * GAP, height, PAPER);
    let mut y = GAP;
    for (height, row) in rows {
        for (i, (caption, picture)) in (0..).zip(row) {
            let x = GAP + i * (COLUMN + GAP);
            let letters = (COLUMN / (8 * DOT)) as usize;
            draw_text(&mut sheet, x, y + 4, &caption.chars().take(letters).collect::<String>(), INK);
            place(&mut sheet, picture, x, y + LINE, scaled_height(picture));
        }
        y += height + LINE + GAP;
    }
    sheet
}

/// Width of a text, pixels.
pub(crate) fn text_width(text: &str) -> u32 {
    text.chars().count() as u32 * 8 * DOT
}

/// Draws text in an 8×8 font at twice its size. Text beyond the image is cut off; characters outside ASCII become `?`.
pub(crate) fn draw_text(image: &mut RgbImage, x: u32, y: u32, text: &str, colour: Rgb<u8>) {
    for (i, letter) in text.chars().enumerate() {
        let glyph = BASIC_LEGACY[if letter.is_ascii() { letter as usize } else { '?' as usize }];
        let left = x.saturating_add(i as u32 * 8 * DOT);
        if left >= image.width() {
            break;
        }
        for (dy, bits) in glyph.iter().enumerate() {
            for dx in (0..8u32).filter(|dx| bits >> dx & 1 == 1) {
                fill(image, left + dx * DOT, y.saturating_add(dy as u32 * DOT), DOT, DOT, colour);
            }
        }
    }
}

fn caption(row: &SheetRow) -> String {
    let figure = |value: Option<f64>, digits: usize, name: &str, unit: &str| {
        value.map(|v| format!("  {name} {v:.digits$}{unit}")).unwrap_or_default()
    };
    let figures = [
        figure(row.psnr, 2, "PSNR", " dB"),
        figure(row.ssim, 3, "SSIM", ""),
        figure(row.perceptual, 1, "SSIMULACRA2", ""),
    ];
    format!("{}{}", row.label, figures.concat())
}

fn scaled_height(image: &RgbImage) -> u32 {
    let ratio = f64::from(image.height()) / f64::from(image.width().max(1));
    ((f64::from(COLUMN) * ratio).round() as u32).clamp(1, 4 * COLUMN)
}

fn place(sheet: &mut RgbImage, image: &RgbImage, x: u32, y: u32, height: u32) {
    if image.width() == 0 || image.height() == 0 {
        return;
    }
    // Enlarged pictures keep hard pixel edges, so that no detail is invented.
    let filter = if image.width() < COLUMN { FilterType::Nearest } else { FilterType::Triangle };
    let scaled = imageops::resize(image, COLUMN, height, filter);
    imageops::replace(sheet, &scaled, i64::from(x), i64::from(y));
}

fn legend(sheet: &mut RgbImage, x: u32, y: u32) {
    let bar = 200;
    draw_text(sheet, x, y, "0", DIM);
    for i in 0..bar {
        fill(sheet, x + 24 + i, y, 1, 8 * DOT, heat(i as f32 / (bar - 1) as f32));
    }
    draw_text(sheet, x + 24 + bar + 8, y, &format!("{MAX_ERROR} mean"), DIM);
}

/// The heat map's colour at a share of [`MAX_ERROR`].
fn heat(share: f32) -> Rgb<u8> {
    let at = share.clamp(0.0, 1.0) * (HEAT.len() - 1) as f32;
    let below = (at as usize).min(HEAT.len() - 2);
    let t = at - below as f32;
    Rgb(std::array::from_fn(|c| (HEAT[below][c] + t * (HEAT[below + 1][c] - HEAT[below][c]) + 0.5) as u8))
}

/// Fills a rectangle, as far as it lies in the image.
pub(crate) fn fill(image: &mut RgbImage, x: u32, y: u32, width: u32, height: u32, colour: Rgb<u8>) {
    for y in y..y.saturating_add(height).min(image.height()) {
        for x in x..x.saturating_add(width).min(image.width()) {
            image.put_pixel(x, y, colour);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(photo: RgbImage, render: RgbImage) -> SheetRow {
        SheetRow { label: "view_é.png".into(), photo, render, psnr: Some(27.3), ssim: None, perceptual: None }
    }

    #[test]
    fn equal_pictures_have_a_black_error_and_others_a_bright_one() {
        let grey = RgbImage::from_pixel(60, 40, Rgb([100, 100, 100]));
        let white = RgbImage::from_pixel(60, 40, Rgb([255, 255, 255]));
        assert_eq!(*error_map(&grey, &grey).unwrap().get_pixel(5, 5), Rgb([0, 0, 4]));
        assert_eq!(*error_map(&grey, &white).unwrap().get_pixel(5, 5), Rgb([252, 255, 164]));
        let bright = |share: f32| heat(share).0.iter().map(|&c| u32::from(c)).sum::<u32>();
        assert!((1..=20).all(|i| bright(i as f32 / 20.0) > bright((i - 1) as f32 / 20.0)));
    }

    #[test]
    fn pictures_are_placed_in_their_columns() {
        let (red, blue) =
            (RgbImage::from_pixel(60, 40, Rgb([200, 0, 0])), RgbImage::from_pixel(60, 40, Rgb([0, 0, 200])));
        let sheet = contact_sheet(&[row(red.clone(), blue.clone()), row(red, blue)]);
        assert_eq!(sheet.dimensions(), (3 * COLUMN + 4 * GAP, HEADER + 2 * (320 + LINE + GAP)));
        let y = HEADER + LINE + 160;
        assert_eq!(*sheet.get_pixel(GAP + 200, y), Rgb([200, 0, 0]));
        assert_eq!(*sheet.get_pixel(2 * GAP + COLUMN + 200, y), Rgb([0, 0, 200]));
        let has_ink = (HEADER..HEADER + LINE).any(|y| (0..400).any(|x| *sheet.get_pixel(x, y) == INK));
        assert!(has_ink, "the caption is missing");
    }

    #[test]
    fn a_gallery_has_three_columns() {
        let red = (String::from("a.png"), RgbImage::from_pixel(60, 40, Rgb([200, 0, 0])));
        let sheet = gallery(&vec![red; 4]);
        assert_eq!(sheet.dimensions(), (3 * COLUMN + 4 * GAP, GAP + 2 * (320 + LINE + GAP)));
        let second = GAP + 320 + LINE + GAP + LINE;
        assert_eq!(*sheet.get_pixel(GAP, second), Rgb([200, 0, 0]));
        assert_eq!(*sheet.get_pixel(2 * GAP + COLUMN, second), PAPER);
        assert_eq!(gallery(&[]).height(), GAP);
    }

    #[test]
    fn degenerate_sizes_do_not_panic() {
        let sheet = contact_sheet(&[
            row(RgbImage::new(1, 3000), RgbImage::new(2, 2)),
            row(RgbImage::new(4000, 1), RgbImage::new(4000, 1)),
            row(RgbImage::new(0, 0), RgbImage::new(0, 0)),
        ]);
        assert!(sheet.height() > 4 * COLUMN);
        assert_eq!(contact_sheet(&[]).height(), HEADER);
    }
}
