//! From settings to a city: plan the roads, build all pieces in parallel, put them together in order.

use std::collections::{BTreeMap, BTreeSet};

use glam::DQuat;
use rayon::prelude::*;
use scene::{BadInput, Rigid};

use crate::build::ground::{self, Piece};
use crate::materials;
use crate::parcels::{Parcel, Placement};
use crate::props::Prop;
use crate::random::Random;
use crate::roads::Roads;
use crate::settings::CitySettings;
use crate::terrain::Terrain;
use crate::words::{Actor, City, Class};

impl City {
    /// Generates a city.
    ///
    /// # Errors
    /// A setting is out of its range.
    pub fn generate(settings: &CitySettings) -> Result<Self, BadInput> {
        settings.check()?;
        let extent = settings.extent_metres();
        let random = Random::new(settings.seed);
        let plain_edge = if settings.plain > 0.0 { (settings.plain - 0.5) * extent } else { f64::NEG_INFINITY };
        let terrain = Terrain::new(&random, settings.layout, 0.5 * extent, plain_edge);
        let roads = Roads::new(settings, &random);
        let (materials, texts) = materials::table();
        let mut city = Self { extent_metres: extent, materials, texts, ..Self::default() };
        city.lay_ground(&roads, &terrain, settings, &random);
        let variants = (3.0 + 2.0 * settings.area_km2).min(12.0) as u8;
        let blocks: Vec<(Piece, Vec<Placement>)> = (0..roads.blocks.len())
            .into_par_iter()
            .map(|block| build_on(&roads, &terrain, block, variants, &random))
            .collect();
        let (pieces, placements): (Vec<_>, Vec<_>) = blocks.into_iter().unzip();
        for piece in pieces {
            city.add_ground(piece, Class::Sidewalk);
        }
        city.place(&placements.concat(), &random.fork(0x9409));
        Ok(city)
    }

    fn lay_ground(&mut self, roads: &Roads, terrain: &Terrain, settings: &CitySettings, random: &Random) {
        let random = random.fork(0x6409);
        let crossings: Vec<Option<Piece>> = (0..roads.nodes.len())
            .into_par_iter()
            .map(|node| ground::crossing(roads, terrain, node, &random))
            .collect();
        for piece in crossings.into_iter().flatten() {
            self.add_ground(piece, Class::Road);
        }
        let extent = settings.extent_metres();
        for piece in ground::country(roads, terrain, 0.5 * extent, settings.plain * extent) {
            self.add_ground(piece, Class::Terrain);
        }
    }

    fn add_ground(&mut self, piece: Piece, class: Class) {
        let asset = self.assets.len() as u32;
        self.assets.push(piece.asset);
        let world_from_asset = Rigid { rotation: DQuat::IDENTITY, translation: piece.origin };
        self.actors.push(Actor { asset, class, instance: 0, world_from_asset, trajectory: None });
    }

    /// Builds each shared asset that is used, once, and puts it wherever it stands.
    fn place(&mut self, placements: &[Placement], seed: &Random) {
        let used: BTreeSet<Prop> = placements.iter().map(|p| p.prop).collect();
        let used: Vec<Prop> = used.into_iter().collect();
        let rows: BTreeMap<Prop, u32> = used.iter().copied().zip(self.assets.len() as u32..).collect();
        self.assets.par_extend(used.par_iter().map(|prop| prop.build(seed)));
        for (placement, instance) in placements.iter().zip(1..) {
            self.actors.push(Actor {
                asset: rows[&placement.prop],
                class: placement.prop.class(),
                instance,
                world_from_asset: placement.pose,
                trajectory: None,
            });
        }
    }
}

/// A block's ground and what stands on it.
fn build_on(roads: &Roads, terrain: &Terrain, block: usize, variants: u8, random: &Random) -> (Piece, Vec<Placement>) {
    let mut parcel = Parcel::new(roads, terrain, block, variants, random);
    let piece = ground::block(roads, terrain, &parcel.walk, parcel.cover(), format!("block {block}"));
    parcel.houses();
    (piece, parcel.placements)
}
