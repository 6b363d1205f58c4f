//! Measures whether the division into blocks shows: pixels of held-out views near a face between blocks against all other pixels of
//! the same views.
//!
//! A pixel is near a face if the surface point that it shows is, by the rendered depth of the finest model's foreground. Pixels that
//! show no point in the scene's root square, and masked ones, count in neither region. Pixels near a face may be harder or easier
//! than the rest whatever the division; the same pixels of a model that was trained as one block say by how much.
//!
//! Each face has two figures of its own. Its *jump* says how far its two blocks disagree: the band is rendered from one block's splats
//! (with its halo in place of the neighbour's own) and from the other's. Its *step* is the difference of the mean signed error
//! between the face's sides, which is what the eye follows.

mod figures;
mod picture;
mod regions;

use std::path::{Path, PathBuf};

use blocks::{Cut, Seams};
use glam::DVec3;
use model::Tree;
use render::{Frame, Options};
use scene::{BlockId, Camera, Capture, Pixels, Splats, View};
use serde::Serialize;

use crate::birdseye::birdseye_camera;
use crate::figures::{clamped, mean};
use crate::images::{colour_image, frame_image, photo_image, write_png};
use crate::sheet::error_map;
use crate::surface::without_backdrop;
use crate::{EvalError, Renderer};
use figures::{FaceSums, RegionFigures, region_figures, step, view_means};
use picture::{caption, table, tinted};
use regions::{Region, RegionMap};

pub use figures::{FaceFigures, SeamFigures};

/// Half width of the band at a face, metres, where the capture's unit is known to be a metre.
const NEAR_METRES: f64 = 2.0;
/// Else: the share of the smallest block's edge.
const NEAR_SHARE: f64 = 1.0 / 32.0;
/// Largest share of that edge.
const MAX_NEAR_SHARE: f64 = 1.0 / 8.0;
/// A view counts if band and interior each have at least this share of its pixels.
const MIN_SHARE: f64 = 0.01;
/// Rows of the picture at most.
const MAX_ROWS: usize = 8;
/// Width of the bird's-eye picture, pixels.
const BIRDSEYE_WIDTH: u32 = 960;

/// The seam report. The field names are keys of `eval/report.json`.
#[derive(Debug, Clone, Serialize)]
pub struct SeamReport {
    /// Half width of the band, metres.
    pub seam_metres: f64,
    /// Views that show enough of both regions.
    pub views: usize,
    /// Share of those views' pixels in the band.
    pub seam_share: f64,
    /// Share of those views' pixels in the interior.
    pub interior_share: f64,
    /// Figures of the evaluated model.
    #[serde(flatten)]
    pub figures: SeamFigures,
    /// With another model's seams: the figures of that model.
    pub of: Option<SeamFigures>,
    /// With another model's seams: how many dB more its band lies below its interior than the evaluated model's does. This is what
    /// the faces cost.
    pub faces_cost_db: Option<f64>,
    /// By pair of blocks.
    pub faces: Vec<FaceFigures>,
    /// Photos, renders, bands and errors of some views.
    pub sheet: PathBuf,
    /// The finest model and its bands from above.
    pub birdseye: PathBuf,
}

/// What one view shows, all as large as its photo.
pub(crate) struct SeamFrames<'a> {
    /// Colours of the model whose seams are measured, clamped to 0..1.
    pub(crate) colour: &'a [f32],
    /// Colours of the evaluated model where the seams are another model's.
    pub(crate) control: Option<&'a [f32]>,
    /// The foreground of the model whose seams are measured, with depth.
    pub(crate) foreground: &'a Frame,
}

/// Measures seams view by view.
pub(crate) struct SeamMeter<'a> {
    tree: &'a Tree,
    leaves: Cut,
    seams: Seams,
    pairs: Vec<[BlockId; 2]>,
    seam_metres: f64,
    finest: &'a Splats,
    has_control: bool,
    own: Vec<RegionFigures>,
    control: Vec<RegionFigures>,
    /// OwnershipWeights of the band and of the interior.
    shares: [Vec<Option<f64>>; 2],
    faces: Vec<FaceSums>,
    rows: Vec<(String, [image::RgbImage; 4])>,
}

impl<'a> SeamMeter<'a> {
    /// For the seams of a tree with this finest cut; with a control, that is the evaluated model.
    pub(crate) fn new(
        tree: &'a Tree,
        finest: &'a Splats,
        has_control: bool,
        seam_metres: Option<f64>,
        capture: &Capture,
    ) -> Self {
        let leaves = tree.plan.leaves();
        let seams = Seams::of(&leaves, &tree.plan.ground);
        let pairs = seams.pairs();
        Self {
            tree,
            seam_metres: seam_metres.unwrap_or_else(|| default_metres(tree, &pairs, capture)),
            finest,
            has_control,
            own: Vec::new(),
            control: Vec::new(),
            shares: [Vec::new(), Vec::new()],
            faces: vec![FaceSums::default(); pairs.len()],
            rows: Vec::new(),
            leaves,
            seams,
            pairs,
        }
    }

    fn region_map(&self) -> RegionMap<'_> {
        let Self { tree, leaves, seams, pairs, seam_metres, .. } = self;
        RegionMap { tree, leaves, seams, pairs, seam_metres: *seam_metres }
    }

    /// Measures one view; `truth` are the photo's colours in 0..1.
    pub(crate) fn add_view(
        &mut self,
        view: &View,
        photo: &Pixels,
        truth: &[f32],
        frames: &SeamFrames,
        renderer: &mut Renderer,
    ) -> Result<(), EvalError> {
        let (width, height) = (photo.width as usize, photo.height as usize);
        let mut regions = self.region_map().regions(frames.foreground, &view.camera);
        if let Some(mask) = &photo.mask {
            regions
                .iter_mut()
                .zip(mask)
                .filter(|(_, mask)| **mask < 128)
                .for_each(|(region, _)| *region = Region::Neither);
        }
        let share = |of: fn(&Region) -> bool| regions.iter().filter(|r| of(r)).count() as f64 / regions.len() as f64;
        let [band, interior] = [share(|r| matches!(r, Region::Band(..))), share(|r| *r == Region::Interior)];
        let counts = band.min(interior) >= MIN_SHARE;
        if counts {
            self.own.push(region_figures(frames.colour, truth, &regions, width));
            self.control.extend(frames.control.map(|colour| region_figures(colour, truth, &regions, width)));
            self.shares[0].push(Some(band));
            self.shares[1].push(Some(interior));
        }
        self.add_faces(view, truth, frames, &regions, renderer)?;
        if band > 0.0 && self.rows.len() < MAX_ROWS {
            let (photo, picture) = (photo_image(photo), colour_image(frames.colour, width, height));
            let error = error_map(&photo, &picture).unwrap_or_else(|| picture.clone());
            let caption = caption(&view.name, self.own.last().filter(|_| counts));
            self.rows.push((caption, [photo, picture.clone(), tinted(&picture, &regions), error]));
        }
        Ok(())
    }

    /// Step and jump of each pair's faces in one view.
    fn add_faces(
        &mut self,
        view: &View,
        truth: &[f32],
        frames: &SeamFrames,
        regions: &[Region],
        renderer: &mut Renderer,
    ) -> Result<(), EvalError> {
        for pair in 0..self.pairs.len() {
            let Some(own_step) = step(frames.colour, truth, regions, pair as u32) else { continue };
            let map = self.region_map();
            let sides = self.pairs[pair].map(|keeper| map.as_kept_by(self.finest, pair, keeper));
            let sums = &mut self.faces[pair];
            sums.views += 1;
            sums.step.push(Some(own_step));
            sums.control_step.extend(frames.control.map(|colour| step(colour, truth, regions, pair as u32)));
            if sides.iter().all(Option::is_none) {
                continue;
            }
            let mut colours = |splats: Option<Splats>| -> Result<Vec<f32>, EvalError> {
                match splats {
                    Some(splats) => Ok(clamped(&self.tree_frame(&splats, &view.camera, false, renderer)?.colour)),
                    None => Ok(frames.colour.to_vec()),
                }
            };
            let [a, b] = sides;
            let (a, b) = (colours(a)?, colours(b)?);
            self.faces[pair].add_jump(&a, &b, regions, pair as u32);
        }
        Ok(())
    }

    /// Splats rendered as the tree says.
    fn tree_frame<'r>(
        &self,
        splats: &Splats,
        camera: &Camera,
        extras: bool,
        renderer: &'r mut Renderer,
    ) -> Result<&'r Frame, EvalError> {
        let (antialiased, sh_degree) = (self.tree.antialiased, splats.sh_degree());
        renderer.render_once(splats, camera, &Options { antialiased, extras, sh_degree, ..Options::default() })
    }

    /// Writes the pictures under `out` and sums up.
    pub(crate) fn finish(
        self,
        capture: &Capture,
        out: &Path,
        renderer: &mut Renderer,
    ) -> Result<SeamReport, EvalError> {
        let (sheet, birdseye) = (out.join("seams.png"), out.join("seams_birdseye.png"));
        write_png(&sheet, &table(&self.rows))?;
        let ground = &self.tree.plan.ground;
        let camera = birdseye_camera(capture, ground.to_world(DVec3::Z), BIRDSEYE_WIDTH);
        let picture = frame_image(self.tree_frame(self.finest, &camera, false, renderer)?);
        let foreground = without_backdrop(self.finest, ground);
        let frame = self.tree_frame(&foreground, &camera, true, renderer)?;
        let regions = self.region_map().regions(frame, &camera);
        let pictures = [picture.clone(), tinted(&picture, &regions)];
        write_png(&birdseye, &table(&[("finest model, and its faces between blocks".into(), pictures)]))?;

        let [own, control] = [&self.own, &self.control].map(|views| (!views.is_empty()).then(|| view_means(views)));
        let none = view_means(&[]);
        Ok(SeamReport {
            seam_metres: self.seam_metres,
            views: self.shares[0].len(),
            seam_share: mean(self.shares[0].iter().copied()).unwrap_or_default(),
            interior_share: mean(self.shares[1].iter().copied()).unwrap_or_default(),
            faces_cost_db: own.zip(control).and_then(|(own, control)| Some(own.gap_db? - control.gap_db?)),
            of: own.filter(|_| self.has_control),
            figures: if self.has_control { control } else { own }.unwrap_or(none),
            faces: self.pairs.iter().zip(self.faces).map(|(&[a, b], sums)| sums.figures(a, b)).collect(),
            sheet,
            birdseye,
        })
    }
}

/// [`NEAR_METRES`] or [`NEAR_SHARE`], bounded by the edge of the smallest block that has a face.
fn default_metres(tree: &Tree, pairs: &[[BlockId; 2]], capture: &Capture) -> f64 {
    let level = pairs.iter().flatten().map(|block| block.level).max().unwrap_or(0);
    let edge = tree.plan.ground.core_edge_metres(level);
    match capture.geo_origin {
        Some(_) => NEAR_METRES.min(MAX_NEAR_SHARE * edge),
        None => NEAR_SHARE * edge,
    }
}
