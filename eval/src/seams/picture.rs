//! Pictures of the bands at faces.

use image::{Rgb, RgbImage, imageops};

use super::figures::RegionFigures;
use super::regions::Region;
use crate::sheet::{INK, PAPER, draw_text};

/// Colours of the two sides of a face.
const TINTS: [Rgb<u8>; 2] = [Rgb([0, 220, 255]), Rgb([255, 60, 200])];

/// Caption of a view's row.
pub(super) fn caption(name: &str, figures: Option<&RegionFigures>) -> String {
    let Some([[Some(band), ..], [Some(interior), ..]]) = figures else { return name.to_owned() };
    format!("{name}  band {band:.2} dB  interior {interior:.2} dB")
}

/// The picture with the sides of bands tinted, and pixels of neither region darkened.
pub(super) fn tinted(picture: &RgbImage, regions: &[Region]) -> RgbImage {
    let mut picture = picture.clone();
    for (pixel, region) in picture.pixels_mut().zip(regions) {
        let (tint, share) = match region {
            Region::Interior => continue,
            Region::Neither => (PAPER, 0.6),
            Region::Band(_, first) => (TINTS[usize::from(!first)], 0.45),
        };
        *pixel = Rgb([0, 1, 2].map(|c| (f32::from(pixel[c]) * (1.0 - share) + f32::from(tint[c]) * share) as u8));
    }
    picture
}

/// Rows of pictures side by side, each under its caption.
pub(super) fn table<const N: usize>(rows: &[(String, [RgbImage; N])]) -> RgbImage {
    const GAP: u32 = 8;
    const LINE: u32 = 24;
    let row_width = |pictures: &[RgbImage; N]| pictures.iter().map(|p| p.width() + GAP).sum::<u32>() + GAP;
    let row_height = |pictures: &[RgbImage; N]| pictures.iter().map(RgbImage::height).max().unwrap_or(0) + LINE + GAP;
    let width = rows.iter().map(|(_, pictures)| row_width(pictures)).max().unwrap_or(1);
    let height = rows.iter().map(|(_, pictures)| row_height(pictures)).sum::<u32>().max(1);
    let mut sheet = RgbImage::from_pixel(width, height, PAPER);
    let mut y = 0;
    for (caption, pictures) in rows {
        draw_text(&mut sheet, GAP, y + 4, caption, INK);
        let mut x = GAP;
        for picture in pictures {
            imageops::replace(&mut sheet, picture, i64::from(x), i64::from(y + LINE));
            x += picture.width() + GAP;
        }
        y += row_height(pictures);
    }
    sheet
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_are_tinted_by_side() {
        let regions = [Region::Band(0, true), Region::Band(0, false), Region::Interior, Region::Neither];
        let picture = tinted(&RgbImage::from_pixel(4, 1, Rgb([100, 100, 100])), &regions);
        let [first, second, interior, neither] = [0, 1, 2, 3].map(|x| picture.get_pixel(x, 0).0);
        assert!(first[2] > first[0] && second[0] > second[1]);
        assert_eq!(interior, [100; 3]);
        assert!(neither[0] < 60);
        assert_eq!(table::<2>(&[]).dimensions(), (1, 1));
    }
}
