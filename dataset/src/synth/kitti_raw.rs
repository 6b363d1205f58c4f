//! Writes the drives of the cars in the layout of the KITTI raw recordings, a frame for each place with a photo or a sweep.
//! `scene::kitti_raw` describes the files.
//!
//! ```text
//! kitti_raw/1970_01_01/calib_*.txt
//! kitti_raw/1970_01_01/1970_01_01_drive_LEG_sync/image_0{2,3}/data/FRAME.png      photos of the cameras that look ahead
//! kitti_raw/1970_01_01/1970_01_01_drive_LEG_sync/oxts/data/FRAME.txt
//! kitti_raw/1970_01_01/1970_01_01_drive_LEG_sync/velodyne_points/data/FRAME.bin   with a lidar
//! kitti_raw/1970_01_01/1970_01_01_drive_LEG_sync/tracklet_labels.xml              boxes of vehicles and people
//! ```
//!
//! The IMU is on the road under the car's centre. A frame has one position: that of its first photo as reported, with its
//! errors, or the true one without a photo. The cameras of the rig that look to the sides and to the rear have no place in the
//! format.

mod tracklets;

use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use city::Waypoint;
use city::sense::lidar::{Lidar, Return};
use city::sense::rig::{Mount, sensor_pose_at};
use city::sense::{Motion, Shot};
use city::trace::World;
use glam::{DMat3, DQuat, DVec3, EulerRot};
use scene::kitti_raw::Mercator;
use scene::lidar::Turn;
use scene::{Pinhole, Rigid};
use store::file::{SaveError, save};

use self::tracklets::Frame;
use super::cameras::ORIGIN;
use super::lidar_turn::LidarTurn;
use super::nuscenes::{Sample, mount_of, vehicle_from_camera};
use super::output::create_folder;
use super::settings::{Progress, Settings, SynthError};
use super::shots::Station;

/// The folder below the capture.
pub(super) const FOLDER: &str = "kitti_raw";
const DATE: &str = "1970_01_01";
/// Duration of a turn of KITTI's Velodyne.
const TURN_SECONDS: f64 = 0.1;
/// Points whose place is met by no firing of such a turn are left out: those at the seam to the rear, where a turn of a moving
/// sensor has a gap. Metres.
const SEAM_METRES: f64 = 1e-4;
/// Numbers of a colour camera, in the order of the rig.
const COLOUR: [u8; 2] = [2, 3];

/// Writes calibration, positions, photos and tracklets; the sweeps are there ([`save_sweep`]). `shots` are sorted by name, `turns`
/// those of the stations.
pub(super) fn write(
    out: &Path,
    world: &World,
    shots: &[Shot],
    legs: &[Vec<Waypoint>],
    stations: &[Station],
    turns: &[Option<LidarTurn>],
    settings: &Settings,
    progress: Progress,
) -> Result<(), SynthError> {
    let mounts: Vec<Mount> = settings.rig.rig().cameras.into_iter().filter(|mount| mount.yaw_degrees == 0.0).collect();
    let Some(shot) = shots.iter().find(|shot| mount_of(&mounts, shot).is_some()) else { return Ok(()) };
    save_calibration(&out.join(FOLDER).join(DATE), &mounts, &shot.reported.pinhole)?;
    let projection = Mercator::new(&ORIGIN);
    let mut drives: BTreeMap<usize, Vec<(&Station, Option<&LidarTurn>)>> = BTreeMap::new();
    for (i, station) in stations.iter().enumerate() {
        drives.entry(station.leg).or_default().push((station, turns.get(i).and_then(Option::as_ref)));
    }
    for (done, (leg, stations)) in drives.iter().enumerate() {
        progress("kitti raw", done + 1, drives.len());
        let drive = folder(out, *leg);
        create_folder(&drive.join("oxts/data"))?;
        let cameras = mounts.iter().zip(COLOUR);
        cameras.clone().try_for_each(|(_, number)| create_folder(&drive.join(format!("image_0{number}/data"))))?;
        let car = Mount { name: String::new(), offset: DVec3::ZERO, yaw_degrees: 0.0 };
        let mut frames = Vec::new();
        for (station, turn) in stations {
            let pose = legs.get(*leg).and_then(|leg| sensor_pose_at(leg, &car, station.seconds));
            let Some((mut vehicle, motion)) = pose else { continue };
            let world_from_velodyne = vehicle.compose(&vehicle_from_lidar());
            let mut photos = Vec::new();
            let frame = format!("{:010}", station.frame);
            for (i, (mount, number)) in cameras.clone().enumerate() {
                let is_photo = |shot: &&Shot| mount_of(&mounts, shot).is_some_and(|other| other.name == mount.name);
                let find = |name: &String| shots.binary_search_by(|shot| shot.name.cmp(name)).ok().map(|at| &shots[at]);
                let Some(shot) = station.photos.iter().filter_map(find).find(is_photo) else { continue };
                photos.push(shot);
                if i == 0 {
                    let world_from_camera = shot.reported.camera_from_world.inverse();
                    vehicle = world_from_camera.after(&vehicle_from_camera(mount).inverse());
                }
                let from = out.join(format!("images/{}.png", shot.name));
                let photo = fs::read(&from).map_err(|e| SaveError::new(&from, &e))?;
                save(&drive.join(format!("image_0{number}/data/{frame}.png")), &photo)?;
            }
            let oxts = oxts(&projection, &vehicle, &motion);
            save(&drive.join(format!("oxts/data/{frame}.txt")), oxts.as_bytes())?;
            frames.push(Frame { sample: Sample { station, photos, turn: *turn }, world_from_velodyne });
        }
        save(&drive.join("tracklet_labels.xml"), tracklets::text(world, &frames).as_bytes())?;
        save_times(&drive, stations.iter().map(|(station, _)| *station), settings.lidar)?;
    }
    Ok(())
}

/// The folder of a drive.
fn folder(out: &Path, leg: usize) -> PathBuf {
    out.join(FOLDER).join(DATE).join(format!("{DATE}_drive_{leg:04}_sync"))
}

/// All four cameras: camera 0 is where the first one is, and the grey ones are where those in colour are.
fn save_calibration(folder: &Path, mounts: &[Mount], k: &Pinhole) -> Result<(), SynthError> {
    create_folder(folder)?;
    let Some(first) = mounts.first() else { return Ok(()) };
    let first_from_vehicle = vehicle_from_camera(first).inverse();
    let mut text = format!("calib_time: {}\ncorner_dist: 0\n", time_text(0.0));
    for number in 0..4 {
        let mount = mounts.get(number % 2).unwrap_or(first);
        let t = -first_from_vehicle.apply(mount.offset);
        let last = [k.fx * t.x + k.cx * t.z, k.fy * t.y + k.cy * t.z, t.z];
        let (w, h, fx, fy, cx, cy) = (k.width, k.height, k.fx, k.fy, k.cx, k.cy);
        let lines = format!(
            "S_{number:02}: {w} {h}\nK_{number:02}: {fx} 0 {cx} 0 {fy} {cy} 0 0 1\nS_rect_{number:02}: {w} {h}\n\
             R_rect_{number:02}: 1 0 0 0 1 0 0 0 1\n\
             P_rect_{number:02}: {fx} 0 {cx} {} 0 {fy} {cy} {} 0 0 1 {}\n",
            last[0], last[1], last[2]
        );
        text += &lines;
    }
    save(&folder.join("calib_cam_to_cam.txt"), text.as_bytes())?;
    let vehicle_from_lidar = vehicle_from_lidar();
    let mountings = [
        ("calib_velo_to_cam.txt", first_from_vehicle.compose(&vehicle_from_lidar)),
        ("calib_imu_to_velo.txt", vehicle_from_lidar.inverse()),
    ];
    for (name, pose) in mountings {
        let (r, t) = (DMat3::from_quat(pose.rotation).transpose().to_cols_array(), pose.translation);
        let r = r.map(|value| value.to_string()).join(" ");
        let text = format!("calib_time: {}\nR: {r}\nT: {} {} {}\n", time_text(0.0), t.x, t.y, t.z);
        save(&folder.join(name), text.as_bytes())?;
    }
    Ok(())
}

fn vehicle_from_lidar() -> Rigid {
    let mount = Lidar::default().mount;
    Rigid { rotation: DQuat::from_rotation_z(mount.yaw_degrees.to_radians()), translation: mount.offset }
}

/// A line of oxts. Accelerations are those of a car that keeps its speed.
fn oxts(projection: &Mercator, vehicle: &Rigid, motion: &Motion) -> String {
    let place = projection.geo(vehicle.translation);
    let (yaw, pitch, roll) = vehicle.rotation.to_euler(EulerRot::ZYX);
    let level = DQuat::from_rotation_z(-yaw);
    let (v, ahead) = (motion.velocity, level * motion.velocity);
    let (spin, turn) = (vehicle.rotation.inverse() * motion.spin, level * motion.spin);
    let up = vehicle.rotation.inverse() * (9.81 * DVec3::Z);
    let numbers = [
        [place.latitude_degrees, place.longitude_degrees, place.altitude_metres],
        [roll, pitch, yaw],
        [v.y, v.x, ahead.x],
        [ahead.y, v.z, up.x],
        [up.y, up.z, 0.0],
        [0.0, 9.81, spin.x],
        [spin.y, spin.z, turn.x],
        [turn.y, turn.z, 0.01],
    ];
    let text: Vec<String> = numbers.iter().flatten().map(f64::to_string).collect();
    // Accuracy of the velocity, then: navigating, ten satellites, RTK for position, velocity and orientation.
    format!("{} 0.01 4 10 5 5 5\n", text.join(" "))
}

/// Writes a line for each frame into the files of times.
fn save_times<'a>(
    drive: &Path,
    stations: impl Iterator<Item = &'a Station> + Clone,
    lidar: bool,
) -> Result<(), SaveError> {
    let lines = |delay: f64| {
        let mut text = String::new();
        for station in stations.clone() {
            writeln!(text, "{}", time_text(station.seconds + delay)).expect("writing to a string cannot fail");
        }
        text
    };
    let half = 0.5 * TURN_SECONDS;
    let mut files = vec![("oxts/timestamps.txt".to_string(), 0.0)];
    files.extend(COLOUR.iter().map(|number| (format!("image_0{number}/timestamps.txt"), 0.0)));
    let sweeps = [("timestamps", 0.0), ("timestamps_start", -half), ("timestamps_end", half)];
    files.extend(
        sweeps.into_iter().filter(|_| lidar).map(|(name, delay)| (format!("velodyne_points/{name}.txt"), delay)),
    );
    for (name, delay) in files {
        let path = drive.join(name);
        if path.parent().is_some_and(Path::is_dir) {
            save(&path, lines(delay).as_bytes())?;
        }
    }
    Ok(())
}

/// A time after the start of 1970, to the nanosecond.
fn time_text(seconds: f64) -> String {
    let nanoseconds = (seconds.max(0.0) * 1e9).round() as u64;
    let (seconds, rest) = (nanoseconds / 1_000_000_000 % 86_400, nanoseconds % 1_000_000_000);
    format!("1970-01-01 {:02}:{:02}:{:02}.{rest:09}", seconds / 3600, seconds / 60 % 60, seconds % 60)
}

/// Writes the sweep of a station as KITTI's Velodyne measures it: counter-clockwise, each point in the axes of its firing.
pub(super) fn save_sweep(
    out: &Path,
    station: &Station,
    pose: &Rigid,
    motion: &Motion,
    returns: &[&Return],
) -> Result<(), SaveError> {
    let data = folder(out, station.leg).join("velodyne_points/data");
    create_folder(&data)?;
    let turn = Turn { seconds: TURN_SECONDS, clockwise: false, velocity: motion.velocity, spin: motion.spin };
    let mut bytes = Vec::with_capacity(16 * returns.len());
    for found in returns {
        let then = motion.extrapolate(pose, found.seconds - station.seconds);
        let place = then.apply(found.direction.as_dvec3() * f64::from(found.range));
        // When it was fired depends on where it lies in the axes of then.
        let mut point = pose.inverse().apply(place);
        for _ in 0..8 {
            point = turn.pose(pose, point).inverse().apply(place);
        }
        if turn.pose(pose, point).apply(point).distance(place) < SEAM_METRES {
            let [x, y, z] = point.as_vec3().to_array();
            [x, y, z, found.intensity].iter().for_each(|value| bytes.extend(value.to_le_bytes()));
        }
    }
    save(&data.join(format!("{:010}.bin", station.frame)), &bytes)
}
