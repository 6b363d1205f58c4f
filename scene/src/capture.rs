//! An opened capture: posed views, sparse points and their geographic origin.

use glam::{DMat4, DVec3, DVec4};
use serde::{Deserialize, Serialize};

use crate::camera::Camera;
use crate::error::CodecError;
use crate::ids::ArtefactId;
use crate::objects::{self, MovingObject};

/// WGS84 origin of the capture's local east-north-up frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GeoOrigin {
    /// Degrees north.
    pub latitude_degrees: f64,
    /// Degrees east.
    pub longitude_degrees: f64,
    /// Metres above the ellipsoid.
    pub altitude_metres: f64,
}

/// WGS84: the radius at the equator, metres, and the square of the eccentricity.
const RADIUS: f64 = 6_378_137.0;
const ECCENTRICITY: f64 = FLATTENING * (2.0 - FLATTENING);
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// Metres from the ellipsoid within which a place is one on Earth.
const NEAR_EARTH: f64 = 100_000.0;

impl GeoOrigin {
    /// True if the numbers are in range.
    pub fn is_sane(&self) -> bool {
        self.latitude_degrees.abs() <= 90.0 && self.longitude_degrees.abs() <= 360.0 && self.altitude_metres.abs() < 1e6
    }

    /// Takes the local east-north-up frame to the Earth's (ECEF: x to the equator at Greenwich, z to the north pole), metres.
    pub fn ecef_from_local(&self) -> DMat4 {
        let (sin_lat, cos_lat) = self.latitude_degrees.to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.longitude_degrees.to_radians().sin_cos();
        let normal = RADIUS / (1.0 - ECCENTRICITY * sin_lat * sin_lat).sqrt();
        let across = (normal + self.altitude_metres) * cos_lat;
        let up = ((1.0 - ECCENTRICITY) * normal + self.altitude_metres) * sin_lat;
        DMat4::from_cols(
            DVec4::new(-sin_lon, cos_lon, 0.0, 0.0),
            DVec4::new(-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat, 0.0),
            DVec4::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat, 0.0),
            DVec4::new(across * cos_lon, across * sin_lon, up, 1.0),
        )
    }

    /// The frame whose origin is this place of the Earth's frame, metres; `None` for one that is not within 100 km of the ellipsoid.
    pub fn at_ecef(place: DVec3) -> Option<Self> {
        let across = place.truncate().length();
        let mut latitude = place.z.atan2(across * (1.0 - ECCENTRICITY));
        // Each step leaves less than a hundredth of the error.
        for _ in 0..8 {
            let sin = latitude.sin();
            let normal = RADIUS / (1.0 - ECCENTRICITY * sin * sin).sqrt();
            latitude = (place.z + ECCENTRICITY * normal * sin).atan2(across);
        }
        let (sin, cos) = latitude.sin_cos();
        let altitude_metres = across * cos + place.z * sin - RADIUS * (1.0 - ECCENTRICITY * sin * sin).sqrt();
        (altitude_metres.abs() < NEAR_EARTH).then(|| Self {
            latitude_degrees: latitude.to_degrees(),
            longitude_degrees: place.y.atan2(place.x).to_degrees(),
            altitude_metres,
        })
    }
}

/// One image with its camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct View {
    /// Name of the image in the capture, with `/` between folders.
    pub name: String,
    /// Ideal pinhole camera of mip 0.
    pub camera: Camera,
    /// One artefact per mip, finest first. Empty before ingest.
    pub mips: Vec<ArtefactId>,
    /// True if the view has a mask. Its mips then have a fourth channel: 255 = use, 0 = leave out.
    pub masked: bool,
    /// Artefact of the view's target depths from lidar and depth maps, if any. `None` before ingest.
    pub depth: Option<ArtefactId>,
    /// When the photo was taken, seconds on the clock of the capture's objects; `None` if it is not known.
    pub seconds: Option<f64>,
}

/// Structure-from-motion points and their tracks, and points from lidar after them.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SparsePoints {
    /// World positions, metres.
    pub positions: Vec<DVec3>,
    /// sRGB colours, one per position.
    pub colours: Vec<[u8; 3]>,
    /// Offsets into `seen_by`: point `i` was observed in `seen_by[track_start[i] .. track_start[i + 1]]`. One longer
    /// than `positions`, or empty if the capture has no tracks.
    pub track_start: Vec<u32>,
    /// Indices of views, for all tracks.
    pub seen_by: Vec<u32>,
    /// How many points, the last ones, were measured by lidar. The others were triangulated from photos.
    pub measured: u32,
}

impl SparsePoints {
    /// The number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// True without points.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// The number of points that were triangulated from photos, which come first.
    pub fn triangulated(&self) -> usize {
        self.len().saturating_sub(self.measured as usize)
    }

    /// The views in which point `i` was observed; `None` if the capture has no tracks.
    pub fn track(&self, i: usize) -> Option<&[u32]> {
        let (from, to) = (*self.track_start.get(i)?, *self.track_start.get(i + 1)?);
        self.seen_by.get(from as usize..to as usize)
    }

    /// Appends points. They keep their tracks only if the present points have tracks, or there are none: readers take
    /// points without a track beside points with one as seen by no view. Points from lidar before triangulated ones count
    /// as triangulated.
    pub fn append(&mut self, other: Self) {
        self.measured = if other.triangulated() == 0 { self.measured + other.measured } else { other.measured };
        let is_tracked = (self.is_empty() || !self.track_start.is_empty()) && !other.track_start.is_empty();
        if is_tracked {
            let start = self.seen_by.len() as u32;
            let first = self.track_start.is_empty().then_some(0);
            self.track_start.extend(first.into_iter().chain(other.track_start[1..].iter().map(|end| start + end)));
            self.seen_by.extend(other.seen_by);
        } else if !other.is_empty() {
            (self.track_start, self.seen_by) = (Vec::new(), Vec::new());
        }
        self.positions.extend(other.positions);
        self.colours.extend(other.colours);
    }

    /// The points for which `keep` holds, with their tracks.
    pub fn filter(&self, keep: impl Fn(usize) -> bool) -> Self {
        let mut kept = Self::default();
        if !self.track_start.is_empty() {
            kept.track_start.push(0);
        }
        for i in (0..self.len()).filter(|&i| keep(i)) {
            kept.positions.push(self.positions[i]);
            kept.colours.push(self.colours[i]);
            kept.measured += u32::from(i >= self.triangulated());
            if let Some(track) = self.track(i) {
                kept.seen_by.extend_from_slice(track);
                kept.track_start.push(kept.seen_by.len() as u32);
            }
        }
        kept
    }
}

/// Images, cameras and points, views in name order.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Capture {
    /// Posed views, sorted by name.
    pub views: Vec<View>,
    /// Sparse points.
    pub points: SparsePoints,
    /// Geographic origin of the local frame, if known.
    pub geo_origin: Option<GeoOrigin>,
    /// Objects that move, by name.
    pub objects: Vec<MovingObject>,
}

impl Capture {
    /// Checks the invariants that other functions rely on. Captures come from files, so every number is untrusted.
    ///
    /// # Errors
    /// The first number that is out of range.
    pub fn check(&self) -> Result<(), CodecError> {
        for view in &self.views {
            let (k, bad) = (&view.camera.pinhole, |what| Err(CodecError::new(format!("view {:?} {what}", view.name))));
            let finite = [k.fx, k.fy, k.cx, k.cy].iter().all(|v| v.is_finite());
            if !finite || k.fx <= 0.0 || k.fy <= 0.0 || k.width == 0 || k.height == 0 {
                return bad("has a camera without pixels or without positive focal lengths");
            }
            if !view.camera.camera_from_world.is_sane() {
                return bad("has a pose that is not finite or not a rotation");
            }
            if view.seconds.is_some_and(|seconds| !seconds.is_finite()) {
                return bad("was taken at a time that is not finite");
            }
            if view.mips.len() > 32 {
                return bad("has more mips than an image can have");
            }
        }
        objects::check_all(&self.objects)?;
        let SparsePoints { positions, colours, track_start, seen_by, measured } = &self.points;
        if colours.len() != positions.len() || !positions.iter().all(|p| p.is_finite()) {
            return Err(CodecError::new("sparse points are not finite, or their colours do not match their number"));
        }
        if *measured as usize > positions.len() {
            return Err(CodecError::new("more points are from lidar than there are"));
        }
        let tracks = match track_start.as_slice() {
            [] => seen_by.is_empty(),
            [first, .., last] => *first == 0 && *last as usize == seen_by.len() && track_start.is_sorted(),
            [only] => *only == 0 && seen_by.is_empty(),
        };
        if !tracks || !(track_start.is_empty() || track_start.len() == positions.len() + 1) {
            return Err(CodecError::new("tracks do not match the sparse points"));
        }
        if seen_by.iter().any(|&view| view as usize >= self.views.len()) {
            return Err(CodecError::new("a track refers to a view that does not exist"));
        }
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::camera::{Pinhole, Rigid};

    /// A view of this many pixels.
    pub(crate) fn view(width: u32, height: u32) -> View {
        let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
        let camera =
            Camera { pinhole: Pinhole { width, height, fx: 5.0, fy: 5.0, cx, cy }, camera_from_world: Rigid::IDENTITY };
        View { name: "a.png".into(), camera, mips: Vec::new(), masked: false, depth: None, seconds: None }
    }

    #[test]
    fn invalid_captures_are_refused() {
        let points = SparsePoints {
            positions: vec![DVec3::ZERO, DVec3::ONE],
            colours: vec![[1, 2, 3]; 2],
            track_start: vec![0, 1, 1],
            seen_by: vec![0],
            measured: 2,
        };
        let good = Capture { views: vec![view(4, 3)], points, ..Capture::default() };
        assert_eq!([good.check(), Capture::default().check()], [Ok(()), Ok(())]);
        let changes: [fn(&mut Capture); 13] = [
            |c| c.views[0].camera.pinhole.width = 0,
            |c| c.views[0].camera.pinhole.fx = 0.0,
            |c| c.views[0].camera.pinhole.cy = f64::NAN,
            |c| c.views[0].camera.camera_from_world.translation.x = f64::INFINITY,
            |c| c.views[0].camera.camera_from_world.rotation.w = 3.0,
            |c| c.views[0].mips = vec![ArtefactId([0; 32]); 33],
            |c| c.points.positions[1].z = f64::NAN,
            |c| c.points.colours.truncate(1),
            |c| c.points.track_start = vec![0, 2, 1],
            |c| c.points.track_start = vec![0, 1],
            |c| c.points.track_start.clear(),
            |c| c.points.seen_by[0] = 1,
            |c| c.points.measured = 3,
        ];
        for (i, change) in changes.into_iter().enumerate() {
            let mut bad = good.clone();
            change(&mut bad);
            assert!(bad.check().is_err(), "change {i}");
        }
    }

    #[test]
    fn points_from_lidar_stay_the_last() {
        let points = |count: usize, measured| SparsePoints {
            positions: vec![DVec3::ZERO; count],
            colours: vec![[0; 3]; count],
            measured,
            ..SparsePoints::default()
        };
        let mut all = points(3, 0);
        all.append(points(2, 2));
        all.append(points(1, 1));
        assert_eq!((all.len(), all.triangulated()), (6, 3));
        let kept = all.filter(|i| i % 2 == 1);
        assert_eq!((kept.len(), kept.triangulated()), (3, 1));
        all.append(points(4, 0));
        assert_eq!(all.triangulated(), 10);
        assert_eq!(points(2, 5).triangulated(), 0);
    }

    #[test]
    fn places_on_earth_are_those_of_wgs84() {
        let at = |latitude_degrees, longitude_degrees, altitude_metres| {
            GeoOrigin { latitude_degrees, longitude_degrees, altitude_metres }.ecef_from_local()
        };
        let is_near = |found: DVec3, expected: DVec3| assert!((found - expected).length() < 1e-3, "{found}");
        let greenwich = at(0.0, 0.0, 10.0);
        is_near(greenwich.transform_point3(DVec3::ZERO), DVec3::new(6_378_147.0, 0.0, 0.0));
        is_near(greenwich.transform_vector3(DVec3::X), DVec3::Y);
        is_near(greenwich.transform_vector3(DVec3::Y), DVec3::Z);
        is_near(greenwich.transform_vector3(DVec3::Z), DVec3::X);
        is_near(at(90.0, 0.0, 0.0).transform_point3(DVec3::ZERO), DVec3::new(0.0, 0.0, 6_356_752.314_2));
        // 45° north, 90° east: the normal has 6,388,838.29 m.
        let middle = DVec3::new(0.0, 4_517_590.879, 4_487_348.409);
        is_near(at(45.0, 90.0, 0.0).transform_point3(DVec3::ZERO), middle);
    }

    #[test]
    fn places_on_earth_are_found_again() {
        for latitude_degrees in [-90.0, -89.999, -45.0, -1e-9, 0.0, 12.5, 48.137, 90.0] {
            for (longitude_degrees, altitude_metres) in [(0.0, 0.0), (11.575, 519.0), (-179.9, -400.0), (91.0, 9000.0)]
            {
                let origin = GeoOrigin { latitude_degrees, longitude_degrees, altitude_metres };
                let found = GeoOrigin::at_ecef(origin.ecef_from_local().w_axis.truncate()).unwrap();
                assert!((found.latitude_degrees - latitude_degrees).abs() < 1e-12, "{found:?}");
                assert!((found.altitude_metres - altitude_metres).abs() < 1e-8, "{found:?}");
                let is_pole = latitude_degrees.abs() == 90.0;
                assert!(is_pole || (found.longitude_degrees - longitude_degrees).abs() < 1e-9, "{found:?}");
            }
        }
        for place in [DVec3::ZERO, DVec3::X * 6e6, DVec3::Z * 7e6, DVec3::NAN, DVec3::splat(f64::MAX)] {
            assert_eq!(GeoOrigin::at_ecef(place), None, "{place}");
        }
    }
}
