//! What detectors find.

use serde::{Deserialize, Serialize};

/// What a detector finds on renders of held-out views, compared with what it finds on their photos.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Judged {
    /// Name of the network's file.
    pub detector: String,
    /// Detections on the photos.
    pub objects: u64,
    /// Detections on the photos that the renders lack.
    pub misses: u64,
    /// Detections on the renders that the photos lack.
    pub extra: u64,
    /// Mean average precision at overlaps from 0.5 to 0.95; null without detections.
    pub map: Option<f64>,
    /// Mean overlap of the detections that both have.
    pub mean_iou: Option<f64>,
    /// PSNR where the photos have detections, dB.
    pub zone_psnr: Option<f64>,
}

impl Judged {
    pub(crate) fn is_finite(&self) -> bool {
        [self.map, self.mean_iou, self.zone_psnr].into_iter().flatten().all(f64::is_finite)
    }
}
