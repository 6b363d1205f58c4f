//! What a detector sees in photos and in renders, and how far both agree.
//!
//! A [`Detector`] is an ONNX network with a [`Card`] that says how pictures go in and boxes come out. [`agreement`]
//! compares the detections on a photo with those on a render of the same view. [`network`] runs graphs of others so
//! that they cannot crash the program.
//!
//! [`moving_points`] finds what moves in the sweeps of a lidar, [`seen_boxes`] where detections are, and [`tracking`] follows both.
//!
//! Architecture invariant: functions of bytes, pixels and points; no files, no network, no clock. The caller reads the files.

pub mod agreement;
pub mod aligned;
pub mod boxes;
pub mod card;
mod coco;
mod detector;
pub mod echoes;
pub mod gradient;
mod heads;
mod masked;
pub mod moving_points;
pub mod network;
mod placed;
pub mod precision;
pub mod seen_boxes;
#[cfg(test)]
mod testing;
pub mod tracking;

pub use agreement::{Agreement, Counts, agreement, kept};
pub use boxes::{Detection, iou};
pub use card::Card;
pub use detector::{Cost, Detector};
pub use masked::{MAX_MASKED, box_pixels, masked_share};
pub use precision::{Boxes, Precision, TrueBox, precision};

/// A picture: rows from the top, three bytes a pixel, red first.
#[derive(Debug, Clone, Copy)]
pub struct Picture<'a> {
    /// `3 · width · height` bytes.
    pub rgb: &'a [u8],
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
}
