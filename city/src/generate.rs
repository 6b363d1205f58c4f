//! Generates a city from settings: plans the roads, builds all parts in parallel and assembles them in a fixed order.

use std::collections::{BTreeMap, BTreeSet};

use glam::DQuat;
use rayon::prelude::*;
use scene::{BadInput, Rigid};

use crate::build::furniture;
use crate::build::ground::{self, Piece};
use crate::build::person;
use crate::deck::Deck;
use crate::lattice::lay_roads;
use crate::materials;
use crate::parcels::{Parcel, Placement, upright};
use crate::props::Prop;
use crate::random::Random;
use crate::roads::Roads;
use crate::settings::CitySettings;
use crate::street_furniture::random_car;
use crate::terrain::Terrain;
use crate::traffic::{self, Mover};
use crate::types::{Actor, City, Class, Trajectory};

impl City {
    /// Generates a city. The result depends on the settings alone.
    ///
    /// # Errors
    /// A setting is out of range.
    pub fn generate(settings: &CitySettings) -> Result<Self, BadInput> {
        settings.check()?;
        let extent = settings.extent_metres();
        let random = Random::new(settings.seed);
        let plain_edge = if settings.plain > 0.0 { (settings.plain - 0.5) * extent } else { f64::NEG_INFINITY };
        let terrain = Terrain::new(&random, settings.layout, 0.5 * extent, plain_edge);
        let plan = Plan { settings: *settings, roads: lay_roads(settings, &random), terrain, random };
        let deck = Deck::new(&plan.roads, &plan.terrain);
        let (materials, texts) = materials::table();
        let streets = traffic::free_lanes(&plan.roads, &plan.terrain, deck.as_ref());
        let mut city = Self { extent_metres: extent, materials, texts, streets, ..Self::default() };
        city.lay_ground(&plan, deck.as_ref());
        let (pieces, placements): (Vec<_>, Vec<_>) = (0..plan.roads.blocks.len())
            .into_par_iter()
            .map(|block| plan.block(block))
            .collect::<Vec<_>>()
            .into_iter()
            .unzip();
        for piece in pieces {
            city.add_ground(piece, Class::Sidewalk);
        }
        let mut placements = placements.concat();
        placements.extend(
            deck.iter().flat_map(Deck::lamps).map(|(at, along)| Placement {
                prop: Prop::Furniture(furniture::Piece::Lamp),
                pose: upright(at, along),
            }),
        );
        city.populate(&placements, plan.movers(deck.as_ref()), &plan.random.fork(0x9409));
        Ok(city)
    }

    /// Parks a car at a pose (on the road, x ahead). The seed chooses which.
    pub fn park(&mut self, pose: Rigid, seed: u64) {
        let mut random = Random::new(seed).fork(0x9A4C);
        let prop = random_car(&mut random);
        let asset = self.assets.len() as u32;
        self.assets.push(prop.build(&random));
        let instance = 1 + self.actors.iter().map(|actor| actor.instance).max().unwrap_or(0);
        self.actors.push(Actor { asset, class: prop.class(), instance, world_from_asset: pose, trajectory: None });
    }

    fn lay_ground(&mut self, plan: &Plan, deck: Option<&Deck>) {
        let Plan { settings, roads, terrain, .. } = plan;
        let random = plan.random.fork(0x6409);
        let crossing = |node| ground::crossing(roads, terrain, node, &random);
        let crossings: Vec<Option<Piece>> = (0..roads.nodes.len()).into_par_iter().map(crossing).collect();
        for piece in crossings.into_iter().flatten() {
            self.add_ground(piece, Class::Road);
        }
        let extent = settings.extent_metres();
        for piece in ground::countryside(roads, terrain, 0.5 * extent, settings.plain * extent) {
            self.add_ground(piece, Class::Terrain);
        }
        for piece in deck.iter().flat_map(|deck| deck.pieces()) {
            self.add_ground(piece, Class::Bridge);
        }
    }

    fn add_ground(&mut self, piece: Piece, class: Class) {
        let asset = self.assets.len() as u32;
        self.assets.push(piece.asset);
        let world_from_asset = Rigid { rotation: DQuat::IDENTITY, translation: piece.origin };
        self.actors.push(Actor { asset, class, instance: 0, world_from_asset, trajectory: None });
    }

    /// Builds each shared asset in use once, and adds an actor for each of its placements.
    fn populate(&mut self, placements: &[Placement], movers: Vec<Mover>, seed: &Random) {
        let used: BTreeSet<Prop> =
            placements.iter().map(|p| p.prop).chain(movers.iter().flat_map(|m| gait_phases(m.prop))).collect();
        let used: Vec<Prop> = used.into_iter().collect();
        let rows: BTreeMap<Prop, u32> = used.iter().copied().zip(self.assets.len() as u32..).collect();
        self.assets.par_extend(used.par_iter().map(|prop| prop.build(seed)));
        let mut instances = 1..;
        let mut actor = |prop: Prop, pose: Rigid, trajectory: Option<Trajectory>| Actor {
            asset: rows[&prop],
            class: prop.class(),
            instance: if prop.is_counted() { instances.next().unwrap_or(u32::MAX) } else { 0 },
            world_from_asset: pose,
            trajectory,
        };
        self.actors.extend(placements.iter().map(|p| actor(p.prop, p.pose, None)));
        self.actors.extend(movers.into_iter().filter_map(|mover| {
            let pose = mover.waypoints.first()?.world_from_asset;
            let gait = if mover.gait_seconds.is_some() {
                gait_phases(mover.prop).map(|p| rows[&p]).collect()
            } else {
                Vec::new()
            };
            let gait_seconds = mover.gait_seconds.unwrap_or(0.0);
            Some(actor(mover.prop, pose, Some(Trajectory { waypoints: mover.waypoints, gait, gait_seconds })))
        }));
    }
}

/// The assets of a moving prop: all phases of a pedestrian's gait, or the prop itself.
fn gait_phases(prop: Prop) -> impl Iterator<Item = Prop> {
    let count = if matches!(prop, Prop::Walker { .. }) { person::PHASES as u8 } else { 1 };
    (0..count).map(move |k| match prop {
        Prop::Walker { build, .. } => Prop::Walker { build, phase: k },
        other => other,
    })
}

/// Inputs of all generators.
struct Plan {
    settings: CitySettings,
    roads: Roads,
    terrain: Terrain,
    random: Random,
}

impl Plan {
    /// The ground of a block and the props on it.
    fn block(&self, block: usize) -> (Piece, Vec<Placement>) {
        let variants = (3.0 + 2.0 * self.settings.area_km2).min(12.0) as u8;
        let mut parcel = Parcel::new(&self.roads, &self.terrain, block, variants, &self.random);
        let piece =
            ground::block_ground(&self.roads, &self.terrain, &parcel.walk, parcel.cover(), format!("block {block}"));
        parcel.place_houses();
        parcel.furnish();
        (piece, parcel.placements)
    }

    /// Vehicles by quarter, vehicles on the deck, pedestrians by block.
    fn movers(&self, deck: Option<&Deck>) -> Vec<Mover> {
        let Self { settings: CitySettings { traffic, .. }, roads, terrain, random } = self;
        let quarter = |q| traffic::vehicles(roads, terrain, q, *traffic, random);
        let block = |b| traffic::walkers(roads, terrain, b, *traffic, random);
        let mut movers: Vec<Mover> = (0..roads.quarters.len()).into_par_iter().flat_map_iter(quarter).collect();
        movers.extend(deck.into_iter().flat_map(|deck| traffic::deck_vehicles(deck, *traffic, random)));
        movers.par_extend((0..roads.blocks.len()).into_par_iter().flat_map_iter(block));
        movers
    }
}
