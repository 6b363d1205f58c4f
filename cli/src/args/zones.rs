//! Options that say where objects on photos are, and how much they count.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::values::weight;

/// Default of `--zone-weight`.
const ZONE_WEIGHT: f64 = 4.0;

#[derive(Debug, Clone, PartialEq, Args, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) struct ZoneOptions {
    /// Look for objects on the photos with this detector (ONNX), as `plat eval --detector` does, and let their pixels count more in
    /// training and in pruning, by --zone-weight
    #[arg(long = "detector", value_name = "FILE", conflicts_with = "zones")]
    #[serde(rename = "detector", skip_serializing_if = "Option::is_none")]
    pub(crate) zone_detector: Option<PathBuf>,
    /// Boxes of objects instead, as JSON in COCO's layout: images, annotations, categories. They are in pixels of the photos without
    /// their lens distortion
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) zones: Option<PathBuf>,
    /// Pixels of objects count 1 + W times, with --detector or --zones
    #[arg(long, value_name = "W", value_parser = weight, default_value_t = ZONE_WEIGHT)]
    pub(crate) zone_weight: f64,
}

impl Default for ZoneOptions {
    fn default() -> Self {
        Self { zone_detector: None, zones: None, zone_weight: ZONE_WEIGHT }
    }
}

impl ZoneOptions {
    /// The additional weight of objects' pixels; 0 if nobody looks for objects.
    pub(crate) fn weight(&self) -> f64 {
        if self.zone_detector.is_some() || self.zones.is_some() { self.zone_weight } else { 0.0 }
    }
}
