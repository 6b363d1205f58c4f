//! Poses, velocities and gait phases of actors at a time.

use glam::DVec3;
use scene::Rigid;

use crate::{Actor, Waypoint};

/// The actor's pose at a city time, seconds.
pub fn pose_at(actor: &Actor, seconds: f64) -> Rigid {
    let path = actor.trajectory.as_ref().map_or(&[][..], |t| &t.waypoints);
    between(path, seconds).unwrap_or(actor.world_from_asset)
}

/// The actor's asset at a time: the current phase of its gait, or its own asset without one.
pub fn asset_at(actor: &Actor, seconds: f64) -> u32 {
    match &actor.trajectory {
        Some(t) if !t.gait.is_empty() && t.gait_seconds > 0.0 => {
            let part = (seconds / t.gait_seconds).rem_euclid(1.0) * t.gait.len() as f64;
            t.gait[(part as usize).min(t.gait.len() - 1)]
        }
        _ => actor.asset,
    }
}

/// The velocity of a point fixed to the actor, world metres per second.
pub fn velocity_at(actor: &Actor, seconds: f64, point: DVec3) -> DVec3 {
    const STEP: f64 = 1e-3;
    if actor.trajectory.is_none() {
        return DVec3::ZERO;
    }
    let sensor_pose_at = pose_at(actor, seconds).inverse().apply(point);
    let (before, after) = (pose_at(actor, seconds - STEP), pose_at(actor, seconds + STEP));
    (after.apply(sensor_pose_at) - before.apply(sensor_pose_at)) / (2.0 * STEP)
}

/// The pose between waypoints: linear interpolation and slerp, constant before the first and after the last waypoint.
/// `None` without waypoints.
pub fn between(path: &[Waypoint], seconds: f64) -> Option<Rigid> {
    let next = path.partition_point(|w| w.seconds <= seconds);
    let (Some(a), Some(b)) = (path.get(next.saturating_sub(1)), path.get(next.min(path.len().saturating_sub(1))))
    else {
        return None;
    };
    let span = b.seconds - a.seconds;
    let share = if span > 0.0 { ((seconds - a.seconds) / span).clamp(0.0, 1.0) } else { 0.0 };
    Some(mix(&a.world_from_asset, &b.world_from_asset, share))
}

/// Interpolates two poses; `share` is 0 at `a` and 1 at `b`.
pub fn mix(a: &Rigid, b: &Rigid, share: f64) -> Rigid {
    Rigid {
        rotation: a.rotation.slerp(b.rotation, share).normalize(),
        translation: a.translation.lerp(b.translation, share),
    }
}
