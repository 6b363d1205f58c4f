//! What the city is painted with: procedural patterns from 10 cm (bricks, slabs) to 10 m (stains, lawns), filtered over
//! the footprint of a pixel so that distance blurs them as a lens would.

use glam::{Vec2, Vec3, vec3};

use super::city::{HALF_ROAD, Layout, Material, PAVEMENT, Solid, hash, unit};

/// The colour (sRGB, 0..1) of a point on a solid with this outward normal; `footprint` is a pixel's width in metres.
pub(super) fn solid_colour(solid: &Solid, point: Vec3, normal: Vec3, footprint: f32) -> Vec3 {
    let seed = solid.seed;
    let size = solid.max - solid.min;
    let local = point - solid.min;
    // along the wall or, on level faces, along x
    let (along, length) = if normal.x.abs() > 0.5 { (local.y, size.y) } else { (local.x, size.x) };
    let level = normal.z.abs() > 0.7;
    match solid.material {
        Material::Brick | Material::Plaster | Material::Tower if !level => {
            facade(solid.material, seed ^ face(normal), Vec2::new(along, local.z), Vec2::new(length, size.z), footprint)
        }
        Material::RoofTiles => roof_tiles(seed, point, normal, footprint),
        Material::Brick | Material::Plaster | Material::Tower | Material::FlatRoof => {
            let gravel = 0.12 * noise(point.truncate(), 0.35, seed, footprint);
            Vec3::splat(0.42 + 0.16 * pick(seed, 1) + gravel) + stains(point.truncate(), seed)
        }
        Material::Balcony => {
            let bars = stripes(along, 0.24, 0.12, footprint);
            if level { Vec3::splat(0.6) } else { Vec3::splat(0.2).lerp(vec3(0.62, 0.62, 0.64), bars) }
        }
        Material::Awning => {
            let cloth = palette(seed, &[[0.72, 0.16, 0.14], [0.13, 0.36, 0.25], [0.15, 0.26, 0.5], [0.8, 0.52, 0.14]]);
            cloth.lerp(Vec3::splat(0.92), stripes(along, 0.9, 0.45, footprint))
        }
        Material::CarBody => car_paint(seed),
        Material::CarCabin => {
            if level {
                return car_paint(seed);
            }
            let pillar = stripes(along + 0.08, 0.5 * length, 0.16, footprint);
            let rim = if local.z > 0.47 || local.z < 0.06 { 1.0 } else { pillar };
            vec3(0.08, 0.1, 0.13).lerp(car_paint(seed), rim)
        }
        Material::Foliage => {
            let leaf = vec3(0.2, 0.33, 0.1).lerp(vec3(0.36, 0.44, 0.15), pick(seed, 3));
            let leaves = |feature: f32| -> f32 {
                let planes = [point.truncate(), Vec2::new(point.y, point.z), Vec2::new(point.z, point.x)];
                planes.iter().map(|&p| noise(p, feature, seed, footprint)).sum()
            };
            let patches = 0.6 * leaves(0.5) + 0.5 * leaves(0.17);
            leaf * (1.0 + 0.7 * patches)
        }
        Material::Bark => Vec3::splat(0.17) + vec3(0.07, 0.04, 0.0) * noise(point.truncate(), 0.1, seed, footprint),
        Material::Metal => Vec3::splat(0.5 + 0.14 * pick(seed, 2)) - 0.1 * stripes(local.z, 0.3, 0.06, footprint),
        Material::Stone => {
            let joints = stripes(local.z, 0.4, 0.03, footprint).max(stripes(along, 0.8, 0.03, footprint));
            vec3(0.66, 0.62, 0.55) * (1.0 - 0.25 * joints) + 0.06 * noise(point.truncate(), 0.5, seed, footprint)
        }
    }
}

/// The colour of the ground: carriageways with markings, pavements, courtyards, parks, fields outside.
pub(super) fn ground_colour(layout: &Layout, p: Vec2, footprint: f32) -> Vec3 {
    let seed = layout.seed;
    let (dx, dy) = (layout.off_line(p.x), layout.off_line(p.y));
    let (ax, ay) = (dx.abs(), dy.abs());
    let across = ax.min(ay);
    if p.x < layout.plain {
        return vec3(0.56, 0.53, 0.46) + 0.04 * noise(p, 25.0, seed ^ 8, footprint);
    }
    let in_city = p.abs().max_element() < 0.5 * layout.extent + HALF_ROAD + PAVEMENT;
    if !in_city {
        return field(seed, p, footprint);
    }
    if across < HALF_ROAD {
        // a lane's own frame: `side` across the street, `along` it from the crossing's centre
        let (side, along) = if ax < ay { (dx, dy) } else { (dy, dx) };
        return carriageway(seed, p, side, along, footprint);
    }
    if across < HALF_ROAD + 0.25 {
        return Vec3::splat(0.66 - 0.1 * stripes(p.x + p.y, 1.0, 0.03, footprint));
    }
    if across < HALF_ROAD + PAVEMENT {
        let joints = stripes(p.x, 0.75, 0.035, footprint).max(stripes(p.y, 0.75, 0.035, footprint));
        let slab = unit(hash(seed, (p.x / 0.75).floor() as i32 as u32, (p.y / 0.75).floor() as i32 as u32)) - 0.5;
        let tone = 0.56 + 0.07 * slab * fade(0.75, footprint) - 0.13 * joints;
        return vec3(1.0, 0.98, 0.94) * (tone + stains(p, seed ^ 5));
    }
    let block = layout.block(p);
    if layout.is_park(block) {
        let centre = Vec2::new(layout.line(block.0), layout.line(block.1)) + 0.5 * layout.pitch;
        let off = (p - centre).abs();
        if off.min_element() < 1.6 || (p - centre).length() < 7.5 {
            return vec3(0.68, 0.6, 0.46) + 0.08 * noise(p, 0.4, seed ^ 3, footprint) + stains(p, seed ^ 4);
        }
        return lawn(seed ^ 21, p, footprint);
    }
    let inside = across - HALF_ROAD - PAVEMENT;
    if inside < 13.5 || unit(hash(seed, block.0 + 77, block.1)) < 0.3 {
        let joints = stripes(p.x, 0.4, 0.03, footprint).max(stripes(p.y, 0.2, 0.02, footprint));
        return vec3(0.6, 0.55, 0.48) * (1.0 - 0.2 * joints + 0.1 * noise(p, 0.9, seed ^ 7, footprint))
            + stains(p, seed ^ 6);
    }
    lawn(seed ^ 22, p, footprint)
}

/// The sky's colour in a direction: pale at the horizon, blue above.
pub(super) fn sky_colour(direction: Vec3) -> Vec3 {
    let height = direction.z.max(0.0);
    HORIZON.lerp(vec3(0.3, 0.5, 0.8), (1.0 - (-3.0 * height).exp()).min(1.0))
}

/// What far ground fades into.
pub(super) const HORIZON: Vec3 = vec3(0.8, 0.85, 0.9);

fn facade(material: Material, seed: u32, at: Vec2, size: Vec2, footprint: f32) -> Vec3 {
    let ground_floor = at.y < 4.0;
    let (floor, v, storey) = match ground_floor {
        true => (0, at.y, 4.0),
        false => (1 + ((at.y - 4.0) / 3.2) as u32, (at.y - 4.0) % 3.2, 3.2),
    };
    let tower = material == Material::Tower;
    let bays = (size.x / (2.2 + 0.9 * pick(seed, 11))).round().max(1.0);
    let bay_width = size.x / bays;
    let (bay, u) = ((at.x / bay_width) as u32, at.x % bay_width / bay_width);
    let shop = ground_floor && pick(seed, 12) < 0.6;
    let wall = if tower {
        palette(seed, &[[0.62, 0.65, 0.68], [0.52, 0.48, 0.44], [0.72, 0.7, 0.66]])
    } else if material == Material::Brick {
        brick(seed, at, footprint)
    } else {
        let tint = palette(
            seed,
            &[
                [0.86, 0.8, 0.66],
                [0.8, 0.62, 0.42],
                [0.7, 0.76, 0.74],
                [0.84, 0.72, 0.68],
                [0.9, 0.88, 0.83],
                [0.6, 0.68, 0.78],
            ],
        );
        tint + 0.05 * noise(at, 0.3, seed, footprint)
    };
    let top = size.y - at.y;
    if top < 0.45 || (top < 0.55 && !tower) {
        return Vec3::splat(0.82 - 0.12 * stripes(at.x, 0.5, 0.2, footprint));
    }
    if at.y < 0.55 {
        return vec3(0.36, 0.34, 0.32) + 0.05 * noise(at, 0.25, seed ^ 2, footprint);
    }
    if (at.y - 4.0).abs() < 0.14 {
        return Vec3::splat(0.74);
    }
    // the opening of this bay: left, right (share of the bay), bottom, top (metres above the floor)
    let (left, right, bottom, lintel) = match (shop, tower) {
        (true, _) => (0.06, 0.94, 0.55, 3.1),
        (_, true) => (0.08, 0.92, 0.8, 2.8),
        _ if ground_floor => (0.25, 0.75, 1.1, 3.0),
        _ => (0.24 + 0.06 * pick(seed, 13), 0.76 - 0.06 * pick(seed, 13), 0.85, 2.55),
    };
    let door = ground_floor && !shop && bay == (bays * pick(seed, 14)) as u32;
    let bottom = if door { 0.0 } else { bottom };
    let edge = ((u - left).min(right - u) * bay_width).min(v - bottom).min(lintel - v);
    if edge < 0.0 {
        let sill = (bottom - v).clamp(0.0, 1.0) < 0.16 && v < bottom && edge > -0.16;
        let shop_sign = shop && v > 3.2 && v < 3.75;
        let grime =
            0.06 * noise(at * Vec2::new(1.0, 0.25), 1.1, seed ^ 3, footprint) - 0.05 * (1.0 - at.y / 2.5).max(0.0);
        return match () {
            _ if shop_sign => shop_board(seed, at.x, footprint),
            _ if sill => Vec3::splat(0.83),
            _ => wall + grime,
        };
    }
    let wood = palette(seed ^ 31, &[[0.9, 0.9, 0.87], [0.32, 0.22, 0.16], [0.16, 0.3, 0.26], [0.88, 0.86, 0.8]]);
    if door {
        let leaf = palette(seed ^ 32, &[[0.35, 0.16, 0.1], [0.12, 0.25, 0.3], [0.2, 0.3, 0.16]]);
        return if v > 2.3 { vec3(0.2, 0.24, 0.28) } else { leaf * (1.0 - 0.25 * stripes(at.x, 0.5, 0.1, footprint)) };
    }
    let mullion = (u - 0.5 * (left + right)).abs() * bay_width < 0.05;
    let transom = !tower && !shop && (v - (bottom + 0.68 * (lintel - bottom))).abs() < 0.05;
    if edge < 0.09 || ((mullion || transom) && !shop) {
        return wood;
    }
    let window = hash(seed, bay, floor);
    let upward = (v - bottom) / storey;
    let glass = vec3(0.12, 0.16, 0.2) + vec3(0.12, 0.17, 0.22) * upward + 0.1 * pick(window, 1);
    let blind_to = lintel - (lintel - bottom) * pick(window, 2);
    if !shop && pick(window, 3) < 0.55 && v > blind_to {
        let cloth = palette(window, &[[0.82, 0.8, 0.74], [0.7, 0.68, 0.66], [0.76, 0.6, 0.46], [0.85, 0.84, 0.82]]);
        return cloth * (0.9 - 0.12 * stripes(v, 0.22, 0.05, footprint));
    }
    if shop {
        let goods = noise(at, 0.45, window, footprint).max(0.0) * (1.0 - upward * 1.3).max(0.0);
        return glass * 0.8 + goods * palette(window, &[[1.3, 0.9, 0.3], [0.4, 0.9, 1.2], [1.2, 0.4, 0.4]]);
    }
    glass
}

fn brick(seed: u32, at: Vec2, footprint: f32) -> Vec3 {
    let (length, height) = (0.5, 0.19);
    let row = (at.y / height).floor();
    let shifted = at.x + 0.25 * (row % 2.0);
    let tint = palette(
        seed,
        &[[0.62, 0.3, 0.22], [0.55, 0.36, 0.26], [0.66, 0.42, 0.28], [0.47, 0.26, 0.22], [0.68, 0.6, 0.46]],
    );
    let one = unit(hash(seed, (shifted / length).floor() as i32 as u32, row as i32 as u32)) - 0.5;
    let joints = stripes(at.y, height, 0.03, footprint).max(stripes(shifted, length, 0.03, footprint));
    (tint * (1.0 + 0.32 * one * fade(length, footprint))).lerp(vec3(0.7, 0.66, 0.6), 0.7 * joints)
}

fn roof_tiles(seed: u32, point: Vec3, normal: Vec3, footprint: f32) -> Vec3 {
    let tint = palette(
        seed,
        &[[0.62, 0.29, 0.19], [0.52, 0.26, 0.19], [0.3, 0.31, 0.35], [0.68, 0.38, 0.22], [0.4, 0.26, 0.22]],
    );
    if normal.z < 0.2 {
        // a gable's triangle
        return vec3(0.78, 0.72, 0.62) + 0.06 * noise(Vec2::new(point.x + point.y, point.z), 0.4, seed, footprint);
    }
    let along = if normal.y.abs() > normal.x.abs() { point.x } else { point.y };
    let row = (point.z / 0.16).floor();
    let one = unit(hash(seed, (along / 0.4 + 0.5 * (row % 2.0)).floor() as i32 as u32, row as i32 as u32)) - 0.5;
    let shade = 0.22 * one * fade(0.4, footprint) - 0.3 * stripes(point.z, 0.16, 0.04, footprint);
    tint * (1.0 + shade) + stains(point.truncate(), seed)
}

fn carriageway(seed: u32, p: Vec2, side: f32, along: f32, footprint: f32) -> Vec3 {
    // asphalt in lots of different age, with repairs
    let lot = (p / 9.0).floor().as_ivec2();
    let repair = unit(hash(seed ^ 41, lot.x as u32, lot.y as u32));
    let offset = p - lot.as_vec2() * 9.0 - 1.0;
    let is_repair =
        repair < 0.3 && offset.cmpgt(Vec2::ZERO).all() && offset.cmplt(Vec2::new(5.0, 2.0 + 12.0 * repair)).all();
    let mut tone = if is_repair { 0.29 } else { 0.36 };
    tone += 0.07 * noise(p, 0.16, seed ^ 42, footprint) + 0.05 * noise(p, 0.6, seed ^ 43, footprint);
    let asphalt = Vec3::splat(tone) + stains(p, seed ^ 44);
    let manhole = (p - (lot.as_vec2() * 9.0 + 4.0 + 3.0 * repair)).length();
    if repair > 0.75 && manhole < 0.45 {
        return Vec3::splat(if manhole > 0.36 { 0.5 } else { 0.22 });
    }
    let (across, away) = (side.abs(), along.abs());
    let junction = HALF_ROAD + PAVEMENT;
    let paint = if away < HALF_ROAD {
        0.0
    } else if away < junction + 1.0 {
        // zebra crossing
        if away > HALF_ROAD + 0.5 { stripes(side + 0.25, 1.0, 0.5, footprint) } else { 0.0 }
    } else if away < junction + 2.0 {
        if away > junction + 1.5 { 1.0 } else { 0.0 }
    } else {
        let dashes = stripes(along, 6.0, 3.0, footprint) * if across < 0.11 { 1.0 } else { 0.0 };
        let bays = stripes(along, 6.0, 0.12, footprint) * if across > 3.0 { 1.0 } else { 0.0 };
        let edge = if (across - 3.0).abs() < 0.06 { 1.0 } else { 0.0 };
        dashes.max(bays).max(edge)
    };
    let worn = 0.85 + 0.3 * noise(p, 0.3, seed ^ 45, footprint);
    asphalt.lerp(Vec3::splat(0.88), (paint * worn).clamp(0.0, 1.0))
}

fn lawn(seed: u32, p: Vec2, footprint: f32) -> Vec3 {
    let blades = noise(p, 0.18, seed, footprint) + noise(p, 0.7, seed ^ 1, footprint);
    vec3(0.32, 0.44, 0.18) * (1.0 + 0.28 * blades) + vec3(0.09, 0.05, 0.0) * noise(p, 5.0, seed ^ 2, footprint)
}

fn field(seed: u32, p: Vec2, footprint: f32) -> Vec3 {
    let lot = (p / 60.0).floor().as_ivec2();
    let crop = palette(
        hash(seed ^ 51, lot.x as u32, lot.y as u32),
        &[[0.42, 0.5, 0.22], [0.6, 0.56, 0.3], [0.34, 0.46, 0.2], [0.5, 0.4, 0.27]],
    );
    let furrows = stripes(p.x + 0.2 * p.y, 2.0, 0.8, footprint);
    crop * (1.0 - 0.12 * furrows
        + 0.15 * noise(p, 1.2, seed ^ 52, footprint)
        + 0.15 * noise(p, 9.0, seed ^ 53, footprint))
}

fn car_paint(seed: u32) -> Vec3 {
    palette(
        seed,
        &[
            [0.75, 0.1, 0.1],
            [0.12, 0.2, 0.5],
            [0.86, 0.86, 0.86],
            [0.12, 0.12, 0.13],
            [0.55, 0.57, 0.6],
            [0.9, 0.7, 0.1],
            [0.1, 0.4, 0.3],
        ],
    )
}

fn shop_board(seed: u32, along: f32, footprint: f32) -> Vec3 {
    let board = palette(
        seed ^ 33,
        &[[0.1, 0.25, 0.45], [0.5, 0.1, 0.12], [0.1, 0.32, 0.2], [0.2, 0.18, 0.17], [0.85, 0.65, 0.2]],
    );
    let letter = unit(hash(seed, (along / 0.4).floor() as i32 as u32, 34)) > 0.4;
    if letter { board.lerp(Vec3::splat(0.95), stripes(along, 0.4, 0.22, footprint)) } else { board }
}

/// Soft blotches of several metres, visible from the air.
fn stains(p: Vec2, seed: u32) -> Vec3 {
    Vec3::splat(0.05 * noise(p, 2.7, seed ^ 61, 0.0) + 0.04 * noise(p, 9.0, seed ^ 62, 0.0))
}

/// Tells the four walls of a house apart.
fn face(normal: Vec3) -> u32 {
    let side = normal.x.abs() > 0.5;
    hash(u32::from(side), u32::from(normal.x + normal.y > 0.0), 71)
}

/// A number in [0, 1) of this seed.
fn pick(seed: u32, which: u32) -> f32 {
    unit(hash(seed, which, 81))
}

fn palette(seed: u32, colours: &[[f32; 3]]) -> Vec3 {
    let tone = 0.92 + 0.16 * pick(seed, 92);
    Vec3::from(colours[(pick(seed, 91) * colours.len() as f32) as usize]) * tone
}

/// The share of a pixel that lies on stripes of this width, one per period.
fn stripes(x: f32, period: f32, width: f32, footprint: f32) -> f32 {
    let covered = |x: f32| {
        let n = (x / period).floor();
        n * width + (x - n * period).min(width)
    };
    let span = footprint.max(0.01);
    ((covered(x + 0.5 * span) - covered(x - 0.5 * span)) / span).clamp(0.0, 1.0)
}

/// Smooth noise in about -1..1 with features of this size, which vanishes where a pixel is larger.
fn noise(p: Vec2, feature: f32, seed: u32, footprint: f32) -> f32 {
    let strength = fade(feature, footprint);
    if strength <= 0.0 {
        return 0.0;
    }
    let q = p / feature;
    let cell = q.floor();
    let t = q - cell;
    let t = t * t * (3.0 - 2.0 * t);
    let (x, y) = (cell.x as i32 as u32, cell.y as i32 as u32);
    let corner = |i: u32, j: u32| unit(hash(seed, x.wrapping_add(i), y.wrapping_add(j)));
    let low = corner(0, 0) + t.x * (corner(1, 0) - corner(0, 0));
    let high = corner(0, 1) + t.x * (corner(1, 1) - corner(0, 1));
    strength * (2.0 * (low + t.y * (high - low)) - 1.0)
}

/// 1 where a pixel is much smaller than a pattern's period, 0 where it is larger.
fn fade(period: f32, footprint: f32) -> f32 {
    (1.5 - 1.5 * footprint / period).clamp(0.0, 1.0)
}
