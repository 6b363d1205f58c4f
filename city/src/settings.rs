//! The settings that a city is generated from.

use std::fmt;
use std::str::FromStr;

use scene::BadInput;
use serde::{Deserialize, Serialize};

/// Cities below this area are compact, km².
const COMPACT_BELOW_KM2: f64 = 0.05;
/// Smallest width from the edge of the plain to the east edge, metres: one block of houses and its roads.
const MIN_BUILT_METRES: f64 = 44.0;

/// Settings of a city. The city is a function of them alone.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CitySettings {
    /// Seed of all random numbers.
    pub seed: u64,
    /// Area of the square city, km²: 0.005 to 25. Below 0.05 the city is **compact**, see
    /// [`is_compact`](Self::is_compact).
    pub area_km2: f64,
    /// Street layout.
    pub layout: Layout,
    /// Amount of moving vehicles and pedestrians.
    pub traffic: Traffic,
    /// Share of the city, from its west edge, that is a bare plain: 0 to 0.8.
    pub plain: f64,
}

impl Default for CitySettings {
    fn default() -> Self {
        Self { seed: 1, area_km2: 0.05, layout: Layout::Mixed, traffic: Traffic::Medium, plain: 0.0 }
    }
}

impl CitySettings {
    /// Side of the square city, metres.
    pub fn extent_metres(&self) -> f64 {
        1000.0 * self.area_km2.sqrt()
    }

    /// Whether the city is under 0.05 km² (224 m square).
    ///
    /// A larger city is a ring of streets around at least two rows of blocks: generated traffic drives around the first
    /// row, camera cars drive around the second. Two rows of ordinary blocks between ordinary streets need 200 m. A
    /// compact city keeps the two rows, and with them one street that has houses on both sides. It saves space at its
    /// edge: the outer roads are back lanes of 7.6 m between the fronts, and small houses stand along them. At 0.005
    /// km², 71 m square, there are 300 m of road in all: 60 m of street and back lanes on all four sides. A square is
    /// kept, and not a strip of 300 m, because 0.005 km² would be a strip of 17 m: the street alone, without a house. A
    /// camera car also drives around the whole city, so that photos show every road.
    ///
    /// Compact cities have no parks, squares or car parks, which could take the place of all houses. They have a deck
    /// only where its ramps fit, from about 0.02 km² on. A mixed city shows two layouts under 130 m of side, four
    /// above.
    pub fn is_compact(&self) -> bool {
        self.area_km2 < COMPACT_BELOW_KM2
    }

    /// Checks that every number is in its range.
    ///
    /// # Errors
    /// A setting is out of its range, in one line.
    pub fn check(&self) -> Result<(), BadInput> {
        let refuse = |what: &str, range: &str| Err(BadInput::new("city", format!("{what} is out of range"), range));
        match self {
            s if !(0.005..=25.0).contains(&s.area_km2) => refuse("its area", "choose 0.005 to 25 km²"),
            s if !(0.0..=0.8).contains(&s.plain) => refuse("the share of bare plain", "choose 0 to 0.8"),
            s if (1.0 - s.plain) * s.extent_metres() < MIN_BUILT_METRES => refuse(
                "the width that the bare plain leaves",
                "choose a smaller share of plain or a larger area: at least 44 m",
            ),
            _ => Ok(()),
        }
    }
}

/// Defines an enum whose values have kebab-case names.
macro_rules! named_enum {
    ($(#[$meta:meta])* $type:ident, $what:literal, { $($(#[$doc:meta])* $variant:ident = $name:literal),+ $(,)? }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
        #[serde(rename_all = "kebab-case")]
        pub enum $type { $($(#[$doc])* $variant),+ }

        impl $type {
            /// All values, in the order of declaration.
            pub const ALL: &'static [Self] = &[$(Self::$variant),+];

            /// The kebab-case name, as in command lines and files.
            pub fn name(self) -> &'static str {
                match self { $(Self::$variant => $name),+ }
            }
        }

        impl fmt::Display for $type {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(self.name())
            }
        }

        impl FromStr for $type {
            type Err = BadInput;

            fn from_str(text: &str) -> Result<Self, BadInput> {
                Self::ALL.iter().copied().find(|it| it.name() == text).ok_or_else(|| {
                    let names: Vec<_> = Self::ALL.iter().map(|it| it.name()).collect();
                    BadInput::new($what, format!("there is no {text:?}"), format!("choose {}", names.join(", ")))
                })
            }
        }
    };
}
pub(crate) use named_enum;

named_enum!(
    /// Street layouts: a plain grid, the four layouts that are hard to reconstruct (SDG, section 2.2), and all of them.
    Layout, "layout", {
        /// Streets at right angles.
        Grid = "grid",
        /// Long curved canyons between tall facades, few cross streets.
        CurvedCorridor = "curved-corridor",
        /// Passages of 3 to 5 m between houses, off narrow lanes.
        Alley = "alley",
        /// Curved streets on slopes, detached houses.
        Winding = "winding",
        /// A grid with a road on a deck over its boulevard, with guardrails, and raised platforms.
        Deck = "deck",
        /// Quarters of each kind, joined by streets.
        Mixed = "mixed",
    }
);

named_enum!(
    /// Traffic levels (CarlaOcc, supplement 1.1). Parked vehicles are the same at every level.
    Traffic, "traffic", {
        /// No moving vehicles or pedestrians.
        None = "none",
        /// Free driving.
        Light = "light",
        /// Ordinary traffic.
        Medium = "medium",
        /// Short distances, low and uneven speeds.
        Heavy = "heavy",
    }
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_round_trip() {
        for layout in Layout::ALL {
            assert_eq!(layout.to_string().parse::<Layout>().unwrap(), *layout);
        }
        for traffic in Traffic::ALL {
            assert_eq!(traffic.to_string().parse::<Traffic>().unwrap(), *traffic);
        }
        let refusal = "hexagonal".parse::<Layout>().unwrap_err().to_string();
        assert!(refusal.contains("curved-corridor") && !refusal.contains('\n'), "{refusal}");
    }

    #[test]
    fn settings_out_of_range_are_refused_in_one_line() {
        let wrong = [
            CitySettings { area_km2: 0.0049, ..Default::default() },
            CitySettings { area_km2: 0.005, plain: 0.5, ..Default::default() },
            CitySettings { area_km2: 25.1, ..Default::default() },
            CitySettings { area_km2: f64::NAN, ..Default::default() },
            CitySettings { area_km2: f64::INFINITY, ..Default::default() },
            CitySettings { plain: -0.1, ..Default::default() },
            CitySettings { plain: 0.81, ..Default::default() },
            CitySettings { plain: f64::NAN, ..Default::default() },
        ];
        for settings in wrong {
            let refusal = crate::City::generate(&settings).unwrap_err().to_string();
            assert!(refusal.contains("out of range") && !refusal.contains('\n'), "{refusal}");
        }
    }
}
