use std::collections::BTreeMap;

use proptest::prelude::*;

use super::read::rotation_of;
use super::*;
use crate::splats::Splat;

/// Splats in a room, with colours that vary with the place.
fn room(count: usize, sh_degree: u8) -> Splats {
    let mut splats = Splats::new(sh_degree);
    let unit = |i: usize, k: usize| ((i * 7919 + k * 104_729) % 10_007) as f32 / 10_007.0;
    for i in 0..count {
        let mean = glam::Vec3::new(unit(i, 0) * 80.0 - 40.0, unit(i, 1) * 60.0 - 30.0, unit(i, 2) * 9.0);
        let mut sh = [[0.0; 3]; 16];
        for (k, coefficient) in sh.iter_mut().enumerate() {
            let size = if k == 0 { 1.0 } else { 0.2 / k as f32 };
            *coefficient = [0, 1, 2].map(|c| size * (mean.x * 0.1 * (k + c + 1) as f32).sin());
        }
        splats.push(&Splat {
            mean,
            log_scale: glam::Vec3::new(unit(i, 3), unit(i, 4), unit(i, 5)) * 4.0 - 5.0,
            quat: [0, 1, 2, 3].map(|k| unit(i, 6 + k) - 0.5),
            opacity_logit: unit(i, 10) * 8.0 - 3.0,
            sh,
        });
    }
    splats
}

fn read_back(files: &[File]) -> Result<(Splats, bool), CodecError> {
    let by_name: BTreeMap<&str, &[u8]> = files.iter().map(|file| (file.name.as_str(), file.bytes.as_slice())).collect();
    let bytes =
        |name: &str| by_name.get(name).map(|bytes| bytes.to_vec()).ok_or_else(|| CodecError::new("no such file"));
    read(&bytes(META)?, bytes)
}

#[test]
fn splats_come_back_within_the_steps_of_the_format() {
    for (count, sh_degree) in [(1, 0), (700, 1), (3000, 3)] {
        let splats = room(count, sh_degree);
        let files = write(&splats, sh_degree == 1).unwrap();
        assert_eq!(files.last().unwrap().name, META);
        assert_eq!(files, write(&splats, sh_degree == 1).unwrap(), "the same bytes twice");
        let (back, antialiased) = read_back(&files).unwrap();
        assert_eq!((back.len(), back.sh_degree(), antialiased), (count, sh_degree, sh_degree == 1));
        let mut worst = [0.0f32; 5];
        for i in 0..count {
            let (a, b) = (splats.get(i), back.get(i));
            let dot = |a: [f32; 4], b: [f32; 4]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
            let angle = 1.0 - dot(a.quat, b.quat).abs() / (dot(a.quat, a.quat) * dot(b.quat, b.quat)).sqrt();
            let opacity = |logit: f32| 1.0 / (1.0 + (-logit).exp());
            let off = [
                a.mean.distance(b.mean),
                (a.log_scale - b.log_scale).abs().max_element(),
                angle,
                (opacity(a.opacity_logit) - opacity(b.opacity_logit)).abs(),
                (0..3).map(|c| (a.sh[0][c] - b.sh[0][c]).abs()).fold(0.0, f32::max),
            ];
            (worst.iter_mut().zip(off)).for_each(|(worst, off)| *worst = worst.max(off));
        }
        assert!(worst[0] < 0.01 && worst[1] < 0.03 && worst[2] < 1e-4, "{worst:?}");
        assert!(worst[3] < 0.003 && worst[4] < 0.02, "{worst:?}");
    }
}

#[test]
fn palettes_keep_most_of_the_colour() {
    let splats = room(5000, 3);
    let (back, _) = read_back(&write(&splats, false).unwrap()).unwrap();
    let (mut error, mut whole) = (0.0f64, 0.0f64);
    for (a, b) in splats.columns()[column::SH + 3..].iter().zip(&back.columns()[column::SH + 3..]) {
        error += a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>();
        whole += a.iter().map(|a| f64::from(*a).powi(2)).sum::<f64>();
    }
    assert!(error < 0.01 * whole, "{error} of {whole}");
}

#[test]
fn what_cannot_be_written_is_refused() {
    let mut splats = room(3, 0);
    splats.columns_mut()[column::OPACITY][1] = f32::NAN;
    let problem = write(&splats, false).unwrap_err().to_string();
    assert!(problem.contains("splat 1"), "{problem}");
    assert!(write(&Splats::new(0), false).is_err());
}

#[test]
fn damaged_files_are_refused() {
    let files = write(&room(50, 1), false).unwrap();
    let changed = |name: &str, change: &dyn Fn(&mut Vec<u8>)| {
        let mut files = files.clone();
        change(&mut files.iter_mut().find(|file| file.name == name).unwrap().bytes);
        read_back(&files)
    };
    let meta = |from: &str, to: &str| {
        changed(META, &|bytes| *bytes = String::from_utf8(bytes.clone()).unwrap().replacen(from, to, 1).into_bytes())
    };
    assert!(changed(META, &|_| ()).is_ok());
    for (result, expected) in [
        (meta("\"version\":2", "\"version\":3"), "version 3"),
        (meta("\"count\":50", "\"count\":5000000000"), "cannot hold"),
        (meta("\"count\":50", "\"count\":500"), "pixels of 500"),
        (meta("\"bands\":1", "\"bands\":9"), "9 SH bands"),
        (meta("\"bands\":1", "\"bands\":2"), "pixels of 400"),
        (meta("means_u.webp", "../secret"), "no such file"),
        (meta("\"codebook\":[", "\"codebook\":[1.5,"), "codebook of scales"),
        (changed("sh0.webp", &|bytes| bytes.truncate(20)), "sh0.webp"),
        (changed("quats.webp", &|bytes| *bytes = b"RIFF\xff\xff\xff\x7fWEBPVP8L".to_vec()), "quats.webp"),
    ] {
        let problem = result.map(|_| ()).unwrap_err().to_string();
        assert!(problem.contains(expected), "{expected}: {problem}");
    }
}

proptest! {
    #[test]
    fn rotations_are_near_their_codes(quat in prop::array::uniform4(-1.0f32..1.0)) {
        prop_assume!(quat.iter().map(|v| v * v).sum::<f32>() > 0.01);
        let back = rotation_of(rotation_code(quat));
        let norm = quat.iter().map(|v| v * v).sum::<f32>().sqrt();
        let cosine: f32 = quat.iter().zip(back).map(|(a, b)| a / norm * b).sum();
        prop_assert!(cosine.abs() > 0.9999, "{quat:?} {back:?}");
    }

    #[test]
    fn codes_of_any_bytes_are_rotations(code: [u8; 4]) {
        prop_assert!(rotation_of(code).iter().all(|v| v.is_finite()));
    }
}
