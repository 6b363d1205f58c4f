//! Placement of street furniture, parked vehicles, trees and yards on a parcel.

use glam::{DVec2, DVec3};

use crate::build::furniture::Piece;
use crate::build::ground::Polyline;
use crate::build::tree;
use crate::build::vehicle::{PAINTS, VehicleKind};
use crate::parcels::{Footprint, LandUse, Parcel, contains, on_slope, upright};
use crate::props::Prop;
use crate::random::Random;
use crate::roads::{Profile, RoadKind};
use crate::settings::Layout;

/// Car kinds, repeated by their frequency.
const CARS: [VehicleKind; 10] = [
    VehicleKind::Hatchback,
    VehicleKind::Hatchback,
    VehicleKind::Saloon,
    VehicleKind::Saloon,
    VehicleKind::Estate,
    VehicleKind::Estate,
    VehicleKind::OffRoad,
    VehicleKind::OffRoad,
    VehicleKind::Van,
    VehicleKind::Pickup,
];

/// A random car in a random colour.
pub(crate) fn random_car(random: &mut Random) -> Prop {
    Prop::Vehicle(*random.one_of(&CARS), random.below(PAINTS) as u8)
}

impl Parcel<'_> {
    /// Places everything but houses.
    pub(crate) fn furnish(&mut self) {
        self.place_curbside();
        self.park_vehicles();
        match self.land_use {
            LandUse::Houses => self.fill_yard(),
            LandUse::Park => self.fill_park(),
            LandUse::Square => self.fill_square(),
            LandUse::CarPark => self.fill_car_park(),
        }
    }

    /// Places a prop on the pavement at arc length `s` of a line.
    fn on_pavement(&mut self, line: &Polyline, s: f64, profile: &Profile, prop: Prop) {
        let (p, along) = line.at(s);
        let at = self.terrain.at(p) + DVec3::Z * profile.curb;
        self.place(prop, upright(at, along));
    }

    /// Places lamps, signs and trees behind the curb.
    fn place_curbside(&mut self) {
        let behind = |p: &Profile| p.half + if p.pavement > 2.5 { 0.7 } else { 0.32 };
        for (line, profile) in self.sides(&behind) {
            match profile.kind {
                RoadKind::Alley => {}
                RoadKind::Lane => self.on_pavement(&line, 0.4, &profile, Prop::Furniture(Piece::Bollard)),
                _ => self.place_along_street(&line, &profile),
            }
        }
        if self.layout == Layout::Alley {
            // alley pavements are narrow: lamps stand at the corners of the fronts
            let (ring, turns) = self.roads.ring(&self.walk, &|p| p.front() + 0.2);
            for &turn in turns.iter().step_by(2) {
                let at = self.ground(ring[turn].at);
                self.place(Prop::Furniture(Piece::OldLamp), upright(at, DVec2::X));
            }
        }
    }

    fn place_along_street(&mut self, line: &Polyline, profile: &Profile) {
        let length = line.length;
        let wide = profile.pavement > 2.5;
        let name = self.random.below(12) as u8;
        let first = match profile.kind {
            RoadKind::Street | RoadKind::Boulevard if self.random.chance(0.6) => Piece::Signal,
            _ => *self.random.one_of(&[Piece::Yield, Piece::Sign(0), Piece::Yield]),
        };
        self.on_pavement(line, 0.3, profile, Prop::Furniture(first));
        self.on_pavement(line, 1.3, profile, Prop::Furniture(Piece::StreetName(name)));
        let limit = *self.random.one_of(&[1, 1, 2, 3]);
        self.on_pavement(line, length - 3.0, profile, Prop::Furniture(Piece::Sign(limit)));
        let mut s = 5.0;
        let mut slot = self.random.below(4);
        while s < length - 5.0 {
            // space for a bus stop
            if profile.pavement > 3.5 && (-5.0..4.0).contains(&(s - 0.5 * length)) {
                s = 0.5 * length + 5.0;
                continue;
            }
            let prop = match slot % 4 {
                0 => Some(Prop::Furniture(Piece::Lamp)),
                _ if wide && self.random.chance(0.6) => Some(self.street_tree(profile)),
                _ => None,
            };
            if let Some(prop) = prop {
                self.on_pavement(line, s, profile, prop);
            }
            if wide && self.random.chance(0.25) {
                let small = [Piece::Bin, Piece::Hydrant, Piece::Bollard, Piece::Bench, Piece::Column];
                let piece = *self.random.one_of(if profile.pavement > 3.5 { &small[..] } else { &small[..3] });
                self.on_pavement(line, s + 2.5, profile, Prop::Furniture(piece));
            } else if wide && self.random.chance(0.15) {
                let paint = self.random.below(PAINTS) as u8;
                self.on_pavement(line, s + 2.5, profile, Prop::Vehicle(VehicleKind::BicycleParked, paint));
            }
            s += f64::from(self.random.range(6.5, 8.5));
            slot += 1;
        }
        if profile.pavement > 3.5 && length > 40.0 {
            self.on_pavement(line, 0.5 * length, profile, Prop::Furniture(Piece::Shelter));
            self.on_pavement(line, 0.5 * length + 3.9, profile, Prop::Furniture(Piece::Sign(4)));
        }
    }

    fn street_tree(&mut self, profile: &Profile) -> Prop {
        let kinds = if profile.pavement > 3.5 { &tree::STREET_KINDS[..] } else { &tree::STREET_KINDS[2..] };
        Prop::Tree(*self.random.one_of(kinds) as u8)
    }

    /// Parks vehicles along the curb, in the driving direction of the adjacent lane.
    fn park_vehicles(&mut self) {
        for (line, profile) in self.sides(&|p| p.half - 1.07) {
            if !profile.parking {
                continue;
            }
            let mut s = 8.5;
            loop {
                s += f64::from(self.random.range(0.7, 9.0));
                let prop = if self.random.chance(0.06) {
                    Prop::Vehicle(VehicleKind::MotorcycleParked, self.random.below(PAINTS) as u8)
                } else if matches!(self.layout, Layout::Grid | Layout::Deck) && self.random.chance(0.05) {
                    // long vehicles only on straight streets
                    let kind = *self.random.one_of(&[VehicleKind::Bus, VehicleKind::Truck, VehicleKind::Truck]);
                    Prop::Vehicle(kind, self.random.below(PAINTS) as u8)
                } else {
                    random_car(&mut self.random)
                };
                let Prop::Vehicle(kind, _) = prop else { continue };
                let length = f64::from(kind.size().x);
                // wide vehicles stand closer to the lane
                let aside = (f64::from(kind.size().y) - 1.9).max(0.0) * 0.25;
                if s + length > line.length - 8.5 {
                    break;
                }
                let (p, along) = line.at(s + 0.5 * length);
                self.place(prop, on_slope(self.terrain, p - aside * along.perp(), -along));
                s += length;
            }
        }
    }

    /// Places a prop behind the fronts if the point is clear of the pavement and of all footprints.
    fn place_if_free(&mut self, prop: Prop, p: DVec2, along: DVec2, clear: f64, outline: &[DVec2]) -> bool {
        let free = contains(outline, p)
            && outline.iter().all(|q| q.distance(p) > clear)
            && self.footprints.iter().all(|f| f.distance(p) > clear);
        if free {
            let at = self.ground(p);
            self.place(prop, upright(at, along));
            self.footprints.push(Footprint { centre: p, along, half: DVec2::splat(0.4) });
        }
        free
    }

    fn outline(&self) -> Vec<DVec2> {
        self.roads.ring(&self.walk, &Profile::front).0.iter().map(|p| p.at).collect()
    }

    /// Scatters trees at random, at a density per hectare.
    fn scatter_trees(&mut self, per_hectare: f64, kinds: &[u8], outline: &[DVec2], clear: f64) {
        let (low, high) = outline.iter().fold((DVec2::MAX, DVec2::MIN), |(a, b), &p| (a.min(p), b.max(p)));
        let tries = ((high - low).element_product() * per_hectare / 1e4) as usize;
        for _ in 0..tries {
            let p = self.random.between(low.as_vec2(), high.as_vec2()).as_dvec2();
            let kind = *self.random.one_of(kinds);
            let heading = DVec2::from_angle(f64::from(self.random.range(0.0, std::f32::consts::TAU)));
            self.place_if_free(Prop::Tree(kind), p, heading, clear, outline);
        }
    }

    fn fill_yard(&mut self) {
        let outline = self.outline();
        match self.layout {
            Layout::Winding => {
                self.park_in_driveways(&outline);
                self.place_garden_fronts();
                self.scatter_trees(90.0, &[0, 1, 3, 4, 5, 6, 7, 8], &outline, 2.8);
            }
            Layout::Alley => self.scatter_trees(60.0, &[7, 8], &outline, 1.6),
            _ => self.scatter_trees(110.0, &[0, 1, 2, 4, 8], &outline, 3.2),
        }
    }

    /// Parks cars beside villas.
    fn park_in_driveways(&mut self, outline: &[DVec2]) {
        for house in self.footprints.clone() {
            let beside = house.centre + (house.half.x + 1.7) * house.along - 0.3 * house.half.y * house.along.perp();
            let car = random_car(&mut self.random);
            let Prop::Vehicle(kind, _) = car else { continue };
            let half = 0.5 * kind.size().as_dvec2();
            let footprint = Footprint { centre: beside, along: house.along.perp(), half };
            let inside = footprint.corners().iter().all(|&c| contains(outline, c));
            let free = self.footprints.iter().all(|other| !footprint.overlaps(other, 0.3));
            if inside && free && self.random.chance(0.7) {
                let mut pose = on_slope(self.terrain, beside, house.along.perp());
                pose.translation = self.ground(beside);
                self.footprints.push(footprint);
                self.place(car, pose);
            }
        }
    }

    /// Places hedges, fences or low walls behind the pavement, with gaps at driveways.
    fn place_garden_fronts(&mut self) {
        for (line, _) in self.sides(&|p| p.front() + 0.45) {
            let prop = match self.random.below(4) {
                0 => Prop::Hedge,
                1 => Prop::Furniture(Piece::Fence),
                2 => Prop::Furniture(Piece::Wall),
                _ => continue,
            };
            let mut s = 2.0;
            while s + 1.0 < line.length {
                let (p, along) = line.at(s);
                let piece = Footprint { centre: p, along, half: DVec2::new(1.0, 4.0) };
                let free =
                    self.footprints.iter().all(|f| f.half.x > 2.9 && f.half.x > f.half.y || !piece.overlaps(f, 0.5));
                let walled = self.footprints.iter().all(|f| f.distance(p) > 1.3);
                if free && walled && !self.random.chance(0.06) {
                    let at = self.ground(p);
                    self.place(prop, upright(at, along));
                }
                s += 2.0;
            }
        }
    }

    fn fill_park(&mut self) {
        let outline = self.outline();
        for (line, _) in self.sides(&|p| p.front() + 6.0) {
            for k in 1..4 {
                let (p, along) = line.at(line.length * f64::from(k) / 4.0);
                self.place_if_free(Prop::Furniture(Piece::Bench), p, along, 1.5, &outline);
            }
        }
        self.scatter_trees(260.0, &[0, 1, 2, 3, 4, 5, 6, 7], &outline, 3.0);
    }

    fn fill_square(&mut self) {
        let outline = self.outline();
        let middle = outline.iter().sum::<DVec2>() / outline.len() as f64;
        let along = (outline[outline.len() / 8] - outline[0]).normalize_or(DVec2::X);
        let fits = outline.iter().all(|p| p.distance(middle) > 22.0);
        if fits && matches!(self.layout, Layout::Deck | Layout::Grid) {
            let at = self.ground(middle);
            let footprint = Footprint { centre: middle + 8.0 * along.perp(), along, half: DVec2::new(10.5, 11.0) };
            self.place(Prop::Furniture(Piece::Platform), upright(at, along));
            self.footprints.push(footprint);
        }
        for (line, _) in self.sides(&|p| p.front() + 4.0) {
            let count = (line.length / 9.0) as usize;
            for k in 0..count {
                let (p, along) = line.at((k as f64 + 0.5) * line.length / count as f64);
                let prop = match k % 4 {
                    0 => Prop::Furniture(Piece::OldLamp),
                    1 => Prop::Furniture(Piece::Bench),
                    _ => Prop::Tree(1),
                };
                self.place_if_free(prop, p, along, 2.0, &outline);
            }
        }
        self.place_if_free(Prop::Furniture(Piece::Column), middle, along, 2.0, &outline);
    }

    /// Places rows of parked cars.
    fn fill_car_park(&mut self) {
        let outline = self.outline();
        let Some((line, _)) = self.sides(&|p| p.front() + 5.0).into_iter().next() else { return };
        let (corner, along) = line.at(0.0);
        let across = along.perp();
        for row in 0..12 {
            // two rows back to back, then an aisle
            let y = 5.9 * f64::from(row) + 6.0 * f64::from((row + 1) / 2);
            for k in 0..(line.length / 2.7) as usize {
                let p = corner + along * (2.7 * k as f64 + 2.0) + across * y;
                let car = random_car(&mut self.random);
                let Prop::Vehicle(kind, _) = car else { continue };
                let footprint = Footprint { centre: p, along: across, half: 0.5 * kind.size().as_dvec2() + 1.0 };
                let inside = footprint.corners().iter().all(|&c| contains(&outline, c));
                if inside && self.random.chance(0.6) {
                    let heading = if self.random.chance(0.5) { across } else { -across };
                    let mut pose = on_slope(self.terrain, p, heading);
                    pose.translation = self.ground(p);
                    self.place(car, pose);
                }
            }
        }
        for p in [line.at(0.3 * line.length).0, line.at(0.7 * line.length).0] {
            self.place_if_free(Prop::Furniture(Piece::OldLamp), p - 3.0 * across, along, 1.0, &outline);
        }
    }
}
