//! What several tests need.

use std::path::{Path, PathBuf};

use image::RgbImage;

/// A file of the shared data; `None`, said on standard output, where it is not present.
pub(crate) fn shared(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data").join(name);
    let is_there = path.exists();
    if !is_there {
        println!("skipped: ../shared/data not present");
    }
    is_there.then_some(path)
}

/// A photo of KITTI's object benchmark.
pub(crate) fn photo(name: &str) -> Option<RgbImage> {
    Some(image::open(shared(&format!("images_street/kitti_object/image_2/{name}"))?).unwrap().to_rgb8())
}

/// Σ a·b.
pub(crate) fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum()
}
