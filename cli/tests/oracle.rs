//! `plat render` against images of an independent float64 renderer (reference tensors are kept outside the repository).

mod common;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec3};
use scene::transforms::{Frame, Intrinsics, Transforms};
use scene::{CameraModel, Rigid, Splats, column};

fn oracle(name: &str) -> Option<BTreeMap<String, Vec<f64>>> {
    let shared = std::env::var_os("PLAT_SHARED")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared")), PathBuf::from);
    let Ok(file) = File::open(shared.join("oracle").join(name)) else {
        println!("skipped: ../shared/oracle not present");
        return None;
    };
    let mut zip = zip::ZipArchive::new(file).unwrap();
    let mut arrays = BTreeMap::new();
    for i in 0..zip.len() {
        let mut entry = zip.by_index(i).unwrap();
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).unwrap();
        let body = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        let integers = !String::from_utf8_lossy(&bytes[10..body]).contains("<f8");
        let value = |b: &[u8]| {
            let raw = b.try_into().unwrap();
            if integers { i64::from_le_bytes(raw) as f64 } else { f64::from_le_bytes(raw) }
        };
        arrays.insert(entry.name().replace(".npy", ""), bytes[body..].chunks_exact(8).map(value).collect());
    }
    Some(arrays)
}

/// Writes the capture and the model of a reference case into a folder.
fn write_case(case: &BTreeMap<String, Vec<f64>>, folder: &Path) {
    let n = case["opac_logit"].len();
    let mut splats = Splats::new(case["sh_degree"][0] as u8);
    let columns = [
        (column::MEAN, "means"),
        (column::LOG_SCALE, "log_scales"),
        (column::QUAT, "quats"),
        (column::OPACITY, "opac_logit"),
        (column::SH, "sh"),
    ];
    for (first, key) in columns {
        let width = case[key].len() / n;
        for k in 0..width {
            splats.columns_mut()[first + k] = (0..n).map(|i| case[key][i * width + k] as f32).collect();
        }
    }
    std::fs::write(folder.join("model.ply"), scene::ply::write(&splats, &[])).unwrap();

    let (v, k) = (&case["viewmat"], &case["K"]);
    let rotation = DMat3::from_cols_array(&[v[0], v[4], v[8], v[1], v[5], v[9], v[2], v[6], v[10]]);
    let camera_from_world = Rigid { rotation: DQuat::from_mat3(&rotation), translation: DVec3::new(v[3], v[7], v[11]) };
    let size = (case["W"][0] as u32, case["H"][0] as u32);
    let intrinsics = Intrinsics::from_model(&CameraModel::Pinhole([k[0], k[4], k[2], k[5]]), Some(size));
    let frame =
        Frame { file_path: "view.png".into(), mask_path: None, depth_file_path: None, intrinsics, camera_from_world };
    let transforms = Transforms { frames: vec![frame], ply_file_path: None };
    std::fs::write(folder.join("transforms.json"), scene::transforms::write(&transforms)).unwrap();
}

#[test]
fn rendered_pngs_agree_with_an_independent_float64_renderer() {
    for name in ["small.npz", "medium.npz"] {
        let Some(case) = oracle(name) else { return };
        let folder = tempfile::tempdir().unwrap();
        write_case(&case, folder.path());
        common::done(folder.path(), &["render", "model.ply", "--cameras", "transforms.json", "--out", "renders"]);
        let png = image::open(folder.path().join("renders/view.png")).unwrap().to_rgb8();
        // plat renders on black, so the reference's background is removed.
        let (image, alpha, background) = (&case["image"], &case["alpha"], &case["bg"]);
        let far = png.pixels().enumerate().filter(|(i, pixel)| {
            let black = |c: usize| image[i * 3 + c] - background[c] * (1.0 - alpha[*i]);
            (0..3).any(|c| (f64::from(pixel.0[c]) - 255.0 * black(c).clamp(0.0, 1.0)).abs() > 1.5)
        });
        let (far, all) = (far.count(), alpha.len());
        println!("{name}: {far} of {all} pixels differ by more than 1.5/255");
        assert!(far * 1000 <= all, "{name}: {far} of {all} pixels differ by more than 1.5/255");
    }
}
