//! The readers under test, each with a check of the values that it accepts.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::rc::Rc;
use std::sync::Arc;

use dataset::depth_maps::DepthMapOptions;
use dataset::depth_samples::DepthSamples;
use dataset::ingest::{self, IngestOptions};
use dataset::mip_tiles;
use dataset::open::{self, OpenOptions};
use glam::{DQuat, DVec3};
use image::{ImageFormat, RgbImage};
use scene::frame::{self, Kind};
use scene::parquet::Table;
use scene::transforms::{Frame, Intrinsics, Transforms};
use scene::{CameraModel, Capture, CodecError, Exposures, MovingObject, PathPose, Rect, Rigid, Swing};
use scene::{
    colmap, kitti_raw, kitti360, lidar, npy, nuscenes, objects, opensfm, ply, rad, radar, sog, splat_glb, spz,
    transforms, waymo,
};
use store::Store;

use crate::corpus::{CLOUD, PHOTO_SIZE, encoded};

/// A reader of files.
pub(crate) struct Reader {
    /// The fuzz target (`fuzz/fuzz_targets`) that the file is a seed of.
    pub(crate) target: &'static str,
    call: Box<Call>,
}

type Call = dyn Fn(&[u8]) -> Result<(), String>;
pub(crate) type Read = Rc<Reader>;

impl Reader {
    pub(crate) fn new(target: &'static str, call: impl Fn(&[u8]) -> Result<(), String> + 'static) -> Read {
        Rc::new(Self { target, call: Box::new(call) })
    }

    /// Reads the bytes and checks the value; a one-line error if the reader refuses them.
    pub(crate) fn read(&self, bytes: &[u8]) -> Result<(), String> {
        (self.call)(bytes)
    }
}

/// A reader with a check of its values.
fn codec<T: 'static>(target: &'static str, read: fn(&[u8]) -> Result<T, CodecError>, kept: fn(T) -> bool) -> Read {
    Reader::new(target, move |bytes| {
        let value = read(bytes).map_err(|error| error.to_string())?;
        assert!(kept(value), "accepted what it promises to refuse");
        Ok(())
    })
}

fn camera_is_sane(model: &CameraModel, width: u32, height: u32) -> bool {
    let finite = model.focal_and_centre().iter().chain(&model.distortion()).all(|v| v.is_finite());
    finite && model.focal_and_centre()[..2].iter().all(|f| *f > 0.0) && width > 0 && height > 0
}

pub(crate) fn colmap_binary() -> [Read; 3] {
    let images: fn(&[u8]) -> _ = |bytes| {
        let keypoints = colmap::read_keypoints_bin(bytes);
        colmap::read_images_bin(bytes).inspect(|_| assert!(keypoints.is_ok()))
    };
    [
        codec("colmap_binary", colmap::read_cameras_bin, |c| {
            c.values().all(|c| camera_is_sane(&c.model, c.width, c.height))
        }),
        codec("colmap_binary", images, |i| i.iter().all(|i| i.camera_from_world.is_sane() && !i.name.is_empty())),
        codec("colmap_binary", colmap::read_points_bin, points_are_sane),
    ]
}

pub(crate) fn colmap_text() -> [Read; 3] {
    [
        codec("colmap_text", colmap::read_cameras_txt, |c| {
            c.values().all(|c| camera_is_sane(&c.model, c.width, c.height))
        }),
        codec("colmap_text", colmap::read_images_txt, |i| {
            i.iter().all(|i| i.camera_from_world.is_sane() && !i.name.is_empty())
        }),
        codec("colmap_text", colmap::read_points_txt, points_are_sane),
    ]
}

fn points_are_sane(points: colmap::ColmapPoints) -> bool {
    points.positions.iter().all(|p| p.is_finite())
        && (0..points.len()).map(|i| points.track(i).len()).sum::<usize>() == points.track_images.len()
}

pub(crate) fn transforms_codec() -> Read {
    codec("transforms", transforms::read, |file| {
        let sane = |frame: &Frame| {
            let (width, height) = frame.intrinsics.size.unwrap_or((40, 30));
            frame.intrinsics.model(width, height);
            frame.camera_from_world.is_sane() && width > 0 && height > 0
        };
        file.frames.iter().all(sane) && transforms::read(&transforms::write(&file)).is_ok()
    })
}

pub(crate) fn tracks_codec() -> Read {
    codec("tracks", objects::read, |tracks| {
        let at =
            |seconds: f64| tracks.objects.iter().filter_map(|object| object.pose(seconds)).all(|pose| pose.is_sane());
        [-1e300, 0.25, 1.5, f64::INFINITY].into_iter().all(at) && objects::read(&objects::write(&tracks)).is_ok()
    })
}

/// The poses of sweeps, and the detections of a radar.
pub(crate) fn radar_codecs() -> [Read; 2] {
    [
        codec("radar", lidar::read_poses, |sweeps| {
            let sane =
                |sweep: &lidar::SweepPose| sweep.world_from_sensor.is_sane() && sweep.height.is_none_or(f64::is_finite);
            sweeps.iter().all(sane)
        }),
        codec("radar", radar::read_detections, |found| {
            found.iter().all(|of| [of.range, of.azimuth, of.velocity].iter().all(|value| value.is_finite()))
        }),
    ]
}

pub(crate) fn opensfm_codec() -> Read {
    codec("opensfm", opensfm::read, |sfm| {
        sfm.shots
            .iter()
            .all(|s| s.camera_from_world.is_sane() && camera_is_sane(&s.camera.model, s.camera.width, s.camera.height))
            && sfm.positions.iter().all(|p| p.is_finite())
            && sfm.colours.len() == sfm.positions.len()
    })
}

pub(crate) fn kitti_codecs() -> [Read; 5] {
    [
        codec("kitti360", kitti360::read_perspective, |c| {
            c.values().all(|c| camera_is_sane(&c.model, c.width, c.height))
        }),
        codec("kitti360", kitti360::read_cam_to_pose, |poses| poses.values().all(Rigid::is_sane)),
        codec("kitti360", kitti360::read_cam_to_velo, |pose| pose.is_sane()),
        codec("kitti360", kitti360::read_poses, |poses| poses.values().all(Rigid::is_sane)),
        codec("kitti360", |bytes| kitti360::read_scan(bytes, 1), |points| points.iter().all(|p| p.is_finite())),
    ]
}

/// `calib_cam_to_cam.txt`, a mounting, a file of oxts, one of times, and the tracklets.
pub(crate) fn kitti_raw_codecs() -> [Read; 5] {
    [
        codec("kitti_raw", kitti_raw::read_cameras, |found| {
            let sane = |c: &kitti_raw::RawCamera| camera_is_sane(&c.model, c.width, c.height) && c.from_first.is_sane();
            found.cameras.values().all(sane) && found.rectified_from_camera.is_sane()
        }),
        codec("kitti_raw", kitti_raw::read_mounting, |pose| pose.is_sane()),
        codec("kitti_raw", kitti_raw::read_oxts, |oxts| {
            let world = kitti_raw::Mercator::new(&oxts.place);
            world.world_from_imu(&oxts).is_sane() && oxts.velocity.is_finite() && oxts.spin.is_finite()
        }),
        codec("kitti_raw", kitti_raw::read_times, |_| true),
        codec("kitti_raw", kitti_raw::read_tracklets, |tracklets| {
            tracklets.iter().all(|of| of.size.min_element() > 0.0 && of.poses.iter().all(scene::Rigid::is_sane))
        }),
    ]
}

/// Tables of nuScenes in the order of `corpus::NUSCENES`, whose tokens these select.
pub(crate) fn nuscenes_codecs() -> [Read; 7] {
    fn samples() -> BTreeMap<String, i64> {
        BTreeMap::from([("s".to_string(), 7)])
    }
    [
        codec("nuscenes", nuscenes::read_names, |_| true),
        codec("nuscenes", |bytes| nuscenes::read_samples(bytes, "one"), |_| true),
        codec(
            "nuscenes",
            |bytes| nuscenes::read_data(bytes, &samples()),
            |data| data.is_sorted_by_key(|datum| datum.microseconds),
        ),
        codec(
            "nuscenes",
            |bytes| nuscenes::read_ego_poses(bytes, &BTreeSet::from(["e"])),
            |poses| poses.values().all(Rigid::is_sane),
        ),
        codec("nuscenes", nuscenes::read_modalities, |_| true),
        codec("nuscenes", nuscenes::read_calibrated_sensors, |sensors| {
            let lens = |lens: &CameraModel| camera_is_sane(lens, 16, 9);
            sensors.values().all(|s| s.vehicle_from_sensor.is_sane() && s.lens.iter().all(lens))
        }),
        codec(
            "nuscenes",
            |bytes| nuscenes::read_annotations(bytes, &samples()),
            |boxes| boxes.iter().all(|found| found.world_from_box.is_sane() && found.size.min_element() > 0.0),
        ),
    ]
}

/// A table of Waymo, or one with the columns of scene's tests of Parquet.
pub(crate) fn waymo_codec() -> Read {
    codec("waymo", read_table, |()| true)
}

fn read_table(bytes: &[u8]) -> Result<(), CodecError> {
    let mut table = Table::open(Arc::<[u8]>::from(bytes))?;
    if table.has("[CameraCalibrationComponent].width") {
        let cameras = waymo::read_cameras(&table)?;
        assert!(
            cameras.values().all(|c| camera_is_sane(&c.lens, c.width, c.height) && c.vehicle_from_camera.is_sane())
        );
    }
    if table.has("[VehiclePoseComponent].world_from_vehicle.transform") {
        assert!(waymo::read_vehicle_poses(&table)?.values().all(Rigid::is_sane));
    }
    if table.has(waymo::IMAGE) {
        for photo in waymo::read_photos(&table)?.iter().take(4) {
            assert!(photo.world_from_vehicle.is_sane());
            table.bytes(waymo::IMAGE, photo.row, 1 << 20)?;
        }
    }
    if table.has("[LiDARCalibrationComponent].beam_inclination.values") {
        assert!(waymo::read_lasers(&table)?.values().all(|laser| laser.vehicle_from_laser.is_sane()));
    }
    for (column, depth) in [(waymo::RANGES, 4), (waymo::PIXEL_POSES, 6)] {
        if table.has(column) {
            let turns = waymo::read_turns(&table, column, depth)?;
            let lengths: Vec<u32> = turns.iter().map(waymo::WaymoTurn::length).collect();
            for row in 0..turns.len().min(4) {
                assert_eq!(table.list(column, row as u64, &lengths)?.len(), lengths[row] as usize);
            }
        }
    }
    if table.has("[LiDARBoxComponent].type") {
        let boxes = waymo::read_boxes(&table)?;
        assert!(boxes.iter().all(|found| found.vehicle_from_box.is_sane() && found.size.min_element() > 0.0));
    }
    if table.has("photo") {
        table.texts("text")?;
        table.lists("values")?;
        table.bytes("photo", 4, 1 << 20)?;
    }
    Ok(())
}

pub(crate) fn ply_codec() -> Read {
    let both: fn(&[u8]) -> _ = |bytes| {
        ply::comments(bytes);
        ply::read(bytes)
    };
    codec("ply", both, |splats| splats.columns().iter().all(|c| c.len() == splats.len()))
}

pub(crate) fn cloud_codec() -> Read {
    codec("ply", ply::read_points, |(points, colours)| {
        points.len() == colours.len() && points.iter().all(|p| p.is_finite())
    })
}

pub(crate) fn spz_codec() -> Read {
    codec("spz", spz::read, |(splats, _)| (0..splats.len()).all(|i| splats.is_finite(i)))
}

pub(crate) fn splat_glb_codec() -> Read {
    codec("splat_glb", splat_glb::read, |parts| {
        parts.iter().all(|part| (0..part.splats.len()).all(|i| part.splats.is_finite(i)))
    })
}

pub(crate) fn rad_codec() -> Read {
    codec("rad", rad::read, |rad| {
        rad.nodes.len() == rad.children.len() && rad.nodes.iter().all(|node| node.is_finite())
    })
}

pub(crate) fn sog_codec() -> Read {
    codec("sog", sog::read_bundle, |(splats, _)| (0..splats.len()).all(|i| splats.is_finite(i)))
}

/// The pictures of a SOG, and its `meta.json`, without the archive, whose checksums stop damage early.
pub(crate) fn sog_file_codec(files: Vec<sog::File>, name: &str) -> Read {
    let damaged = name.to_owned();
    Reader::new("sog_file", move |bytes| {
        let file = |name: &str| match files.iter().find(|file| file.name == name) {
            Some(_) if name == damaged => Ok(bytes.to_vec()),
            Some(file) => Ok(file.bytes.clone()),
            None => Err(CodecError::new(format!("{name:?} is not there"))),
        };
        let meta = file(sog::META).map_err(|error| error.to_string())?;
        let (splats, _) = sog::read(&meta, file).map_err(|error| error.to_string())?;
        assert!((0..splats.len()).all(|i| splats.is_finite(i)), "accepted what it promises to refuse");
        Ok(())
    })
}

pub(crate) fn splats_codec() -> Read {
    codec("frames", frame::decode_splats, |splats| splats.columns().iter().all(|c| c.len() == splats.len()))
}

/// A trained object: what is known of it, and its frame's reader.
pub(crate) fn object_codec() -> Read {
    codec(
        "frames",
        |bytes| objects::from_frame(bytes, &parked()),
        |(object, splats, swing)| {
            let is_whole = swing.as_ref().is_none_or(|swing| swing.amplitudes.len() == splats.len());
            is_whole && object.check().is_ok() && splats.columns().iter().all(|c| c.len() == splats.len())
        },
    )
}

/// How so many splats swing.
pub(crate) fn swing_codec(splats: usize) -> Read {
    Reader::new("frames", move |bytes| {
        let Swing { amplitudes, .. } = Swing::from_frame(bytes, splats).map_err(|error| error.to_string())?;
        let is_kept = amplitudes.len() == splats && amplitudes.iter().flatten().all(|value| value.is_finite());
        assert!(is_kept, "accepted what it promises to refuse");
        Ok(())
    })
}

/// An object that stands still.
pub(crate) fn parked() -> MovingObject {
    let pose = |seconds: f64| PathPose { seconds, world_from_object: Rigid::IDENTITY };
    let path = (0..40).map(|i| pose(0.1 * f64::from(i))).collect();
    MovingObject { id: "car-1".into(), class: "car".into(), low: DVec3::ZERO, high: DVec3::ONE, path }
}

pub(crate) fn exposures_codec() -> Read {
    codec("frames", Exposures::from_frame, |exposures| {
        exposures.iter().all(|(_, exposure)| exposure.0.iter().flatten().all(|value| value.is_finite()))
    })
}

pub(crate) fn npy_codec() -> Read {
    codec("npy", npy::read_f32, |(shape, data)| shape.iter().product::<usize>() == data.len())
}

/// A plan with a capture that it may or may not belong to.
pub(crate) fn plan_codec(capture: Capture) -> Read {
    Reader::new("frames", move |bytes| {
        let plan = blocks::Plan::from_frame(bytes).map_err(|error| error.to_string())?;
        plan.leaves();
        for task in &plan.tasks {
            task.window_pixels();
            task.context_cut();
            plan.ground.halo(task.block);
            assert!(plan.task(task.block).is_some());
        }
        blocks::lint(&plan, &capture);
        Ok(())
    })
}

/// Loads a capture through the store and plans it.
pub(crate) fn capture_codec() -> Read {
    let store = Store::open("memory://").expect("memory").blocking();
    Reader::new("frames", move |bytes| {
        let kind: Kind = ingest::CAPTURE;
        frame::decode::<Capture>(kind, bytes).map_err(|error| error.to_string())?;
        let id = store.put(bytes.to_vec()).expect("memory takes it");
        let capture = ingest::load_capture(&store, id).map_err(|error| error.to_string())?;
        let settings = blocks::PlanSettings { budget: 1000, ..Default::default() };
        // Planning may fail: the values may be extreme.
        let _ = blocks::plan(&capture, id, &settings, "cpu").map_err(|error| error.to_string())?;
        Ok(())
    })
}

pub(crate) fn mip_codec() -> Read {
    Reader::new("mips", |bytes| {
        let layout = mip_tiles::MipLayout { width: 150, height: 140, masked: false };
        let index = layout.index(bytes.get(..layout.index_len()).unwrap_or(bytes)).map_err(|e| e.to_string())?;
        let rect = Rect { x: 100, y: 100, width: 50, height: 40 };
        let ranges = index.ranges(rect).expect("the window is inside");
        let part = |r: &std::ops::Range<u64>| bytes.get(r.start as usize..r.end as usize).unwrap_or(&[]);
        index.window(rect, &ranges.iter().map(part).collect::<Vec<_>>()).map_err(|e| e.to_string())?;
        Ok(())
    })
}

/// Opens and ingests a capture whose photo, or mask, is the file.
pub(crate) fn photo_codec(as_mask: bool) -> Read {
    let folder = tempfile::tempdir().expect("a folder");
    let frame = |x: f64, mask: bool| Frame {
        file_path: if mask { "good.png" } else { "photo" }.into(),
        mask_path: mask.then(|| "photo".to_string()),
        depth_file_path: None,
        intrinsics: Intrinsics::from_model(&CameraModel::Pinhole([90.0, 90.0, 50.0, 50.0]), None),
        camera_from_world: Rigid { rotation: DQuat::IDENTITY, translation: DVec3::new(x, 0.0, 0.0) },
    };
    let file = Transforms { frames: vec![frame(0.0, as_mask)], ply_file_path: Some("cloud.ply".into()) };
    fs::write(folder.path().join("transforms.json"), transforms::write(&file)).expect("written");
    fs::write(folder.path().join("cloud.ply"), CLOUD).expect("written");
    fs::write(folder.path().join("good.png"), encoded(RgbImage::new(PHOTO_SIZE.0, PHOTO_SIZE.1), ImageFormat::Png))
        .expect("written");
    Reader::new("image", move |bytes| {
        fs::write(folder.path().join("photo"), bytes).expect("written");
        let source = open::open(folder.path(), &OpenOptions::default()).map_err(|error| error.to_string())?;
        let store = Store::open("memory://").expect("memory").blocking();
        let options = IngestOptions { downscale: 1, threads: 1 };
        let ingested = ingest::ingest(&source, &store, &options, &|_, _| ()).map_err(|error| error.to_string())?;
        let loaded = ingest::load_capture(&store, ingested.id).map_err(|error| error.to_string())?;
        assert_eq!(loaded, ingested.capture);
        Ok(())
    })
}

/// Opens and ingests a capture whose photo has the file as its depth map, under this name.
pub(crate) fn depth_map_codec(target: &'static str, name: &'static str) -> Read {
    let folder = tempfile::tempdir().expect("a folder");
    let frame = Frame {
        file_path: "photo.png".into(),
        mask_path: None,
        depth_file_path: Some(name.into()),
        intrinsics: Intrinsics::from_model(&CameraModel::Pinhole([90.0, 90.0, 40.0, 30.0]), None),
        camera_from_world: Rigid::IDENTITY,
    };
    let file = Transforms { frames: vec![frame], ply_file_path: Some("cloud.ply".into()) };
    fs::write(folder.path().join("transforms.json"), transforms::write(&file)).expect("written");
    fs::write(folder.path().join("cloud.ply"), CLOUD).expect("written");
    let photo = encoded(RgbImage::new(PHOTO_SIZE.0, PHOTO_SIZE.1), ImageFormat::Png);
    fs::write(folder.path().join("photo.png"), photo).expect("written");
    Reader::new(target, move |bytes| {
        fs::write(folder.path().join(name), bytes).expect("written");
        let depths = Some(DepthMapOptions::default());
        let source = open::open(folder.path(), &OpenOptions { depths, ..OpenOptions::default() })
            .map_err(|error| error.to_string())?;
        assert_eq!(source.depth_maps(), 1);
        let store = Store::open("memory://").expect("memory").blocking();
        let options = IngestOptions { downscale: 1, threads: 1 };
        let ingested = ingest::ingest(&source, &store, &options, &|_, _| ()).map_err(|error| error.to_string())?;
        if let Some(id) = ingested.capture.views[0].depth {
            let bytes = store.get(id).expect("it was stored");
            let depths = DepthSamples::decode(&bytes, PHOTO_SIZE.0, PHOTO_SIZE.1).map_err(|error| error.to_string())?;
            assert!(depths.iter().all(|(_, _, depth)| depth > 0.0 && depth.is_finite()));
        }
        Ok(())
    })
}
