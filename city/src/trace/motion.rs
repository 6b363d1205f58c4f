//! Where an actor is at a moment, how fast, and in which part of its gait.

use glam::DVec3;
use scene::Rigid;

use crate::{Actor, Waypoint};

/// The actor's pose at a moment of the city's clock.
pub fn pose_at(actor: &Actor, seconds: f64) -> Rigid {
    let path = actor.trajectory.as_ref().map_or(&[][..], |t| &t.waypoints);
    between(path, seconds).unwrap_or(actor.world_from_asset)
}

/// The asset that the actor wears at a moment: its gait's in turn, else its own.
pub fn asset_at(actor: &Actor, seconds: f64) -> u32 {
    match &actor.trajectory {
        Some(t) if !t.gait.is_empty() && t.gait_seconds > 0.0 => {
            let part = (seconds / t.gait_seconds).rem_euclid(1.0) * t.gait.len() as f64;
            t.gait[(part as usize).min(t.gait.len() - 1)]
        }
        _ => actor.asset,
    }
}

/// The velocity of a point that the actor carries along, world metres per second.
pub fn velocity_at(actor: &Actor, seconds: f64, point: DVec3) -> DVec3 {
    const STEP: f64 = 1e-3;
    if actor.trajectory.is_none() {
        return DVec3::ZERO;
    }
    let carried = pose_at(actor, seconds).inverse().apply(point);
    let (before, after) = (pose_at(actor, seconds - STEP), pose_at(actor, seconds + STEP));
    (after.apply(carried) - before.apply(carried)) / (2.0 * STEP)
}

/// A pose between waypoints: straight and by slerp, held before the first and after the last; none where there are none.
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

/// A pose between two.
pub fn mix(a: &Rigid, b: &Rigid, share: f64) -> Rigid {
    Rigid {
        rotation: a.rotation.slerp(b.rotation, share).normalize(),
        translation: a.translation.lerp(b.translation, share),
    }
}
