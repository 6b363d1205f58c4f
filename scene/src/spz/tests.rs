use std::io::Write;

use flate2::{Compression, write::GzEncoder};
use glam::{Quat, Vec3};
use proptest::prelude::*;

use super::*;
use crate::similarity::harmonics;
use crate::splats::Splat;

/// Pseudo-random numbers in -1..1.
fn noise(seed: &mut u32) -> f32 {
    *seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    (*seed >> 8) as f32 / (1 << 24) as f32 * 2.0 - 1.0
}

fn splats(count: usize, sh_degree: u8) -> Splats {
    let mut splats = Splats::new(sh_degree);
    let mut seed = 7;
    for _ in 0..count {
        let mut v = || noise(&mut seed);
        let mut sh = [[0.0; 3]; 16];
        sh.as_flattened_mut().iter_mut().for_each(|c| *c = 0.7 * v());
        splats.push(&Splat {
            mean: Vec3::new(900.0 * v(), 700.0 * v(), 30.0 * v()),
            log_scale: Vec3::new(v(), v(), v()) * 3.0 - 4.0,
            quat: [v(), v(), v(), v()],
            opacity_logit: 5.0 * v(),
            sh,
        });
    }
    splats
}

fn rotation(q: [f32; 4]) -> Quat {
    Quat::from_xyzw(q[1], q[2], q[3], q[0]).normalize()
}

#[test]
fn round_trips_within_the_quantisation_steps_and_then_exactly() {
    // Version 2 loses a w near zero in the rounding of the others.
    for (version, degrees) in [(Version::V2, 12.0), (Version::V3, 0.3)] {
        for sh_degree in 0..=3 {
            let splats = splats(1500, sh_degree);
            let bytes = write(&splats, sh_degree == 2, version).unwrap();
            let (back, antialiased) = read(&bytes).unwrap();
            assert_eq!((back.len(), back.sh_degree(), antialiased), (1500, sh_degree, sh_degree == 2));
            let mut angles = 0.0;
            for i in 0..splats.len() {
                let (a, b) = (splats.get(i), back.get(i));
                assert!((a.mean - b.mean).abs().max_element() <= 0.51 / 4096.0);
                assert!((a.log_scale - b.log_scale).abs().max_element() <= 0.501 / 16.0);
                let opacity = |logit: f32| 1.0 / (1.0 + (-logit).exp());
                assert!((opacity(a.opacity_logit) - opacity(b.opacity_logit)).abs() <= 0.501 / 255.0);
                let angle = rotation(a.quat).angle_between(rotation(b.quat)).to_degrees();
                assert!(angle < degrees, "{angle}");
                angles += angle;
                for (k, (a, b)) in a.sh.iter().zip(b.sh).enumerate() {
                    let step = [0.501 / (0.15 * 255.0), 4.6 / 128.0, 8.6 / 128.0][[0, 1, 1, 1, 2][k.min(4)]];
                    assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() <= step), "{k}");
                }
            }
            assert!(angles / 1500.0 < [1.2, 0.12][usize::from(version == Version::V3)], "{angles}");
            assert_eq!(write(&back, antialiased, version).unwrap(), bytes);
        }
    }
}

#[test]
fn codes_are_fixed_points() {
    let mut seed = 3;
    for i in 0..200_000 {
        let mut quat = [(); 4].map(|()| noise(&mut seed));
        // Many with two or four nearly equal components, and many with zeros.
        match i % 5 {
            0 => quat[1] = quat[0] * (1.0 + 0.004 * noise(&mut seed)),
            1 => quat = quat.map(|v| v.signum() * (1.0 + 0.004 * noise(&mut seed))),
            2 => quat[i / 5 % 4] = 0.0005 * quat[0],
            3 => (quat[2], quat[3]) = (quat[1].abs(), 0.0),
            _ => {}
        }
        for rotation in [Rotation::FirstThree, Rotation::SmallestThree] {
            let word = rotation.pack(quat);
            assert_eq!(rotation.pack(rotation.unpack(word)), word, "{quat:?} {rotation:?}");
        }
    }
    for byte in 0..=255u8 {
        assert_eq!(quantise::opacity(crate::ply::logit_of_byte(byte)), byte);
        assert_eq!(quantise::colour(quantise::from_colour(byte)), byte);
        assert_eq!(quantise::log_scale(quantise::from_log_scale(byte)), byte);
    }
    for coefficient in [1, 5] {
        for value in -2000..2000 {
            let code = quantise::sh(value as f32 / 1000.0, coefficient);
            assert_eq!(quantise::sh(quantise::from_sh(code), coefficient), code);
        }
        assert_eq!(quantise::from_sh(quantise::sh(0.0, coefficient)), 0.0);
    }
}

#[test]
fn sh_signs_match_the_axis_flip() {
    let at = Vec3::new(0.3, -0.7, 0.5);
    let [here, turned] = [at, Vec3::from_array(quantise::FLIP) * at].map(|at| harmonics(at.as_dvec3()));
    for (k, (a, b)) in here.into_iter().zip(turned).enumerate() {
        assert_eq!(f64::from(sh_sign(k)) * a, b, "{k}");
    }
    // Rotations are conjugated with the flip of the axes.
    let q = [0.5, -0.1, 0.8, 0.3];
    let word = Rotation::SmallestThree.pack(q);
    let [x, y, z, w] = {
        let [w, x, y, z] = Rotation::SmallestThree.unpack(word);
        [x, -y, -z, w]
    };
    let flip = Vec3::from_array(quantise::FLIP);
    let v = Vec3::new(0.2, 0.4, -0.6);
    let spz = Quat::from_xyzw(x, y, z, w) * (flip * v);
    assert!((flip * (rotation(q) * v) - spz).length() < 5e-3);
}

#[test]
fn distant_scenes_use_fewer_fractional_bits() {
    let mut splats = splats(3, 0);
    splats.columns_mut()[0][1] = -30_000.25;
    let (back, _) = read(&write(&splats, false, Version::V3).unwrap()).unwrap();
    assert_eq!(back.col(0)[1], -30_000.25);
    assert!((back.col(1)[2] - splats.col(1)[2]).abs() < 1.0 / 256.0);
    splats.columns_mut()[0][1] = 9e6;
    assert!(write(&splats, false, Version::V3).is_err());
    splats.columns_mut()[0][1] = f32::NAN;
    splats.columns_mut()[column::OPACITY][2] = f32::INFINITY;
    let refused = write(&splats, false, Version::V3).unwrap_err().to_string();
    assert!(refused.contains("splat 1 has numbers that are not finite (2 of 3"), "{refused}");
    assert_eq!(read(&write(&Splats::new(1), true, Version::V2).unwrap()), Ok((Splats::new(1), true)));
}

/// A gzip stream of these bytes.
fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut to = GzEncoder::new(Vec::new(), Compression::default());
    to.write_all(bytes).unwrap();
    to.finish().unwrap()
}

/// The decompressed gzip stream.
fn gunzip(bytes: &[u8]) -> Vec<u8> {
    let mut inside = Vec::new();
    GzDecoder::new(bytes).read_to_end(&mut inside).unwrap();
    inside
}

#[test]
fn inconsistent_and_damaged_files_are_refused() {
    let bytes = write(&splats(40, 1), false, Version::V3).unwrap();
    for end in 0..bytes.len() {
        assert!(read(&bytes[..end]).is_err(), "{end}");
    }
    let raw = gunzip(&bytes);
    let with = |at: usize, value: &[u8]| {
        let mut bad = raw.clone();
        bad[at..at + value.len()].copy_from_slice(value);
        read(&gzip(&bad))
    };
    assert!(with(0, b"X").is_err() && with(4, &[1]).is_err() && with(4, &[4]).is_err() && with(4, &[5]).is_err());
    assert!(with(8, &[39]).is_err() && with(8, &[41]).is_err());
    assert!(with(8, &u32::MAX.to_le_bytes()).unwrap_err().to_string().contains("announce"));
    assert!(with(12, &[5]).is_err() && with(13, &[25]).is_err() && with(14, &[2]).is_err());
    assert!(with(12, &[2]).is_err() && read(&gzip(&[&raw[..], &[0]].concat())).is_err());
    assert!(read(&raw).is_err() && read(b"").is_err());
    // A decompression bomb: two gigabytes of zero splats.
    let count = 1u32 << 23;
    let header = [&MAGIC.to_le_bytes()[..], &3u32.to_le_bytes(), &count.to_le_bytes(), &[3, 12, 0, 0]].concat();
    assert!(read(&gzip(&header)).unwrap_err().to_string().contains("announce"));
}

/// Converts version 3 to version 4.
fn version_4(bytes: &[u8]) -> Vec<u8> {
    let raw = gunzip(bytes);
    let header = Header::parse(*raw.first_chunk().unwrap()).unwrap();
    let (mut contents, mut body, mut planes) = (Vec::new(), Vec::new(), &raw[16..]);
    for size in header.plane_sizes().into_iter().filter(|&size| size > 0) {
        let (plane, rest) = planes.split_at(size * header.count);
        let stream = zstd::encode_all(plane, 3).unwrap();
        contents.extend((stream.len() as u64).to_le_bytes().into_iter().chain((plane.len() as u64).to_le_bytes()));
        body.extend(stream);
        planes = rest;
    }
    let mut bytes = raw[..16].to_vec();
    (bytes[4], bytes[15]) = (4, (contents.len() / 16) as u8);
    bytes.extend(32u32.to_le_bytes().into_iter().chain([0; 12]));
    [bytes, contents, body].concat()
}

#[test]
fn version_4_decodes_like_version_3() {
    for sh_degree in [0, 2, 3] {
        let third = write(&splats(700, sh_degree), true, Version::V3).unwrap();
        let fourth = version_4(&third);
        assert_eq!(read(&fourth).unwrap(), read(&third).unwrap());
        for end in (0..fourth.len()).step_by(7) {
            assert!(read(&fourth[..end]).is_err(), "{end}");
        }
        for at in 0..130.min(fourth.len()) {
            let mut bad = fourth.clone();
            bad[at] ^= 0x15;
            let _ = read(&bad);
        }
    }
}

#[test]
fn biker_is_read() {
    let shared = std::env::var("PLAT_SHARED").unwrap_or(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared").into());
    let Ok(bytes) = std::fs::read(std::path::Path::new(&shared).join("data/splats/playcanvas/biker.spz")) else {
        println!("skipped: ../shared/data not present");
        return;
    };
    let (splats, _) = read(&bytes).unwrap();
    assert_eq!((splats.len(), splats.sh_degree()), (152_746, 0));
    assert!((0..splats.len()).all(|i| splats.is_finite(i)));
    let again = write(&splats, false, Version::V3).unwrap();
    let (back, _) = read(&again).unwrap();
    assert_eq!(write(&back, false, Version::V3).unwrap(), again);
    for axis in 0..3 {
        assert_eq!(back.col(axis), splats.col(axis), "positions have the same fractional bits");
    }
}

proptest! {
    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = (read(&bytes), read(&gzip(&bytes)));
        let _ = read(&[&MAGIC.to_le_bytes()[..], &[4, 0, 0, 0], &bytes].concat());
    }
}
