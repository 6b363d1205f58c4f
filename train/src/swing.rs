//! Trains how the splats of a person swing with the stride (see [`scene::swing`]).
//!
//! A capture does not say how long a stride is. While the splats still stand, photos pull each of them to where its limb is, and the pull
//! goes to and fro with the stride: the stride is that at which the gradients of all means have the most power (a periodogram over the
//! way). Then the amplitudes are trained with the other columns, from zero, and the stride with them.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::ops::Range;

use render::Gradients;
use scene::swing::{HARMONICS, NUMBERS, TERMS, displace, terms};
use scene::{MovingObject, Splats, Swing, Way, column};

/// Strides that are looked at, relative to the height of the person. Adults take 0.8 to 0.9 of their height at the speed that they
/// choose (Murray, Drought and Kory 1964), less when they stroll, more when they hurry.
const STRIDES: [f64; 2] = [0.5, 1.2];
/// The stride where the way is too short to tell, and the number of strides below which it is.
const USUAL_STRIDE: f64 = 0.83;
const LEAST_HEARD: f64 = 1.5;
/// On a shorter way photos do not show all of a stride.
const LEAST_STRIDES: f64 = 1.0;
/// Heights of people, metres: what is called a person in a file may be anything.
const HEIGHTS: Range<f64> = 0.3..3.0;
/// A swing has twelve numbers for each splat, and a view shows two of three dimensions: fewer views do not fix them. Those farther apart
/// tell strides badly apart (docs/decisions/0098).
const LEAST_VIEWS: usize = 24;
const LEAST_VIEWS_PER_STRIDE: f64 = 6.0;
/// Frequencies looked at for each that the way tells apart.
const OVERSAMPLING: f64 = 4.0;
const MAX_CANDIDATES: usize = 64;
const BETA1: f32 = 0.9;
const EPSILON: f32 = 1e-15;

/// Where on their way the views of a job see the person who is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct Walk {
    /// Metres since the start of the path, by view.
    metres: BTreeMap<u32, f64>,
    /// Height of the person, metres.
    height: f64,
}

impl Walk {
    /// Of views with their times in seconds; `None` where those that show the person well are too few, or too far apart on the way, to
    /// say how limbs swing, or show less than a stride.
    pub fn of(
        views: impl Iterator<Item = (u32, f64)>,
        is_shown: impl Fn(u32) -> bool,
        person: &MovingObject,
    ) -> Option<Self> {
        let way = Way::of(&person.path);
        let all: BTreeMap<u32, f64> = views.map(|(view, seconds)| (view, way.at(seconds))).collect();
        let height = person.high.z - person.low.z;
        let metres = all.iter().filter(|(view, _)| is_shown(**view)).map(|(&view, &metres)| (view, metres)).collect();
        let shown = Self { metres, height };
        let (count, strides) = (shown.metres.len(), shown.length() / (USUAL_STRIDE * height));
        let are_enough = count >= LEAST_VIEWS && count as f64 >= LEAST_VIEWS_PER_STRIDE * strides;
        (are_enough && strides >= LEAST_STRIDES && HEIGHTS.contains(&height)).then_some(Self { metres: all, height })
    }

    /// The frequencies to look at, per metre; none where the way is too short.
    fn candidates(&self) -> Vec<f64> {
        let length = self.length();
        if length < LEAST_HEARD * USUAL_STRIDE * self.height {
            return Vec::new();
        }
        let [high, low] = STRIDES.map(|share| 1.0 / (share * self.height));
        let count = (OVERSAMPLING * length * (high - low)).ceil().clamp(2.0, MAX_CANDIDATES as f64) as usize;
        (0..=count).map(|k| low + (high - low) * k as f64 / count as f64).collect()
    }

    /// Length of the way that the views see, metres.
    fn length(&self) -> f64 {
        let [low, high] = self.ends();
        high - low
    }

    /// The middle of it. Phases are counted from there in training, so that a change of the stride turns them little.
    fn middle(&self) -> f64 {
        self.ends().into_iter().sum::<f64>() / 2.0
    }

    fn ends(&self) -> [f64; 2] {
        [f64::min, f64::max].map(|of| self.metres.values().copied().reduce(of).unwrap_or(0.0))
    }
}

/// What a step does with the swing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum SwingStep {
    /// The splats stand, and the photos' pull is listened to.
    Listen,
    /// Amplitudes are trained.
    Train {
        /// Learning rate of amplitudes, in units of each splat's size.
        rate: f32,
        /// Share of an amplitude that a step takes back.
        decay: f32,
        /// Learning rate of the stride, ln.
        stride_rate: f32,
        /// Decay β₂ of Adam's second moment.
        beta2: f32,
    },
}

/// A swing in training.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SwingTraining {
    /// Power of the gradients at each frequency that is looked at.
    pub(crate) power: Vec<f64>,
    /// Of each candidate and splat, until the stride is chosen: Σ gradient · cos, x to z, and the same with sin.
    pub(crate) sums: Vec<[f32; 6]>,
    /// Strides per metre, once it is chosen.
    pub(crate) frequency: Option<f64>,
    /// First and second moment of ln(frequency).
    pub(crate) of_frequency: [f32; 2],
    /// Adam steps.
    pub(crate) steps: u32,
    /// Amplitudes, first and second moment of each splat.
    pub(crate) values: [Vec<[f32; NUMBERS]>; 3],
    /// Gradients of a step; zero between steps.
    gradients: Vec<[f32; NUMBERS]>,
    frequency_gradient: f64,
}

impl SwingTraining {
    /// Splats that stand.
    pub(crate) fn new(walk: &Walk, splats: usize) -> Self {
        let power = vec![0.0; walk.candidates().len()];
        let zeros = || vec![[0.0; NUMBERS]; splats];
        let sums = vec![[0.0; 6]; splats * power.len()];
        Self::of(power, sums, None, [0.0; 2], 0, [zeros(), zeros(), zeros()])
    }

    /// From its parts between two steps.
    pub(crate) fn of(
        power: Vec<f64>,
        sums: Vec<[f32; 6]>,
        frequency: Option<f64>,
        of_frequency: [f32; 2],
        steps: u32,
        values: [Vec<[f32; NUMBERS]>; 3],
    ) -> Self {
        let gradients = vec![[0.0; NUMBERS]; values[0].len()];
        Self { power, sums, frequency, of_frequency, steps, values, gradients, frequency_gradient: 0.0 }
    }

    /// Moves splats to where they are in a view.
    pub(crate) fn apply(&self, walk: &Walk, splats: &mut Splats, view: u32) {
        if let (Some(frequency), Some(metres)) = (self.frequency, walk.metres.get(&view)) {
            displace(splats, &self.values[0], &terms(frequency * (metres - walk.middle())));
        }
    }

    /// Adds the gradients of a view.
    pub(crate) fn add(&mut self, walk: &Walk, gradients: &Gradients, view: u32, step: SwingStep) {
        let Some(&metres) = walk.metres.get(&view) else { return };
        match (step, self.frequency) {
            (SwingStep::Listen, None) => self.listen(walk, gradients, metres),
            (SwingStep::Train { .. }, Some(frequency)) => {
                self.pull(gradients, frequency * (metres - walk.middle()));
            }
            _ => {}
        }
    }

    /// Adds what the pull on the standing splats has of each frequency.
    fn listen(&mut self, walk: &Walk, gradients: &Gradients, metres: f64) {
        let count = self.values[0].len();
        for (frequency, sums) in walk.candidates().iter().zip(self.sums.chunks_mut(count.max(1))) {
            let (sin, cos) = (TAU * frequency * metres).sin_cos();
            for (i, sum) in sums.iter_mut().enumerate().filter(|(i, _)| is_seen(gradients, *i)) {
                let [x, y, z] = of_mean(gradients, i);
                if x.is_finite() && y.is_finite() && z.is_finite() {
                    let (sin, cos) = (sin as f32, cos as f32);
                    let add = [cos * x, cos * y, cos * z, sin * x, sin * y, sin * z];
                    sum.iter_mut().zip(add).for_each(|(sum, value)| *sum += value);
                }
            }
        }
    }

    /// Adds the gradients of amplitudes so many strides from the middle of the way, and that of ln(frequency).
    fn pull(&mut self, gradients: &Gradients, strides: f64) {
        let terms = terms(strides);
        let slopes: [f32; TERMS] = std::array::from_fn(|k| {
            let turned = if k.is_multiple_of(2) { -terms[k + 1] } else { terms[k - 1] };
            (TAU * (k / 2 + 1) as f64 * strides) as f32 * turned
        });
        for i in (0..self.gradients.len()).filter(|&i| is_seen(gradients, i)) {
            let of_mean = of_mean(gradients, i);
            for k in 0..NUMBERS {
                self.gradients[i][k] += terms[k / 3] * of_mean[k % 3];
                self.frequency_gradient += f64::from(slopes[k / 3] * self.values[0][i][k] * of_mean[k % 3]);
            }
        }
    }

    /// Drops what was added in a step that is skipped.
    pub(crate) fn forget(&mut self) {
        self.gradients.fill([0.0; NUMBERS]);
        self.frequency_gradient = 0.0;
    }

    /// One Adam step from the gradients that were added, of the splats that the views of the step show.
    pub(crate) fn step(&mut self, walk: &Walk, splats: &Splats, shown: &Gradients, step: SwingStep) {
        let SwingStep::Train { rate, decay, stride_rate, beta2 } = step else { return };
        let Some(frequency) = self.frequency else {
            // The gradients of this step are of splats that stand.
            self.frequency = Some(self.choose(walk));
            return;
        };
        self.steps = self.steps.saturating_add(1);
        let steps = self.steps.min(1 << 20) as i32;
        let correction = [1.0 - BETA1.powi(steps), 1.0 - beta2.powi(steps)];
        let unit = |[m, v]: [&mut f32; 2], gradient: f32| {
            *m = BETA1 * *m + (1.0 - BETA1) * gradient;
            *v = beta2 * *v + (1.0 - beta2) * gradient * gradient;
            (*m / correction[0]) / ((*v / correction[1]).sqrt() + EPSILON)
        };
        let longest = walk.height as f32;
        let scales = [0, 1, 2].map(|axis| splats.col(column::LOG_SCALE + axis));
        let [amplitudes, first, second] = &mut self.values;
        for i in 0..amplitudes.len() {
            let gradients = std::mem::take(&mut self.gradients[i]);
            if !is_seen(shown, i) || !gradients.iter().all(|value| value.is_finite()) {
                continue;
            }
            let size = (scales.iter().map(|of| of[i]).sum::<f32>() / 3.0).exp();
            for (k, gradient) in gradients.into_iter().enumerate() {
                let step = rate * size * unit([&mut first[i][k], &mut second[i][k]], gradient);
                let next = (1.0 - decay) * amplitudes[i][k] - step;
                if next.is_finite() {
                    // No limb is longer than its person.
                    amplitudes[i][k] = next.clamp(-longest, longest);
                }
            }
        }
        let gradient = std::mem::take(&mut self.frequency_gradient) as f32;
        if gradient.is_finite() {
            let [m, v] = &mut self.of_frequency;
            let turn = f64::from(-stride_rate * unit([m, v], gradient)).exp();
            self.frequency = Some(frequency * turn);
        }
    }

    /// The strides per metre that the photos pull at the most.
    fn choose(&mut self, walk: &Walk) -> f64 {
        self.flush();
        self.sums = Vec::new();
        let best = (0..self.power.len()).max_by(|&a, &b| self.power[a].total_cmp(&self.power[b]));
        let usual = 1.0 / (USUAL_STRIDE * walk.height);
        best.map_or(usual, |k| walk.candidates()[k])
    }

    /// Adds the power of the sums, and starts these anew.
    fn flush(&mut self) {
        let count = self.values[0].len();
        for (power, sums) in self.power.iter_mut().zip(self.sums.chunks_mut(count.max(1))) {
            for sum in sums {
                *power += std::mem::take(sum).iter().map(|value| f64::from(*value).powi(2)).sum::<f64>();
            }
        }
    }

    /// After densification: row `i` swings as old row `parents[i]`, with its moments where `rows[i]` has them.
    pub(crate) fn rearrange(&mut self, parents: &[u32], rows: &[Option<u32>]) {
        if self.frequency.is_none() {
            self.flush();
            self.sums = vec![[0.0; 6]; parents.len() * self.power.len()];
        }
        let [amplitudes, first, second] = &mut self.values;
        *amplitudes = parents.iter().map(|&i| amplitudes[i as usize]).collect();
        for moments in [first, second] {
            *moments = rows.iter().map(|row| row.map_or([0.0; NUMBERS], |i| moments[i as usize])).collect();
        }
        self.gradients = vec![[0.0; NUMBERS]; parents.len()];
    }

    /// What was trained; `None` where the stride was not chosen.
    pub(crate) fn swing(self, walk: &Walk) -> Option<Swing> {
        let [mut amplitudes, ..] = self.values;
        // From phases counted from the middle to those counted from the start of the path.
        let frequency = self.frequency?;
        let turned = terms(-frequency * walk.middle());
        for of_splat in &mut amplitudes {
            for harmonic in 0..HARMONICS {
                let [cos, sin] = [turned[2 * harmonic], turned[2 * harmonic + 1]];
                for axis in 6 * harmonic..6 * harmonic + 3 {
                    let (a, b) = (of_splat[axis], of_splat[axis + 3]);
                    (of_splat[axis], of_splat[axis + 3]) = (a * cos + b * sin, b * cos - a * sin);
                }
            }
        }
        Some(Swing { stride_metres: 1.0 / frequency, amplitudes })
    }
}

fn of_mean(gradients: &Gradients, i: usize) -> [f32; 3] {
    [0, 1, 2].map(|axis| gradients.columns[column::MEAN + axis][i])
}

fn is_seen(gradients: &Gradients, i: usize) -> bool {
    gradients.seen[i / 16] >> (i % 16) & 1 == 1
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3, Vec3};
    use scene::swing::displacement;
    use scene::{PathPose, Rigid, Splat};

    use super::*;

    const TRUE_STRIDE: f64 = 1.4;

    /// Someone of 1.75 m who walks at 1.3 m/s from second 2 on, seen ten times a second from second 3 to 6.
    fn walk() -> Walk {
        let pose = |seconds: f64| PathPose {
            seconds,
            world_from_object: Rigid {
                rotation: DQuat::IDENTITY,
                translation: DVec3::new(1.3 * (seconds - 2.0), 5.0, 0.0),
            },
        };
        let person = MovingObject {
            id: "a".into(),
            class: "person".into(),
            low: DVec3::new(-0.5, -0.3, 0.0),
            high: DVec3::new(0.5, 0.3, 1.75),
            path: (4..14).map(|half| pose(0.5 * f64::from(half))).collect(),
        };
        let taken = |view: u32| (view, 3.0 + 0.1 * f64::from(view));
        // Too few, too few of all, too few for their way, and not a step; and what is no person.
        assert_eq!(Walk::of((0..20).map(taken), |_| true, &person), None);
        assert_eq!(Walk::of((0..30).map(taken), |view| view < 20, &person), None);
        assert_eq!(Walk::of((0..24).map(|view| (view, 0.4 * f64::from(view))), |_| true, &person), None);
        assert_eq!(Walk::of((0..30).map(|view| (view, 3.0)), |_| true, &person), None);
        for height in [0.01, 150.0] {
            let other = MovingObject { high: person.high.with_z(height), ..person.clone() };
            assert_eq!(Walk::of((0..3000).map(|view| (view, 3.0 + 1e-3 * f64::from(view))), |_| true, &other), None);
        }
        Walk::of((0..30).map(taken), |view| view > 0, &person).unwrap()
    }

    /// The first splat stands, the second swings like a foot.
    fn splats() -> Splats {
        let mut splats = Splats::new(0);
        (0..2).for_each(|i| splats.push(&Splat::round(Vec3::splat(i as f32), 0.05f32.ln(), Vec3::ONE, 0.7)));
        splats
    }

    fn displaced(strides: f64) -> Vec3 {
        let angle = TAU * strides + 0.7;
        Vec3::new(0.4 * angle.sin() as f32, 0.0, 0.05 * (2.0 * angle).cos() as f32)
    }

    /// What pulls each splat to where it is in a view.
    fn gradients(walk: &Walk, swing: &SwingTraining, view: u32) -> Gradients {
        let mut drawn = splats();
        swing.apply(walk, &mut drawn, view);
        let place = |i: usize| splats().mean(i) + i as f32 * displaced(walk.metres[&view] / TRUE_STRIDE);
        let column = |axis: usize| (0..2).map(|i| (drawn.mean(i) - place(i))[axis]).collect();
        Gradients { columns: (0..3).map(column).collect(), seen: vec![3], ..Gradients::default() }
    }

    #[test]
    fn a_stride_is_heard_and_a_swing_found() {
        let walk = walk();
        let mut swing = SwingTraining::new(&walk, 2);
        assert!(walk.candidates().len() > 8 && (walk.length() - 3.77).abs() < 1e-6);
        for view in 0..30 {
            let pull = gradients(&walk, &swing, view);
            swing.add(&walk, &pull, view, SwingStep::Listen);
        }
        let train = |rate: f32| SwingStep::Train { rate, decay: 0.0, stride_rate: 1e-3 * rate, beta2: 0.99 };
        for step in 0..6000u32 {
            let view = (step * 7) % 30;
            let pull = gradients(&walk, &swing, view);
            swing.add(&walk, &pull, view, train(0.1));
            swing.step(&walk, &splats(), &pull, train(if step < 3000 { 0.1 } else { 0.01 }));
            if step == 0 {
                let heard = 1.0 / swing.frequency.unwrap();
                assert!((heard / TRUE_STRIDE - 1.0).abs() < 0.15, "{heard}");
            }
            if step == 100 {
                // Densification: the second splat is split, and the first goes.
                swing.rearrange(&[1, 1], &[None, None]);
                swing.rearrange(&[0, 1], &[Some(0), Some(1)]);
                swing.values[0][0] = [0.0; NUMBERS];
            }
        }
        let found = swing.swing(&walk).unwrap();
        assert!((found.stride_metres / TRUE_STRIDE - 1.0).abs() < 0.01, "{}", found.stride_metres);
        for view in 0..30 {
            let metres = walk.metres[&view];
            let of = |i: usize| displacement(&found.amplitudes[i], &terms(metres / found.stride_metres));
            assert!(of(0).length() < 0.01, "{}", of(0));
            let wanted = displaced(metres / TRUE_STRIDE);
            assert!((of(1) - wanted).length() < 0.03, "{view}: {} {wanted}", of(1));
        }
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        let walk = walk();
        let mut swing = SwingTraining::new(&walk, 2);
        swing.frequency = Some(0.75);
        swing.values[0][1] = std::array::from_fn(|k| 0.03 * (k as f32 - 5.0));
        let view = 25;
        // Half the square of what the pull is.
        let loss = |swing: &SwingTraining| {
            let pull = gradients(&walk, swing, view);
            pull.columns.iter().flatten().map(|value| 0.5 * f64::from(*value).powi(2)).sum::<f64>()
        };
        let mut added = swing.clone();
        let train = SwingStep::Train { rate: 0.1, decay: 0.0, stride_rate: 0.1, beta2: 0.99 };
        added.add(&walk, &gradients(&walk, &swing, view), view, train);
        let slope = |nudged: &dyn Fn(f64) -> SwingTraining| (loss(&nudged(1e-3)) - loss(&nudged(-1e-3))) / 2e-3;
        let of_frequency = slope(&|by| SwingTraining { frequency: Some(0.75 * by.exp()), ..swing.clone() });
        assert!((of_frequency - added.frequency_gradient).abs() < 1e-3, "{of_frequency} {}", added.frequency_gradient);
        for k in 0..NUMBERS {
            let numeric = slope(&|by| {
                let mut nudged = swing.clone();
                nudged.values[0][1][k] += by as f32;
                nudged
            });
            let computed = f64::from(added.gradients[1][k]);
            assert!((numeric - computed).abs() < 1e-3, "{k}: {numeric} {computed}");
        }
    }

    #[test]
    fn a_way_that_is_too_short_gets_the_usual_stride() {
        let short = Walk { metres: [(0, 0.0), (1, 1.0)].into(), height: 1.75 };
        let mut swing = SwingTraining::new(&short, 2);
        assert!(short.candidates().is_empty());
        let pull = Gradients { columns: vec![vec![1.0; 2]; 3], seen: vec![3], ..Gradients::default() };
        swing.add(&short, &pull, 0, SwingStep::Listen);
        let train = SwingStep::Train { rate: 0.1, decay: 0.0, stride_rate: 0.1, beta2: 0.99 };
        swing.step(&short, &splats(), &pull, train);
        assert!((swing.frequency.unwrap() * USUAL_STRIDE * 1.75 - 1.0).abs() < 1e-12);
    }
}
