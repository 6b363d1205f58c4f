//! Collects the figures that a job's evaluation tasks measured.

use std::path::Path;

use blocks::{Part, Plan, Split, view_kinds};
use eval::{ByKind, Group, ViewFigures};
use model::save_json;
use scene::{ArtefactId, Capture};
use store::BlockingStore;

use crate::eval_report::Evaluated;
use crate::failure::{Failure, make_folder};
use crate::run_record::Record;

/// Reads the figures from the results of all tasks of the plan, in the plan's order, and writes them to `OUT/eval/report.json`. `None`
/// without evaluation tasks. `about` says what was trained.
///
/// # Errors
/// A store that fails, a damaged result, a file that cannot be written.
pub(crate) fn collect(
    (plan, capture): (&Plan, &Capture),
    results: &[ArtefactId],
    store: &BlockingStore,
    about: Record,
    out: &Path,
) -> Result<Option<Evaluated>, Failure> {
    if plan.eval_tasks.is_empty() {
        return Ok(None);
    }
    let figures = views_of(results.get(plan.tasks.len()..plan.first_detection()).unwrap_or_default(), store)?;
    let (kinds, split) = (view_kinds(capture), Split::of(plan, capture));
    let measured = plan.eval_tasks.iter().flat_map(|task| &task.views).copied().zip(figures);
    type Measured = (Vec<u32>, Vec<ViewFigures>);
    let (stretches, test): (Vec<_>, Vec<_>) = measured.partition(|(view, _)| split.part(*view) == Part::Stretch);
    let [(test, views), (stretches, in_stretches)]: [Measured; 2] = [test, stretches].map(|of| of.into_iter().unzip());
    let mut record = Record { wall_seconds: None, cpu_seconds: None, command: "eval", ..about };
    record.set_figures(&views);
    let evaluated = Evaluated {
        by_kind: ByKind::of(&views, &test, &kinds),
        stretches: Group::of(in_stretches, &stretches, &kinds),
        ..Evaluated::new(record, views)
    };
    let folder = out.join("eval");
    make_folder(&folder)?;
    save_json(&folder.join("report.json"), &evaluated)?;
    Ok(Some(evaluated))
}

/// Adds to the failure of a task after those of blocks that the model was written.
pub(crate) fn model_is_kept(failure: Failure, plan: &Plan, out: &Path) -> Failure {
    let what = if plan.object_tasks.is_empty() { "model" } else { "model without what moves" };
    let kept = |line: String| format!("{line}; the {what} is complete in {}, and plat eval measures it", out.display());
    match failure {
        Failure::Input(line) => Failure::Input(kept(line)),
        Failure::Work(line) => Failure::Work(kept(line)),
    }
}

/// The views that evaluation tasks measured, by the tasks' results.
fn views_of(results: &[ArtefactId], store: &BlockingStore) -> Result<Vec<ViewFigures>, Failure> {
    let mut views = Vec::new();
    for &id in results {
        let damaged = |error| Failure::Work(format!("the evaluation {id} in {}: {error}", store.store().url()));
        views.extend(eval::figures_from_frame(&store.get(id)?).map_err(damaged)?);
    }
    Ok(views)
}

#[cfg(test)]
mod tests {
    use store::Store;

    use super::*;

    #[test]
    fn views_of_all_tasks_are_read_in_order() {
        let store = Store::open("memory://").unwrap().blocking();
        let view = |name: &str, psnr: Option<f64>| ViewFigures {
            view: name.into(),
            psnr,
            cc_psnr: psnr,
            ssim: 0.5,
            perceptual: None,
            lpips: None,
            psnr_refined: None,
            psnr_fitted: psnr,
        };
        let tasks = [vec![view("a", Some(20.0)), view("b", None)], vec![view("c", Some(30.0))]];
        let ids: Vec<ArtefactId> = tasks.iter().map(|task| store.put(eval::figures_to_frame(task)).unwrap()).collect();
        assert_eq!(views_of(&ids, &store).unwrap(), tasks.concat());
        let splats = store.put(scene::frame::encode_splats(&scene::Splats::new(0))).unwrap();
        let line = views_of(&[ids[0], splats], &store).unwrap_err().to_string();
        assert!(line.contains(&splats.to_string()) && line.contains("not a plat 'figs' frame"), "{line}");
    }
}
