//! Prunes splats within a PSNR tolerance: the fewest splats whose PSNR on views that judge stays above a floor.
//!
//! ```text
//! recovery without a cut → floor
//! repeat: importance → cut to `drop_db` below the floor (bisection) → recovery: train without densification
//!         PSNR at the floor or above, objects shown: keep the cut; else revert it and halve `drop_db`
//! at the end: cut to the floor itself → recovery on all views
//! ```
//! Every fourth view judges, and only the last recovery trains on it. What recoveries train on loses less than what they do
//! not: judged by the same views, held-out ones lost two to three times the tolerance. The floor is the PSNR after a
//! recovery without pruning, minus the tolerance: training saw the judging views, so they lose by that recovery alone, and
//! a model that was not trained to convergence improves by it. Where photos have zones, the PSNR of their pixels has a
//! floor of its own, as objects are few of all pixels. Recovery regains most of what a cut costs at first, so each cut
//! goes deeper than the tolerance. No cut that is kept is below the floor.

mod judges;
mod search;

use std::mem;

use glam::Vec3;
use scene::Splats;

use self::judges::{Evaluator, Objects, Quality, ViewCount, apart, judges_of};
pub use self::judges::{ObjectJudge, ObjectTolerance};
use self::search::Search;
use crate::error::TrainError;
use crate::importance::{EvaluationViews, Order};
use crate::job::{Flow, Job};
use crate::random;
use crate::recipe::Recipe;
use crate::trainer::{Progress, train};
use crate::view::TrainView;

/// Views on which the PSNR of a result is measured.
const MEASURED_VIEWS: ViewCount = ViewCount { min: 8, max: 32, per_step: 0.5 };
/// Views on which the PSNR of a cut is measured before recovery.
const PROBE_VIEWS: ViewCount = ViewCount { min: 4, max: 8, per_step: 0.125 };
/// Views from which importance is computed, and those on which objects are judged.
const IMPORTANCE_VIEWS: ViewCount = ViewCount { min: 24, max: 128, per_step: 1.0 };
/// Pruning ends when a round removes a smaller share of the splats.
const MIN_CUT: f64 = 0.01;

/// Smallest number of recovery steps in a round. Shorter rounds cost more in evaluations than they remove (see
/// ARCHITECTURE).
const MIN_ROUND_STEPS: f32 = 80.0;

/// Share of a job's steps that is spent on pruning where pruning is part of training.
const SHARE: f32 = 0.4;

/// Training steps before pruning, of `steps` in all.
pub fn steps_before(steps: u32) -> u32 {
    (steps - (steps as f32 * SHARE) as u32).max(1)
}

/// Parameters of pruning.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pruning {
    /// Allowed loss of PSNR on the views that judge, over all pixels and over those of zones alike, dB.
    pub tolerance_db: f64,
    /// Importance measure that orders the splats.
    pub order: Order,
    /// Recovery rounds before the first cut.
    pub warm_up: u32,
    /// Largest number of rounds of cut and recovery before the last one. Fewer and longer rounds are used where they
    /// would have under 80 steps.
    pub rounds: u32,
    /// Recovery steps of a round, as a share of the job's steps.
    pub recovery_share: f32,
    /// How far below the floor the first cut may go before recovery, dB.
    pub drop_db: f64,
}

impl Pruning {
    /// The measure and rounds that gave the best results, with this tolerance. Fewer and longer rounds beat many short
    /// ones.
    pub fn within(tolerance_db: f64) -> Self {
        let (warm_up, rounds) = (1, 5);
        let recovery_share = SHARE / (warm_up + rounds + 1) as f32;
        Self { tolerance_db, order: Order::Energy, warm_up, rounds, recovery_share, drop_db: 0.5 }
    }
}

/// The outcome of pruning.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pruned {
    /// Number of counted splats, before and after.
    pub splats: [usize; 2],
    /// PSNR on the job's views, before and after, dB.
    pub psnr: [f64; 2],
    /// Number of the objects that the unpruned splats show on the judging views, and of those that are still shown; `None` if
    /// nobody judges objects.
    pub objects: Option<[usize; 2]>,
    /// Number of rounds whose result was kept, without the last.
    pub rounds: u32,
    /// Training steps of all recoveries, including those of rounds that were left out.
    pub steps: u32,
}

impl Pruning {
    /// The same recovery, all of it after cuts.
    fn without_warm_up(&self) -> Self {
        let recovery_share = self.recovery_share * self.parts() as f32 / (self.rounds + 1) as f32;
        Self { warm_up: 0, recovery_share, ..*self }
    }

    /// Largest total number of recovery steps for a job of `steps` steps.
    pub fn steps(&self, steps: u32) -> u32 {
        self.fitted(steps).parts() * self.round_steps(steps)
    }

    /// Estimated number of views that are rendered for evaluations, for a job of this many steps and views.
    pub fn evaluations(&self, steps: u32, views: usize) -> usize {
        /// Typical number of cuts that a search tries.
        const TRIED: usize = 4;
        let (rounds, recovery) = (self.fitted(steps).rounds as usize, self.round_steps(steps));
        let of = |count: ViewCount| count.for_steps(recovery).min(views);
        let judging = |count: ViewCount| count.for_steps(recovery).min(judges_of(views));
        let [measured, probe, importance] = [judging(MEASURED_VIEWS), judging(PROBE_VIEWS), of(IMPORTANCE_VIEWS)];
        let round = importance + (TRIED + 1) * probe + measured;
        let last = importance + (TRIED + 1) * measured + measured;
        probe + (1 + self.warm_up as usize) * measured + rounds * round + last + 3 * of(MEASURED_VIEWS)
    }

    /// The same recovery in fewer rounds, where rounds would have less than [`MIN_ROUND_STEPS`] steps.
    fn fitted(&self, steps: u32) -> Self {
        let all = self.recovery_share * self.parts() as f32;
        let max = (all * steps as f32 / MIN_ROUND_STEPS) as u32;
        let rounds = self.rounds.min(max.saturating_sub(self.warm_up + 1));
        let fitted = Self { rounds, ..*self };
        Self { recovery_share: all / fitted.parts() as f32, ..fitted }
    }

    /// Number of recoveries.
    fn parts(&self) -> u32 {
        self.warm_up + self.rounds + 1
    }

    fn round_steps(&self, steps: u32) -> u32 {
        ((steps as f32 * self.fitted(steps).recovery_share).ceil() as u32).max(1)
    }
}

/// The progress of pruning.
pub struct PruneProgress<'a> {
    /// Recovery steps done, including those of rounds that were left out.
    pub step: u32,
    /// Largest total number of recovery steps.
    pub steps: u32,
    /// Progress of the current recovery.
    pub recovery: Progress<'a>,
}

/// Called after every recovery step. It may stop pruning; the result is then the last one that was kept.
pub type Report<'a> = &'a mut dyn FnMut(PruneProgress) -> Flow;

/// Prunes the splats that a job has trained, which are its `initial`. Only counted splats are removed; all take part in
/// recovery. The job has the steps and recipe that it was trained with; recovery starts from the recipe's last learning
/// rates. Exposures are fixed or absent. `objects` adds a tolerance on objects.
///
/// # Errors
/// See [`TrainError`].
pub fn within_tolerance(
    trained: Job,
    pruning: &Pruning,
    objects: Option<&ObjectTolerance>,
    report: Report,
) -> Result<(Splats, Pruned), TrainError> {
    let (mut pruner, mut best) = Pruner::new(trained, pruning)?;
    pruner.judge_objects(objects.copied(), &best)?;
    let pruning = pruner.pruning;
    let before = pruner.reported_psnr(&best)?;
    let owned = pruner.owned(&best);
    let mut reached = pruner.quality(&best)?;
    let mut floor = reached;
    let (mut drop_db, mut kept_rounds, mut recoveries, mut stopped) = (pruning.drop_db, 0, 0, false);
    for round in 0..pruning.warm_up {
        let Some(recovered) = pruner.recover(best.clone(), round, report)? else {
            stopped = true;
            break;
        };
        recoveries += 1;
        floor = pruner.quality(&recovered)?;
        // An object at the limit of what is seen may be lost without a cut.
        if pruner.shows_objects(&recovered)? {
            (best, reached) = (recovered, floor);
        }
    }
    let floor = floor.less(pruning.tolerance_db);
    let rounds = if stopped { 0 } else { pruning.rounds };
    // Share of the loss within the PSNR tolerance that cuts use: less where objects are lost sooner.
    let mut depth = 1.0;
    for round in 0..rounds {
        let loss_db = floor.less(drop_db).below(reached).map(|loss| depth * loss);
        let cut = pruner.cut(&best, loss_db, &pruner.probe)?;
        if ((best.len() - cut.len()) as f64) < MIN_CUT * pruner.owned(&best) as f64 {
            break;
        }
        let Some(recovered) = pruner.recover(cut, pruning.warm_up + round, report)? else {
            stopped = true;
            break;
        };
        recoveries += 1;
        let quality = pruner.quality(&recovered)?;
        if !quality.reaches(floor) {
            drop_db *= 0.5;
        } else if pruner.shows_objects(&recovered)? {
            (best, reached, kept_rounds) = (recovered, quality, kept_rounds + 1);
        } else {
            depth *= 0.5;
        }
    }
    if !stopped {
        let cut = pruner.cut(&best, floor.below(reached).map(|loss| depth * loss), &pruner.measured)?;
        if pruner.shows_objects(&cut)? {
            best = cut;
        }
        if let Some(recovered) = pruner.recover(best.clone(), pruning.warm_up + pruning.rounds, report)? {
            recoveries += 1;
            if pruner.quality(&recovered)?.reaches(floor) && pruner.shows_objects(&recovered)? {
                best = recovered;
            }
        }
    }
    let outcome = Pruned {
        splats: [owned, pruner.owned(&best)],
        psnr: [before, pruner.reported_psnr(&best)?],
        objects: pruner.shown_objects(&best)?,
        rounds: kept_rounds,
        steps: recoveries * pruner.job.steps,
    };
    Ok((best, outcome))
}

/// Keeps this share of the counted splats, in rounds that each remove the same share of the rest and recover. Nothing is
/// judged, so all views heal. Otherwise as [`within_tolerance`].
///
/// # Errors
/// See [`TrainError`].
pub fn to_share(trained: Job, pruning: &Pruning, share: f64, report: Report) -> Result<(Splats, Pruned), TrainError> {
    let (mut pruner, mut splats) = Pruner::new(trained, &pruning.without_warm_up())?;
    pruner.healing = pruner.job.views.to_vec();
    let (before, psnr) = (pruner.owned(&splats), pruner.reported_psnr(&splats)?);
    let (rounds, mut recoveries, mut stopped) = (pruner.pruning.parts(), 0, false);
    for round in 0..rounds {
        // Where it was stopped, one cut is left.
        let done = if stopped { 1.0 } else { f64::from(round + 1) / f64::from(rounds) };
        let count = (before as f64 * share.clamp(0.0, 1.0).powf(done)).round();
        let views = pruner.all.some(IMPORTANCE_VIEWS.for_steps(pruner.job.steps));
        let importance = EvaluationViews { views: &views, ..pruner.all }.importance(pruning.order, &splats)?;
        splats = keep(&splats, &importance, count / pruner.owned(&splats).max(1) as f64, pruner.job.counts);
        if stopped || splats.is_empty() {
            break;
        }
        match pruner.recover(splats.clone(), round, report)? {
            Some(recovered) => (splats, recoveries) = (recovered, recoveries + 1),
            None => stopped = true,
        }
    }
    let outcome = Pruned {
        splats: [before, pruner.owned(&splats)],
        psnr: [psnr, pruner.reported_psnr(&splats)?],
        objects: None,
        rounds: recoveries,
        steps: recoveries * pruner.job.steps,
    };
    Ok((splats, outcome))
}

/// Keeps the given share of the counted splats, by importance, and all others. Rows keep their order.
pub fn keep(splats: &Splats, importance: &[f64], share: f64, counts: &(dyn Fn(Vec3) -> bool + Sync)) -> Splats {
    let order = ranking(splats, importance, counts);
    let count = (order.len() as f64 * share.clamp(0.0, 1.0)).round() as usize;
    without(splats, &order[..order.len() - count])
}

/// Rows of the counted splats, least important first; of equal ones the later row first.
fn ranking(splats: &Splats, importance: &[f64], counts: &(dyn Fn(Vec3) -> bool + Sync)) -> Vec<u32> {
    let mut rows: Vec<u32> = (0..splats.len() as u32).filter(|&i| counts(splats.mean(i as usize))).collect();
    rows.sort_by(|&a, &b| importance[a as usize].total_cmp(&importance[b as usize]).then(b.cmp(&a)));
    rows
}

fn without(splats: &Splats, rows: &[u32]) -> Splats {
    let mut removed = vec![false; splats.len()];
    rows.iter().for_each(|&i| removed[i as usize] = true);
    splats.filter(|i| !removed[i])
}

/// A job whose splats are pruned.
struct Pruner<'a> {
    /// Without its splats, and with the steps of one recovery.
    job: Job<'a>,
    recipe: Recipe,
    pruning: Pruning,
    all: EvaluationViews<'a>,
    /// Views that recoveries train on, but for the last.
    healing: Vec<TrainView>,
    measured: Evaluator,
    probe: Evaluator,
    /// Some of all views.
    reported: Evaluator,
    objects: Option<Objects<'a>>,
}

impl<'a> Pruner<'a> {
    fn new(mut job: Job<'a>, pruning: &Pruning) -> Result<(Self, Splats), TrainError> {
        if job.views.is_empty() {
            return Err(TrainError::NoViews);
        }
        let splats = mem::replace(&mut job.initial, Splats::new(0));
        let pruning = pruning.fitted(job.steps);
        job.steps = pruning.round_steps(job.steps);
        (job.trains_exposures, job.trains_poses, job.sensors) = (false, false, None);
        let Job { views, context, antialiased, exposures, source, .. } = job;
        let all = EvaluationViews { views, context, antialiased, exposures, source };
        let [judging, healing] = apart(views);
        let judging = EvaluationViews { views: &judging, ..all };
        let measured = Evaluator::new(&judging, MEASURED_VIEWS.for_steps(job.steps), &splats)?;
        let probe = Evaluator::new(&judging, PROBE_VIEWS.for_steps(job.steps), &splats)?;
        let reported = Evaluator::new(&all, MEASURED_VIEWS.for_steps(job.steps), &splats)?;
        let recipe = recovery_recipe(job.recipe);
        Ok((Self { job, recipe, pruning, all, healing, measured, probe, reported, objects: None }, splats))
    }

    /// From now on, few of the objects that these splats show may be lost.
    fn judge_objects(&mut self, objects: Option<ObjectTolerance<'a>>, splats: &Splats) -> Result<(), TrainError> {
        let Some(objects) = objects else { return Ok(()) };
        let [judging, _] = apart(self.job.views);
        let count = IMPORTANCE_VIEWS.for_steps(self.job.steps);
        self.objects = Some(Objects::new(objects, &EvaluationViews { views: &judging, ..self.all }, count, splats)?);
        Ok(())
    }

    fn shows_objects(&self, splats: &Splats) -> Result<bool, TrainError> {
        self.objects.as_ref().map_or(Ok(true), |objects| objects.are_shown(&self.all, splats))
    }

    /// See [`Pruned::objects`].
    fn shown_objects(&self, splats: &Splats) -> Result<Option<[usize; 2]>, TrainError> {
        self.objects.as_ref().map(|objects| objects.counts(&self.all, splats)).transpose()
    }

    /// On some of all views, dB.
    fn reported_psnr(&self, splats: &Splats) -> Result<f64, TrainError> {
        self.reported.quality(&self.all, splats).map(Quality::psnr)
    }

    fn owned(&self, splats: &Splats) -> usize {
        (0..splats.len()).filter(|&i| (self.job.counts)(splats.mean(i))).count()
    }

    fn quality(&self, splats: &Splats) -> Result<Quality, TrainError> {
        self.measured.quality(&self.all, splats)
    }

    /// The fewest splats that lose at most `loss_db` over all pixels and over those of zones on the evaluator's views, within one percent
    /// of the number or a tenth of the loss.
    fn cut(&self, splats: &Splats, loss_db: [f64; 2], evaluator: &Evaluator) -> Result<Splats, TrainError> {
        let before = evaluator.quality(&self.all, splats)?;
        let views = self.all.some(IMPORTANCE_VIEWS.for_steps(self.job.steps));
        let importance = EvaluationViews { views: &views, ..self.all }.importance(self.pruning.order, splats)?;
        let order = ranking(splats, &importance, self.job.counts);
        // Increases of the mean squared error.
        let increase = |loss_db: f64| 10f64.powf(loss_db / 10.0) - 1.0;
        let allowed = loss_db.map(|loss| increase(loss.max(0.0)).max(1e-9));
        let spent = |cut: Quality| {
            let parts = cut.below(before).into_iter().zip(allowed);
            parts.map(|(loss, allowed)| increase(loss) / allowed).fold(f64::MIN, f64::max)
        };
        let ordered = order.iter().map(|&i| importance[i as usize]);
        // Energy is in units of each view's squared error.
        let factor = (self.pruning.order == Order::Energy).then(|| 1.0 / (views.len() as f64 * allowed[0]));
        let mut search = Search::new(ordered, 1.0, factor);
        let mut best = splats.clone();
        while let Some(count) = search.next() {
            let cut = without(splats, &order[..count]);
            if search.record(count, spent(evaluator.quality(&self.all, &cut)?)) {
                best = cut;
            }
        }
        Ok(best)
    }

    /// Trains without densification; `None` if the report stopped it.
    fn recover(&self, cut: Splats, round: u32, report: Report) -> Result<Option<Splats>, TrainError> {
        let steps = self.job.steps;
        let is_last = round + 1 == self.pruning.parts();
        let job = Job {
            budget: cut.len(),
            initial: cut,
            views: if is_last { self.job.views } else { &self.healing },
            seed: random::bits(self.job.seed, u64::from(round) + 1),
            recipe: &self.recipe,
            ..self.job
        };
        let mut stopped = false;
        let recovered = train(job, &mut |now| {
            let (step, steps) = (round * steps + now.step, self.pruning.parts() * steps);
            let flow = report(PruneProgress { step, steps, recovery: now });
            stopped |= flow == Flow::Stop;
            flow
        })?;
        Ok((!stopped).then_some(recovered))
    }
}

/// The recipe of a recovery: the last learning rates, slightly raised at first, without densification.
fn recovery_recipe(recipe: &Recipe) -> Recipe {
    let again = |[_, last]: [f32; 2]| [last * 2.5, last * 0.3];
    Recipe {
        mean: again(recipe.mean),
        log_scale: again(recipe.log_scale),
        quat: again(recipe.quat),
        opacity: again(recipe.opacity),
        sh_dc: again(recipe.sh_dc),
        sh_from: [0.0; 3],
        picture_from: 0.0,
        coarse: Vec::new(),
        growth: recipe.growth.none(),
        ..recipe.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounds_have_enough_steps() {
        let pruning = Pruning::within(0.1);
        for (steps, rounds) in [(0, 0), (1, 0), (500, 0), (700, 1), (1_400, 5), (100_000, 5)] {
            assert_eq!(pruning.fitted(steps).rounds, rounds, "{steps} steps");
            // Two fifths of the steps for any number of rounds, up to rounding.
            let recovery = pruning.steps(steps);
            assert!(
                recovery >= (0.4 * steps as f32) as u32 && recovery <= (0.4 * steps as f32) as u32 + 8,
                "{recovery}"
            );
        }
        assert!(
            pruning.evaluations(500, 100) < 500 && pruning.evaluations(100_000, 500) > pruning.evaluations(500, 500)
        );
    }
}
