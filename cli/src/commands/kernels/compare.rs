//! Compares the results of two backends for the same view, stage by stage.

use std::collections::{BTreeMap, BTreeSet};

use ::render::cpu::Stage;
use ::render::{BackwardIntermediates, ForwardIntermediates, Frame, Gradients, MOMENTS};
use serde::Serialize;

/// Share of pixels, plus one, that may exceed [`tolerance_of`], and of splats or pairs that only one backend may have. Rounding may
/// flip decisions: whether an ellipse reaches a tile, whether α reaches 1/255.
const SHARE_ALLOWED: f64 = 1e-3;

/// Largest relative error of a value; each comparison defines what it is relative to.
fn tolerance_of(stage: Stage) -> f64 {
    match stage {
        // 1.2e-4 was measured on llvmpipe by render/tests/gpu.rs.
        Stage::Project => 1e-3,
        // 7.5e-6 was measured, of depths.
        Stage::Sort => 3e-5,
        Stage::Bin => 0.0,
        // A pixel may have one splat more, at α = 1/255.
        Stage::Rasterize => 5e-3,
        // 9.4e-4 was measured, of a column's length.
        Stage::RasterizeBackward | Stage::Reduce | Stage::ProjectBackward => 3e-3,
    }
}

/// All results of one view.
pub(super) struct Drawn {
    pub(super) stages: ForwardIntermediates,
    pub(super) frame: Frame,
    pub(super) moments: BackwardIntermediates,
    pub(super) gradients: Gradients,
}

/// Differences between the GPU's and the CPU's results of a stage, over all views.
#[derive(Debug, Clone, Default, Serialize)]
pub(super) struct Compared {
    pub(super) stage: &'static str,
    /// Values compared.
    pub(super) values: u64,
    /// Values beyond the tolerance.
    pub(super) off: u64,
    /// Splats or pairs that only one backend has.
    pub(super) alone: u64,
    /// All splats or pairs.
    pub(super) of: u64,
    /// Largest absolute difference.
    pub(super) largest_absolute: f64,
    /// Its location.
    pub(super) absolute_at: String,
    /// Largest relative difference.
    pub(super) largest_relative: f64,
    /// Its location.
    pub(super) relative_at: String,
    pub(super) tolerance: f64,
    pub(super) within: bool,
}

impl Compared {
    pub(super) fn of(stage: Stage) -> Self {
        Self { stage: stage.name(), tolerance: tolerance_of(stage), ..Self::default() }
    }

    pub(super) fn add(&mut self, stage: Stage, view: usize, ours: &Drawn, theirs: &Drawn) {
        match stage {
            Stage::Project => self.records(view, &ours.stages, &theirs.stages),
            Stage::Sort => self.order(view, &ours.stages, &theirs.stages),
            Stage::Bin => self.tiles(view, &ours.stages, &theirs.stages),
            Stage::Rasterize => self.planes(view, &ours.frame, &theirs.frame),
            Stage::RasterizeBackward => {
                let keyed = |moments: &BackwardIntermediates| {
                    moments.pairs.iter().map(|&(tile, splat, m)| ((tile, splat), m)).collect::<BTreeMap<_, _>>()
                };
                let place = |(tile, splat): &(u32, u32)| format!("splat {splat}, tile {tile}");
                self.moments(view, &keyed(&ours.moments), &keyed(&theirs.moments), place);
            }
            Stage::Reduce => {
                let keyed =
                    |moments: &BackwardIntermediates| moments.splats.iter().copied().collect::<BTreeMap<_, _>>();
                let place = |splat: &u32| format!("splat {splat}");
                self.moments(view, &keyed(&ours.moments), &keyed(&theirs.moments), place);
            }
            Stage::ProjectBackward => self.gradients(view, &ours.gradients, &theirs.gradients),
        }
    }

    /// Projected splats. Errors are relative to 1 + |value|.
    fn records(&mut self, view: usize, ours: &ForwardIntermediates, theirs: &ForwardIntermediates) {
        const NAMES: [&str; 12] = [
            "mean x",
            "mean y",
            "a",
            "b",
            "c",
            "log2 opacity",
            "red",
            "green",
            "blue",
            "depth",
            "half width",
            "half height",
        ];
        let by_splat = |stages: &ForwardIntermediates| -> BTreeMap<u32, [f32; 12]> {
            stages.order.iter().copied().zip(stages.records.iter().copied()).collect()
        };
        let (ours, theirs) = (by_splat(ours), by_splat(theirs));
        self.count_alone(&ours, &theirs);
        for (i, ours) in &ours {
            let Some(theirs) = theirs.get(i) else { continue };
            for ((a, b), name) in ours.iter().zip(theirs).zip(NAMES) {
                self.value(*a, *b, 1.0 + f64::from(b.abs()), &|| format!("{name} of splat {i}, view {view}"));
            }
        }
    }

    /// Depths by rank, of the splats that both have: splats of nearly equal depth may be swapped.
    fn order(&mut self, view: usize, ours: &ForwardIntermediates, theirs: &ForwardIntermediates) {
        let splats = |stages: &ForwardIntermediates| -> BTreeSet<u32> { stages.order.iter().copied().collect() };
        let (of_ours, of_theirs) = (splats(ours), splats(theirs));
        self.of += of_theirs.len() as u64;
        self.alone += of_ours.symmetric_difference(&of_theirs).count() as u64;
        let depths = |stages: &ForwardIntermediates| -> Vec<(u32, f32)> {
            let all = stages.order.iter().zip(&stages.records).map(|(&i, record)| (i, record[9]));
            all.filter(|(i, _)| of_ours.contains(i) && of_theirs.contains(i)).collect()
        };
        for (rank, ((i, a), (j, b))) in depths(ours).into_iter().zip(depths(theirs)).enumerate() {
            self.value(a, b, f64::from(b.abs()), &|| format!("rank {rank}, splats {i} and {j}, view {view}"));
        }
    }

    /// The splats of each tile, front to back.
    fn tiles(&mut self, view: usize, ours: &ForwardIntermediates, theirs: &ForwardIntermediates) {
        let of_tile = |stages: &ForwardIntermediates, tile: usize| -> BTreeMap<u32, u32> {
            let pairs = &stages.pairs[stages.start[tile] as usize..stages.start[tile + 1] as usize];
            pairs.iter().map(|&rank| (stages.order[rank as usize], rank)).collect()
        };
        for tile in 0..theirs.start.len().min(ours.start.len()).saturating_sub(1) {
            let before = self.alone;
            self.count_alone(&of_tile(ours, tile), &of_tile(theirs, tile));
            let out_of_order = |stages: &ForwardIntermediates| {
                let pairs = &stages.pairs[stages.start[tile] as usize..stages.start[tile + 1] as usize];
                pairs.windows(2).filter(|w| w[0] >= w[1]).count()
            };
            self.values += 1;
            let wrong = (out_of_order(ours) + out_of_order(theirs)) as f64;
            let apart = (self.alone - before) as f64;
            if apart > self.largest_absolute {
                (self.largest_absolute, self.absolute_at) = (apart, format!("tile {tile}, view {view}"));
            }
            if wrong > self.largest_relative {
                self.off += 1;
                (self.largest_relative, self.relative_at) = (wrong, format!("order within tile {tile}, view {view}"));
            }
        }
        self.alone += ours.start.len().abs_diff(theirs.start.len()) as u64 * theirs.pairs.len().max(1) as u64;
    }

    /// Pixels. Errors of depth are relative to 1 + depth.
    fn planes(&mut self, view: usize, ours: &Frame, theirs: &Frame) {
        let (area, width) = (theirs.transmittance.len().max(1), theirs.width.max(1));
        let colours =
            ["red", "green", "blue"].into_iter().zip(ours.colour.chunks(area).zip(theirs.colour.chunks(area)));
        let others = [
            ("transmittance", (&ours.transmittance[..], &theirs.transmittance[..])),
            ("depth", (&ours.depth[..], &theirs.depth[..])),
            ("own", (&ours.trainable_alpha[..], &theirs.trainable_alpha[..])),
        ];
        for (name, (ours, theirs)) in colours.chain(others) {
            for (i, (a, b)) in ours.iter().zip(theirs).enumerate() {
                let size = if name == "depth" { 1.0 + f64::from(b.abs()) } else { 1.0 };
                let (x, y) = (i % width, i / width);
                self.value(*a, *b, size, &|| format!("{name} of pixel {x}, {y}, view {view}"));
            }
        }
    }

    /// BackwardIntermediates by key. Each moment's error is relative to the length of its column.
    fn moments<K: Ord>(
        &mut self,
        view: usize,
        ours: &BTreeMap<K, [f32; MOMENTS]>,
        theirs: &BTreeMap<K, [f32; MOMENTS]>,
        place: impl Fn(&K) -> String,
    ) {
        self.count_alone(ours, theirs);
        let keys: Vec<&K> = ours.keys().filter(|key| theirs.contains_key(key)).collect();
        for k in 0..MOMENTS {
            let [a, b] = [ours, theirs].map(|all| keys.iter().map(|key| all[key][k]).collect::<Vec<f32>>());
            self.column(&a, &b, &|i| format!("moment {k} of {}, view {view}", place(keys[i])));
        }
    }

    fn gradients(&mut self, view: usize, ours: &Gradients, theirs: &Gradients) {
        let columns = |gradients: &Gradients| -> Vec<Vec<f32>> {
            let statistics = [&gradients.screen_gradient, &gradients.screen_gradient_abs, &gradients.weight];
            gradients.columns.iter().chain(statistics).cloned().collect()
        };
        let (ours_all, theirs_all) = (columns(ours), columns(theirs));
        for (k, (a, b)) in ours_all.iter().zip(&theirs_all).enumerate() {
            self.column(a, b, &|i| format!("column {k} of splat {i}, view {view}"));
        }
    }

    /// A column as a whole: length of the difference over length of the column.
    fn column(&mut self, ours: &[f32], theirs: &[f32], place: &dyn Fn(usize) -> String) {
        let difference = |i: usize| f64::from(ours[i]) - f64::from(theirs[i]);
        let all = 0..ours.len().min(theirs.len());
        let apart: f64 = all.clone().map(|i| difference(i).powi(2)).sum();
        let length: f64 = theirs.iter().map(|&b| f64::from(b).powi(2)).sum();
        let worst = all.clone().max_by(|&i, &j| difference(i).abs().total_cmp(&difference(j).abs()));
        let Some(worst) = worst else { return };
        let relative = if apart == 0.0 { 0.0 } else { (apart / length).sqrt() };
        self.values += 1;
        self.note(difference(worst).abs(), relative, &|| place(worst));
    }

    /// One value; its error is relative to `size`.
    fn value(&mut self, ours: f32, theirs: f32, size: f64, place: &dyn Fn() -> String) {
        let apart = (f64::from(ours) - f64::from(theirs)).abs();
        self.values += 1;
        // Equal bits are equal, NaN included.
        let (apart, relative) = if ours.to_bits() == theirs.to_bits() { (0.0, 0.0) } else { (apart, apart / size) };
        self.note(apart, relative, place);
    }

    fn note(&mut self, absolute: f64, relative: f64, place: &dyn Fn() -> String) {
        // NaN counts as the largest error.
        let [absolute, relative] = [absolute, relative].map(|v| if v.is_finite() { v } else { f64::MAX });
        self.off += u64::from(relative > self.tolerance);
        if absolute > self.largest_absolute {
            (self.largest_absolute, self.absolute_at) = (absolute, place());
        }
        if relative > self.largest_relative {
            (self.largest_relative, self.relative_at) = (relative, place());
        }
    }

    fn count_alone<K: Ord, V>(&mut self, ours: &BTreeMap<K, V>, theirs: &BTreeMap<K, V>) {
        let lacking = |a: &BTreeMap<K, V>, b: &BTreeMap<K, V>| a.keys().filter(|key| !b.contains_key(key)).count();
        self.alone += (lacking(ours, theirs) + lacking(theirs, ours)) as u64;
        self.of += theirs.len() as u64;
    }

    pub(super) fn judged(self) -> Self {
        let few = |some: u64, of: u64| some as f64 <= 1.0 + SHARE_ALLOWED * of as f64;
        // A few pixels may differ, but no sum and no rank.
        let off = if self.stage == Stage::Rasterize.name() { few(self.off, self.values) } else { self.off == 0 };
        Self { within: off && few(self.alone, self.of), ..self }
    }

    pub(super) fn text(&self) -> String {
        format!(
            "{:<19} {}  largest error {:.1e}, relative {:.1e} (tolerance {:.0e}); {} of {} values beyond it, {} of {} on one backend only",
            self.stage,
            if self.within { "matches" } else { "DIFFERS" },
            self.largest_absolute,
            self.largest_relative,
            self.tolerance,
            self.off,
            self.values,
            self.alone,
            self.of,
        )
    }
}

#[cfg(test)]
mod tests {
    use ::render::Options;
    use ::render::cpu::Renderer;

    use super::*;
    use crate::args::Size;
    use crate::commands::kernels::scene::{Scene, cloud, front};

    fn scene() -> Scene {
        let size = Size { width: 96, height: 64 };
        Scene { splats: cloud(400), options: Options::default(), cameras: vec![front(size)] }
    }

    fn drawn(scene: &Scene) -> Drawn {
        let options = Options { extras: true, ..scene.options };
        Drawn::on_cpu(&mut Renderer::default(), scene, &scene.cameras[0], &options)
    }

    /// Whether each stage is within its tolerance.
    fn within(ours: &Drawn, theirs: &Drawn) -> Vec<bool> {
        let judge = |stage| {
            let mut compared = Compared::of(stage);
            compared.add(stage, 0, ours, theirs);
            assert!(compared.values > 0, "{compared:?}");
            compared.judged().within
        };
        Stage::ALL.into_iter().map(judge).collect()
    }

    #[test]
    fn the_damaged_stage_is_found() {
        let scene = scene();
        let sound = drawn(&scene);
        assert!(within(&sound, &sound).iter().all(|&within| within));
        type Damage = fn(&mut Drawn);
        let damages: [(Stage, Damage); 7] = [
            (Stage::Project, |d| d.stages.records[7][4] += 0.1),
            (Stage::Sort, |d| {
                d.stages.order.swap(3, 200);
                d.stages.records.swap(3, 200);
            }),
            (Stage::Bin, |d| {
                let from = d.stages.start.windows(2).position(|w| w[1] - w[0] > 2).expect("a full tile");
                d.stages.pairs.swap(d.stages.start[from] as usize, d.stages.start[from] as usize + 1);
            }),
            (Stage::Rasterize, |d| d.frame.colour[..300].iter_mut().for_each(|v| *v += 0.02)),
            (Stage::RasterizeBackward, |d| d.moments.pairs.iter_mut().for_each(|pair| pair.2[6] *= 1.01)),
            (Stage::Reduce, |d| d.moments.splats.iter_mut().for_each(|splat| splat.1[12] = f32::NAN)),
            (Stage::ProjectBackward, |d| d.gradients.columns[10].iter_mut().for_each(|v| *v = -*v)),
        ];
        for (stage, damage) in damages {
            let mut damaged = drawn(&scene);
            damage(&mut damaged);
            let found: Vec<Stage> = Stage::ALL
                .into_iter()
                .zip(within(&damaged, &sound))
                .filter(|(_, within)| !within)
                .map(|(s, _)| s)
                .collect();
            // Records are compared by splat, so wrong sorting does not show in the projection.
            let first = found.first();
            assert_eq!(first, Some(&stage), "{found:?}");
        }
    }
}
