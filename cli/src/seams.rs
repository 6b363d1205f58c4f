//! Does the division into blocks show? Pixels of held-out views near a block's face against all others of the same views.
//!
//! A pixel is near a face where the place that it shows is, by the rendered depth of the finest model without its backdrop.
//! Pixels that show no place in the scene's root square, and masked ones, count in neither part. What is near a face may be harder or
//! easier than the rest whatever the division: the same pixels of a model trained as one block say by how much.
//!
//! Each face has two figures of its own. Its *jump* is how far the two blocks disagree: the band is drawn as one block
//! has it (with its halo's splats in place of the neighbour's own) and as the other has it. Its *step* is what an eye follows: by how much
//! the mean signed error differs between the face's sides.

use std::path::{Path, PathBuf};

use bench::sheet::{error_map, text as write_text, write_png};
use blocks::ground::HALO_SCALE;
use blocks::{Cut, Seams};
use dataset::windows::WindowReader;
use glam::DVec3;
use image::{Rgb, RgbImage, imageops};
use render::cpu::Renderer;
use render::{Frame, Options};
use scene::{BlockId, Camera, Capture, Splats};
use serde::Serialize;
use train::metrics;

use crate::commands::eval::{self, mean};
use crate::commands::render::to_image;
use crate::cuts::{scene_of, shown_at, without_backdrop};
use crate::failure::Failure;
use crate::maps;
use crate::model::Tree;
use crate::output::Output;

/// Near is this, where the capture says how long a metre is ...
const NEAR_METRES: f64 = 2.0;
/// ... else this share of the smallest block's edge.
const NEAR_SHARE: f64 = 1.0 / 32.0;
const NEAR_SHARE_MAX: f64 = 1.0 / 8.0;
/// Of a view that counts, band and interior each have at least this share of the pixels.
const MIN_SHARE: f64 = 0.01;
/// A side of a face counts in a view from this many pixels.
const MIN_PIXELS: usize = 24;
/// Views in the picture at most.
const SHOWN: usize = 8;
const TINT: [Rgb<u8>; 2] = [Rgb([0, 220, 255]), Rgb([255, 60, 200])];
const PAPER: Rgb<u8> = Rgb([24, 26, 30]);
const INK: Rgb<u8> = Rgb([232, 232, 232]);

/// The seam report.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct SeamReport {
    pub(crate) seam_metres: f64,
    /// Views that show enough of both.
    pub(crate) views: usize,
    /// Share of those views' pixels that is near a face; and that is neither near one nor left out.
    pub(crate) seam_share: f64,
    pub(crate) interior_share: f64,
    #[serde(flatten)]
    pub(crate) figures: SeamFigures,
    /// With `--seams-of`: the figures of the model whose faces these are.
    pub(crate) of: Option<SeamFigures>,
    /// With `--seams-of`: by how many dB its band lies farther below its interior than MODEL's does: what the faces cost.
    pub(crate) faces_cost_db: Option<f64>,
    pub(crate) faces: Vec<FaceFigures>,
    pub(crate) sheet: PathBuf,
    pub(crate) birdseye: PathBuf,
}

/// Means over views of one model.
#[derive(Debug, Clone, Copy, Serialize)]
pub(crate) struct SeamFigures {
    /// dB.
    pub(crate) seam_psnr: Option<f64>,
    pub(crate) interior_psnr: Option<f64>,
    pub(crate) seam_ssim: Option<f64>,
    pub(crate) interior_ssim: Option<f64>,
    /// ꟻLIP: 0 is no visible difference, 1 the largest.
    pub(crate) seam_flip: Option<f64>,
    pub(crate) interior_flip: Option<f64>,
    /// Interior above band, dB.
    pub(crate) gap_db: Option<f64>,
}

/// A face.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct FaceFigures {
    pub(crate) a: BlockId,
    pub(crate) b: BlockId,
    /// Views that show enough of it.
    pub(crate) views: usize,
    /// Root mean square over the band of what drawing it as `a` has it differs from as `b` has it, levels of 255.
    /// Null where neither kept splats of the other's side.
    pub(crate) jump: Option<f64>,
    /// Difference of the mean signed error across the face, mean over channels and views, levels of 255.
    pub(crate) step: Option<f64>,
    /// With `--seams-of`: the step there of the model that the faces are not of.
    pub(crate) control_step: Option<f64>,
}

/// What is measured.
pub(crate) struct Ask<'a> {
    /// Whose faces.
    pub(crate) tree: &'a Tree,
    /// Another model to measure at them, and whether it is drawn anti-aliased.
    pub(crate) control: Option<(&'a Splats, bool)>,
    pub(crate) seam_metres: Option<f64>,
    pub(crate) out: &'a Path,
}

/// Where a pixel lies.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Part {
    Neither,
    Interior,
    /// Near the face of this pair, on the side of its first block?
    Band(u32, bool),
}

/// Measures over held-out views, by index into the reader's capture.
pub(crate) fn measure(
    ask: &Ask,
    reader: &WindowReader,
    held_out: &[u32],
    output: &Output,
) -> Result<SeamReport, Failure> {
    let (tree, plan) = (ask.tree, &ask.tree.plan);
    let leaves = plan.leaves();
    let seams = Seams::of(&leaves, &plan.ground);
    let pairs = seams.pairs();
    let near = ask.seam_metres.unwrap_or_else(|| default_metres(tree, &pairs, reader.capture()));
    let finest = tree.sewn(&leaves);
    let scene = without_backdrop(&finest, &plan.ground);
    let place = Places { tree, leaves: &leaves, seams: &seams, pairs: &pairs, near };
    let draw = |renderer: &mut Renderer, splats: &Splats, antialiased: bool, camera: &Camera| -> Frame {
        let options = Options { antialiased, extras: true, sh_degree: splats.sh_degree(), ..Options::default() };
        renderer.forward(splats, None, camera, &options).clone()
    };

    let mut renderer = Renderer::default();
    let (mut own, mut control) = (Vec::new(), Vec::new());
    let mut shares = [Vec::new(), Vec::new()];
    let mut faces: Vec<FaceSums> = vec![FaceSums::default(); pairs.len()];
    let mut rows = Vec::new();
    let progress = output.progress("measuring seams", held_out.len() as u64);
    for (at, &index) in held_out.iter().enumerate() {
        let view = &reader.capture().views[index as usize];
        let photo = reader.window(index, 0, view.camera.full()).map_err(|e| Failure::Work(e.to_string()))?;
        let frame = draw(&mut renderer, &finest, tree.antialiased, &view.camera);
        let mut parts = place.parts(&draw(&mut renderer, &scene, tree.antialiased, &view.camera), &view.camera);
        if let Some(mask) = &photo.mask {
            parts.iter_mut().zip(mask).filter(|(_, mask)| **mask < 128).for_each(|(part, _)| *part = Part::Neither);
        }
        let truth: Vec<f32> = photo.rgb.iter().map(|&value| f32::from(value) / 255.0).collect();
        let colour = |frame: &Frame| Vec::from_iter(frame.colour.iter().map(|value| value.clamp(0.0, 1.0)));
        let colours = colour(&frame);
        let other =
            ask.control.map(|(splats, antialiased)| colour(&draw(&mut renderer, splats, antialiased, &view.camera)));

        let share = |of: fn(&Part) -> bool| parts.iter().filter(|part| of(part)).count() as f64 / parts.len() as f64;
        let [band, interior] = [share(|p| matches!(p, Part::Band(..))), share(|p| *p == Part::Interior)];
        if band.min(interior) >= MIN_SHARE {
            own.push(view_figures(&colours, &truth, &parts, frame.width));
            control.extend(other.iter().map(|colours| view_figures(colours, &truth, &parts, frame.width)));
            shares[0].push(Some(band));
            shares[1].push(Some(interior));
        }
        for (pair, sums) in faces.iter_mut().enumerate() {
            let Some(own_step) = step(&colours, &truth, &parts, pair as u32) else { continue };
            sums.views += 1;
            sums.step.push(Some(own_step));
            sums.control_step.extend(other.iter().map(|colours| step(colours, &truth, &parts, pair as u32)));
            let sides = pairs[pair].map(|keeper| place.as_kept_by(&finest, pair, keeper));
            if sides.iter().all(Option::is_none) {
                continue;
            }
            let [a, b] = sides.map(|splats| match splats {
                Some(splats) => colour(&draw(&mut renderer, &splats, tree.antialiased, &view.camera)),
                None => colours.clone(),
            });
            let area = parts.len();
            let in_band = (0..area).filter(|&i| matches!(parts[i], Part::Band(of, _) if of == pair as u32));
            for i in in_band.flat_map(|i| [i, area + i, 2 * area + i]) {
                sums.jump.0 += f64::from(255.0 * (a[i] - b[i])).powi(2);
                sums.jump.1 += 1;
            }
        }
        if band > 0.0 && rows.len() < SHOWN {
            let picture = to_image(&frame);
            rows.push((
                caption(&view.name, own.last().filter(|_| band.min(interior) >= MIN_SHARE)),
                [
                    eval::photo_image(&photo),
                    picture.clone(),
                    tinted(&picture, &parts),
                    error_map(&eval::photo_image(&photo), &picture).unwrap_or(picture),
                ],
            ));
        }
        progress.at(at as u64 + 1, "");
    }
    drop(progress);

    let (sheet, birdseye) = (ask.out.join("seams.png"), ask.out.join("seams_birdseye.png"));
    write_png(&sheet, &table(&rows))?;
    let camera = bench::birdseye_camera(reader.capture(), plan.ground.to_world(DVec3::Z), 960);
    let frame = draw(&mut renderer, &finest, tree.antialiased, &camera);
    let picture = to_image(&frame);
    let parts = place.parts(&draw(&mut renderer, &scene, tree.antialiased, &camera), &camera);
    let pictures = [picture.clone(), tinted(&picture, &parts)];
    write_png(&birdseye, &table(&[("finest model, and where its faces are".into(), pictures)]))?;

    let [own, control] = [own, control].map(|views| (!views.is_empty()).then(|| means(&views)));
    let faces = pairs.iter().zip(faces).map(|(&[a, b], sums)| sums.figures(a, b)).collect();
    let none = means(&[]);
    Ok(SeamReport {
        seam_metres: near,
        views: shares[0].len(),
        seam_share: mean(shares[0].iter().copied()).unwrap_or_default(),
        interior_share: mean(shares[1].iter().copied()).unwrap_or_default(),
        faces_cost_db: own.zip(control).and_then(|(own, control)| Some(own.gap_db? - control.gap_db?)),
        of: own.filter(|_| ask.control.is_some()),
        figures: if ask.control.is_some() { control } else { own }.unwrap_or(none),
        faces,
        sheet,
        birdseye,
    })
}

/// The report for people.
pub(crate) fn text(report: &SeamReport) -> String {
    let figure = |value: Option<f64>, digits: usize| value.map_or("-".into(), |v| format!("{v:.digits$}"));
    let mut text = format!(
        "within {:.2} m of a face ({:.1} % of {} views) against interior ({:.1} %)\n",
        report.seam_metres,
        100.0 * report.seam_share,
        report.views,
        100.0 * report.interior_share
    );
    let mut lines = vec![("MODEL", &report.figures)];
    lines.extend(report.of.as_ref().map(|of| ("that model", of)));
    text += &format!("{:<10}  {:>14}  {:>15}  {:>15}  gap dB\n", "", "PSNR", "SSIM", "FLIP");
    for (name, f) in lines {
        text += &format!(
            "{name:<10}  {:>6} / {:>5}  {:>6} / {:>6}  {:>6} / {:>6}  {:>6}\n",
            figure(f.seam_psnr, 2),
            figure(f.interior_psnr, 2),
            figure(f.seam_ssim, 4),
            figure(f.interior_ssim, 4),
            figure(f.seam_flip, 4),
            figure(f.interior_flip, 4),
            figure(f.gap_db, 2),
        );
    }
    if let Some(cost) = report.faces_cost_db {
        text += &format!("the faces cost {cost:.2} dB\n");
    }
    text += "face                  views    jump    step";
    text += if report.of.is_some() { "  (without)\n" } else { "  levels of 255\n" };
    for face in &report.faces {
        let control = face.control_step.map_or(String::new(), |step| format!("  ({step:.1})"));
        let name = format!("{} | {}", face.a, face.b);
        let (jump, step) = (figure(face.jump, 1), figure(face.step, 1));
        text += &format!("{name:<20} {:>6} {jump:>7} {step:>7}{control}\n", face.views);
    }
    text + &format!("{}\n{}", report.sheet.display(), report.birdseye.display())
}

/// [`NEAR_METRES`], or by the edge of the smallest block that has a face.
fn default_metres(tree: &Tree, pairs: &[[BlockId; 2]], capture: &Capture) -> f64 {
    let level = pairs.iter().flatten().map(|block| block.level).max().unwrap_or(0);
    let edge = tree.plan.ground.core_edge_metres(level);
    match capture.geo_origin {
        Some(_) => NEAR_METRES.min(NEAR_SHARE_MAX * edge),
        None => NEAR_SHARE * edge,
    }
}

struct Places<'a> {
    tree: &'a Tree,
    leaves: &'a Cut,
    seams: &'a Seams,
    pairs: &'a [[BlockId; 2]],
    near: f64,
}

impl Places<'_> {
    /// Where each pixel of a frame with depth lies.
    fn parts(&self, frame: &Frame, camera: &Camera) -> Vec<Part> {
        let ground = &self.tree.plan.ground;
        let root = ground.core(BlockId::ROOT);
        let part = |pixel: usize| {
            let Some((place, _)) = shown_at(frame, camera, pixel) else { return Part::Neither };
            let at = ground.from_world(place).truncate();
            if !root.contains(at) {
                return Part::Neither;
            }
            let Some((face, _)) = self.seams.nearest(place, self.near) else { return Part::Interior };
            let pair = [face.a.min(face.b), face.a.max(face.b)];
            let index = self.pairs.binary_search(&pair).expect("every face is of a pair");
            Part::Band(index as u32, face.is_before(at) == (face.a == pair[0]))
        };
        (0..frame.width * frame.height).map(part).collect()
    }

    /// The finest model with `keeper`'s splats in place of the other block's, as far beyond the pair's faces as a halo
    /// reaches. `None` where it has none: it was trained against the other's final ones.
    fn as_kept_by(&self, finest: &Splats, pair: usize, keeper: BlockId) -> Option<Splats> {
        let ground = &self.tree.plan.ground;
        let [a, b] = self.pairs[pair];
        let other = if keeper == a { b } else { a };
        let task = self.tree.plan.task(keeper)?;
        if other.level >= keeper.level && task.context.contains(&other) {
            return None;
        }
        let reach = 0.5 * (HALO_SCALE - 1.0) * ground.core_edge_metres(a.level.max(b.level));
        let faces = || self.seams.faces().iter().filter(|f| [f.a.min(f.b), f.a.max(f.b)] == [a, b]);
        let is_scene = scene_of(finest, ground);
        let replaced = |splats: &Splats, i: usize| {
            let place = splats.mean(i).as_dvec3();
            let at = ground.from_world(place).truncate();
            self.leaves.owner_of(ground, place) == Some(other)
                && faces().any(|face| face.distance(at) <= reach)
                && is_scene(place)
        };
        let theirs = self.tree.results.get(&keeper)?;
        let theirs = theirs.filter(|i| replaced(theirs, i));
        let mut splats = finest.filter(|i| !replaced(finest, i));
        splats.append(&theirs);
        (!theirs.is_empty()).then_some(splats)
    }
}

/// Band and interior of one view: PSNR, SSIM, ꟻLIP of each.
fn view_figures(colours: &[f32], truth: &[f32], parts: &[Part], width: usize) -> [[Option<f64>; 3]; 2] {
    let height = parts.len() / width.max(1);
    let (ssim, flip) = (maps::ssim(colours, truth, width, height), maps::flip(truth, colours, width, height));
    let of = |is_in: &dyn Fn(&Part) -> bool| {
        let mask: Vec<u8> = parts.iter().map(|part| if is_in(part) { 255 } else { 0 }).collect();
        let over = |map: &[f64]| mean(map.iter().zip(&mask).map(|(&value, &mask)| (mask > 0).then_some(value)));
        [metrics::psnr(colours, truth, Some(&mask)), over(&ssim), over(&flip)]
    };
    [of(&|part| matches!(part, Part::Band(..))), of(&|part| *part == Part::Interior)]
}

fn means(views: &[[[Option<f64>; 3]; 2]]) -> SeamFigures {
    let over = |part: usize, figure: usize| mean(views.iter().map(|view| view[part][figure]));
    let (seam_psnr, interior_psnr) = (over(0, 0), over(1, 0));
    SeamFigures {
        seam_psnr,
        interior_psnr,
        seam_ssim: over(0, 1),
        interior_ssim: over(1, 1),
        seam_flip: over(0, 2),
        interior_flip: over(1, 2),
        gap_db: interior_psnr.zip(seam_psnr).map(|(interior, seam)| interior - seam),
    }
}

/// Difference of the mean signed error across a pair's faces, mean over channels, levels of 255. `None` where a side has
/// too few pixels.
fn step(colours: &[f32], truth: &[f32], parts: &[Part], pair: u32) -> Option<f64> {
    let area = parts.len();
    let mean_error = |side: bool, channel: usize| {
        let on_side = (0..area).filter(|&i| parts[i] == Part::Band(pair, side)).map(|i| channel * area + i);
        let (sum, count) =
            on_side.fold((0.0, 0usize), |(sum, count), i| (sum + f64::from(colours[i] - truth[i]), count + 1));
        (count >= MIN_PIXELS).then(|| sum / count as f64)
    };
    let steps = [0, 1, 2].map(|channel| Some((mean_error(true, channel)? - mean_error(false, channel)?).abs()));
    Some(255.0 / 3.0 * (steps[0]? + steps[1]? + steps[2]?))
}

/// What was summed of a face.
#[derive(Debug, Clone, Default)]
struct FaceSums {
    views: usize,
    /// Of squares, and how many.
    jump: (f64, u64),
    step: Vec<Option<f64>>,
    control_step: Vec<Option<f64>>,
}

impl FaceSums {
    fn figures(self, a: BlockId, b: BlockId) -> FaceFigures {
        let (sum, count) = self.jump;
        FaceFigures {
            a,
            b,
            views: self.views,
            jump: (count > 0).then(|| (sum / count as f64).sqrt()),
            step: mean(self.step.into_iter()),
            control_step: mean(self.control_step.into_iter()),
        }
    }
}

fn caption(name: &str, figures: Option<&[[Option<f64>; 3]; 2]>) -> String {
    let Some([[Some(band), ..], [Some(interior), ..]]) = figures else { return name.to_owned() };
    format!("{name}  band {band:.2} dB  interior {interior:.2} dB")
}

/// The picture with bands in a colour for each side, and what counts in neither part darkened.
fn tinted(picture: &RgbImage, parts: &[Part]) -> RgbImage {
    let mut picture = picture.clone();
    for (pixel, part) in picture.pixels_mut().zip(parts) {
        let (tint, share) = match part {
            Part::Interior => continue,
            Part::Neither => (PAPER, 0.6),
            Part::Band(_, first) => (TINT[usize::from(!first)], 0.45),
        };
        *pixel = Rgb([0, 1, 2].map(|c| (f32::from(pixel[c]) * (1.0 - share) + f32::from(tint[c]) * share) as u8));
    }
    picture
}

/// Rows of pictures side by side, each under its caption.
fn table<const N: usize>(rows: &[(String, [RgbImage; N])]) -> RgbImage {
    const GAP: u32 = 8;
    const LINE: u32 = 24;
    let wide = |pictures: &[RgbImage; N]| pictures.iter().map(|p| p.width() + GAP).sum::<u32>() + GAP;
    let high = |pictures: &[RgbImage; N]| pictures.iter().map(RgbImage::height).max().unwrap_or(0) + LINE + GAP;
    let width = rows.iter().map(|(_, pictures)| wide(pictures)).max().unwrap_or(1);
    let height = rows.iter().map(|(_, pictures)| high(pictures)).sum::<u32>().max(1);
    let mut sheet = RgbImage::from_pixel(width, height, PAPER);
    let mut y = 0;
    for (caption, pictures) in rows {
        write_text(&mut sheet, GAP, y + 4, caption, INK);
        let mut x = GAP;
        for picture in pictures {
            imageops::replace(&mut sheet, picture, i64::from(x), i64::from(y + LINE));
            x += picture.width() + GAP;
        }
        y += high(pictures);
    }
    sheet
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn band_and_interior_are_told_apart() {
        let (width, height) = (16, 16);
        let area = width * height;
        let truth = vec![0.5f32; 3 * area];
        let parts: Vec<Part> = (0..area)
            .map(|i| match i % width {
                0..4 => Part::Band(0, true),
                4..8 => Part::Band(0, false),
                8 => Part::Neither,
                _ => Part::Interior,
            })
            .collect();
        // 0.1 too bright on one side of the face, 0.02 on the other, 0.01 elsewhere, far off where nothing counts.
        let error = [0.1, 0.02, 0.01, 0.5];
        let which = |part: &Part| match part {
            Part::Band(_, true) => 0,
            Part::Band(..) => 1,
            Part::Interior => 2,
            Part::Neither => 3,
        };
        let colours: Vec<f32> = (0..3 * area).map(|i| truth[i] + error[which(&parts[i % area])]).collect();
        let [band, interior] = view_figures(&colours, &truth, &parts, width);
        assert!((interior[0].unwrap() - 40.0).abs() < 1e-3, "{interior:?}");
        let squares: f64 = (0.1f64.powi(2) + 0.02f64.powi(2)) / 2.0;
        assert!((band[0].unwrap() + 10.0 * squares.log10()).abs() < 1e-3, "{band:?}");
        assert!(band[2] > interior[2]);
        let figures = means(&[[band, interior]]);
        assert!((figures.gap_db.unwrap() - (interior[0].unwrap() - band[0].unwrap())).abs() < 1e-12);
        assert!((step(&colours, &truth, &parts, 0).unwrap() - 255.0 * 0.08).abs() < 1e-3);
        assert!(step(&colours, &truth, &parts, 1).is_none());
    }

    #[test]
    fn bands_are_tinted_by_side() {
        let parts = [Part::Band(0, true), Part::Band(0, false), Part::Interior, Part::Neither];
        let picture = tinted(&RgbImage::from_pixel(4, 1, Rgb([100, 100, 100])), &parts);
        let [first, second, interior, neither] = [0, 1, 2, 3].map(|x| picture.get_pixel(x, 0).0);
        assert!(first[2] > first[0] && second[0] > second[1]);
        assert_eq!(interior, [100; 3]);
        assert!(neither[0] < 60);
        assert_eq!(table::<2>(&[]).dimensions(), (1, 1));
    }
}
