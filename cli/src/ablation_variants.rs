//! The variants of the training recipe that `plat bench ablate` compares. Each removes one acceleration, or adds one that is off by
//! default.

use train::Recipe;
use train::growth::Growth;

/// A variant of the recipe.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Variant {
    /// Its name in result lines.
    pub(crate) name: &'static str,
    /// What it changes, with the source of the technique.
    pub(crate) about: &'static str,
    /// Changes the default recipe into this variant.
    pub(crate) recipe: fn(Recipe) -> Recipe,
}

/// The variant that the others are compared with.
pub(crate) const DEFAULT: &str = "default";

/// All variants.
pub(crate) const VARIANTS: [Variant; 7] = [
    Variant { name: DEFAULT, about: "the default recipe", recipe: |recipe| recipe },
    Variant {
        name: "fine",
        about: "full resolution from the first step: without coarse-to-fine resolution (DashGaussian, Chen et al. 2025)",
        recipe: |recipe| Recipe { coarse: Vec::new(), ..recipe },
    },
    Variant {
        name: "by-the-clock",
        about: "finer resolution after fixed shares of the steps instead of by the error (train/src/coarse_to_fine.rs)",
        recipe: |recipe| Recipe { detail_factor: 0.0, ..recipe },
    },
    Variant {
        name: "all-at-once",
        about: "densification within a tenth of the steps, doubling each time: without a growth schedule (Taming 3DGS, Mallick et al. 2024)",
        recipe: |recipe| {
            // The early end is tuned for a long growth and would only cut this one short.
            let growth = Growth { from: 0.0, until: 0.1, max_growth_share: 1.0, worth_db: 0.0, ..recipe.growth };
            Recipe { growth, ..recipe }
        },
    },
    Variant {
        name: "all-colours",
        about: "SH degree 3 from the first step: without raising the degree during training (3DGS, Kerbl et al. 2023)",
        recipe: |recipe| Recipe { sh_from: [0.0; 3], ..recipe },
    },
    Variant {
        name: "all-growth",
        about: "growth to the whole budget: without its early end (train/src/coarse_to_fine.rs)",
        recipe: |recipe| Recipe { growth: Growth { worth_db: 0.0, ..recipe.growth }, ..recipe },
    },
    Variant {
        name: "four-views",
        about: "four windows per optimiser step, which fill a large GPU (--views-per-step; gsplat, Ye et al. 2025)",
        recipe: |recipe| Recipe { views_per_step: 4, ..recipe },
    },
];

/// The variant of this name.
pub(crate) fn named(name: &str) -> Result<Variant, String> {
    let names = || VARIANTS.map(|variant| variant.name).join(", ");
    VARIANTS.into_iter().find(|variant| variant.name == name).ok_or_else(|| format!("give one of {}", names()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_variant_has_a_name_of_its_own_and_changes_the_recipe() {
        let recipes: Vec<Recipe> = VARIANTS.iter().map(|variant| (variant.recipe)(Recipe::default())).collect();
        for (i, variant) in VARIANTS.iter().enumerate() {
            assert_eq!(named(variant.name).unwrap().about, variant.about);
            assert!(recipes[..i].iter().all(|before| *before != recipes[i]), "{} is another", variant.name);
        }
        assert_eq!(recipes[0], Recipe::default());
        assert!(named("fast").unwrap_err().contains("all-at-once"));
    }
}
