//! What is known of the true depth of a capture's views, to compare renders with: of captures of `plat synth --truth`
//! the depth of every pixel, of others what their lidar and metric depth maps measured.

use std::collections::BTreeMap;
use std::path::Path;

use scene::{BadInput, Capture, View};

use super::depths::{Depths, is_used};
use super::downscaled;
use super::undistorter::LastUndistorter;
use crate::depth_maps::DepthMapOptions;
use crate::depth_samples::DepthSamples;
use crate::open::{OpenOptions, Source, open, truth_folder};

/// A capture opened for its depths. No depth is read yet.
#[derive(Debug)]
pub struct TrueDepth {
    source: Source,
    kind: &'static str,
}

impl TrueDepth {
    /// Finds the depths of the capture at this path. True depths are used alone, without lidar and depth maps.
    ///
    /// # Errors
    /// A capture that cannot be opened or has no depths.
    pub fn open(path: &Path) -> Result<Self, BadInput> {
        let truth = truth_folder(path)?;
        let has_truth = truth.is_some();
        let depths = Some(DepthMapOptions { folder: truth, ..DepthMapOptions::default() });
        let source = open(path, &OpenOptions { lidar: !has_truth, depths, ..OpenOptions::default() })?;
        let has_lidar = source.sweeps.iter().any(|sweep| !sweep.views.is_empty());
        let kind = match (has_truth, has_lidar, source.depth_maps() > 0) {
            (true, ..) => "truth",
            (_, true, true) => "lidar and depth maps",
            (_, true, false) => "lidar",
            (_, false, true) => "depth maps",
            (_, false, false) => {
                let problem = "has no depths to compare with: no true ones, no lidar and no depth maps in depths/";
                let advice = "leave --depth; of a generated city, write the capture with plat synth --truth";
                return Err(BadInput::new(path.display().to_string(), problem, advice));
            }
        };
        Ok(Self { source, kind })
    }

    /// Where the depths come from: `truth`, `lidar`, `depth maps`, or `lidar and depth maps`.
    pub fn kind(&self) -> &'static str {
        self.kind
    }

    /// The depths of views whose photos were ingested at one N-th of their size.
    pub fn views(&self, downscale: u32) -> ViewDepths<'_> {
        let mut capture = self.source.capture.clone();
        for view in &mut capture.views {
            view.camera.pinhole = downscaled(view.camera.pinhole, downscale.max(1));
        }
        let numbers = (0..).zip(&self.source.capture.views).map(|(i, view)| (view.name.as_str(), i)).collect();
        let depths = Depths::new(&self.source, downscale.max(1));
        ViewDepths { capture, numbers, depths, last_undistorter: None }
    }
}

/// Reads the depths of one view after the other.
pub struct ViewDepths<'a> {
    /// With the cameras of ingested views.
    capture: Capture,
    numbers: BTreeMap<&'a str, usize>,
    depths: Depths<'a>,
    last_undistorter: LastUndistorter,
}

impl ViewDepths<'_> {
    /// Whether a view of this name has depths.
    pub fn has(&self, name: &str) -> bool {
        self.numbers.get(name).is_some_and(|&number| self.depths.concerns(number))
    }

    /// Depths along the optical axis at the pixels of an ingested view that its mask (of the view's size, usable from
    /// 128) leaves. Reads the files of this view only. Of views of over 262,144 pixels a map gives every second, fourth
    /// … pixel in both directions.
    ///
    /// # Errors
    /// Files that cannot be read, or a view that is not of this capture.
    pub fn of_view(&mut self, view: &View, mask: Option<&[u8]>) -> Result<DepthSamples, BadInput> {
        let pinhole = view.camera.pinhole;
        let number = self.numbers.get(view.name.as_str()).copied();
        let Some(number) = number.filter(|&i| self.capture.views[i].camera.pinhole == pinhole) else {
            let problem = "is not in the capture whose depths are read, or has another size there";
            return Err(BadInput::new(format!("view {}", view.name), problem, "give the capture of its photo"));
        };
        let mask = mask.filter(|mask| mask.len() == pinhole.width as usize * pinhole.height as usize);
        let is_used = is_used(pinhole.width, mask);
        Ok(self.depths.samples(&self.capture, number, &is_used, &mut self.last_undistorter)?.0)
    }
}
