//! The hyperparameters of training a block.

use serde::{Deserialize, Serialize};

use crate::growth::Growth;

/// The hyperparameters of training a block. Shares are of the number of steps. Learning rates are of Adam with one view
/// per step, given as `[first, last]` and interpolated geometrically.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Recipe {
    /// Weight λ of D-SSIM (1 - SSIM) in the loss.
    pub lambda: f32,
    /// Weight of the depth loss, for windows with target depths; 0 leaves it out.
    #[serde(default)]
    pub depth_weight: f32,
    /// Weight of the silhouette loss, for windows that say which pixels show the trained object; 0 leaves it out.
    #[serde(default)]
    pub silhouette_weight: f32,
    /// Weight of the picture loss of a job that has one; 0 leaves it out.
    #[serde(default)]
    pub picture_weight: f32,
    /// Share of the steps before the picture loss. A detector sees nothing in the first renders, and where splats are still
    /// added its slopes say little about those that come.
    #[serde(default)]
    pub picture_from: f32,
    /// The picture loss is in every n-th step: a detector costs more than a step.
    #[serde(default)]
    pub picture_every: u32,
    /// Learning rate of means, in units of each splat's size.
    pub mean: [f32; 2],
    /// Learning rate of ln(scale).
    pub log_scale: [f32; 2],
    /// Learning rate of quaternions.
    pub quat: [f32; 2],
    /// Learning rate of opacity logits.
    pub opacity: [f32; 2],
    /// Learning rate of the SH coefficients of degree 0.
    pub sh_dc: [f32; 2],
    /// Learning rate of the other SH coefficients, relative to `sh_dc`.
    pub sh_rest: f32,
    /// Learning rate of exposures, multiplied by the number of times that a view is drawn. A view is drawn 7 times at
    /// the root of a tree and 60 times in a job of one block, and its exposure has to move as far.
    pub exposure: [f32; 2],
    /// Decay β₂ of Adam's second moment. A splat that few of many views see gets few updates, but the bias correction
    /// counts all steps. At 0.999 its updates were up to seven times the learning rate, and the root of a city of 1.2
    /// km² lost 26,000 of its 27,700 splats.
    pub beta2: f32,
    /// Weight of the opacity regulariser, see [`LearningRates`](crate::optimiser::LearningRates).
    pub opacity_reg: f32,
    /// Weight of the needle regulariser, see [`LearningRates`](crate::optimiser::LearningRates).
    pub needle_reg: f32,
    /// Shares of the steps after which SH degrees 1, 2 and 3 are trained.
    pub sh_from: [f32; 3],
    /// Largest share of the steps that is trained at each coarse mip, coarsest first; each is one mip coarser than the
    /// next.
    pub coarse: Vec<f32>,
    /// Training goes to the next finer mip once the error is at most this many times the detail that the coarse photos
    /// lack (see [`coarse_to_fine`](crate::coarse_to_fine)). With 0 only the shares in `coarse` decide.
    pub detail_factor: f32,
    /// Views per optimiser step, at most [`MAX_VIEWS_PER_STEP`](crate::MAX_VIEWS_PER_STEP). With n views the learning
    /// rate is √n times as high, as the noise of the summed gradient is √n times smaller relative to it (as in gsplat;
    /// Granziol et al. 2022). It keeps a large device busy where one window has too few tiles. It saves no arithmetic,
    /// so a CPU gains nothing.
    pub views_per_step: u32,
    /// Opacity of the initial splats.
    pub initial_opacity: f32,
    /// Densification schedule.
    pub growth: Growth,
    /// Learning rate of camera poses where they are trained, in radians and in metres per metre of depth, multiplied by
    /// the number of times that a view is drawn (as `exposure`).
    #[serde(default)]
    pub pose: [f32; 2],
    /// Share of the steps before poses are trained: the first splats say nothing about a pose.
    #[serde(default)]
    pub pose_from: f32,
    /// Weight decay of poses: the share of a displacement that all steps together take back where no gradient holds it.
    #[serde(default)]
    pub pose_decay: f32,
    /// As `pose`, of sensors: every photo of a sensor is a step of its numbers, so they may move further than one camera's.
    #[serde(default)]
    pub sensor: [f32; 2],
    /// As `pose`, of the path of an object: metres of its ends.
    #[serde(default)]
    pub path: [f32; 2],
    /// As `pose_decay`, of paths.
    #[serde(default)]
    pub path_decay: f32,
    /// Shares of the steps before the stride of a person is listened for, and before limbs swing.
    #[serde(default)]
    pub swing_from: [f32; 2],
    /// Learning rate of the amplitudes of a swing, relative to `mean`.
    #[serde(default)]
    pub swing: f32,
    /// As `pose_decay`, of amplitudes.
    #[serde(default)]
    pub swing_decay: f32,
    /// Learning rate of ln(stride), as `pose`.
    #[serde(default)]
    pub stride: f32,
}

impl Default for Recipe {
    fn default() -> Self {
        Self {
            lambda: 0.2,
            depth_weight: 0.0,
            silhouette_weight: 0.0,
            picture_weight: 0.0,
            picture_from: 0.7,
            picture_every: 1,
            mean: [0.05, 0.005],
            log_scale: [0.017, 0.0085],
            quat: [0.0034, 0.0017],
            opacity: [0.06, 0.025],
            sh_dc: [0.017, 0.004],
            sh_rest: 0.05,
            exposure: [0.2, 0.02],
            beta2: 0.99,
            opacity_reg: 0.0,
            needle_reg: 0.01,
            sh_from: [0.1, 0.2, 0.3],
            coarse: vec![0.2, 0.5],
            detail_factor: 2.0,
            views_per_step: 1,
            initial_opacity: 0.5,
            growth: Growth::default(),
            pose: [0.1, 0.004],
            pose_from: 0.05,
            pose_decay: 0.1,
            sensor: [0.4, 0.01],
            path: [0.3, 0.02],
            path_decay: 0.1,
            swing_from: [0.1, 0.3],
            swing: 3.0,
            swing_decay: 0.5,
            stride: 1.0,
        }
    }
}

impl Recipe {
    /// For splats that a parent has trained already, where `finer_share` of the pixels, 0 to 1, are finer than the
    /// parent's: full SH degree from the start. The first learning rates are 1.5 times those of a start from points where
    /// all pixels are finer, as there are fewer steps, and 0.2 times where none is: there the splats have converged, and
    /// each window is drawn once or twice (docs/decisions/0064). Splats that do not fit the coarser mip yet are trained
    /// there first.
    pub fn refinement(finer_share: f32) -> Self {
        let recipe = Self::default();
        let first = 0.2 + 1.3 * finer_share.clamp(0.0, 1.0);
        let longer = |[from, last]: [f32; 2]| [first * from, last];
        Self {
            mean: longer(recipe.mean),
            log_scale: longer(recipe.log_scale),
            quat: longer(recipe.quat),
            opacity: longer(recipe.opacity),
            sh_dc: longer(recipe.sh_dc),
            sh_from: [0.0; 3],
            coarse: vec![0.3],
            ..recipe
        }
    }

    /// The same recipe with all learning rates multiplied by `factor`.
    #[must_use]
    pub fn at_rate(self, factor: f32) -> Self {
        let scaled = |rate: [f32; 2]| rate.map(|rate| factor * rate);
        Self {
            mean: scaled(self.mean),
            log_scale: scaled(self.log_scale),
            quat: scaled(self.quat),
            opacity: scaled(self.opacity),
            sh_dc: scaled(self.sh_dc),
            exposure: scaled(self.exposure),
            pose: scaled(self.pose),
            sensor: scaled(self.sensor),
            path: scaled(self.path),
            ..self
        }
    }

    /// The same recipe on a fixed schedule that ignores the training error: the baseline for the adaptive schedule.
    /// Blocks that are initialised from points start at coarse mips, others do not.
    #[must_use]
    pub fn fixed_schedule(self, from_points: bool) -> Self {
        let coarse = if from_points { vec![0.15, 0.3] } else { Vec::new() };
        Self { coarse, detail_factor: 0.0, growth: Growth { worth_db: 0.0, ..self.growth }, ..self }
    }
}
