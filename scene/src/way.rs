//! How far an object goes along its path.

use crate::objects::PathPose;

/// Least time between two places that the way is measured between, seconds: paths jitter, which would make it longer.
const KNOT_SECONDS: f64 = 0.5;

/// How far an object has gone along its path at a time.
#[derive(Debug, Clone, PartialEq)]
pub struct Way(Vec<[f64; 2]>);

impl Way {
    /// Along this path, by time.
    pub fn of(path: &[PathPose]) -> Self {
        let mut knots: Vec<[f64; 2]> = Vec::new();
        let mut last: Option<&PathPose> = None;
        for (i, pose) in path.iter().enumerate() {
            let (metres, is_due) = match (last, knots.last()) {
                (Some(last), Some([_, metres])) => {
                    let step = last.world_from_object.translation.distance(pose.world_from_object.translation);
                    (metres + step, pose.seconds - last.seconds >= KNOT_SECONDS)
                }
                _ => (0.0, true),
            };
            if is_due || i + 1 == path.len() {
                knots.push([pose.seconds, metres]);
                last = Some(pose);
            }
        }
        Self(knots)
    }

    /// Metres since the first pose; the object is taken to stand still before it and after the last.
    pub fn at(&self, seconds: f64) -> f64 {
        let after = self.0.partition_point(|[at, _]| *at <= seconds);
        match (after.checked_sub(1).and_then(|i| self.0.get(i)), self.0.get(after)) {
            (Some([from, a]), Some([to, b])) => a + (b - a) * (seconds - from) / (to - from).max(f64::MIN_POSITIVE),
            (Some([_, metres]), None) => *metres,
            _ => 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;
    use crate::camera::Rigid;

    fn at(seconds: f64, x: f64) -> PathPose {
        let world_from_object = Rigid { rotation: DQuat::IDENTITY, translation: DVec3::new(x, 0.0, 0.0) };
        PathPose { seconds, world_from_object }
    }

    #[test]
    fn a_way_is_measured_along_the_path_and_not_along_its_jitter() {
        let way = Way::of(&[at(1.0, 0.0), at(2.0, 3.0), at(3.0, 3.0), at(4.0, 1.0)]);
        let metres = [0.0, 1.0, 1.5, 2.0, 2.7, 3.5, 4.0, 9.0].map(|seconds| way.at(seconds));
        assert_eq!(metres, [0.0, 0.0, 1.5, 3.0, 3.0, 4.0, 5.0, 5.0]);
        // A walker of 1.3 m/s, ten times a second, off by 5 cm to either side.
        let jitters: Vec<PathPose> = (0..=100)
            .map(|i| {
                let mut pose = at(0.1 * f64::from(i), 0.13 * f64::from(i));
                pose.world_from_object.translation.y = if i % 2 == 0 { 0.05 } else { -0.05 };
                pose
            })
            .collect();
        let metres = Way::of(&jitters).at(10.0);
        assert!((metres - 13.0).abs() < 0.2, "{metres}");
        assert_eq!((Way::of(&[]).at(1.0), Way::of(&[at(1.0, 5.0)]).at(2.0)), (0.0, 0.0));
    }
}
