use std::path::PathBuf;

use glam::{DQuat, DVec2, Vec3};
use scene::{CodecError, Splat, column};
use serde_json::Value;

use super::*;

const fn block(level: u8, x: u32, y: u32) -> BlockId {
    BlockId { level, x, y }
}

/// A root with two of its four children, one of which has all four.
const TREE: [BlockId; 7] =
    [BlockId::ROOT, block(1, 0, 0), block(1, 1, 1), block(2, 2, 2), block(2, 3, 2), block(2, 2, 3), block(2, 3, 3)];

fn ground() -> Ground {
    let min = DVec2::new(-20.0, -8.0);
    Ground { ground_from_world: DQuat::IDENTITY, min, edge_metres: 64.0, height_metres: 0.0, near_metres: 100.0 }
}

/// Splats on a grid over the root, the finer the deeper the block, and some that are background. The red of a splat tells its level.
fn splats_of(level: u8, step: f32) -> Splats {
    let mut splats = Splats::new(1);
    let side = (80.0 / step) as usize;
    for (x, y) in (0..side).flat_map(|x| (0..side).map(move |y| (x, y))) {
        let mean = Vec3::new(x as f32 * step - 27.9, y as f32 * step - 15.9, 1.0);
        splats.push(&Splat::round(mean, step.ln(), Vec3::new(0.2 * f32::from(level), 0.5, 0.5), 0.8));
    }
    for x in -2..3 {
        splats.push(&Splat::round(Vec3::new(x as f32 * 40.0, 0.0, 300.0), 2.0, Vec3::ONE, 0.9));
    }
    splats
}

fn write(out: &Path, cut: &Cut, deepest: Option<u8>, blocks: &[BlockId]) -> Result<Exported, ModelError> {
    let mut writer = Writer::new(out, ground(), cut, deepest, false);
    for &block in blocks.iter().rev() {
        let splats = splats_of(block.level, 4.0 / f32::from(1u8 << block.level));
        writer.add(block, &splats)?;
    }
    writer.finish(None)
}

fn read_chunk(meta: &Path) -> Splats {
    let bytes = |path: PathBuf| std::fs::read(path).map_err(|error| CodecError::new(error.to_string()));
    let folder = meta.parent().unwrap();
    sog::read(&bytes(meta.to_path_buf()).unwrap(), |name| bytes(folder.join(name))).unwrap().0
}

/// The splats of an archive without compression, by its local headers.
fn read_bundle(path: &Path) -> Splats {
    let bytes = std::fs::read(path).unwrap();
    let mut files = BTreeMap::new();
    let mut at = 0;
    while bytes[at..].starts_with(b"PK\x03\x04") {
        let length = u32::from_le_bytes(bytes[at + 18..at + 22].try_into().unwrap()) as usize;
        let start = at + 30 + usize::from(bytes[at + 26]);
        files.insert(String::from_utf8(bytes[at + 30..start].to_vec()).unwrap(), bytes[start..start + length].to_vec());
        at = start + length;
    }
    sog::read(&files[sog::META], |name| Ok(files[name].clone())).unwrap().0
}

fn leaves(node: &Value) -> Vec<&Value> {
    match node["children"].as_array() {
        Some(children) => {
            assert!(node["lods"].is_null() && children.len() == 2, "the tree is binary");
            children.iter().flat_map(leaves).collect()
        }
        None => vec![node],
    }
}

fn meta_of(folder: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(folder.join(META)).unwrap()).unwrap()
}

#[test]
fn every_level_shows_every_place_once() {
    let folder = tempfile::tempdir().unwrap();
    let cut: Cut = TREE.into_iter().collect();
    let exported = write(folder.path(), &cut, Some(2), &TREE).unwrap();
    let meta = meta_of(folder.path());
    assert_eq!((exported.levels, &meta["lodLevels"], &meta["version"]), (3, &3.into(), &1.into()));
    let names = meta["filenames"].as_array().unwrap();
    let chunks: Vec<Splats> =
        names.iter().map(|name| read_chunk(&folder.path().join(name.as_str().unwrap()))).collect();
    let leaves = leaves(&meta["tree"]);
    assert_eq!(leaves.len(), 3 + 4, "three quarters of the root, and those of 1/1/1");
    let mut runs = BTreeMap::<u64, BTreeSet<(u64, u64)>>::new();
    for lod in 0..3u8 {
        let mut shown = Vec::new();
        for leaf in &leaves {
            let run = &leaf["lods"][lod.to_string()];
            let [file, offset, count] = ["file", "offset", "count"].map(|key| run[key].as_u64().unwrap());
            runs.entry(file).or_default().insert((offset, count));
            for i in offset..offset + count {
                let splat = chunks[file as usize].get(i as usize);
                let inside = |key: &str, sign: f32| {
                    let bound: Vec<f32> = serde_json::from_value(leaf["bound"][key].clone()).unwrap();
                    (sign * (splat.mean - Vec3::from_slice(&bound))).min_element() > -0.02
                };
                assert!(inside("min", 1.0) && inside("max", -1.0), "{} is outside {}", splat.mean, leaf["bound"]);
                shown.push(splat);
            }
        }
        assert_eq!(meta["counts"][usize::from(lod)].as_u64(), Some(shown.len() as u64));
        // The quarter that has all levels shows the level asked for, the others the nearest that they have.
        for splat in &shown {
            let [x, y] = [splat.mean.x - 12.0, splat.mean.y - 24.0];
            let owner = if x > 0.1 && y > 0.1 {
                2
            } else if x < -0.1 && y < -0.1 {
                1
            } else {
                continue;
            };
            let level = (splat.sh[0][0] * scene::SH_C0 + 0.5) / 0.2;
            assert_eq!(level.round() as u8, owner.min(2 - lod), "{} at {lod}", splat.mean);
        }
    }
    // Runs of a file follow each other without gaps, whichever levels they are shown at.
    for (file, runs) in runs {
        let end = runs.iter().fold(0, |at, &(offset, count)| if offset == at { at + count } else { u64::MAX });
        assert_eq!(end, chunks[file as usize].len() as u64, "{runs:?}");
    }
    let environment = read_bundle(&folder.path().join(meta["environment"].as_str().unwrap()));
    assert_eq!(environment.len(), 5);
    assert!(
        (0..5).all(|i| environment.mean(i).z > 299.0) && chunks.iter().all(|c| (0..c.len()).all(|i| c.mean(i).z < 2.0))
    );

    let again = tempfile::tempdir().unwrap();
    write(again.path(), &cut, Some(2), &TREE).unwrap();
    let same = |name: &str| {
        std::fs::read(folder.path().join(name)).unwrap() == std::fs::read(again.path().join(name)).unwrap()
    };
    assert!(same(META) && names.iter().all(|name| same(name.as_str().unwrap())), "not the same bytes twice");
}

#[test]
fn crowded_cells_are_quartered() {
    let folder = tempfile::tempdir().unwrap();
    let cut: Cut = [BlockId::ROOT].into_iter().collect();
    let mut writer = Writer::new(folder.path(), ground(), &cut, None, false);
    let splats = splats_of(0, 0.25);
    writer.add(BlockId::ROOT, &splats).unwrap();
    let exported = writer.finish(None).unwrap();
    assert_eq!(exported.splats, splats.len() as u64);
    let meta = meta_of(folder.path());
    let counts: Vec<u64> =
        leaves(&meta["tree"]).iter().map(|leaf| leaf["lods"]["0"]["count"].as_u64().unwrap()).collect();
    assert!(counts.len() >= 4 && counts.iter().all(|&count| count <= FILE_SPLATS as u64), "{counts:?}");
    assert_eq!(counts.iter().sum::<u64>() + 5, splats.len() as u64);
}

#[test]
fn splats_at_one_place_are_written_all_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let cut: Cut = [BlockId::ROOT].into_iter().collect();
    let mut splats = Splats::new(0);
    (0..FILE_SPLATS + 10).for_each(|_| splats.push(&Splat::round(Vec3::ONE, -1.0, Vec3::ONE, 0.5)));
    let mut writer = Writer::new(folder.path(), ground(), &cut, None, false);
    writer.add(BlockId::ROOT, &splats).unwrap();
    assert_eq!(writer.finish(None).unwrap().splats, splats.len() as u64);
}

#[test]
fn what_cannot_be_exported_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let empty = Writer::new(folder.path(), ground(), &Cut::default(), None, false).finish(None);
    assert!(empty.unwrap_err().to_string().contains("no splat"));
    std::fs::write(folder.path().join("a.ply"), scene::ply::write(&splats_of(0, 8.0), &[])).unwrap();
    let (model, out) = (folder.path().join("a.ply"), folder.path().join("out"));
    let exported = write_streamed_sog(&model, &out, &mut |_, _| ()).unwrap();
    assert!(exported.splats == 105 && out.join(META).is_file());
    let again = write_streamed_sog(&model, &out, &mut |_, _| ()).unwrap_err().to_string();
    assert!(again.contains("is not empty"), "{again}");
    let mut broken = splats_of(0, 8.0);
    broken.columns_mut()[column::OPACITY][7] = f32::NAN;
    std::fs::write(&model, scene::ply::write(&broken, &[])).unwrap();
    let out = folder.path().join("broken");
    let refused = write_streamed_sog(&model, &out, &mut |_, _| ()).unwrap_err().to_string();
    assert!(refused.contains("a.ply") && refused.contains("splat 7") && !out.exists(), "{refused}");
}
