//! Pruning within a tolerance: as few splats as the views allow.
//!
//! ```text
//! heal → importance → cut to `drop` below the floor (bisection) → heal: train on, no growth ── at the floor or above? ── yes → next round
//!                                                                                        └ no → back, with half the drop
//! at the end: cut to the floor itself, heal once more
//! ```
//! The floor is the PSNR after some healing without a cut, minus the tolerance: a model that was not trained to its end gets
//! better by healing alone, and a cut that spent this as well cost views held out two to three times the tolerance. What a
//! cut costs at once, healing mostly gives back, so cuts go deeper than the tolerance; no result is below it.

use std::mem;

use glam::Vec3;
use scene::Splats;

use crate::importance::{Order, Shares, Views};
use crate::{Flow, Job, Progress, Recipe, TrainError, TrainView, random, train};

/// Views that a result is measured on: of more, evenly many.
const MEASURED_VIEWS: Looks = Looks { least: 8, most: 32, per_step: 0.5 };
/// Views that a cut which is yet to heal is measured on.
const PROBED_VIEWS: Looks = Looks { least: 4, most: 8, per_step: 0.125 };
/// Views that say what splats are worth.
const JUDGED_VIEWS: Looks = Looks { least: 24, most: 128, per_step: 1.0 };
/// A cut is deep enough where it costs this much of what it may.
const DEEP_ENOUGH: f64 = 0.9;
/// A round that cuts less than this share is the last.
const WORTH: f64 = 0.01;

/// Steps of healing that a round is worth. Shorter ones cost more in looking than they cut (ARCHITECTURE has the figures).
const ROUND_STEPS: f32 = 80.0;

/// Share of a job's steps that pruning takes where it is part of training.
const SHARE: f32 = 0.4;

/// Steps of training before pruning, of so many in all.
pub fn steps_before(steps: u32) -> u32 {
    (steps - (steps as f32 * SHARE) as u32).max(1)
}

/// How to prune.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pruning {
    /// Loss of PSNR on the job's own views, dB.
    pub tolerance_db: f64,
    /// What goes first.
    pub order: Order,
    /// Rounds of healing before the first cut.
    pub warm_up: u32,
    /// Rounds of cut and healing at most, before the last one: fewer and longer where they would be of under 80 steps.
    pub rounds: u32,
    /// Steps of healing in a round, as a share of those of the job.
    pub healing: f32,
    /// How far below the floor the first cut may go before healing, dB.
    pub drop_db: f64,
}

impl Pruning {
    /// The order and the rounds that measurements chose, at this tolerance. Fewer and longer rounds beat many short ones.
    pub fn within(tolerance_db: f64) -> Self {
        let (warm_up, rounds) = (1, 5);
        let healing = SHARE / (warm_up + rounds + 1) as f32;
        Self { tolerance_db, order: Order::Energy, warm_up, rounds, healing, drop_db: 0.5 }
    }
}

/// How many views to look at: looking takes no longer than the healing between two looks, whatever the number of steps.
#[derive(Clone, Copy)]
struct Looks {
    least: usize,
    most: usize,
    per_step: f32,
}

impl Looks {
    fn beside(&self, steps: u32) -> usize {
        ((steps as f32 * self.per_step) as usize).clamp(self.least, self.most)
    }
}

/// What pruning did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pruned {
    /// Splats that count: before, and now.
    pub splats: [usize; 2],
    /// PSNR on the job's views: before, and now, dB.
    pub psnr: [f64; 2],
    /// Rounds of cut and healing that were kept, without the last.
    pub rounds: u32,
}

impl Pruning {
    /// Steps of healing in all, at most, for a job of so many steps.
    pub fn steps(&self, steps: u32) -> u32 {
        self.fitted(steps).parts() * self.round_steps(steps)
    }

    /// Windows that are drawn beside training, about, for a job of so many steps and views.
    pub fn looks(&self, steps: u32, views: usize) -> usize {
        /// Cuts that are tried in a search, about.
        const TRIED: usize = 4;
        let (rounds, healing) = (self.fitted(steps).rounds as usize, self.round_steps(steps));
        let of = |looks: Looks| looks.beside(healing).min(views);
        let [measured, probed, judged] = [of(MEASURED_VIEWS), of(PROBED_VIEWS), of(JUDGED_VIEWS)];
        let round = judged + (TRIED + 1) * probed + measured;
        let last = judged + (TRIED + 1) * measured + 2 * measured;
        probed + (2 + self.warm_up as usize) * measured + rounds * round + last
    }

    /// The same healing in fewer rounds, where these would be of less than [`ROUND_STEPS`] steps.
    fn fitted(&self, steps: u32) -> Self {
        let all = self.healing * self.parts() as f32;
        let most = (all * steps as f32 / ROUND_STEPS) as u32;
        let rounds = self.rounds.min(most.saturating_sub(self.warm_up + 1));
        let fitted = Self { rounds, ..*self };
        Self { healing: all / fitted.parts() as f32, ..fitted }
    }

    /// Times that it heals.
    fn parts(&self) -> u32 {
        self.warm_up + self.rounds + 1
    }

    fn round_steps(&self, steps: u32) -> u32 {
        ((steps as f32 * self.fitted(steps).healing).ceil() as u32).max(1)
    }
}

/// Where pruning stands.
pub struct PruneProgress<'a> {
    /// Steps of healing done, rounds that were not needed included.
    pub step: u32,
    /// Steps of healing in all, at most.
    pub steps: u32,
    /// The healing under way.
    pub healing: Progress<'a>,
}

/// Is called after every step of healing; may stop the work, and then what was reached is the result.
pub type Report<'a> = &'a mut dyn FnMut(PruneProgress) -> Flow;

/// Prunes the splats that a job has trained, given as its `initial`, among those that it `counts`; the others only heal. The
/// job's steps are those that it was trained with, its recipe the one whose last rates healing takes; exposures are given or none.
///
/// # Errors
/// See [`TrainError`].
pub fn within_tolerance(trained: Job, pruning: &Pruning, report: Report) -> Result<(Splats, Pruned), TrainError> {
    let (pruner, mut best) = Pruner::new(trained, pruning)?;
    let pruning = pruner.pruning;
    let before = pruner.psnr(&best)?;
    let owned = pruner.owned(&best);
    // What healing alone gives is not the cut's to spend.
    for round in 0..pruning.warm_up {
        let Some(healed) = pruner.heal(best.clone(), round, report)? else {
            let outcome = Pruned { splats: [owned; 2], psnr: [before, pruner.psnr(&best)?], rounds: 0 };
            return Ok((best, outcome));
        };
        best = healed;
    }
    let mut reached = pruner.psnr(&best)?;
    let floor = reached.max(before) - pruning.tolerance_db;
    let (mut drop_db, mut kept_rounds, mut stopped) = (pruning.drop_db, 0, false);
    for round in 0..pruning.rounds {
        let cut = pruner.cut(&best, reached - floor + drop_db, &pruner.probed)?;
        if ((best.len() - cut.len()) as f64) < WORTH * pruner.owned(&best) as f64 {
            break;
        }
        let Some(healed) = pruner.heal(cut, pruning.warm_up + round, report)? else {
            stopped = true;
            break;
        };
        let psnr = pruner.psnr(&healed)?;
        if psnr >= floor {
            (best, reached, kept_rounds) = (healed, psnr, kept_rounds + 1);
        } else {
            drop_db *= 0.5;
        }
    }
    if !stopped {
        best = pruner.cut(&best, reached - floor, &pruner.measured)?;
        // What healing gives back here the held-out views need: a cut that uses the tolerance up costs them more.
        if let Some(healed) = pruner.heal(best.clone(), pruning.warm_up + pruning.rounds, report)?
            && pruner.psnr(&healed)? >= floor
        {
            best = healed;
        }
    }
    let outcome =
        Pruned { splats: [owned, pruner.owned(&best)], psnr: [before, pruner.psnr(&best)?], rounds: kept_rounds };
    Ok((best, outcome))
}

/// Keeps this share of the splats that a job has trained and counts, and heals once; else as [`within_tolerance`].
///
/// # Errors
/// See [`TrainError`].
pub fn to_share(trained: Job, pruning: &Pruning, share: f64, report: Report) -> Result<(Splats, Pruned), TrainError> {
    let (pruner, splats) = Pruner::new(trained, &Pruning { warm_up: 0, rounds: 0, ..*pruning })?;
    let before = [pruner.owned(&splats) as f64, pruner.psnr(&splats)?];
    let importance = pruner.all.importance(pruning.order, &splats)?;
    let cut = keep(&splats, &importance, share, pruner.job.counts);
    let healed = if cut.is_empty() { None } else { pruner.heal(cut.clone(), 0, report)? }.unwrap_or(cut);
    let psnr = [before[1], pruner.psnr(&healed)?];
    let outcome = Pruned { splats: [before[0] as usize, pruner.owned(&healed)], psnr, rounds: 1 };
    Ok((healed, outcome))
}

/// The most important splats among those that `counts`, this share of them, and all the others; rows keep their order.
pub fn keep(splats: &Splats, importance: &[f64], share: f64, counts: &(dyn Fn(Vec3) -> bool + Sync)) -> Splats {
    let order = ranking(splats, importance, counts);
    let count = (order.len() as f64 * share.clamp(0.0, 1.0)).round() as usize;
    without(splats, &order[..order.len() - count])
}

/// Rows of the splats that count, the least important first; of equals the later.
fn ranking(splats: &Splats, importance: &[f64], counts: &(dyn Fn(Vec3) -> bool + Sync)) -> Vec<u32> {
    let mut rows: Vec<u32> = (0..splats.len() as u32).filter(|&i| counts(splats.mean(i as usize))).collect();
    rows.sort_by(|&a, &b| importance[a as usize].total_cmp(&importance[b as usize]).then(b.cmp(&a)));
    rows
}

fn without(splats: &Splats, rows: &[u32]) -> Splats {
    let mut gone = vec![false; splats.len()];
    rows.iter().for_each(|&i| gone[i as usize] = true);
    splats.filter(|i| !gone[i])
}

/// Looks for how many splats can go, the least important first: error grows with the sum of the importance that is gone, by a
/// factor that every measurement tells anew. Where that leads astray, the interval is halved.
struct Search {
    /// Importance of the first so many.
    gone: Vec<f64>,
    /// Growth of the error that is allowed, as a share of it.
    allowed: f64,
    /// With so many removed it is good, ...
    low: usize,
    /// ... and with so many it is not.
    high: usize,
    /// Growth of the error for a unit of importance.
    factor: Option<f64>,
    halves: bool,
}

impl Search {
    fn new(importance: impl Iterator<Item = f64>, allowed: f64, factor: Option<f64>) -> Self {
        let sums = importance.scan(0.0, |sum, value| {
            *sum += value;
            Some(*sum)
        });
        let gone: Vec<f64> = [0.0].into_iter().chain(sums).collect();
        Self { high: gone.len() - 1, gone, allowed, low: 0, factor, halves: false }
    }

    /// How many to try without; `None` if that is known.
    fn next(&mut self) -> Option<usize> {
        if self.high - self.low <= 1 + self.gone.len() / 100 {
            return None;
        }
        let middle = (self.low + self.high) / 2;
        let Some(factor) = self.factor.filter(|_| !self.halves) else { return Some(middle) };
        // A little less than all, so that it is good.
        let aim = 0.5 * (1.0 + DEEP_ENOUGH) * self.allowed / factor;
        let count = self.gone.partition_point(|gone| *gone <= aim);
        let margin = (self.high - self.low) / 16;
        Some(count.clamp(self.low + 1 + margin, (self.high - 1 - margin).max(self.low + 1)))
    }

    /// What the error grew by; whether that is good.
    fn tell(&mut self, count: usize, growth: f64) -> bool {
        let width = self.high - self.low;
        let good = growth <= self.allowed;
        if good {
            self.low = count;
            if growth >= DEEP_ENOUGH * self.allowed {
                self.high = count;
            }
        } else {
            self.high = count;
        }
        self.factor = (growth > 0.0 && self.gone[count] > 0.0).then(|| growth / self.gone[count]);
        self.halves = !self.halves && self.high - self.low > width / 2;
        good
    }
}

/// A job whose splats are pruned.
struct Pruner<'a> {
    /// Without its splats, with the healing's steps.
    job: Job<'a>,
    recipe: Recipe,
    pruning: Pruning,
    all: Views<'a>,
    measured: Gauge,
    probed: Gauge,
}

/// Views to measure on, and what their pixels count: as the splats before explain them.
struct Gauge {
    views: Vec<TrainView>,
    shares: Shares,
}

impl Gauge {
    fn new(all: &Views, count: usize, splats: &Splats) -> Result<Self, TrainError> {
        let views = all.some(count);
        let shares = Views { views: &views, ..*all }.shares(splats)?;
        Ok(Self { views, shares })
    }

    fn psnr(&self, all: &Views, splats: &Splats) -> Result<f64, TrainError> {
        Views { views: &self.views, ..*all }.psnr(splats, &self.shares)
    }
}

impl<'a> Pruner<'a> {
    fn new(mut job: Job<'a>, pruning: &Pruning) -> Result<(Self, Splats), TrainError> {
        if job.views.is_empty() {
            return Err(TrainError::NoViews);
        }
        let splats = mem::replace(&mut job.initial, Splats::new(0));
        let pruning = pruning.fitted(job.steps);
        job.steps = pruning.round_steps(job.steps);
        job.trains_exposures = false;
        let Job { views, context, antialiased, exposures, source, .. } = job;
        let all = Views { views, context, antialiased, exposures, source };
        let measured = Gauge::new(&all, MEASURED_VIEWS.beside(job.steps), &splats)?;
        let probed = Gauge::new(&all, PROBED_VIEWS.beside(job.steps), &splats)?;
        Ok((Self { recipe: healing(job.recipe), pruning, all, measured, probed, job }, splats))
    }

    fn owned(&self, splats: &Splats) -> usize {
        (0..splats.len()).filter(|&i| (self.job.counts)(splats.mean(i))).count()
    }

    fn psnr(&self, splats: &Splats) -> Result<f64, TrainError> {
        self.measured.psnr(&self.all, splats)
    }

    /// As few splats as lose at most so much PSNR on the gauge's views, to a percent of their number or a tenth of the loss.
    fn cut(&self, splats: &Splats, loss_db: f64, gauge: &Gauge) -> Result<Splats, TrainError> {
        let before = gauge.psnr(&self.all, splats)?;
        let views = self.all.some(JUDGED_VIEWS.beside(self.job.steps));
        let importance = Views { views: &views, ..self.all }.importance(self.pruning.order, splats)?;
        let order = ranking(splats, &importance, self.job.counts);
        let lost = |psnr: f64| 10f64.powf((before - psnr) / 10.0) - 1.0;
        let of_order = order.iter().map(|&i| importance[i as usize]);
        // Energy is in units of the views' errors.
        let factor = (self.pruning.order == Order::Energy).then(|| 1.0 / views.len() as f64);
        let mut search = Search::new(of_order, lost(before - loss_db), factor);
        let mut best = splats.clone();
        while let Some(count) = search.next() {
            let cut = without(splats, &order[..count]);
            if search.tell(count, lost(gauge.psnr(&self.all, &cut)?)) {
                best = cut;
            }
        }
        Ok(best)
    }

    /// Trains on without growth; `None` if the work was stopped.
    fn heal(&self, cut: Splats, round: u32, report: Report) -> Result<Option<Splats>, TrainError> {
        let steps = self.job.steps;
        let job = Job {
            budget: cut.len(),
            initial: cut,
            seed: random::bits(self.job.seed, u64::from(round) + 1),
            recipe: &self.recipe,
            ..self.job
        };
        let mut stopped = false;
        let healed = train(job, &mut |now| {
            let (step, steps) = (round * steps + now.step, self.pruning.parts() * steps);
            let flow = report(PruneProgress { step, steps, healing: now });
            stopped |= flow == Flow::Stop;
            flow
        })?;
        Ok((!stopped).then_some(healed))
    }
}

/// Training's last steps once more, a little warmer at first, without growth.
fn healing(recipe: &Recipe) -> Recipe {
    let again = |[_, last]: [f32; 2]| [last * 2.5, last * 0.3];
    Recipe {
        mean: again(recipe.mean),
        log_scale: again(recipe.log_scale),
        quat: again(recipe.quat),
        opacity: again(recipe.opacity),
        sh_dc: again(recipe.sh_dc),
        sh_from: [0.0; 3],
        coarse: Vec::new(),
        growth: recipe.growth.none(),
        ..recipe.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a search comes to where `growth` says how much worse each number of removed splats is, and how often it looks.
    fn found(count: usize, allowed: f64, factor: Option<f64>, growth: impl Fn(usize) -> f64) -> (usize, usize) {
        let mut search = Search::new((0..count).map(|i| 1e-6 * i as f64), allowed, factor);
        let (mut best, mut looks) = (0, 0);
        while let Some(tried) = search.next() {
            assert!(tried > 0 && tried < count, "{tried} of {count}");
            looks += 1;
            if search.tell(tried, growth(tried)) {
                assert!(growth(tried) <= allowed);
                best = tried;
            }
        }
        (best, looks)
    }

    #[test]
    fn searches_are_short_where_importance_says_the_truth_and_end_where_it_does_not() {
        let sum = |n: usize| 0.5e-6 * (n * n) as f64;
        let (best, looks) = found(10_000, 2.0, Some(1.0), |n| 3.0 * sum(n));
        assert!(looks <= 4 && (0.9..=1.0).contains(&(3.0 * sum(best) / 2.0)), "{best} {looks}");
        // A cliff; nothing that matters; nothing that may go; one splat; none; what grows less the more is gone.
        let (best, looks) = found(10_000, 2.0, Some(1.0), |n| if n > 7_000 { 1e9 } else { 0.0 });
        assert!((6_890..=7_000).contains(&best) && looks <= 14, "{best} {looks}");
        assert!(found(10_000, 2.0, None, |_| 0.0).0 >= 9_890);
        assert_eq!(found(10_000, 2.0, None, |_| 1e9).0, 0);
        assert_eq!((found(1, 2.0, None, |_| 0.0), found(0, 2.0, None, |_| 0.0)), ((0, 0), (0, 0)));
        assert!(found(5_000, 2.0, Some(1e9), |n| 4.0 / (1 + n) as f64).1 <= 20);
        assert!(found(5_000, 0.0, Some(f64::NAN), |_| f64::NAN).1 <= 20);
    }

    #[test]
    fn rounds_are_worth_their_steps() {
        let pruning = Pruning::within(0.1);
        for (steps, rounds) in [(0, 0), (1, 0), (500, 0), (700, 1), (1_400, 5), (100_000, 5)] {
            assert_eq!(pruning.fitted(steps).rounds, rounds, "{steps} steps");
            // However many rounds: two fifths of them, but for rounding up.
            let healing = pruning.steps(steps);
            assert!(healing >= (0.4 * steps as f32) as u32 && healing <= (0.4 * steps as f32) as u32 + 8, "{healing}");
        }
        assert!(pruning.looks(500, 100) < 500 && pruning.looks(100_000, 500) > pruning.looks(500, 500));
    }
}
