//! Options of the measurements that need a model block by block: cuts and seams.

use std::path::{Path, PathBuf};

use blocks::Plan;
use model::{Tree, read_tree};
use scene::BadInput;

use crate::cuts::CutRequest;

/// Levels of the tree.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Levels {
    /// Every level.
    All,
    /// This level.
    Only(u8),
}

/// What to measure besides the figures of each view.
#[derive(Debug, Clone, Default)]
pub struct DetailOptions {
    /// Measure the tree cut at these levels.
    pub levels: Option<Levels>,
    /// Measure what viewers draw within these budgets of splats.
    pub budgets: Vec<u32>,
    /// Measure the seams between the model's own blocks.
    pub seams: bool,
    /// Measure at the seams of this model instead, of the same capture.
    pub seams_of: Option<PathBuf>,
    /// Half width of the band at a seam, metres. Implies `seams` without `seams_of`.
    pub seam_metres: Option<f64>,
}

/// The trees that the options need, checked against them.
#[derive(Debug, Default)]
pub struct Details {
    /// The model's own tree, where cuts or its own seams are measured.
    pub(crate) own: Option<Tree>,
    pub(crate) cuts: Vec<CutRequest>,
    /// Whether the seams of `own` are measured.
    pub(crate) own_seams: bool,
    /// The tree of [`DetailOptions::seams_of`].
    pub(crate) other: Option<Tree>,
    pub(crate) seam_metres: Option<f64>,
    pub(crate) budgets: Vec<u32>,
}

impl Details {
    /// Reads the trees.
    ///
    /// # Errors
    /// A model without blocks, a level that the tree does not have, a tree without seams.
    pub fn read(model: &Path, options: &DetailOptions) -> Result<Self, BadInput> {
        let other = options.seams_of.as_deref().map(read_tree).transpose()?;
        let own_seams = options.seams || (options.seam_metres.is_some() && other.is_none());
        let needs_own = own_seams || options.levels.is_some();
        let own = needs_own.then(|| read_tree(model)).transpose()?;
        let cuts = own.as_ref().map_or(Ok(Vec::new()), |tree| cut_requests(options, &tree.plan))?;
        let budgets = options.budgets.clone();
        let details = Self { own, cuts, own_seams, other, seam_metres: options.seam_metres, budgets };
        if details.seam_tree().is_some_and(|tree| tree.plan.leaves().blocks().len() < 2) {
            let path = options.seams_of.as_deref().unwrap_or(model).display().to_string();
            let advice = "name a model of several blocks with --seams-of";
            return Err(BadInput::new(path, "is one block and has no seams", advice));
        }
        Ok(details)
    }

    /// The tree whose seams are measured.
    pub(crate) fn seam_tree(&self) -> Option<&Tree> {
        self.other.as_ref().or(self.own.as_ref().filter(|_| self.own_seams))
    }
}

fn cut_requests(options: &DetailOptions, plan: &Plan) -> Result<Vec<CutRequest>, BadInput> {
    let requests = match options.levels {
        None => Vec::new(),
        Some(Levels::All) => (0..=plan.levels).map(CutRequest::Level).collect(),
        Some(Levels::Only(level)) if level <= plan.levels => vec![CutRequest::Level(level)],
        Some(Levels::Only(level)) => {
            let problem = format!("{level} is not in the model, whose finest level is {}", plan.levels);
            return Err(BadInput::new("--level", problem, "give a level that it has, or all"));
        }
    };
    if !requests.is_empty() && plan.tasks.iter().all(|task| task.block.level > 0) {
        let advice = "train with --blocks tree";
        return Err(BadInput::new("--level", "needs a tree: the model has no coarser blocks", advice));
    }
    Ok(requests)
}
