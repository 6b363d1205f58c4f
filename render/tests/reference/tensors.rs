//! The float64 oracle tensors of `../shared/oracle`, and the comparison of a backend with them.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::PathBuf;

use glam::{DMat3, DQuat, DVec3};
use render::{Frame, Gradients, Options, Upstream};
use scene::{Camera, Pinhole, Rigid, Splats, column};

/// Arrays of an .npz file as (shape, float64 values).
pub(crate) type Arrays = BTreeMap<String, (Vec<usize>, Vec<f64>)>;

fn shared() -> PathBuf {
    std::env::var_os("PLAT_SHARED")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared")), PathBuf::from)
}

fn load(name: &str) -> Option<Arrays> {
    let path = shared().join("oracle").join(name);
    let Ok(file) = std::fs::File::open(&path) else {
        println!("skipped: ../shared/oracle not present");
        return None;
    };
    let mut zip = zip::ZipArchive::new(file).expect("an npz is a zip");
    let mut arrays = Arrays::new();
    for i in 0..zip.len() {
        let mut entry = zip.by_index(i).unwrap();
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).unwrap();
        let header_len = u16::from_le_bytes([bytes[8], bytes[9]]) as usize;
        let header = std::str::from_utf8(&bytes[10..10 + header_len]).unwrap();
        let shape = header.split("'shape': (").nth(1).unwrap().split(')').next().unwrap();
        let shape: Vec<usize> = shape.split(',').filter_map(|d| d.trim().parse().ok()).collect();
        let data = &bytes[10 + header_len..];
        let values = if header.contains("'<f8'") {
            data.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().unwrap())).collect()
        } else if header.contains("'<i8'") {
            data.chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().unwrap()) as f64).collect()
        } else {
            assert!(header.contains("'<i4'"), "{header}");
            data.chunks_exact(4).map(|b| i32::from_le_bytes(b.try_into().unwrap()).into()).collect()
        };
        arrays.insert(entry.name().trim_end_matches(".npy").to_string(), (shape, values));
    }
    Some(arrays)
}

pub(crate) struct Case {
    pub(crate) splats: Splats,
    pub(crate) camera: Camera,
    pub(crate) options: Options,
    pub(crate) arrays: Arrays,
}

pub(crate) fn case(name: &str) -> Option<Case> {
    let arrays = load(name)?;
    let get = |key: &str| &arrays[key].1;
    let sh_degree = get("sh_degree")[0] as u8;
    let n = arrays["means"].0[0];
    let mut splats = Splats::new(sh_degree);
    let mut fill = |first: usize, key: &str| {
        let width = get(key).len() / n;
        for k in 0..width {
            splats.columns_mut()[first + k] = (0..n).map(|i| get(key)[i * width + k] as f32).collect();
        }
    };
    fill(column::MEAN, "means");
    fill(column::LOG_SCALE, "log_scales");
    fill(column::QUAT, "quats");
    fill(column::OPACITY, "opac_logit");
    fill(column::SH, "sh");
    let (v, k) = (get("viewmat"), get("K"));
    let rotation = DMat3::from_cols_array(&[v[0], v[4], v[8], v[1], v[5], v[9], v[2], v[6], v[10]]);
    let camera = Camera {
        pinhole: Pinhole {
            width: get("W")[0] as u32,
            height: get("H")[0] as u32,
            fx: k[0],
            fy: k[4],
            cx: k[2],
            cy: k[5],
        },
        camera_from_world: Rigid { rotation: DQuat::from_mat3(&rotation), translation: DVec3::new(v[3], v[7], v[11]) },
    };
    let bg = get("bg");
    let background = [bg[0] as f32, bg[1] as f32, bg[2] as f32];
    let options = Options { antialiased: false, sh_degree, background, extras: true, inverse_depth: false };
    Some(Case { splats, camera, options, arrays })
}

/// [H, W, C] to planes.
pub(crate) fn planes(values: &[f64], channels: usize) -> Vec<f32> {
    (0..channels).flat_map(|c| values.iter().skip(c).step_by(channels).map(|&v| v as f32)).collect()
}

pub(crate) fn cosine(a: &[f32], b: &[f64]) -> (f64, f64) {
    let dot = |f: &dyn Fn(usize) -> f64| (0..b.len()).map(f).sum::<f64>();
    let (ab, aa, bb) = (dot(&|i| f64::from(a[i]) * b[i]), dot(&|i| f64::from(a[i]).powi(2)), dot(&|i| b[i] * b[i]));
    (ab / (aa * bb).sqrt(), (aa / bb).sqrt())
}

impl Case {
    /// The upstream gradient of the tensors.
    pub(crate) fn upstream(&self) -> Upstream {
        Upstream {
            colour: planes(&self.arrays["dL_dimage"].1, 3),
            transmittance: self.arrays["dL_dalpha"].1.iter().map(|&g| -g as f32).collect(),
            ..Upstream::default()
        }
    }

    /// Compares an image and gradients with the tensors.
    pub(crate) fn compare(&self, name: &str, frame: &Frame, gradients: &Gradients) {
        let arrays = &self.arrays;
        let image = planes(&arrays["image"].1, 3);
        let worst = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        let error = worst(&frame.colour, &image);
        assert!(error < 2e-4, "{name}: colour differs by {error}");
        let alpha: Vec<f32> = frame.transmittance.iter().map(|t| 1.0 - t).collect();
        let expected: Vec<f32> = arrays["alpha"].1.iter().map(|&a| a as f32).collect();
        let error = worst(&alpha, &expected);
        assert!(error < 2e-4, "{name}: alpha differs by {error}");
        for (first, key) in [
            (column::MEAN, "grad_means"),
            (column::LOG_SCALE, "grad_log_scales"),
            (column::QUAT, "grad_quats"),
            (column::OPACITY, "grad_opac_logit"),
            (column::SH, "grad_sh"),
        ] {
            let expected = &arrays[key].1;
            let n = self.splats.len();
            let width = expected.len() / n;
            let ours: Vec<f32> = (0..n)
                .flat_map(|i| (0..width).map(move |k| (i, k)))
                .map(|(i, k)| gradients.columns[first + k][i])
                .collect();
            let (cosine, ratio) = cosine(&ours, expected);
            println!("{name} {key}: cosine {cosine:.8}, length ratio {ratio:.6}");
            assert!(cosine > 0.99999 && (ratio - 1.0).abs() < 1e-3, "{name} {key}");
        }
    }
}
