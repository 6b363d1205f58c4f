//! Measures what viewers draw of a model within budgets of splats: nodes of the tree of levels of detail that `plat export --to rad` writes,
//! chosen for each view, against the whole model and against the model pruned to as many.

use glam::DVec3;
use render::Options;
use scene::rad::{self, Rad};
use scene::{BadInput, Splats, View};
use serde::Serialize;

use crate::cuts::by_importance;
use crate::figures::{Comparison, Means, ViewFigures};
use crate::{EvalError, Renderer};

/// Figures of one budget: means over the held-out views. The field names are keys of `eval/report.json`.
#[derive(Debug, Clone, Serialize)]
pub struct BudgetFigures {
    /// Splats at most.
    pub budget: u32,
    /// Splats drawn.
    pub drawn: f64,
    /// Of the drawn nodes.
    pub figures: Means,
    /// dB below the whole model.
    pub loss_db: Option<f64>,
    /// Of as many of the model's most important splats.
    pub pruned: Means,
    /// dB above these.
    pub gain_db: Option<f64>,
}

/// Measures budgets view by view.
pub(crate) struct BudgetMeter<'a> {
    finest: &'a Splats,
    antialiased: bool,
    rad: Rad,
    origin: DVec3,
    /// Rows of `finest`, most important first.
    ranking: Vec<u32>,
    sums: Vec<Sums>,
}

#[derive(Default)]
struct Sums {
    budget: u32,
    drawn: f64,
    finest: Vec<ViewFigures>,
    figures: Vec<ViewFigures>,
    pruned: Vec<ViewFigures>,
}

impl<'a> BudgetMeter<'a> {
    /// Builds the tree of `finest`.
    pub(crate) fn new(finest: &'a Splats, antialiased: bool, budgets: &[u32]) -> Result<Self, BadInput> {
        let bad =
            |error: scene::CodecError| BadInput::new("the model", error.to_string(), "repair it, or train it again");
        let count = finest.len().max(1) as f64;
        let origin = ((0..finest.len()).map(|i| finest.mean(i).as_dvec3() / count)).sum::<DVec3>().round();
        // Through the bytes, as viewers see them.
        let rad = rad::write(finest, origin, None).and_then(|bytes| rad::read(&bytes)).map_err(bad)?;
        let sums = budgets.iter().map(|&budget| Sums { budget, ..Sums::default() }).collect();
        Ok(Self { finest, antialiased, rad, origin, ranking: by_importance(finest), sums })
    }

    /// Measures all budgets on a view; `whole` are its figures for the whole model.
    pub(crate) fn add_view(
        &mut self,
        view: &View,
        photo: &scene::Pixels,
        whole: &ViewFigures,
        renderer: &mut Renderer,
    ) -> Result<(), EvalError> {
        let options =
            Options { antialiased: self.antialiased, sh_degree: self.finest.sh_degree(), ..Options::default() };
        let mut measure = |splats: &Splats| -> Result<ViewFigures, EvalError> {
            let frame = renderer.render_once(splats, &view.camera, &options)?;
            Ok(Comparison::new(&view.name, &frame.colour, photo).figures(None)?)
        };
        for sums in &mut self.sums {
            let nodes = self.rad.cut(&view.camera, self.origin, sums.budget as usize);
            let mut most_important = self.ranking[..nodes.len().min(self.ranking.len())].to_vec();
            most_important.sort_unstable();
            sums.drawn += nodes.len() as f64;
            sums.finest.push(whole.clone());
            sums.figures.push(measure(&self.rad.splats(&nodes, self.origin))?);
            sums.pruned.push(measure(&self.finest.select(&most_important))?);
        }
        Ok(())
    }

    /// The figures of all budgets.
    pub(crate) fn figures(self) -> Vec<BudgetFigures> {
        let of = |sums: &Sums| {
            let [finest, figures, pruned] = [&sums.finest, &sums.figures, &sums.pruned].map(|all| Means::of(all));
            let difference = |a: &Means, b: &Means| Some(a.psnr? - b.psnr?);
            BudgetFigures {
                budget: sums.budget,
                drawn: sums.drawn / sums.figures.len().max(1) as f64,
                loss_db: difference(&finest, &figures),
                gain_db: difference(&figures, &pruned),
                figures,
                pruned,
            }
        };
        self.sums.iter().map(of).collect()
    }
}
