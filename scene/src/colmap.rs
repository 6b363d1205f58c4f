//! Reads and writes COLMAP sparse models: `cameras`, `images` and `points3D`, in binary and text.
//!
//! Format: COLMAP's documentation ("Output Format") and its `scene/reconstruction_io*.cc`. The 2D observations of
//! images are skipped, as training does not need them; [`read_keypoints_bin`] reads them on their own. The `rigs` and
//! `frames` files of COLMAP 4 are not read, as `images` contains all poses.

mod binary;
mod model;
mod text;

pub use self::binary::{
    read_cameras_bin, read_images_bin, read_keypoints_bin, read_points_bin, write_cameras_bin, write_images_bin,
    write_points_bin,
};
pub use self::model::{ColmapCamera, ColmapImage, ColmapPoints, Reconstruction};
pub use self::text::{read_cameras_txt, read_images_txt, read_points_txt};

#[cfg(test)]
mod tests;
