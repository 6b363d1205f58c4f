//! Writes a model of many blocks as `plat train` does, without training: for measuring what reads whole cities.
//!
//! ```text
//! cargo run --release -p model --example city_of_blocks -- OUT [SPLATS [SH_DEGREE [SEED]]]
//! ```
//!
//! A square of houses between streets, 50 m of ground a block, about 80,000 splats of a block's core and a quarter as many in its
//! halo. Colours and sizes vary as those of trained splats do, so that what is compressed is of a plausible size. The store that the
//! results lie in before they are written is a folder beside OUT; it is removed.

use std::error::Error;
use std::fs;
use std::path::PathBuf;

use blocks::{Ground, Plan, PlanSettings, Task};
use glam::{DQuat, DVec2, DVec3, Quat, Vec3};
use scene::random::uniform;
use scene::{ArtefactId, BlockId, Capture, Splat, Splats, frame};
use store::Store;

/// Splats of a block's core.
const BLOCK_SPLATS: u64 = 80_000;
/// Side of a block of the finest level, metres.
const LEAF_METRES: f64 = 50.0;
/// Distance between houses, and their side, metres.
const HOUSES: (f64, f64) = (25.0, 15.0);

fn main() -> Result<(), Box<dyn Error>> {
    let mut words = std::env::args().skip(1);
    let out = PathBuf::from(words.next().ok_or("usage: city_of_blocks OUT [SPLATS [SH_DEGREE [SEED]]]")?);
    let splats: u64 = words.next().map_or(Ok(1_000_000), |word| word.parse())?;
    let sh_degree: u8 = words.next().map_or(Ok(1), |word| word.parse())?;
    let seed: u64 = words.next().map_or(Ok(0), |word| word.parse())?;

    let levels = (0..=8).find(|&levels| BLOCK_SPLATS << (2 * levels) >= splats).ok_or("too many splats")?;
    let plan = plan(levels, sh_degree.min(3), seed, splats);
    plan.check()?;
    let folder = out.with_extension("store");
    let store = Store::open(folder.to_str().ok_or("OUT is not UTF-8")?)?.blocking();
    let results = plan.tasks.iter().map(|task| {
        let splats = block(&plan, task.block, splats);
        store.put(frame::encode_splats(&splats))
    });
    let results: Vec<ArtefactId> = results.collect::<Result<_, _>>()?;
    let written = model::write(&out, &plan, &results, &store, &Capture::default(), 1)?;
    fs::remove_dir_all(&folder)?;
    println!("{} splats in {} blocks, {} bytes", written.splats, plan.tasks.len(), written.bytes);
    Ok(())
}

/// The plan of a full tree.
fn plan(levels: u8, sh_degree: u8, seed: u64, splats: u64) -> Plan {
    let edge_metres = LEAF_METRES * f64::from(1u32 << levels);
    let ground = Ground {
        ground_from_world: DQuat::IDENTITY,
        min: DVec2::splat(-0.5 * edge_metres),
        edge_metres,
        height_metres: 10.0,
        near_metres: 2.0 * edge_metres,
    };
    let rho_metres: Vec<f64> = (0..=levels).map(|level| 0.02 * f64::from(1u32 << (levels - level))).collect();
    let side = |level: u8| 0..1u32 << level;
    let blocks = (0..=levels).flat_map(|level| side(level).flat_map(move |y| side(level).map(move |x| (level, x, y))));
    let mut tasks: Vec<Task> = blocks.map(|(level, x, y)| task(BlockId { level, x, y }, &rho_metres)).collect();
    tasks.sort_by_key(|task| blocks::lod::training_order(task.block));
    let settings = PlanSettings {
        levels: Some(levels),
        seed,
        budget: splats as u32,
        sh_degree,
        antialiased: true,
        ..Default::default()
    };
    Plan {
        version: blocks::plan::VERSION,
        capture: ArtefactId::of(b"city of blocks"),
        zones: None,
        detector: None,
        settings,
        backend: "none".into(),
        ground,
        levels,
        rho_metres,
        tasks,
        eval_tasks: Vec::new(),
        detect_tasks: Vec::new(),
        object_tasks: Vec::new(),
    }
}

fn task(block: BlockId, rho_metres: &[f64]) -> Task {
    Task {
        block,
        parent: block.parent(),
        context: Vec::new(),
        views: Vec::new(),
        test_views: Vec::new(),
        points: 0,
        budget: BLOCK_SPLATS as u32,
        visible_splats: 0,
        visible_context_splats: 0,
        steps: 1,
        rho_metres: rho_metres[usize::from(block.level)],
        memory_bytes: 0,
    }
}

/// The splats of a block: as many as its share of the finest level or, of coarser levels, of a whole block; then its halo. The root
/// also has a sky.
fn block(plan: &Plan, block: BlockId, splats: u64) -> Splats {
    let leaves = 1u64 << (2 * plan.levels);
    let index = u64::from(block.y) << block.level | u64::from(block.x);
    let own =
        if block.level == plan.levels { splats * (index + 1) / leaves - splats * index / leaves } else { BLOCK_SPLATS };
    let key = plan.settings.seed ^ block.code().map_or(0, u64::from).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let core = plan.ground.core(block);
    let edge = core.max.x - core.min.x;
    let spacing = edge / (own.max(1) as f64).sqrt();
    let mut all = Splats::new(plan.settings.sh_degree);
    all.reserve((own + own / 4) as usize);
    for i in 0..own {
        let random = |k: u64| f64::from(uniform(key, 40 * i + k));
        let at = core.min + DVec2::new(random(0), random(1)) * edge;
        all.push(&splat(at, spacing, &random));
    }
    for i in own..own + own / 4 {
        let random = |k: u64| f64::from(uniform(key, 40 * i + k));
        // Of a ring around the core, one side after the other.
        let (along, out) = (random(0) * edge, 0.12 * random(1) * edge);
        let at = match i % 4 {
            0 => DVec2::new(core.min.x + along, core.min.y - out),
            1 => DVec2::new(core.min.x + along, core.max.y + out),
            2 => DVec2::new(core.min.x - out, core.min.y + along),
            _ => DVec2::new(core.max.x + out, core.min.y + along),
        };
        all.push(&splat(at, spacing, &random));
    }
    for i in 0..if block == BlockId::ROOT { 5000u64 } else { 0 } {
        let random = |k: u64| f64::from(uniform(!key, 4 * i + k));
        let (turn, up) = (std::f64::consts::TAU * random(0), 0.05 + 0.9 * random(1));
        let flat = (1.0 - up * up).sqrt();
        let place = 4.0 * plan.ground.edge_metres * DVec3::new(flat * turn.cos(), flat * turn.sin(), up);
        let size = (0.03 * plan.ground.edge_metres) as f32;
        all.push(&Splat::round(place.as_vec3(), size.ln(), Vec3::new(0.5, 0.65, 0.9 - 0.2 * up as f32), 0.9));
    }
    all
}

/// A splat of the ground, of a wall, of a roof, or of a tree above a place.
fn splat(at: DVec2, spacing: f64, random: &dyn Fn(u64) -> f64) -> Splat {
    let (step, side) = HOUSES;
    let house = (at / step).floor();
    let within = at - house * step;
    let of_house = |k: u64| f64::from(uniform(k, (house.x as i64 as u64) << 32 ^ house.y as i64 as u64));
    let height = 6.0 + 18.0 * of_house(1);
    let is_house = within.x < side && within.y < side;
    let (place, normal, colour) = match random(2) {
        lot if is_house && lot < 0.5 => {
            // The nearest wall, somewhere along its height.
            let walls = [within.x, side - within.x, within.y, side - within.y];
            let wall = (0..4).min_by(|&a, &b| walls[a].total_cmp(&walls[b])).unwrap_or(0);
            let shift = [DVec2::NEG_X, DVec2::X, DVec2::NEG_Y, DVec2::Y][wall];
            let window = if (at.x + at.y).rem_euclid(3.0) < 1.2 { 0.4 } else { 1.0 };
            let colour = window * DVec3::new(0.75, 0.7 - 0.2 * of_house(2), 0.6 - 0.3 * of_house(3));
            ((at + shift * walls[wall]).extend(height * random(3)), shift.extend(0.0), colour)
        }
        _ if is_house => (at.extend(height), DVec3::Z, DVec3::new(0.5, 0.25 + 0.2 * of_house(4), 0.2)),
        lot if lot > 0.85 => (at.extend(1.5 + 5.0 * random(3)), DVec3::X, DVec3::new(0.2, 0.4, 0.15)),
        _ => (at.extend(0.0), DVec3::Z, DVec3::splat(0.35 + 0.05 * (0.7 * at.x).sin())),
    };
    // Trained splats are noisy, their sizes spread over a decade.
    let normal_noise = |k: u64| random(k) + random(k + 1) + random(k + 2) - 1.5;
    let noise = |k: u64| DVec3::new(normal_noise(k), normal_noise(k + 3), normal_noise(k + 6));
    let colour = (colour + 0.08 * noise(4)).clamp(DVec3::ZERO, DVec3::ONE).as_vec3();
    let size = (0.8 * spacing).ln() as f32;
    let log_scale = Vec3::new(size, size, size - 2.0) + 0.8 * noise(13).as_vec3();
    let opacity = (0.98 - 0.9 * random(22) * random(23)) as f32;
    let turn = Quat::from_rotation_arc(Vec3::Z, (normal + 0.1 * noise(24)).normalize().as_vec3());
    let turn = turn * Quat::from_rotation_z(6.3 * random(33) as f32);
    let round = Splat::round((place + 0.3 * spacing * noise(4)).as_vec3(), 0.0, colour, opacity);
    let mut sh = round.sh;
    for (k, coefficient) in sh.iter_mut().enumerate().skip(1) {
        *coefficient = (0.06 * noise(24 + k as u64 % 3)).as_vec3().to_array();
    }
    Splat { log_scale, quat: [turn.w, turn.x, turn.y, turn.z], sh, ..round }
}
