//! Figures of bands, interiors and faces.

use scene::BlockId;
use serde::Serialize;
use train::metrics;

use super::regions::Region;
use crate::figures::mean;
use crate::metric_maps::{flip, ssim};

/// A side of a face counts in a view from this many pixels.
const MIN_PIXELS: usize = 24;

/// Means over views of one model.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct SeamFigures {
    /// PSNR of the band, dB.
    pub seam_psnr: Option<f64>,
    /// PSNR of the interior, dB.
    pub interior_psnr: Option<f64>,
    /// SSIM of the band.
    pub seam_ssim: Option<f64>,
    /// SSIM of the interior.
    pub interior_ssim: Option<f64>,
    /// ꟻLIP of the band: 0 = no visible difference, 1 = the largest.
    pub seam_flip: Option<f64>,
    /// ꟻLIP of the interior.
    pub interior_flip: Option<f64>,
    /// PSNR of the interior above that of the band, dB.
    pub gap_db: Option<f64>,
}

/// Figures of the faces between two blocks.
#[derive(Debug, Clone, Serialize)]
pub struct FaceFigures {
    /// The first block.
    pub a: BlockId,
    /// The second block.
    pub b: BlockId,
    /// Views that show enough of both sides.
    pub views: usize,
    /// Root mean square difference over the band between the render from `a`'s splats and that from `b`'s, levels of 255.
    /// Null if neither kept splats of the other's side.
    pub jump: Option<f64>,
    /// Difference of the mean signed error across the face, mean over channels and views, levels of 255.
    pub step: Option<f64>,
    /// With another model's seams: the evaluated model's step there.
    pub control_step: Option<f64>,
}

/// PSNR, SSIM, ꟻLIP of the band, then of the interior, in one view.
pub(super) type RegionFigures = [[Option<f64>; 3]; 2];

pub(super) fn region_figures(colours: &[f32], truth: &[f32], regions: &[Region], width: usize) -> RegionFigures {
    let height = regions.len() / width.max(1);
    let (ssim, flip) = (ssim(colours, truth, width, height), flip(truth, colours, width, height));
    let of = |is_in: &dyn Fn(&Region) -> bool| {
        let mask: Vec<u8> = regions.iter().map(|region| if is_in(region) { 255 } else { 0 }).collect();
        let over = |map: &[f64]| mean(map.iter().zip(&mask).map(|(&value, &mask)| (mask > 0).then_some(value)));
        [metrics::psnr(colours, truth, Some(&mask)), over(&ssim), over(&flip)]
    };
    [of(&|region| matches!(region, Region::Band(..))), of(&|region| *region == Region::Interior)]
}

pub(super) fn view_means(views: &[RegionFigures]) -> SeamFigures {
    let over = |region: usize, figure: usize| mean(views.iter().map(|view| view[region][figure]));
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

/// Difference of the mean signed error across a pair's faces, mean over channels, levels of 255. `None` if a side has
/// too few pixels.
pub(super) fn step(colours: &[f32], truth: &[f32], regions: &[Region], pair: u32) -> Option<f64> {
    let area = regions.len();
    let mean_error = |side: bool, channel: usize| {
        let on_side = (0..area).filter(|&i| regions[i] == Region::Band(pair, side)).map(|i| channel * area + i);
        let (sum, count) =
            on_side.fold((0.0, 0usize), |(sum, count), i| (sum + f64::from(colours[i] - truth[i]), count + 1));
        (count >= MIN_PIXELS).then(|| sum / count as f64)
    };
    let steps = [0, 1, 2].map(|channel| Some((mean_error(true, channel)? - mean_error(false, channel)?).abs()));
    Some(255.0 / 3.0 * (steps[0]? + steps[1]? + steps[2]?))
}

/// Sums over views of one pair's faces.
#[derive(Debug, Clone, Default)]
pub(super) struct FaceSums {
    pub(super) views: usize,
    /// Sum of squares and their count.
    jump: (f64, u64),
    pub(super) step: Vec<Option<f64>>,
    pub(super) control_step: Vec<Option<f64>>,
}

impl FaceSums {
    /// Adds the squared differences of two renders over the pair's band.
    pub(super) fn add_jump(&mut self, a: &[f32], b: &[f32], regions: &[Region], pair: u32) {
        let area = regions.len();
        let in_band = (0..area).filter(|&i| matches!(regions[i], Region::Band(of, _) if of == pair));
        for i in in_band.flat_map(|i| [i, area + i, 2 * area + i]) {
            self.jump.0 += f64::from(255.0 * (a[i] - b[i])).powi(2);
            self.jump.1 += 1;
        }
    }

    pub(super) fn figures(self, a: BlockId, b: BlockId) -> FaceFigures {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn band_and_interior_are_measured_apart() {
        let (width, height) = (16, 16);
        let area = width * height;
        let truth = vec![0.5f32; 3 * area];
        let regions: Vec<Region> = (0..area)
            .map(|i| match i % width {
                0..4 => Region::Band(0, true),
                4..8 => Region::Band(0, false),
                8 => Region::Neither,
                _ => Region::Interior,
            })
            .collect();
        // 0.1 too bright on one side of the face, 0.02 on the other, 0.01 in the interior, 0.5 where nothing counts.
        let error = [0.1, 0.02, 0.01, 0.5];
        let which = |region: &Region| match region {
            Region::Band(_, true) => 0,
            Region::Band(..) => 1,
            Region::Interior => 2,
            Region::Neither => 3,
        };
        let colours: Vec<f32> = (0..3 * area).map(|i| truth[i] + error[which(&regions[i % area])]).collect();
        let [band, interior] = region_figures(&colours, &truth, &regions, width);
        assert!((interior[0].unwrap() - 40.0).abs() < 1e-3, "{interior:?}");
        let squares: f64 = (0.1f64.powi(2) + 0.02f64.powi(2)) / 2.0;
        assert!((band[0].unwrap() + 10.0 * squares.log10()).abs() < 1e-3, "{band:?}");
        assert!(band[2] > interior[2]);
        let figures = view_means(&[[band, interior]]);
        assert!((figures.gap_db.unwrap() - (interior[0].unwrap() - band[0].unwrap())).abs() < 1e-12);
        assert!((step(&colours, &truth, &regions, 0).unwrap() - 255.0 * 0.08).abs() < 1e-3);
        assert!(step(&colours, &truth, &regions, 1).is_none());
    }
}
