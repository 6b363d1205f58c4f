//! Where the objects on a photo are: from the lidar's points inside their boxes, or from where they touch the ground.

use std::ops::Range;

use glam::DVec3;
use scene::Camera;

use crate::boxes::iou;
use crate::moving_points::{GroundHeights, JudgedScan, Verdict};
use crate::tracking::{Kind, Place, Sighting};

/// A box is that of a sighting from this overlap on: a lidar has no points at an object's edges.
const LEAST_OVERLAP: f32 = 0.25;
/// A person is seen by the lidar already if a cluster is this near, metres.
const CLUSTER_METRES: f64 = 1.0;
/// Where a box and echoes of a radar may differ besides by what the box is unsure, metres: echoes are of the near side. Height of what
/// the radar sees above the ground, metres.
const RADAR_METRES: f64 = 2.5;
const RADAR_HEIGHT: f64 = 0.7;
/// Fewer points that moved do not say where it is.
const LEAST_POINTS: usize = 2;
/// Its points lie within this many metres of their median distance.
const DEPTH_METRES: f64 = 0.8;
/// 1σ of where points say that it is, metres.
const POINTS_METRES: f64 = 0.3;
/// 1σ of a box's edge, pixels, and as a share of the box's height.
const EDGE_PIXELS: f64 = 1.5;
const EDGE_SHARE: f64 = 0.04;
/// A box this near to the photo's edge shows a part of the object, pixels.
const CUT_PIXELS: f64 = 2.0;
/// Distances along the ground at which a box's lower edge may meet it, metres. Farther ones are too uncertain.
const REACH_METRES: Range<f64> = 2.0..60.0;
/// 1σ along the ray that is too uncertain, metres.
const MAX_METRES: f64 = 2.5;
/// Steps of the search for the ground along a ray, metres.
const STEP_METRES: f64 = 0.5;
/// Two boxes of different photos are one object up to this squared distance in standard deviations, and up to this one, metres.
const SAME_DISTANCE: f64 = 9.0;
const SAME_METRES: f64 = 3.0;

/// An object on a photo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenBox {
    /// Left, top, right and bottom edge, pixels.
    pub corners: [f32; 4],
    /// What it is.
    pub kind: Kind,
}

/// Adds the objects on photos of one time to what was seen at it. Those that were seen already get their kinds. `photos` have cameras
/// in ground axes; `scan` is the sweep of their time.
pub fn add_boxes(
    seen: &mut Vec<Sighting>,
    photos: &[(Camera, &[SeenBox])],
    scan: Option<&JudgedScan>,
    ground: &GroundHeights,
) {
    let clusters = seen.len();
    for (camera, boxes) in photos {
        for of in *boxes {
            let may_be = |sighting: &&mut Sighting| sighting.may_be(of.kind);
            let shown =
                seen[..clusters].iter_mut().filter(may_be).map(|sighting| (overlap(camera, of, sighting), sighting));
            if let Some((_, shown)) =
                shown.filter(|(share, _)| *share >= LEAST_OVERLAP).max_by(|a, b| a.0.total_cmp(&b.0))
            {
                shown.kind = shown.kind.max(Some(of.kind));
                continue;
            }
            let new = sighting(camera, of, scan, ground);
            if let Some(echoes) = of_radar(camera, of, &mut seen[..clusters], new.as_ref()) {
                // Someone who walks past parked cars is in their boxes too.
                let is_other = echoes.kind.is_some_and(|kind| kind.is_narrow() != of.kind.is_narrow());
                echoes.kind = if is_other { echoes.kind.min(Some(of.kind)) } else { echoes.kind.max(Some(of.kind)) };
                continue;
            }
            let Some(new) = new else { continue };
            let is_near = |cluster: &&mut Sighting| cluster.middle().distance(new.middle()) <= CLUSTER_METRES;
            if let Some(cluster) = seen[..clusters].iter_mut().filter(may_be).find(is_near) {
                cluster.kind = cluster.kind.max(Some(of.kind));
                continue;
            }
            let same = seen[clusters..].iter().position(|old| is_same(old, &new));
            match same.map(|at| &mut seen[clusters + at]) {
                None => seen.push(new),
                Some(old) => {
                    let kind = old.kind.max(new.kind);
                    if new.place.variance() < old.place.variance() {
                        *old = new;
                    }
                    old.kind = kind;
                }
            }
        }
    }
}

/// What a radar saw in a box's direction, nearest to where the box says that the object is, or to the camera where it does not.
fn of_radar<'a>(
    camera: &Camera,
    of: &SeenBox,
    seen: &'a mut [Sighting],
    on_photo: Option<&Sighting>,
) -> Option<&'a mut Sighting> {
    let from = on_photo.map_or(camera.centre().truncate(), Sighting::middle);
    let is_there = |echoes: &Sighting| {
        let near = on_photo.map_or(f64::INFINITY, |photo| RADAR_METRES + 2.0 * photo.place.variance().sqrt());
        echoes.place.radial.is_some()
            && echoes.may_be(of.kind)
            && is_inside(camera, of, echoes.middle().extend(echoes.ground + RADAR_HEIGHT))
            && echoes.middle().distance(from) <= near
    };
    let there = seen.iter_mut().filter(|echoes| is_there(echoes));
    there.min_by(|a, b| a.middle().distance(from).total_cmp(&b.middle().distance(from)))
}

fn is_same(a: &Sighting, b: &Sighting) -> bool {
    let is_narrow = |of: &Sighting| of.kind.is_some_and(Kind::is_narrow);
    let off = a.place.middle - b.place.middle;
    let variance = 0.5 * (a.place.variance() + b.place.variance());
    is_narrow(a) == is_narrow(b) && off.length() <= SAME_METRES && off.length_squared() <= SAME_DISTANCE * variance
}

fn is_inside(camera: &Camera, of: &SeenBox, place: DVec3) -> bool {
    let (pixel, depth) = camera.project(place);
    let [left, top, right, bottom] = of.corners.map(f64::from);
    depth > 0.0 && (left..right).contains(&pixel.x) && (top..bottom).contains(&pixel.y)
}

/// The overlap of a box with the bounds of a sighting's points on the photo.
fn overlap(camera: &Camera, of: &SeenBox, sighting: &Sighting) -> f32 {
    let mut bounds = [f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY];
    for &point in &sighting.points {
        let (pixel, depth) = camera.project(point);
        if depth <= 0.0 {
            return 0.0;
        }
        let [x, y] = [pixel.x as f32, pixel.y as f32];
        bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x), bounds[3].max(y)];
    }
    // The photo may show a part.
    let size = [camera.pinhole.width as f32, camera.pinhole.height as f32];
    let cut = [bounds[0].max(0.0), bounds[1].max(0.0), bounds[2].min(size[0]), bounds[3].min(size[1])];
    iou(cut, of.corners)
}

fn sighting(camera: &Camera, of: &SeenBox, scan: Option<&JudgedScan>, ground: &GroundHeights) -> Option<Sighting> {
    let Some(scan) = scan else { return on_the_ground(camera, of, ground) };
    // What is larger and moves forms a cluster.
    if of.kind != Kind::Person {
        return None;
    }
    // Others stand still, or nothing is known of them.
    let moved = scan.points.iter().filter(|(_, verdict)| *verdict == Verdict::Moved).map(|(point, _)| *point);
    let mut points: Vec<DVec3> = moved.filter(|point| is_inside(camera, of, *point)).collect();
    if points.len() < LEAST_POINTS {
        return None;
    }
    let centre = camera.centre();
    points.sort_by(|a, b| a.distance(centre).total_cmp(&b.distance(centre)));
    let median = points[points.len() / 2].distance(centre);
    points.retain(|point| (point.distance(centre) - median).abs() <= DEPTH_METRES);
    let mean = points.iter().sum::<DVec3>() / points.len().max(1) as f64;
    let outward = (mean - centre).truncate().normalize_or_zero() * (0.25 * of.kind.size().y);
    let middle = mean.truncate() + outward;
    Some(Sighting {
        place: Place::around(middle, POINTS_METRES),
        moves: true,
        points,
        sensor: centre.truncate(),
        ground: ground.height(middle).unwrap_or(mean.z),
        kind: Some(of.kind),
    })
}

/// Where the middle of a box's lower edge meets the ground.
fn on_the_ground(camera: &Camera, of: &SeenBox, ground: &GroundHeights) -> Option<Sighting> {
    let [left, top, right, bottom] = of.corners.map(f64::from);
    let (width, height) = (f64::from(camera.pinhole.width), f64::from(camera.pinhole.height));
    if bottom > height - CUT_PIXELS || left < CUT_PIXELS || right > width - CUT_PIXELS {
        return None;
    }
    let k = &camera.pinhole;
    let pixel = DVec3::new((0.5 * (left + right) - k.cx) / k.fx, (bottom - k.cy) / k.fy, 1.0);
    let ray = camera.camera_from_world.rotation.inverse() * pixel;
    let along = ray.truncate().length();
    let centre = camera.centre();
    let slope = ray.z / along;
    let ahead = ray.truncate() / along;
    let at = |metres: f64| (centre.truncate() + metres * ahead, centre.z + metres * slope);
    let steps = (REACH_METRES.start / STEP_METRES) as u32..(REACH_METRES.end / STEP_METRES) as u32;
    let meets = steps.map(|step| f64::from(step) * STEP_METRES).find(|&metres| {
        let (place, z) = at(metres);
        ground.height(place).is_some_and(|ground| ground >= z)
    })?;
    let (place, z) = at(meets);
    let above = (centre.z - z).max(0.3);
    let edge = EDGE_PIXELS + EDGE_SHARE * (bottom - top);
    let deep = 0.5 * of.kind.size().y;
    let sigma_ahead =
        (meets * meets * edge / (camera.pinhole.fy * above)).hypot(if of.kind.is_narrow() { 0.3 } else { 0.8 });
    if sigma_ahead > MAX_METRES {
        return None;
    }
    let sigma_across = (meets * edge / camera.pinhole.fx).max(0.1);
    Some(Sighting {
        place: Place::along(place + deep * ahead, ahead, [sigma_ahead, sigma_across]),
        points: Vec::new(),
        sensor: centre.truncate(),
        ground: ground.height(place).unwrap_or(z),
        moves: false,
        kind: Some(of.kind),
    })
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DQuat, DVec2};
    use scene::{Pinhole, Rigid};

    use super::*;
    use crate::moving_points::{RangeImage, Scan};
    use crate::tracking::Radial;

    /// 1.6 m above the ground, looking along x.
    fn camera() -> Camera {
        let axes = DMat3::from_cols(-DVec3::Y, -DVec3::Z, DVec3::X);
        let world_from_camera = Rigid { rotation: DQuat::from_mat3(&axes), translation: DVec3::new(0.0, 0.0, 1.6) };
        let pinhole = Pinhole { width: 800, height: 600, fx: 400.0, fy: 400.0, cx: 400.0, cy: 300.0 };
        Camera { pinhole, camera_from_world: world_from_camera.inverse() }
    }

    fn flat() -> GroundHeights {
        let mut ground = GroundHeights::new(1.0);
        let places =
            (0..200).flat_map(|i| (-60..60).map(move |j| DVec3::new(0.5 * f64::from(i), 0.5 * f64::from(j), 0.0)));
        ground.add(&places.collect::<Vec<_>>());
        ground
    }

    /// The box of an object that is this wide and high.
    fn box_at(middle: DVec2, kind: Kind, [wide, high]: [f64; 2]) -> SeenBox {
        let pixel = |y: f64, z: f64| camera().project(middle.extend(0.0) + DVec3::new(0.0, y, z)).0;
        let (a, b) = (pixel(0.5 * wide, high), pixel(-0.5 * wide, 0.0));
        SeenBox { corners: [a.x, a.y, b.x, b.y].map(|value| value as f32), kind }
    }

    #[test]
    fn a_box_without_points_stands_where_it_touches_the_ground() {
        let (ground, mut seen) = (flat(), Vec::new());
        let person = box_at(DVec2::new(15.0, 3.0), Kind::Person, [0.6, 1.7]);
        add_boxes(&mut seen, &[(camera(), &[person])], None, &ground);
        assert_eq!((seen.len(), seen[0].kind, seen[0].moves), (1, Some(Kind::Person), false));
        assert!((seen[0].middle() - DVec2::new(15.3, 3.0)).length() < 0.6, "{}", seen[0].middle());
        // Less sure along the ray than across it.
        assert!(seen[0].place.covariance[0] > 4.0 * seen[0].place.covariance[2]);
        // Cut by the edge, or above the horizon.
        let cut = SeenBox { corners: [300.0, 200.0, 400.0, 599.5], ..person };
        let sky = SeenBox { corners: [300.0, 100.0, 400.0, 250.0], ..person };
        add_boxes(&mut seen, &[(camera(), &[cut, sky])], None, &ground);
        assert_eq!(seen.len(), 1);
        // The same object on another photo.
        add_boxes(&mut seen, &[], None, &ground);
        let mut twice = Vec::new();
        add_boxes(&mut twice, &[(camera(), &[person]), (camera(), &[person])], None, &ground);
        assert_eq!(twice.len(), 1);
    }

    #[test]
    fn who_walks_past_a_parked_car_is_no_car() {
        let ground = flat();
        let (parked, person) = ([2.6, 1.6], [0.6, 1.7]);
        let boxes = [
            box_at(DVec2::new(12.0, 3.0), Kind::Person, person),
            box_at(DVec2::new(12.5, 3.2), Kind::Car, parked),
            box_at(DVec2::new(12.5, 3.2), Kind::Truck, parked),
        ];
        let kind = |speed: f64, boxes: &[SeenBox]| {
            let (middle, away) = (DVec2::new(12.2, 3.0), DVec2::X);
            let radial = Some(Radial { away, speed, sigma: 0.3 });
            let place = Place { radial, ..Place::along(middle, away, [0.8, 0.4]) };
            let mut seen =
                vec![Sighting { place, points: Vec::new(), sensor: DVec2::ZERO, ground: 0.0, moves: true, kind: None }];
            add_boxes(&mut seen, &[(camera(), boxes)], None, &ground);
            seen[0].kind
        };
        let reversed: Vec<SeenBox> = boxes.iter().rev().copied().collect();
        assert_eq!([kind(-1.2, &boxes), kind(-1.2, &reversed)], [Some(Kind::Person); 2]);
        assert_eq!(kind(-8.0, &boxes), Some(Kind::Truck), "nobody walks as fast");
    }

    #[test]
    fn points_say_where_it_is_and_whether_it_stands() {
        let ground = flat();
        let sensor = DVec3::new(0.0, 0.0, 1.8);
        let figure = |x: f64| (0..12).map(move |i| DVec3::new(x, 0.1 * f64::from(i % 3), 0.5 + 0.1 * f64::from(i)));
        let with = |x: f64| Scan { seconds: 0.0, sensor, points: figure(x).collect() };
        let image = |x: f64| {
            RangeImage::of(&Scan {
                points: (0..60)
                    .flat_map(|i| {
                        (0..60).map(move |j| DVec3::new(x, 0.1 * f64::from(i) - 3.0, 0.1 * f64::from(j) - 2.0))
                    })
                    .collect(),
                ..with(x)
            })
        };
        let person = box_at(DVec2::new(12.0, 0.1), Kind::Person, [0.8, 1.7]);
        let seen = |others: &[&RangeImage]| {
            let mut seen = Vec::new();
            let judged = JudgedScan::new(&with(12.0), others, &ground);
            add_boxes(&mut seen, &[(camera(), &[person])], Some(&judged), &ground);
            seen
        };
        let (far, same) = (image(20.0), image(12.0));
        let moving = seen(&[&far, &far]);
        assert_eq!((moving.len(), moving[0].moves), (1, true));
        assert!((moving[0].middle() - DVec2::new(12.15, 0.1)).length() < 0.2, "{}", moving[0].middle());
        assert!(seen(&[&same, &same]).is_empty() && seen(&[]).is_empty(), "it stands, or may do so");
    }
}
