//! From settings to a city: plan the roads, build all pieces in parallel, put them together in order.

use glam::{DQuat, DVec3};
use rayon::prelude::*;
use scene::{BadInput, Rigid};

use crate::build::ground::{self, Cover, Piece};
use crate::materials as m;
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
        let plain_edge = if settings.plain > 0.0 { (settings.plain - 0.5) * extent } else { -1e6 };
        let terrain = Terrain::new(&random, settings.layout, 0.5 * extent, plain_edge);
        let roads = Roads::new(settings, &random);
        let (materials, texts) = m::table();
        let mut city = City { extent_metres: extent, materials, texts, ..City::default() };
        let crossings: Vec<_> = (0..roads.nodes.len()).into_par_iter().map(|n| ground::crossing(&roads, &terrain, n, &random)).collect();
        for piece in crossings.into_iter().flatten() { city.add_ground(piece); }
        let blocks: Vec<_> = (0..roads.blocks.len()).into_par_iter().map(|n| {
            let walk = roads.around(roads.blocks[n].lines);
            let cover = Cover { ground: (m::LAWN, Class::Terrain), rim: (m::GRAVEL, Class::Terrain) };
            ground::block(&roads, &terrain, &walk, cover, format!("block {n}"))
        }).collect();
        for piece in blocks { city.add_ground(piece); }
        for piece in ground::country(&roads, &terrain, 0.5*extent, settings.plain*extent) { city.add_ground(piece); }
        Ok(city)
    }

    fn add_ground(&mut self, piece: Piece) {
        let asset = self.assets.len() as u32;
        self.assets.push(piece.asset);
        let world_from_asset = Rigid { rotation: DQuat::IDENTITY, translation: piece.origin };
        let _ = DVec3::ZERO;
        self.actors.push(Actor { asset, class: Class::Terrain, instance: 0, world_from_asset, trajectory: None });
    }
}
