//! Parcels: land use of blocks, and rows of houses along their fronts.

use glam::{DMat3, DQuat, DVec2, DVec3};
use scene::Rigid;

use crate::build::ground::{Cover, Polyline};
use crate::build::house::{HouseKind, PLINTH, WIDTHS};
use crate::materials as m;
use crate::props::Prop;
use crate::random::Random;
use crate::roads::{CORNER_POINTS, Profile, RoadKind, Roads, Step};
use crate::settings::Layout;
use crate::terrain::Terrain;
use crate::types::Class;

/// A prop at a pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Placement {
    pub(crate) prop: Prop,
    pub(crate) pose: Rigid,
}

/// Land use of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LandUse {
    Houses,
    Park,
    Square,
    CarPark,
}

/// A block during generation: its land use and the props placed so far.
pub(crate) struct Parcel<'a> {
    pub(crate) roads: &'a Roads,
    pub(crate) terrain: &'a Terrain,
    pub(crate) walk: Vec<Step>,
    pub(crate) layout: Layout,
    pub(crate) land_use: LandUse,
    pub(crate) random: Random,
    /// Number of variants of each kind and width of house.
    pub(crate) variants: u8,
    /// Areas that are occupied by houses and other props.
    pub(crate) footprints: Vec<Footprint>,
    pub(crate) placements: Vec<Placement>,
}

/// An oriented rectangle on the ground that a prop occupies.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Footprint {
    pub(crate) centre: DVec2,
    /// Unit direction of the length.
    pub(crate) along: DVec2,
    pub(crate) half: DVec2,
}

impl Footprint {
    pub(crate) fn corners(&self) -> [DVec2; 4] {
        let (x, y) = (self.half.x * self.along, self.half.y * self.along.perp());
        [-x - y, x - y, x + y, -x + y].map(|d| self.centre + d)
    }

    /// Whether two footprints are closer than `gap` (separating axes; a negative gap allows an overlap).
    pub(crate) fn overlaps(&self, other: &Self, gap: f64) -> bool {
        let between = other.centre - self.centre;
        [self.along, self.along.perp(), other.along, other.along.perp()].into_iter().all(|axis| {
            let reach = |f: &Self| f.half.x * axis.dot(f.along).abs() + f.half.y * axis.dot(f.along.perp()).abs();
            between.dot(axis).abs() < reach(self) + reach(other) + gap
        })
    }

    /// Distance from a point, 0 inside.
    pub(crate) fn distance(&self, p: DVec2) -> f64 {
        let d = p - self.centre;
        let d = DVec2::new(d.dot(self.along), d.dot(self.along.perp())).abs() - self.half;
        d.max(DVec2::ZERO).length()
    }
}

/// An upright pose with x along a direction.
pub(crate) fn upright(at: DVec3, along: DVec2) -> Rigid {
    Rigid { rotation: DQuat::from_rotation_z(along.to_angle()), translation: at }
}

/// A pose perpendicular to sloping ground, with x along a direction.
pub(crate) fn on_slope(terrain: &Terrain, at: DVec2, along: DVec2) -> Rigid {
    let slope = |d: DVec2| (terrain.at(at + d) - terrain.at(at - d)).normalize();
    let x = slope(along);
    let z = x.cross(slope(along.perp())).normalize();
    let rotation = DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z)).normalize();
    Rigid { rotation, translation: terrain.at(at) }
}

impl<'a> Parcel<'a> {
    pub(crate) fn new(roads: &'a Roads, terrain: &'a Terrain, block: usize, variants: u8, random: &Random) -> Self {
        let layout = roads.quarters[roads.blocks[block].quarter].layout;
        let mut random = random.fork(0xB10C).fork(block as u64);
        let land_use = match (layout, random.unit()) {
            // a compact city has too few blocks for other uses
            _ if roads.is_compact => LandUse::Houses,
            (Layout::CurvedCorridor, _) => LandUse::Houses,
            (Layout::Alley, u) if u < 0.05 => LandUse::Square,
            (Layout::Alley, _) => LandUse::Houses,
            (_, u) if u < 0.08 => LandUse::Park,
            (_, u) if u < 0.12 => LandUse::Square,
            (_, u) if u < 0.17 => LandUse::CarPark,
            _ => LandUse::Houses,
        };
        let walk = roads.walk_around(roads.blocks[block].lines);
        Self {
            roads,
            terrain,
            walk,
            layout,
            land_use,
            random,
            variants,
            footprints: Vec::new(),
            placements: Vec::new(),
        }
    }

    /// Ground cover of the block.
    pub(crate) fn cover(&self) -> Cover {
        let lawn = (m::LAWN, Class::Terrain);
        let (ground, rim) = match (self.land_use, self.layout) {
            (LandUse::Park, _) => (lawn, lawn),
            (LandUse::Square, _) => ((m::PAVERS, Class::Sidewalk), (m::SLABS, Class::Sidewalk)),
            (LandUse::CarPark, _) => ((m::ASPHALT_FRESH, Class::Terrain), (m::GRAVEL, Class::Terrain)),
            (_, Layout::Winding) => (lawn, lawn),
            (_, Layout::Alley) => ((m::GRAVEL, Class::Terrain), (m::PAVERS, Class::Terrain)),
            _ => (lawn, (m::GRAVEL, Class::Terrain)),
        };
        Cover { ground, rim }
    }

    /// The ground of the block at a point behind the fronts.
    pub(crate) fn ground(&self, p: DVec2) -> DVec3 {
        self.terrain.at(p) + DVec3::Z * self.curb()
    }

    /// Curb height of the quarter's own roads.
    fn curb(&self) -> f64 {
        match self.layout {
            Layout::Winding => RoadKind::Winding,
            Layout::Alley => RoadKind::Alley,
            _ => RoadKind::Street,
        }
        .profile()
        .curb
    }

    pub(crate) fn place(&mut self, prop: Prop, pose: Rigid) {
        self.placements.push(Placement { prop, pose });
    }

    /// The four sides without corners at an offset from the centre lines, counter-clockwise, with the block on the
    /// left.
    pub(crate) fn sides(&self, distance: &dyn Fn(&Profile) -> f64) -> Vec<(Polyline, Profile)> {
        let (ring, turns) = self.roads.ring(&self.walk, distance);
        let count = ring.len();
        (0..turns.len())
            .map(|s| {
                let (before, turn) = (turns[(s + turns.len() - 1) % turns.len()], turns[s]);
                let from = before + CORNER_POINTS / 2 + 1;
                let to = turn - CORNER_POINTS / 2 - 1;
                let from = if from > to { from - count } else { from };
                let points: Vec<DVec2> = (from..=to).map(|k| ring[k % count].at).collect();
                (Polyline::through(&points), ring[from.midpoint(to) % count].profile)
            })
            .collect()
    }

    /// Places rows of houses on all four sides.
    pub(crate) fn place_houses(&mut self) {
        if self.land_use != LandUse::Houses {
            return;
        }
        let outline: Vec<DVec2> = self.roads.ring(&self.walk, &Profile::front).0.iter().map(|p| p.at).collect();
        let mut sides = self.sides(&Profile::front);
        if self.roads.is_compact {
            // blocks are not deep enough for houses on all sides: the widest road comes first
            sides.sort_by(|a, b| b.1.front().total_cmp(&a.1.front()));
        }
        for (line, profile) in sides {
            self.place_row(&line, &profile, &outline);
        }
    }

    fn house_kind(&mut self, profile: &Profile) -> HouseKind {
        let unit = self.random.unit();
        match (self.layout, profile.kind) {
            (Layout::Winding, _) => HouseKind::Villa,
            // back lanes get the shallowest houses
            (_, RoadKind::Lane) if self.roads.is_compact => HouseKind::Old,
            (Layout::Alley, _) => HouseKind::Old,
            (Layout::CurvedCorridor, _) => HouseKind::Tall,
            (Layout::Deck, RoadKind::Boulevard) if unit < 0.35 => HouseKind::Tower,
            (Layout::Deck, _) if unit < 0.15 => HouseKind::Tower,
            (_, _) if unit < 0.05 => HouseKind::Tower,
            (_, _) if unit < 0.2 => HouseKind::Tall,
            _ => HouseKind::Town,
        }
    }

    /// Places a row of houses along a front line.
    fn place_row(&mut self, line: &Polyline, profile: &Profile, outline: &[DVec2]) {
        let villas = self.layout == Layout::Winding;
        let mut s = if villas { self.random.range(1.0, 4.0).into() } else { 0.0 };
        while s + f64::from(WIDTHS[0]) <= line.length {
            let kind = self.house_kind(profile);
            let min_width = match kind {
                HouseKind::Tower => 4,
                HouseKind::Villa => 2,
                _ => 0,
            };
            let fitting = WIDTHS.iter().filter(|&&w| f64::from(w) <= line.length - s).count();
            if fitting <= min_width {
                break;
            }
            let max_width = if kind == HouseKind::Old { fitting.min(4) } else { fitting };
            let width = min_width + self.random.below(max_width - min_width);
            let back = if villas { self.random.range(3.0, 6.5) } else { 0.0 };
            self.place_house(line, s, kind, width, back.into(), outline);
            s += f64::from(WIDTHS[width]);
            s += match kind {
                HouseKind::Villa => self.random.range(4.0, 9.0).into(),
                HouseKind::Tower => self.random.range(2.0, 4.0).into(),
                // an occasional passage
                _ if self.random.chance(0.1) => self.random.range(1.2, 3.5).into(),
                _ => 0.0,
            };
        }
    }

    /// Places a house at arc length `s` of a front line if its footprint is free.
    fn place_house(&mut self, line: &Polyline, s: f64, kind: HouseKind, width: usize, back: f64, outline: &[DVec2]) {
        let size = DVec2::new(WIDTHS[width].into(), kind.depth().into());
        let points: Vec<DVec2> = (0..=4).map(|k| line.at(s + size.x * f64::from(k) / 4.0).0).collect();
        let along = (points[4] - points[0]).normalize_or(DVec2::X);
        let inwards = along.perp();
        // houses are straight: behind a convex front line the house is set back
        let behind = points.iter().map(|&p| (p - points[0]).dot(inwards)).fold(0.0, f64::max) + 0.02 + back;
        let front = points[0].midpoint(points[4]) + behind * inwards;
        let footprint = Footprint { centre: front + 0.5 * size.y * inwards, along, half: 0.5 * size };
        let overlap = if kind == HouseKind::Villa { 1.5 } else { -1.4 };
        let inside = footprint.corners().iter().all(|c| contains(outline, c.lerp(footprint.centre, 0.02)));
        if !inside || self.footprints.iter().any(|other| footprint.overlaps(other, overlap)) {
            return;
        }
        let high = points.iter().map(|&p| self.ground(p + behind * inwards).z).fold(f64::NEG_INFINITY, f64::max);
        let low = footprint.corners().iter().map(|&p| self.ground(p).z).fold(f64::INFINITY, f64::min);
        if high - low > f64::from(PLINTH) - 0.4 {
            return;
        }
        let variant = self.random.below(usize::from(self.variants)) as u8;
        self.footprints.push(footprint);
        self.place(Prop::House { kind, width: width as u8, variant }, upright(front.extend(high), along));
    }
}

/// Whether a polygon contains a point (even-odd rule).
pub(crate) fn contains(polygon: &[DVec2], p: DVec2) -> bool {
    let mut inside = false;
    for k in 0..polygon.len() {
        let (a, b) = (polygon[k], polygon[(k + 1) % polygon.len()]);
        if (a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x) {
            inside = !inside;
        }
    }
    inside
}
