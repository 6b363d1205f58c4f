//! Options that say where objects on photos are, and how much they count.

use std::path::PathBuf;

use clap::{ArgGroup, Args};
use serde::Serialize;

use super::values::{aligned_weight, weight};

/// The weight where `--zone-weight` is not given.
const ZONE_WEIGHT: f64 = 4.0;
/// The value of `--zones` for the labels that the capture itself has.
pub(crate) const OWN_LABELS: &str = "@labels";

/// Where objects are.
#[derive(Debug, Clone, Default, PartialEq, Args, Serialize)]
#[serde(rename_all = "kebab-case")]
#[command(group = ArgGroup::new("zone_source").args(["zone_detector", "zones"]))]
pub(crate) struct ZoneFinder {
    /// Look for objects on the photos with this detector (ONNX), as `plat eval --detector` does; see --zones
    #[arg(long = "detector", value_name = "FILE")]
    #[serde(rename = "detector", skip_serializing_if = "Option::is_none")]
    pub(crate) zone_detector: Option<PathBuf>,
    /// Objects whose pixels count more in training and in pruning, by --zone-weight: a JSON file in COCO's layout (boxes, polygons, run
    /// lengths, in pixels of the photos without their lens distortion), a folder of label maps NAME.png of the photos as they were taken
    /// (ids as Cityscapes' instanceIds, or those in its classes.json or classes.txt), or @labels for the labels that the capture itself
    /// has (DGP, nuScenes, KITTI raw, Waymo, plat synth)
    #[arg(long, value_name = "FILE|DIR|@labels")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) zones: Option<PathBuf>,
}

impl ZoneFinder {
    /// Whether anybody looks for objects.
    pub(crate) fn is_given(&self) -> bool {
        self.zone_detector.is_some() || self.zones.is_some()
    }
}

#[derive(Debug, Clone, Default, PartialEq, Args, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) struct ZoneOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) finder: ZoneFinder,
    /// Pixels of objects that cover a hundredth of the photo count 1 + W times, with --detector or --zones, those of smaller objects more
    /// and those of larger ones less; 4 if it is not given
    #[arg(long, value_name = "W", value_parser = weight, requires = "zone_source")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) zone_weight: Option<f64>,
}

impl ZoneOptions {
    /// The additional weight of objects' pixels; 0 if nobody looks for objects.
    pub(crate) fn weight(&self) -> f64 {
        if self.finder.is_given() { self.zone_weight.unwrap_or(ZONE_WEIGHT) } else { 0.0 }
    }
}

#[derive(Debug, Clone, Default, PartialEq, Args, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) struct AlignedOptions {
    /// Weight of the perception-aligned loss in the last 30 % of the steps and while pruning: what --detector sees in renders shall be
    /// what it sees in the photos. From 0, the default, which leaves it out, to 1000; above 0.01 pictures suffer. The detector runs on the
    /// CPU, also beside a GPU, whose results then depend on the CPU's instruction set
    #[arg(long, value_name = "A", value_parser = aligned_weight, requires = "zone_detector")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) aligned_weight: Option<f64>,
}

impl AlignedOptions {
    /// The weight of the loss; 0 without it.
    pub(crate) fn weight(&self) -> f64 {
        self.aligned_weight.unwrap_or(0.0)
    }
}
