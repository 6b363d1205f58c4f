//! Which photos of a capture one sensor took, and how it moved when it took them.
//!
//! The errors of a rig are those of its sensors: a clock that is late, a mount or a focal length that was measured wrongly.
//! They are the same in all photos of a sensor, so few numbers describe them.

use std::collections::BTreeMap;

use glam::DVec3;

use crate::camera::{Pinhole, Rigid};
use crate::capture::View;

/// Longest time between two photos of a sensor that a motion is taken from, seconds.
const LONGEST_GAP: f64 = 10.0;
/// Two photos further apart in time than this many times the sensor's typical gap say nothing of the motion at either.
const TYPICAL_GAPS: f64 = 2.0;
/// How much the motions before and after a photo may differ: a share of the faster one, and metres per second. Where they
/// differ more, the sensor turned in between, and the chord of its path is not its motion.
const AGREES: (f64, f64) = (0.3, 0.5);

/// The sensor of a photo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Taken {
    /// Number of the sensor, from 0 in the order of their first views.
    pub sensor: u32,
    /// How it moved; `None` where the times of the photos do not tell.
    pub motion: Option<Motion>,
}

/// How a sensor moves, in its own axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion {
    /// Metres per second.
    pub velocity: DVec3,
    /// Rotation vector per second, radians.
    pub spin: DVec3,
}

/// The sensors of a capture.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Sensors {
    /// Name of each: what the names of its photos have in common.
    pub names: Vec<String>,
    /// Which took each view.
    pub of_views: Vec<Taken>,
}

/// The sensors that took these views. Views belong to one sensor if their names are in the same folder and differ only in the numbers
/// at their end, and their cameras have the same intrinsics.
pub fn sensors(views: &[View]) -> Sensors {
    let (mut numbers, mut names) = (BTreeMap::new(), Vec::new());
    let mut of_sensor: Vec<Vec<usize>> = Vec::new();
    for (at, view) in views.iter().enumerate() {
        let next = of_sensor.len();
        let (name, intrinsics) = key(view);
        let number = *numbers.entry((name, intrinsics)).or_insert(next);
        if number == next {
            names.push(name.trim_end_matches('/').to_owned());
            of_sensor.push(Vec::new());
        }
        of_sensor[number].push(at);
    }
    let mut of_views = vec![Taken { sensor: 0, motion: None }; views.len()];
    for (sensor, rows) in of_sensor.iter_mut().enumerate() {
        rows.iter().for_each(|&row| of_views[row].sensor = sensor as u32);
        rows.retain(|&row| views[row].seconds.is_some());
        rows.sort_by(|&a, &b| views[a].seconds.unwrap_or(0.0).total_cmp(&views[b].seconds.unwrap_or(0.0)));
        let poses: Vec<(f64, Rigid)> = rows
            .iter()
            .map(|&row| (views[row].seconds.unwrap_or(0.0), views[row].camera.camera_from_world.inverse()))
            .collect();
        rows.iter().zip(motions(&poses)).for_each(|(&row, motion)| of_views[row].motion = motion);
    }
    Sensors { names, of_views }
}

/// What all photos of a sensor share: the folder, the name without its last numbers, and the intrinsics.
fn key(view: &View) -> (&str, [u64; 6]) {
    let stem = match view.name.rsplit_once('.') {
        Some((stem, ending)) if !ending.contains('/') => stem,
        _ => &view.name,
    };
    let name = stem.trim_end_matches(|c: char| c.is_ascii_digit() || "-_. ".contains(c));
    let Pinhole { width, height, fx, fy, cx, cy } = view.camera.pinhole;
    let [fx, fy, cx, cy] = [fx, fy, cx, cy].map(f64::to_bits);
    (name, [width.into(), height.into(), fx, fy, cx, cy])
}

/// The motion of a sensor at each of its poses (world_from_sensor), which are in the order of their times.
fn motions(poses: &[(f64, Rigid)]) -> Vec<Option<Motion>> {
    let mut gaps: Vec<f64> = poses.windows(2).map(|pair| pair[1].0 - pair[0].0).filter(|&gap| gap > 0.0).collect();
    gaps.sort_by(f64::total_cmp);
    let longest = gaps.get(gaps.len() / 2).map_or(0.0, |&typical| LONGEST_GAP.min(TYPICAL_GAPS * typical));
    let between = |pair: &[(f64, Rigid)]| {
        let [(from, a), (to, b)] = pair else { return None };
        let seconds = to - from;
        (seconds > 0.0 && seconds <= longest).then(|| Motion {
            velocity: (b.translation - a.translation) / seconds,
            spin: (b.rotation * a.rotation.inverse()).normalize().to_scaled_axis() / seconds,
        })
    };
    let in_world = |at: usize| {
        let before = at.checked_sub(1).and_then(|last| between(&poses[last..=at]));
        let after = poses.get(at..at + 2).and_then(between);
        let (Some(a), Some(b)) = (before, after) else { return before.or(after) };
        let fastest = a.velocity.length().max(b.velocity.length());
        let agree = (a.velocity - b.velocity).length() <= AGREES.0 * fastest + AGREES.1;
        agree.then(|| Motion { velocity: 0.5 * (a.velocity + b.velocity), spin: 0.5 * (a.spin + b.spin) })
    };
    let own = |(at, (_, pose)): (usize, &(f64, Rigid))| {
        let (motion, back) = (in_world(at)?, pose.rotation.inverse());
        Some(Motion { velocity: back * motion.velocity, spin: back * motion.spin })
    };
    poses.iter().enumerate().map(own).collect()
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;
    use crate::camera::Camera;

    fn view(name: &str, fx: f64, seconds: Option<f64>, place: DVec3) -> View {
        let pinhole = Pinhole { width: 40, height: 30, fx, fy: fx, cx: 20.0, cy: 15.0 };
        let camera_from_world = Rigid { rotation: DQuat::from_rotation_y(0.5), translation: place }.inverse();
        let (mips, depth) = (Vec::new(), None);
        View { name: name.into(), camera: Camera { pinhole, camera_from_world }, mips, masked: false, depth, seconds }
    }

    #[test]
    fn photos_of_one_folder_or_name_with_the_same_lens_are_of_one_sensor() {
        let names = [
            "a/0001.jpg",
            "a/0002.jpg",
            "b/0001.jpg",
            "left-0001-07.png",
            "left-0001-08.png",
            "right-0001-07.png",
            "plain",
        ];
        let mut views: Vec<View> = names.iter().map(|name| view(name, 50.0, None, DVec3::ZERO)).collect();
        views[1].camera.pinhole.fx = 51.0;
        let Sensors { names, of_views } = sensors(&views);
        assert_eq!(names, ["a", "a", "b", "left", "right", "plain"]);
        assert_eq!(of_views.iter().map(|taken| taken.sensor).collect::<Vec<_>>(), [0, 1, 2, 3, 3, 4, 5]);
        assert!(of_views.iter().all(|taken| taken.motion.is_none()));
    }

    #[test]
    fn motions_follow_from_times_but_not_across_turns_and_gaps() {
        let at = |n: u32, seconds: f64, place: DVec3| view(&format!("a/{n}.jpg"), 50.0, Some(seconds), place);
        let views = [
            at(0, 0.0, DVec3::ZERO),
            at(1, 0.5, 5.0 * DVec3::X),
            at(2, 1.0, 10.0 * DVec3::X),
            at(3, 1.5, DVec3::new(10.0, 5.0, 0.0)),
            at(4, 9.0, DVec3::new(10.0, 80.0, 0.0)),
            view("a/5.jpg", 50.0, None, DVec3::ZERO),
        ];
        let taken = sensors(&views).of_views;
        let ahead = DQuat::from_rotation_y(-0.5) * (10.0 * DVec3::X);
        for n in [0, 1] {
            assert!((taken[n].motion.unwrap().velocity - ahead).length() < 1e-9, "{n}: {:?}", taken[n]);
        }
        // It turned left at the third; nothing is known of what is far in time, or without a time.
        for n in [2, 4, 5] {
            assert_eq!(taken[n].motion, None, "{n}");
        }
        assert!((taken[3].motion.unwrap().velocity.y - 10.0).abs() < 1e-9);
    }
}
