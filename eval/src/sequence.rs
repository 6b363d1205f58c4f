//! Moving pictures: cameras between those of photos, and a filter over time.

use glam::DVec3;
use rayon::prelude::*;
use scene::{Camera, View};

use crate::picture::Picture;

/// Most pictures of a sequence: an hour at 30 a second.
const MAX_PICTURES: f64 = 108_000.0;
/// A surface of the picture before is the same one if its depth differs by at most this share.
const SAME_DEPTH: f64 = 0.05;

/// A picture of a sequence.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// On the clock of the photos, where they have one.
    pub seconds: Option<f64>,
    /// The camera.
    pub camera: Camera,
}

/// Cameras at this many pictures a second, between those of the photos of one sensor, which the first has the intrinsics of. Where photos
/// have no times, their cameras in the given order.
///
/// # Errors
/// More pictures than an hour has at 30 a second.
pub fn camera_path(views: &[&View], per_second: f64) -> Result<Vec<Moment>, String> {
    let timed: Option<Vec<(f64, &View)>> = views.iter().map(|&view| Some((view.seconds?, view))).collect();
    let Some(mut timed) = timed else {
        return Ok(views.iter().map(|view| Moment { seconds: None, camera: view.camera }).collect());
    };
    timed.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (Some((first, of_first)), Some((last, _))) = (timed.first().copied(), timed.last().copied()) else {
        return Ok(Vec::new());
    };
    let count = ((last - first) * per_second).floor() + 1.0;
    if count.is_nan() || count > MAX_PICTURES {
        return Err(format!("{:.0} s at {per_second} a second are more than {MAX_PICTURES} pictures", last - first));
    }
    let moment = |i: usize| {
        let seconds = first + i as f64 / per_second;
        let after = timed.partition_point(|(at, _)| *at < seconds).min(timed.len() - 1);
        let ((from, a), (to, b)) = (timed[after.saturating_sub(1)], timed[after]);
        let share = if to > from { ((seconds - from) / (to - from)).clamp(0.0, 1.0) } else { 0.0 };
        // The camera's place moves straight, not the world's in its axes.
        let [a, b] = [a, b].map(|view| view.camera.camera_from_world.inverse());
        let camera_from_world = a.between(&b, share).inverse();
        Moment { seconds: Some(seconds), camera: Camera { camera_from_world, ..of_first.camera } }
    };
    Ok((0..count as usize).map(moment).collect())
}

/// Mixes each picture with those before it, as they look from its camera: the exponential filter over time of Street Detection
/// Gaussians (section 3.5), but along surfaces. What was hidden or has another depth is not mixed in, and no colour goes beyond those
/// around its pixel, so that nothing is drawn out behind what moves.
#[derive(Debug)]
pub struct TemporalFilter {
    /// Share of the newest picture, β.
    newest: f32,
    /// The last picture, unfiltered and filtered, and its camera.
    last: Option<(Camera, [Picture; 2])>,
    flicker: [f64; 2],
    compared: u64,
}

impl TemporalFilter {
    /// A filter in which the newest picture has this share, 0 to 1.
    pub fn new(newest: f32) -> Self {
        Self { newest, last: None, flicker: [0.0; 2], compared: 0 }
    }

    /// The filtered picture. Pictures need depths.
    pub fn filtered(&mut self, picture: Picture, camera: &Camera) -> Picture {
        let mut filtered = picture.clone();
        if let Some((from, [unfiltered, shown])) = &self.last {
            let seen = Reprojection { picture: &picture, camera, last: shown, from };
            let places: Vec<Option<(f32, f32)>> = seen.places();
            let (newest, width, height) = (self.newest, picture.width, picture.height);
            let row = |(at, row): (usize, &mut [f32])| {
                let (plane, y) = (at / height, at % height);
                let mut changes = [0.0; 2];
                for (x, value) in row.iter_mut().enumerate() {
                    let Some((u, v)) = places[y * width + x] else { continue };
                    let [low, high] = around(&picture, plane, x, y);
                    let (now, past) = (*value, shown.at(plane, u, v));
                    *value = newest * now + (1.0 - newest) * past.max(low).min(high);
                    changes[0] += f64::from((now - unfiltered.at(plane, u, v)).abs());
                    changes[1] += f64::from((*value - past).abs());
                }
                changes
            };
            let rows: Vec<[f64; 2]> = filtered.colour.par_chunks_mut(width).enumerate().map(row).collect();
            rows.iter().for_each(|row| (0..2).for_each(|i| self.flicker[i] += row[i]));
            self.compared += 3 * places.iter().flatten().count() as u64;
        }
        self.last = Some((*camera, [picture, filtered.clone()]));
        filtered
    }

    /// Mean change of a surface's colour from picture to picture, 0 to 1: unfiltered, and filtered. `None` before the second picture.
    pub fn flicker(&self) -> Option<[f64; 2]> {
        (self.compared > 0).then(|| self.flicker.map(|sum| sum / self.compared as f64))
    }
}

/// A picture, and the one before it.
struct Reprojection<'a> {
    picture: &'a Picture,
    camera: &'a Camera,
    last: &'a Picture,
    from: &'a Camera,
}

impl Reprojection<'_> {
    /// Where the last picture shows what each pixel shows, in its pixels.
    fn places(&self) -> Vec<Option<(f32, f32)>> {
        let Self { picture, camera, last, from } = self;
        let k = &camera.pinhole;
        let last_from_now = from.camera_from_world.after(&camera.camera_from_world.inverse());
        let last_camera = Camera { camera_from_world: last_from_now, ..**from };
        let place = |i: usize| {
            let depth = f64::from(*picture.depth.get(i).filter(|depth| **depth > 0.0)?);
            let (x, y) = ((i % picture.width) as f64 + 0.5, (i / picture.width) as f64 + 0.5);
            let ahead = DVec3::new((x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0);
            let (pixel, expected) = last_camera.project(depth * ahead);
            let is_inside = (0.0..last.width as f64).contains(&pixel.x) && (0.0..last.height as f64).contains(&pixel.y);
            if expected <= 0.0 || !is_inside {
                return None;
            }
            let known = f64::from(*last.depth.get(pixel.y as usize * last.width + pixel.x as usize)?);
            ((known - expected).abs() <= SAME_DEPTH * expected).then_some((pixel.x as f32, pixel.y as f32))
        };
        (0..picture.area()).into_par_iter().map(place).collect()
    }
}

/// The least and the greatest value of a plane within a pixel of this one.
fn around(picture: &Picture, plane: usize, x: usize, y: usize) -> [f32; 2] {
    let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
    for row in y.saturating_sub(1)..(y + 2).min(picture.height) {
        let start = plane * picture.area() + row * picture.width;
        for value in &picture.colour[start + x.saturating_sub(1)..start + (x + 2).min(picture.width)] {
            (low, high) = (low.min(*value), high.max(*value));
        }
    }
    [low, high]
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use scene::{Pinhole, Rigid};

    use super::*;

    const SIDE: usize = 16;

    /// Looks along z from this far to the right.
    fn camera(x: f64) -> Camera {
        let pinhole = Pinhole { width: 16, height: 16, fx: 16.0, fy: 16.0, cx: 8.0, cy: 8.0 };
        let world_from_camera =
            Rigid { rotation: DQuat::from_rotation_y(0.1 * x), translation: DVec3::new(x, 0.0, 0.0) };
        Camera { pinhole, camera_from_world: world_from_camera.inverse() }
    }

    fn view(x: f64, seconds: Option<f64>) -> View {
        let name = format!("{x}.png");
        View { name, camera: camera(x), mips: Vec::new(), masked: false, depth: None, seconds }
    }

    #[test]
    fn cameras_lie_between_those_of_photos() {
        let views = [view(2.0, Some(11.0)), view(0.0, Some(10.0)), view(3.0, Some(13.0))];
        let path = camera_path(&views.iter().collect::<Vec<_>>(), 2.0).unwrap();
        let of = |moment: &Moment| (moment.seconds.unwrap(), moment.camera.centre().x);
        let expected = [(10.0, 0.0), (10.5, 1.0), (11.0, 2.0), (11.5, 2.25), (12.0, 2.5), (12.5, 2.75), (13.0, 3.0)];
        assert_eq!(path.len(), expected.len());
        for (moment, expected) in path.iter().map(of).zip(expected) {
            assert!((moment.0 - expected.0).abs() < 1e-9 && (moment.1 - expected.1).abs() < 1e-9, "{moment:?}");
        }
        let turned = (path[1].camera.camera_from_world.rotation.inverse() * DVec3::Z).x;
        assert!((turned - 0.1f64.sin()).abs() < 1e-9);
        // One photo, none, and photos without times.
        assert_eq!(camera_path(&[&views[0]], 30.0).unwrap().len(), 1);
        assert_eq!(camera_path(&[], 30.0).unwrap().len(), 0);
        let untimed = [view(5.0, None), view(1.0, Some(0.0))];
        let path = camera_path(&untimed.iter().collect::<Vec<_>>(), 30.0).unwrap();
        assert!(path.len() == 2 && path[0] == Moment { seconds: None, camera: camera(5.0) });
        let ages = [view(0.0, Some(0.0)), view(0.0, Some(1e300))];
        assert!(camera_path(&ages.iter().collect::<Vec<_>>(), 30.0).unwrap_err().contains("more than"));
    }

    /// A wall 8 m ahead; each pixel's colour by its column and row.
    fn wall(colour: impl Fn(usize, usize) -> f32) -> Picture {
        let plane: Vec<f32> = (0..SIDE * SIDE).map(|i| colour(i % SIDE, i / SIDE)).collect();
        let (colour, depth) = ([plane.clone(), plane.clone(), plane].concat(), vec![8.0; SIDE * SIDE]);
        Picture { width: SIDE, height: SIDE, colour, depth }
    }

    fn shifted(x: f64) -> Camera {
        let translation = DVec3::new(-x, 0.0, 0.0);
        Camera { camera_from_world: Rigid { translation, ..Rigid::IDENTITY }, ..camera(0.0) }
    }

    #[test]
    fn noise_goes_and_what_is_there_stays() {
        // Columns of the wall, seen from a camera that moves by two pixels a picture (a metre), with noise.
        let noise = |n: u64, i: usize| 0.1 * (train::random::uniform(n, i as u64) - 0.5);
        let column = |x: usize, n: usize| 0.2 + 0.05 * ((x + 2 * n) % 7) as f32;
        let mut filter = TemporalFilter::new(0.4);
        let mut last = Picture::default();
        for n in 0..12 {
            let noisy = wall(|x, y| column(x, n) + noise(n as u64, y * SIDE + x));
            last = filter.filtered(noisy, &shifted(n as f64));
        }
        let error = |picture: &Picture| {
            let off = |i: usize| (picture.colour[i] - column(i % SIDE, 11)).powi(2);
            (0..SIDE * SIDE).map(off).sum::<f32>() / (SIDE * SIDE) as f32
        };
        let given = error(&wall(|x, y| column(x, 11) + noise(11, y * SIDE + x)));
        let [before, after] = filter.flicker().unwrap();
        println!("{given:.2e} before, {:.2e} after; flicker {before:.3} to {after:.3}", error(&last));
        assert!(error(&last) < 0.6 * given && after < 0.6 * before);
    }

    #[test]
    fn what_was_hidden_and_what_changed_is_not_mixed_in() {
        let mut filter = TemporalFilter::new(0.3);
        let dark = wall(|_, _| 0.1);
        assert!(filter.filtered(dark.clone(), &shifted(0.0)) == dark && filter.flicker().is_none());
        // Nearer: another surface.
        let mut near = wall(|_, _| 0.9);
        near.depth.fill(4.0);
        assert!(filter.filtered(near.clone(), &shifted(0.0)) == near && filter.flicker().is_none());
        // The same surface in another light: no colour goes beyond those around its pixel.
        let mut bright = wall(|_, _| 0.5);
        bright.depth.fill(4.0);
        assert!(filter.filtered(bright.clone(), &shifted(0.0)) == bright);
        // Where no colour around a pixel is a number, there is none to keep within, and nothing breaks.
        let mut broken = wall(|_, _| f32::NAN);
        broken.depth.fill(4.0);
        assert!(filter.filtered(broken, &shifted(0.0)).colour[0].is_nan());
        // Without depth nothing is known.
        let mut unknown = wall(|x, _| x as f32 / 16.0);
        unknown.depth.fill(0.0);
        assert!(filter.filtered(unknown.clone(), &shifted(0.0)) == unknown);
    }
}
