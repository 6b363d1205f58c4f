//! The table of materials, the same for all cities.
//!
//! Base colours are linear RGB. Reflectivities are for 905 nm at normal incidence, as lidar makers state their ranges
//! by: dark asphalt about 0.1 to 0.2, concrete 0.3 to 0.45, brick 0.3 to 0.4, white render and paint 0.6 to 0.85,
//! foliage 0.45 to 0.6 (near infrared plateau of chlorophyll), dark car paint 0.05 to 0.15, light car paint 0.5 to 0.7,
//! tyres 0.04, clear glass under 0.1, retroreflective sheeting at the top of the scale (see the ECOSTRESS spectral
//! library, Meerdink et al. 2019, for the shapes of such spectra). They are plausible, not measured.

use glam::{Vec2, Vec3};

use crate::random::Random;
use crate::types::{Material, Pattern};

/// A row of the table of materials.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Surface(pub(crate) u16);

macro_rules! surfaces {
    ($($name:ident, $label:literal, [$r:literal, $g:literal, $b:literal], $rough:literal, $metal:literal, $lidar:literal, $pattern:expr;)+) => {
        #[repr(u16)]
        #[derive(Clone, Copy)]
        #[allow(clippy::upper_case_acronyms, non_camel_case_types)]
        enum Rows { $($name),+ }
        $(pub(crate) const $name: Surface = Surface(Rows::$name as u16);)+

        /// All materials without texts.
        fn rows() -> Vec<Material> {
            vec![$(Material {
                name: $label.to_owned(),
                base_colour: Vec3::new($r, $g, $b),
                roughness: $rough,
                metallic: $metal,
                transparency: if is_glass($name) { 0.7 } else { 0.0 },
                lidar_reflectivity: $lidar,
                pattern: $pattern,
            }),+]
        }
    };
}

const PLAIN: Pattern = Pattern::Plain;

const fn noise(finest_metres: f32, coarsest_metres: f32, amount: f32) -> Pattern {
    Pattern::Noise { finest_metres, coarsest_metres, amount }
}

const fn bricks(length: f32, height: f32, joint_metres: f32, joint_shade: f32, bond: bool, amount: f32) -> Pattern {
    Pattern::Bricks { size_metres: Vec2::new(length, height), joint_metres, joint_shade, bond, amount }
}

const fn panels(width_metres: f32, joint_metres: f32, amount: f32) -> Pattern {
    Pattern::Panels { width_metres, joint_metres, amount }
}

surfaces! {
    ASPHALT, "asphalt", [0.085, 0.085, 0.09], 0.9, 0.0, 0.15, noise(0.012, 4.0, 0.55);
    ASPHALT_FRESH, "asphalt, freshly laid", [0.030, 0.030, 0.032], 0.8, 0.0, 0.09, PLAIN;
    ASPHALT_PATCH, "asphalt, patch", [0.05, 0.05, 0.052], 0.85, 0.0, 0.12, noise(0.02, 0.8, 0.35);
    COBBLES, "cobbles", [0.17, 0.155, 0.14], 0.8, 0.0, 0.25, bricks(0.16, 0.12, 0.015, 0.4, true, 0.5);
    SLABS, "paving slabs", [0.36, 0.345, 0.32], 0.85, 0.0, 0.35, bricks(0.45, 0.45, 0.012, 0.5, false, 0.2);
    PAVERS, "clay pavers", [0.34, 0.19, 0.14], 0.85, 0.0, 0.3, bricks(0.2, 0.1, 0.006, 0.5, true, 0.35);
    CURB, "curb stone", [0.42, 0.41, 0.39], 0.8, 0.0, 0.38, panels(1.0, 0.01, 0.2);
    CONCRETE, "concrete", [0.40, 0.39, 0.37], 0.85, 0.0, 0.4, noise(0.02, 2.5, 0.3);
    CONCRETE_SMOOTH, "concrete, smooth", [0.5, 0.5, 0.49], 0.7, 0.0, 0.42, PLAIN;
    LAWN, "lawn", [0.095, 0.18, 0.045], 0.95, 0.0, 0.45, noise(0.01, 3.0, 0.6);
    MEADOW, "meadow", [0.16, 0.19, 0.07], 0.95, 0.0, 0.42, noise(0.02, 12.0, 0.4);
    PASTURE, "pasture, grazed bare", [0.19, 0.2, 0.09], 0.95, 0.0, 0.42, noise(0.05, 12.0, 0.1);
    SOIL, "soil", [0.16, 0.11, 0.07], 0.95, 0.0, 0.3, noise(0.01, 1.0, 0.5);
    GRAVEL, "gravel", [0.36, 0.33, 0.28], 0.95, 0.0, 0.32, noise(0.01, 0.6, 0.6);
    PAINT_WHITE, "road paint, white", [0.8, 0.8, 0.78], 0.6, 0.0, 0.8, noise(0.02, 0.5, 0.2);
    PAINT_YELLOW, "road paint, yellow", [0.75, 0.5, 0.06], 0.6, 0.0, 0.7, noise(0.02, 0.5, 0.2);
    BRICK_RED, "brick, red", [0.36, 0.13, 0.085], 0.9, 0.0, 0.33, bricks(0.25, 0.077, 0.011, 1.6, true, 0.45);
    BRICK_BROWN, "brick, brown", [0.21, 0.12, 0.08], 0.9, 0.0, 0.28, bricks(0.25, 0.077, 0.011, 1.5, true, 0.45);
    BRICK_YELLOW, "brick, yellow", [0.55, 0.43, 0.25], 0.9, 0.0, 0.42, bricks(0.25, 0.077, 0.011, 0.7, true, 0.35);
    RENDER_WHITE, "render, white", [0.82, 0.81, 0.79], 0.9, 0.0, 0.75, PLAIN;
    RENDER_CREAM, "render, cream", [0.74, 0.63, 0.43], 0.9, 0.0, 0.65, noise(0.015, 3.0, 0.16);
    RENDER_GREY, "render, grey", [0.42, 0.43, 0.43], 0.9, 0.0, 0.45, noise(0.012, 4.0, 0.25);
    RENDER_OCHRE, "render, ochre", [0.64, 0.38, 0.14], 0.9, 0.0, 0.5, noise(0.012, 2.5, 0.3);
    RENDER_ROSE, "render, rose", [0.66, 0.37, 0.31], 0.9, 0.0, 0.55, noise(0.012, 2.5, 0.25);
    RENDER_GREEN, "render, green", [0.35, 0.46, 0.34], 0.9, 0.0, 0.5, noise(0.012, 2.5, 0.25);
    RENDER_BLUE, "render, blue", [0.3, 0.41, 0.53], 0.9, 0.0, 0.5, PLAIN;
    STONE, "sandstone blocks", [0.5, 0.43, 0.32], 0.9, 0.0, 0.42, bricks(0.8, 0.4, 0.012, 0.55, true, 0.25);
    PLINTH, "plinth", [0.25, 0.24, 0.23], 0.9, 0.0, 0.28, noise(0.02, 0.6, 0.4);
    CLADDING, "metal cladding", [0.42, 0.46, 0.5], 0.4, 0.7, 0.45, panels(0.6, 0.015, 0.1);
    TIMBER, "timber", [0.31, 0.19, 0.1], 0.8, 0.0, 0.4, panels(0.14, 0.006, 0.35);
    TILES_RED, "roof tiles, red", [0.4, 0.14, 0.075], 0.85, 0.0, 0.32, bricks(0.24, 0.33, 0.02, 0.45, true, 0.4);
    TILES_DARK, "roof tiles, dark", [0.1, 0.1, 0.105], 0.8, 0.0, 0.14, bricks(0.24, 0.33, 0.02, 0.5, true, 0.35);
    SLATE, "slate", [0.14, 0.155, 0.175], 0.6, 0.0, 0.16, bricks(0.3, 0.2, 0.008, 0.5, true, 0.3);
    ROOFING, "roofing felt", [0.15, 0.15, 0.15], 0.9, 0.0, 0.12, panels(1.0, 0.02, 0.2);
    ZINC, "zinc sheet", [0.5, 0.52, 0.54], 0.45, 0.8, 0.4, panels(0.5, 0.012, 0.08);
    GLASS, "window glass", [0.55, 0.62, 0.62], 0.05, 0.0, 0.08, PLAIN;
    GLASS_DARK, "glass, tinted", [0.1, 0.13, 0.14], 0.05, 0.0, 0.06, PLAIN;
    FRAME_WHITE, "window frame, white", [0.8, 0.8, 0.8], 0.5, 0.0, 0.7, PLAIN;
    FRAME_DARK, "window frame, dark", [0.06, 0.055, 0.05], 0.5, 0.0, 0.15, PLAIN;
    CURTAIN, "curtain", [0.62, 0.57, 0.47], 0.95, 0.0, 0.55, panels(0.11, 0.03, 0.3);
    ROOM_DARK, "room, dark", [0.06, 0.05, 0.045], 0.95, 0.0, 0.3, noise(0.05, 0.8, 0.5);
    ROOM_WARM, "room, lit", [0.55, 0.4, 0.22], 0.95, 0.0, 0.5, noise(0.1, 1.2, 0.5);
    GOODS, "shop shelves", [0.45, 0.3, 0.25], 0.9, 0.0, 0.45, bricks(0.34, 0.42, 0.05, 0.2, false, 0.9);
    DOOR_GREEN, "door, green", [0.05, 0.16, 0.1], 0.5, 0.0, 0.25, panels(0.3, 0.012, 0.1);
    DOOR_RED, "door, red", [0.35, 0.05, 0.04], 0.5, 0.0, 0.3, panels(0.3, 0.012, 0.1);
    STEEL, "steel, galvanised", [0.45, 0.46, 0.47], 0.45, 0.9, 0.45, noise(0.02, 0.3, 0.12);
    IRON, "iron, painted dark", [0.04, 0.045, 0.045], 0.5, 0.3, 0.12, PLAIN;
    AWNING_RED, "awning, striped", [0.55, 0.08, 0.07], 0.9, 0.0, 0.5, panels(0.22, 0.11, 0.1);
    BARK, "bark", [0.13, 0.095, 0.065], 0.95, 0.0, 0.3, noise(0.012, 0.3, 0.7);
    BARK_BIRCH, "bark, birch", [0.6, 0.58, 0.53], 0.9, 0.0, 0.45, noise(0.02, 0.25, 0.6);
    LEAVES, "leaves", [0.09, 0.19, 0.035], 0.8, 0.0, 0.5, noise(0.03, 0.7, 0.65);
    LEAVES_LIGHT, "leaves, light", [0.18, 0.29, 0.06], 0.8, 0.0, 0.55, noise(0.03, 0.7, 0.6);
    LEAVES_DARK, "needles", [0.035, 0.09, 0.035], 0.85, 0.0, 0.4, noise(0.02, 0.5, 0.65);
    LEAVES_RED, "leaves, copper", [0.22, 0.055, 0.045], 0.8, 0.0, 0.5, noise(0.03, 0.7, 0.6);
    HEDGE, "hedge", [0.065, 0.15, 0.035], 0.9, 0.0, 0.48, noise(0.02, 0.4, 0.75);
    TYRE, "tyre", [0.02, 0.02, 0.02], 0.9, 0.0, 0.04, PLAIN;
    RIM, "wheel rim", [0.5, 0.5, 0.52], 0.35, 0.9, 0.5, PLAIN;
    TRIM, "black plastic", [0.025, 0.025, 0.027], 0.6, 0.0, 0.06, PLAIN;
    LAMP_WHITE, "head lamp", [0.85, 0.86, 0.85], 0.15, 0.0, 0.6, PLAIN;
    LAMP_RED, "tail lamp", [0.5, 0.02, 0.02], 0.2, 0.0, 0.55, PLAIN;
    LAMP_AMBER, "lamp, amber", [0.8, 0.35, 0.02], 0.3, 0.0, 0.5, PLAIN;
    LAMP_GREEN, "lamp, green", [0.03, 0.6, 0.25], 0.3, 0.0, 0.4, PLAIN;
    CAR_WHITE, "car paint, white", [0.8, 0.8, 0.8], 0.25, 0.0, 0.65, PLAIN;
    CAR_SILVER, "car paint, silver", [0.48, 0.5, 0.52], 0.3, 0.6, 0.5, PLAIN;
    CAR_BLACK, "car paint, black", [0.015, 0.015, 0.018], 0.2, 0.0, 0.06, PLAIN;
    CAR_RED, "car paint, red", [0.45, 0.025, 0.02], 0.25, 0.0, 0.4, PLAIN;
    CAR_BLUE, "car paint, blue", [0.03, 0.08, 0.3], 0.25, 0.0, 0.2, PLAIN;
    CAR_GREEN, "car paint, green", [0.04, 0.14, 0.09], 0.25, 0.0, 0.2, PLAIN;
    CAR_YELLOW, "car paint, yellow", [0.75, 0.47, 0.03], 0.25, 0.0, 0.6, PLAIN;
    CANVAS, "lorry canvas", [0.55, 0.57, 0.6], 0.8, 0.0, 0.5, panels(0.9, 0.02, 0.12);
    SKIN_LIGHT, "skin, light", [0.65, 0.42, 0.32], 0.7, 0.0, 0.6, PLAIN;
    SKIN_DARK, "skin, dark", [0.22, 0.12, 0.075], 0.7, 0.0, 0.5, PLAIN;
    HAIR, "hair", [0.05, 0.032, 0.02], 0.8, 0.0, 0.2, noise(0.01, 0.06, 0.4);
    CLOTH_BLUE, "cloth, blue", [0.05, 0.1, 0.28], 0.95, 0.0, 0.4, noise(0.01, 0.2, 0.25);
    CLOTH_RED, "cloth, red", [0.45, 0.05, 0.06], 0.95, 0.0, 0.45, noise(0.01, 0.2, 0.25);
    CLOTH_GREY, "cloth, grey", [0.2, 0.2, 0.21], 0.95, 0.0, 0.4, noise(0.01, 0.15, 0.3);
    CLOTH_BEIGE, "cloth, beige", [0.55, 0.45, 0.31], 0.95, 0.0, 0.5, bricks(0.09, 0.09, 0.012, 0.6, false, 0.1);
    CLOTH_GREEN, "cloth, green", [0.1, 0.25, 0.13], 0.95, 0.0, 0.4, panels(0.07, 0.02, 0.1);
    CLOTH_WHITE, "cloth, white", [0.75, 0.75, 0.73], 0.95, 0.0, 0.65, PLAIN;
    DENIM, "denim", [0.07, 0.1, 0.17], 0.95, 0.0, 0.35, noise(0.01, 0.1, 0.35);
    CLOTH_BLACK, "cloth, black", [0.02, 0.02, 0.022], 0.95, 0.0, 0.15, PLAIN;
    LEATHER, "leather", [0.09, 0.05, 0.03], 0.7, 0.0, 0.25, PLAIN;
    SIGN_WHITE, "sheeting, white", [0.85, 0.85, 0.85], 0.4, 0.0, 0.95, PLAIN;
    SIGN_RED, "sheeting, red", [0.6, 0.02, 0.03], 0.4, 0.0, 0.9, PLAIN;
    SIGN_BLUE, "sheeting, blue", [0.02, 0.1, 0.45], 0.4, 0.0, 0.85, PLAIN;
    PLASTIC_GREEN, "plastic, green", [0.04, 0.2, 0.1], 0.6, 0.0, 0.3, PLAIN;
    PLASTIC_RED, "plastic, red", [0.5, 0.04, 0.03], 0.5, 0.0, 0.4, PLAIN;
}

const fn is_glass(surface: Surface) -> bool {
    surface.0 == GLASS.0
}

/// First row of the materials with texts.
const FIRST_TEXT: u16 = PLASTIC_RED.0 + 1;

/// A sign: text, ink colour, ground colour.
type SignText = (&'static str, [f32; 3], [f32; 3]);

const WHITE: [f32; 3] = [0.85, 0.85, 0.83];
const BLACK: [f32; 3] = [0.02, 0.02, 0.02];
const BLUE: [f32; 3] = [0.02, 0.09, 0.38];
const GREEN: [f32; 3] = [0.02, 0.16, 0.08];
const RED: [f32; 3] = [0.5, 0.02, 0.03];
const CREAM: [f32; 3] = [0.75, 0.65, 0.45];
const GOLD: [f32; 3] = [0.7, 0.45, 0.08];

/// Shop names.
const SHOPS: [SignText; 16] = [
    ("BAKERY", GOLD, [0.12, 0.06, 0.03]),
    ("CAFE LUNA", WHITE, GREEN),
    ("BOOKS & MAPS", BLACK, CREAM),
    ("PHARMACY", GREEN, WHITE),
    ("HOTEL PLAT", GOLD, BLACK),
    ("FLOWERS", RED, WHITE),
    ("KEBAB 24H", WHITE, RED),
    ("BICYCLES", BLACK, GOLD),
    ("SHOES", WHITE, BLACK),
    ("BANK", WHITE, BLUE),
    ("FISH & CHIPS", WHITE, BLUE),
    ("LAUNDRY", BLUE, WHITE),
    ("TAILOR", CREAM, [0.1, 0.02, 0.04]),
    ("OPTICS", BLACK, WHITE),
    ("WINE BAR", CREAM, [0.18, 0.01, 0.03]),
    ("RECORDS", RED, BLACK),
];
/// Street names.
const STREETS: [SignText; 12] = [
    ("LIME STREET", WHITE, BLUE),
    ("MILL LANE", WHITE, BLUE),
    ("STATION ROAD", WHITE, BLUE),
    ("HARBOUR STREET", WHITE, BLUE),
    ("QUARRY HILL", WHITE, BLUE),
    ("ORCHARD WAY", WHITE, BLUE),
    ("FERRY STREET", WHITE, BLUE),
    ("TOWER ROW", WHITE, BLUE),
    ("CANAL STREET", WHITE, BLUE),
    ("ROPEWALK", WHITE, BLUE),
    ("ABBEY GATE", WHITE, BLUE),
    ("FOUNDRY LANE", WHITE, BLUE),
];
/// Traffic signs.
const TRAFFIC_SIGNS: [SignText; 6] = [
    ("STOP", WHITE, RED),
    ("30", BLACK, WHITE),
    ("50", BLACK, WHITE),
    ("P", WHITE, BLUE),
    ("BUS", BLACK, GOLD),
    ("TAXI", BLACK, GOLD),
];
/// Number plates.
const PLATES: [SignText; 4] =
    [("PL 4711", BLACK, WHITE), ("AT 2026", BLACK, WHITE), ("GS 3141", BLACK, WHITE), ("KX 1618", BLACK, WHITE)];
/// Bus routes and advertisements.
const POSTERS: [SignText; 6] = [
    ("12 CENTRAL", GOLD, BLACK),
    ("42 HARBOUR", GOLD, BLACK),
    ("CIRCUS!", RED, CREAM),
    ("SALE -50%", WHITE, RED),
    ("VOTE", WHITE, BLUE),
    ("JAZZ FRIDAY", GOLD, [0.08, 0.03, 0.2]),
];

fn sign_texts() -> impl Iterator<Item = SignText> {
    SHOPS.into_iter().chain(STREETS).chain(TRAFFIC_SIGNS).chain(PLATES).chain(POSTERS)
}

fn text(group: usize, k: usize) -> Surface {
    Surface(FIRST_TEXT + (group + k) as u16)
}

pub(crate) fn shop_name(random: &mut Random) -> Surface {
    text(0, random.below(SHOPS.len()))
}

/// All street name plates.
pub(crate) fn street_names() -> impl Iterator<Item = Surface> {
    (0..STREETS.len()).map(|k| text(SHOPS.len(), k))
}

/// 0 stop, 1 thirty, 2 fifty, 3 parking, 4 bus, 5 taxi.
pub(crate) fn traffic_sign(k: usize) -> Surface {
    text(SHOPS.len() + STREETS.len(), k.min(TRAFFIC_SIGNS.len() - 1))
}

pub(crate) fn number_plate(random: &mut Random) -> Surface {
    text(SHOPS.len() + STREETS.len() + TRAFFIC_SIGNS.len(), random.below(PLATES.len()))
}

/// 0 and 1 are bus routes, the others advertisements.
pub(crate) fn poster(k: usize) -> Surface {
    text(SHOPS.len() + STREETS.len() + TRAFFIC_SIGNS.len() + PLATES.len(), k.min(POSTERS.len() - 1))
}

/// The table of materials and the texts of signs.
pub(crate) fn table() -> (Vec<Material>, Vec<String>) {
    let mut materials = rows();
    let texts: Vec<String> = sign_texts().map(|(text, ..)| text.to_owned()).collect();
    materials.extend(sign_texts().enumerate().map(|(row, (text, ink, ground))| Material {
        name: format!("sign, {text}"),
        base_colour: Vec3::from(ground),
        roughness: 0.45,
        metallic: 0.0,
        transparency: 0.0,
        lidar_reflectivity: 0.8,
        pattern: Pattern::Text { row: row as u32, ink: Vec3::from(ink) },
    }));
    (materials, texts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn material_values_are_in_range_and_texts_match_their_rows() {
        let (materials, texts) = table();
        assert_eq!(materials.len(), usize::from(FIRST_TEXT) + texts.len());
        for material in &materials {
            let shares = material.base_colour.to_array().into_iter().chain([
                material.roughness,
                material.metallic,
                material.transparency,
                material.lidar_reflectivity,
            ]);
            assert!(shares.into_iter().all(|x| (0.0..=1.0).contains(&x)), "{material:?}");
            if let Pattern::Text { row, .. } = material.pattern {
                assert_eq!(material.name, format!("sign, {}", texts[row as usize]));
            }
        }
        let named = |s: Surface| materials[usize::from(s.0)].name.clone();
        assert_eq!(
            [named(traffic_sign(0)), named(poster(5)), named(GLASS)],
            ["sign, STOP", "sign, JAZZ FRIDAY", "window glass"]
        );
        assert_eq!(street_names().map(named).next().unwrap(), "sign, LIME STREET");
        assert_eq!(materials.iter().filter(|m| m.transparency > 0.0).count(), 1);
        assert!(materials.iter().filter(|m| m.pattern == Pattern::Plain).count() > 10);
    }
}
