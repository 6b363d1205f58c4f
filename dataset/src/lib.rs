//! Captures: opened from common formats, ingested into the store as mip pyramids, read back as windows of pixels, or written
//! synthetically from a generated city.
//!
//! Architecture invariant: this is the only crate that opens a capture's files. It returns plain data (`scene`) and artefact
//! ids; crates above it do not know the files or the lenses of photos.

pub mod box_masks;
pub mod byte_lru;
pub mod depth_maps;
pub mod depth_samples;
pub mod ingest;
pub mod lidar;
pub mod mip_tiles;
pub mod mips;
pub mod moving;
pub mod networks;
mod observations;
pub mod open;
mod photo;
pub mod radar;
pub mod synth;
mod tables;
pub mod true_boxes;
pub mod undistortion;
pub mod windows;
pub mod zones;
