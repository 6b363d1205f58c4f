//! The data types of plat (splats, cameras, captures, ids) and the codecs between them and bytes.
//!
//! Architecture invariant: no files, no network, no clock, no threads. A codec maps a byte slice to a value or a
//! [`CodecError`]; the caller that opened the file adds its name.
//!
//! Conventions: the world is metres, right-handed; cameras are OpenCV (x right, y down, z forward); pixel centres
//! lie at `+0.5`; quaternions are stored `wxyz` for splats (as INRIA's PLY does) and normalised on use.

pub mod camera;
pub mod capture;
pub mod colmap;
pub mod dgp;
pub mod error;
pub mod exposures;
pub mod frame;
pub mod ids;
pub mod image;
pub mod kitti;
pub mod kitti360;
pub mod kitti_raw;
pub mod lidar;
pub mod morton;
pub mod npy;
pub mod nuscenes;
pub mod objects;
pub mod opensfm;
pub mod parquet;
pub mod ply;
pub mod poses;
pub mod rad;
pub mod radar;
pub mod random;
pub mod sensors;
pub mod similarity;
pub mod sog;
pub mod splat_glb;
pub mod splats;
pub mod spz;
pub mod swing;
pub mod transforms;
pub mod way;
pub mod waymo;
pub mod zones;

pub use camera::{Camera, CameraModel, Pinhole, Rect, Rigid};
pub use capture::{Capture, GeoOrigin, SparsePoints, View};
pub use error::{BadInput, CodecError};
pub use exposures::{Exposure, Exposures};
pub use ids::{ArtefactId, BlockId};
pub use image::Pixels;
pub use objects::{MovingObject, PathPose};
pub use poses::Poses;
pub use similarity::Similarity;
pub use splats::{Attribute, BLOCK_ATTRIBUTE, SH_C0, Splat, Splats, column};
pub use swing::Swing;
pub use way::Way;
pub use zones::{MaskBuilder, Zone, ZoneMask, Zones};
