//! Options that decide the plan of a capture.

use std::path::PathBuf;

use blocks::{Mode, PlanSettings};
use clap::{Args, ValueEnum};
use scene::Capture;
use serde::Serialize;

use super::values::{Auto, decibels, metres, metres_or_none, residual, views_per_step, weight};

/// How the scene is divided.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Blocks {
    /// Level-of-detail tree: blocks start from their parent's splats and train beside their neighbours'
    Tree,
    /// Only the leaves, each independently from the sparse points
    Flat,
    /// One block
    Whole,
}

/// What the values of depth maps are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum DepthKind {
    /// Depths along the optical axis in metres or --depth-unit
    #[default]
    Metric,
    /// Depths of an unknown scale and shift: fitted to the sparse points of each photo
    Relative,
    /// Inverse depths (disparity) of an unknown scale and shift: fitted to the sparse points of each photo
    Inverse,
}

/// Default of `--block-memory`, MiB.
pub(crate) const BLOCK_MEMORY_MIB: u64 = 4096;
/// Default of `--residual`.
pub(crate) const RESIDUAL: f64 = 0.4;

/// Options of the plan.
#[derive(Debug, Clone, Args, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) struct PlanOptions {
    /// How the scene is divided
    #[arg(long, value_enum, default_value = "tree")]
    pub(crate) blocks: Blocks,
    /// Levels below the root; auto divides only what no block can hold (see --block-memory), as deep as extent, resolution, views and points allow
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) levels: Auto<u8>,
    /// Optimiser steps, counted in full images of the whole scene, so that every division costs about the same; auto takes 60
    /// per view, at least 500
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) steps: Auto<u32>,
    /// Render N windows, at most 16, per optimiser step, with learning rates √N times as high. --steps still counts windows.
    /// This fills a large GPU with small photos; on a CPU it saves nothing
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = views_per_step())]
    pub(crate) views_per_step: u32,
    /// Splats of the merged model before pruning; auto takes three for each sparse point and for two of lidar, from 5,000 to 2,000,000,
    /// and fewer where --levels is auto and the steps cannot train them
    #[arg(long, value_name = "N|auto", default_value_t)]
    pub(crate) budget: Auto<u32>,
    /// Prune the finest blocks within this loss of PSNR on their training views, dB; 0 prunes nothing
    #[arg(long, value_name = "X", value_parser = decibels, default_value_t = 0.1)]
    pub(crate) tolerance_db: f64,
    /// Refine a block only if the error of its parent's splats in the block's photos exceeds R times the root's error over all photos
    /// (both root mean square), and use fine pixels and densify only while that reduces the error; 0 turns adaptation off
    #[arg(long, value_name = "R", value_parser = residual, default_value_t = RESIDUAL)]
    pub(crate) residual: f64,
    /// Seed of all random choices
    #[arg(long, value_name = "S", default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub(crate) seed: u64,
    /// Hold out every K-th view by name, starting with the first; 0 holds out none
    #[arg(long, value_name = "K", default_value_t = 8)]
    pub(crate) test_every: u32,
    /// Compensate opacity for the screen-space dilation (Mip-Splatting): the model can be rendered at any resolution by viewers that
    /// do the same, at a cost of 0.2 to 0.6 dB at its own resolution
    #[arg(long)]
    pub(crate) antialiased: bool,
    /// Train an exposure per view in the root block and use it in all other blocks. For photos of varying exposure or white
    /// balance; not with --blocks flat
    #[arg(long)]
    pub(crate) exposure: bool,
    /// Refine the pose of each training view with the splats in the root block and use it in all other blocks. For poses
    /// with errors of some pixels; not with --blocks flat. The refined cameras go to OUT/cameras.json
    #[arg(long)]
    pub(crate) refine_poses: bool,
    /// Refine the mount, the focal length and the clock of each sensor with the splats: errors that all its photos share. For rigs of
    /// which the clocks differ or the calibration is wrong; not with --blocks flat. The refined cameras go to OUT/cameras.json
    #[arg(long)]
    pub(crate) refine_sensors: bool,
    /// Also model what moves: each object that the capture has a box and a path for gets splats of its own, in tasks of the job, which
    /// go to OUT/objects. Its pixels are left out of the static scene, and `plat render` draws it where it is at a time; not with
    /// --blocks flat
    #[arg(long)]
    pub(crate) objects: bool,
    /// Label each splat with the block that trained it, as the integer property `block` of merged.ply
    #[arg(long)]
    pub(crate) label_blocks: bool,
    /// Weight of a loss that compares rendered depths with those that lidar, radar, depth maps and the sparse points give for the photo. It
    /// keeps splats from floating where few photos overlap; 0 leaves it out
    #[arg(long, value_name = "W", value_parser = weight, default_value_t = 0.0)]
    pub(crate) depth_weight: f64,
    /// Leave out the capture's lidar: its sweeps give neither target depths nor initial points
    #[arg(long)]
    pub(crate) no_lidar: bool,
    /// Leave out the capture's radar: the road that its sweeps find gives neither target depths nor initial points
    #[arg(long)]
    pub(crate) no_radar: bool,
    /// Use the pixels that the capture's mask files exclude, and those of labelled objects that move, as all others
    #[arg(long)]
    pub(crate) no_masks: bool,
    /// Start without the sphere of splats around the scene that stands for the sky and everything far away. For captures that show
    /// neither
    #[arg(long)]
    pub(crate) no_backdrop: bool,
    /// Most memory of a block, as estimated. --levels auto divides the scene until no block needs more; what still does is refused
    #[arg(long, value_name = "MIB", default_value_t = BLOCK_MEMORY_MIB, value_parser = clap::value_parser!(u64).range(16..=1 << 24))]
    pub(crate) block_memory: u64,
    /// Folder of depth maps, named like the photos: NAME.npy (floats) or NAME.png (16-bit grey), 0 for no depth. By default those
    /// that transforms.json names, or the capture's folder `depths`. Used with --depth-weight
    #[arg(long, value_name = "DIR", conflicts_with = "no_depths")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) depths: Option<PathBuf>,
    /// What the values of depth maps are
    #[arg(long, value_enum, default_value = "metric", conflicts_with = "no_depths")]
    pub(crate) depth_kind: DepthKind,
    /// Metres that a value of 1 in a metric depth map stands for; by default 1 in npy files and 0.001 in PNG files. KITTI's is 0.00390625
    #[arg(long, value_name = "METRES", value_parser = metres, conflicts_with = "no_depths")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) depth_unit: Option<f64>,
    /// Leave out the capture's depth maps
    #[arg(long)]
    pub(crate) no_depths: bool,
    /// After training, measure the merged model on the held-out photos in tasks of the job, which any worker can take. The
    /// figures are those of `plat eval`, without the contact sheet; they go to OUT/eval/report.json
    #[arg(long)]
    pub(crate) evaluate: bool,
    /// Use photos at one N-th of their size
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) downscale: u32,
    /// Hold out whole stretches of streets as well: about one in ten of the squares of this side that street photos were taken in,
    /// with all of their street photos. Reported beside the other held-out photos; 0 holds out none
    #[arg(long, value_name = "METRES", value_parser = metres_or_none, default_value_t = 0.0)]
    pub(crate) test_stretches: f64,
}

impl PlanOptions {
    /// The planner's settings for a capture whose last `lidar` points were measured by lidar.
    ///
    /// Budget and steps grow with points and views, as more would overfit: at a quarter of its size `street_lund` (25 views,
    /// 1,540 points) reaches 16.1 dB held out with 6,000 splats and 1,500 steps, 15.3 dB with 20,000 and 3,000.
    pub(crate) fn settings(&self, capture: &Capture, lidar: usize) -> PlanSettings {
        let times = |count: usize, each: u32| u32::try_from(count).unwrap_or(u32::MAX).saturating_mul(each);
        // Lidar points are dense: splats that start from them are split less.
        let sparse = capture.points.len().saturating_sub(lidar);
        let budget = || times(sparse, 3).saturating_add(times(lidar, 3) / 2).clamp(5000, 2_000_000);
        let steps = || times(capture.views.len(), 60).max(500);
        PlanSettings {
            mode: match self.blocks {
                Blocks::Tree => Mode::Tree,
                Blocks::Flat => Mode::Flat,
                Blocks::Whole => Mode::Whole,
            },
            levels: self.levels.0,
            seed: self.seed,
            steps: self.steps.0.unwrap_or_else(steps),
            views_per_step: self.views_per_step,
            budget: self.budget.0.unwrap_or_else(budget),
            tolerance_db: self.tolerance_db,
            residual: self.residual,
            test_every: self.test_every,
            antialiased: self.antialiased,
            exposure: self.exposure,
            refine_poses: self.refine_poses,
            refine_sensors: self.refine_sensors,
            objects: self.objects,
            label_blocks: self.label_blocks,
            depth_weight: self.depth_weight,
            backdrop: !self.no_backdrop,
            memory_limit_bytes: self.block_memory << 20,
            evaluate: self.evaluate,
            test_stretches: self.test_stretches,
            ..PlanSettings::default()
        }
    }
}
