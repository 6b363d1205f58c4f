//! Sweeps as nuScenes has them: in the sensor's axes at the middle of the turn (x right, y ahead, z up), corrected for the car's
//! motion; five f32 a point: x, y, z, intensity 0 to 255, and the number of the beam.

use std::path::Path;

use city::sense::Motion;
use city::sense::lidar::{Lidar, Return};
use glam::DQuat;
use scene::Rigid;
use store::file::{SaveError, save};

use super::super::shots::Station;

/// The lidar's name.
pub(crate) const LIDAR: &str = "LIDAR_TOP";

/// Path of a station's sweep, relative to the data set.
pub(super) fn file(station: &Station) -> String {
    format!("samples/{LIDAR}/{}.pcd.bin", station.name)
}

/// The sensor's mounting.
pub(super) fn vehicle_from_sensor() -> Rigid {
    vehicle_from_turn().compose(&turn_from_sensor())
}

/// The vehicle's pose from that of the sensor's turn, whose axes are x ahead, y left, z up.
pub(super) fn world_from_vehicle(world_from_turn: &Rigid) -> Rigid {
    world_from_turn.after(&vehicle_from_turn().inverse())
}

/// Writes the sweep of a station into a data set. The folder exists.
pub(crate) fn save_sweep(
    root: &Path,
    station: &Station,
    pose: &Rigid,
    motion: &Motion,
    returns: &[&Return],
) -> Result<(), SaveError> {
    let from_world = pose.compose(&turn_from_sensor()).inverse();
    let mut bytes = Vec::with_capacity(20 * returns.len());
    for found in returns {
        let then = motion.extrapolate(pose, found.seconds - station.seconds);
        let place = then.apply(found.direction.as_dvec3() * f64::from(found.range));
        let [x, y, z] = from_world.apply(place).as_vec3().to_array();
        [x, y, z, 255.0 * found.intensity, f32::from(found.channel)].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
    }
    save(&root.join(file(station)), &bytes)
}

fn vehicle_from_turn() -> Rigid {
    let mount = Lidar::default().mount;
    Rigid { rotation: DQuat::from_rotation_z(mount.yaw_degrees.to_radians()), translation: mount.offset }
}

/// From x right, y ahead to x ahead, y left.
fn turn_from_sensor() -> Rigid {
    Rigid { rotation: DQuat::from_rotation_z(-std::f64::consts::FRAC_PI_2), ..Rigid::IDENTITY }
}
