//! What a radar would have heard.

use glam::DVec2;

/// An object is heard up to this far away, metres, if it goes towards the sensor or away from it at this speed, metres per second.
const REACH_METRES: f64 = 40.0;
const LEAST_SPEED: f64 = 1.0;

/// The sector that a radar watched at a time, in ground axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Watch {
    /// Where the radar was, metres.
    pub sensor: DVec2,
    /// Its middle direction, of unit length.
    pub ahead: DVec2,
    /// How far to each side of that it sees, radians.
    pub half_angle: f64,
}

impl Watch {
    /// Whether it hears a vehicle that goes this fast (metres per second) at this place, unless something hides it.
    pub(crate) fn hears(&self, place: DVec2, velocity: DVec2) -> bool {
        let off = place - self.sensor;
        let away = off.normalize_or_zero();
        off.length() <= REACH_METRES
            && away.dot(self.ahead) >= self.half_angle.cos()
            && away.dot(velocity).abs() >= LEAST_SPEED
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_goes_along_rays_of_the_sector_is_heard() {
        let watch = Watch { sensor: DVec2::new(5.0, 0.0), ahead: DVec2::X, half_angle: 0.8 };
        let hears = |x: f64, y: f64, velocity: DVec2| watch.hears(DVec2::new(x, y), velocity);
        assert!(hears(25.0, 3.0, DVec2::new(-4.0, 0.0)) && hears(25.0, 3.0, DVec2::new(4.0, 0.0)));
        assert!(!hears(25.0, 0.0, DVec2::new(0.0, 9.0)), "it crosses");
        assert!(!hears(5.0, 20.0, DVec2::new(0.0, 9.0)) && !hears(-5.0, 0.0, DVec2::X * 9.0), "beside and behind");
        assert!(!hears(55.0, 0.0, DVec2::X * 9.0) && !hears(5.0, 0.0, DVec2::X * 9.0), "too far, and at the sensor");
    }
}
