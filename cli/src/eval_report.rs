//! The results of `plat eval`: as `eval/report.json` and as text.

use std::path::PathBuf;

use eval::cuts::CutFigures;
use eval::seams::SeamReport;
use eval::{
    AgainstTruth, BudgetFigures, ByKind, Correlation, Correlations, DepthReport, DetectionReport, Group, MovedReport,
    MovingFigures, ObjectFigures, Summary, ViewFigures, mean,
};
use perceive::{Counts, Precision};
use serde::Serialize;

use crate::run_record::Record;

/// `eval/report.json`.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Evaluated {
    #[serde(flatten)]
    pub(crate) record: Record,
    /// dB over the held-out views, each from the pose that fits its photo best.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) psnr_refined: Option<f64>,
    /// dB over the right halves of the held-out views, with the exposure fitted to the left half of each.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) psnr_fitted: Option<f64>,
    /// The contact sheet; tasks of a job draw none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) sheet: Option<PathBuf>,
    /// By view; those in held-out stretches are in `stretches`.
    pub(crate) views: Vec<ViewFigures>,
    /// Of these views, if both kinds are among them.
    #[serde(flatten)]
    pub(crate) by_kind: ByKind,
    /// With `--test-stretches`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) stretches: Option<Group>,
    /// With `--trained`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) trained_on: Option<Group>,
    /// With `--depth`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) depth: Option<DepthReport>,
    /// With `--detector`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) detections: Vec<DetectionReport>,
    /// With `--level`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) cuts: Vec<CutFigures>,
    /// With `--budget`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) budgets: Vec<BudgetFigures>,
    /// With `--seams` or `--seams-of`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) seams: Option<SeamReport>,
    /// Of objects that move, where the capture has some.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) moving: Option<MovingFigures>,
    /// With `--objects-later`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) objects_moved: Option<MovedReport>,
}

impl Evaluated {
    /// The figures of these views alone.
    pub(crate) fn new(record: Record, views: Vec<ViewFigures>) -> Self {
        let psnr_refined = mean(views.iter().map(|view| view.psnr_refined));
        let psnr_fitted = mean(views.iter().map(|view| view.psnr_fitted));
        Self {
            record,
            psnr_refined,
            psnr_fitted,
            sheet: None,
            views,
            by_kind: ByKind::default(),
            stretches: None,
            trained_on: None,
            depth: None,
            detections: Vec::new(),
            cuts: Vec::new(),
            budgets: Vec::new(),
            seams: None,
            moving: None,
            objects_moved: None,
        }
    }
}

/// The figures, a line per view, then cuts and seams.
pub(crate) fn text(evaluated: &Evaluated) -> String {
    let record = &evaluated.record;
    let column = |is_measured: Option<f64>, value, digits| {
        is_measured.map_or(String::new(), |_| format!(" {:>8}", figure(value, digits)))
    };
    let line = |name: &str, [psnr, cc_psnr, ssim, perceptual, lpips, refined, fitted]: [Option<f64>; 7]| {
        let lpips = column(record.lpips, lpips, 4)
            + &column(evaluated.psnr_refined, refined, 2)
            + &column(evaluated.psnr_fitted, fitted, 2);
        let [psnr, cc_psnr] = [psnr, cc_psnr].map(|value| figure(value, 2));
        format!("{psnr:>8} {cc_psnr:>8} {:>8} {:>11}{lpips}  {name}\n", figure(ssim, 4), figure(perceptual, 2))
    };
    let heading = |is_measured: Option<f64>, name: &str| is_measured.map_or(String::new(), |_| format!(" {name:>8}"));
    let lpips = heading(record.lpips, "LPIPS")
        + &heading(evaluated.psnr_refined, "refined")
        + &heading(evaluated.psnr_fitted, "fitted");
    let mut text = format!("{:>8} {:>8} {:>8} {:>11}{lpips}\n", "PSNR", "cc-PSNR", "SSIM", "SSIMULACRA2");
    for view in &evaluated.views {
        text += &line(
            &view.view,
            [
                view.psnr,
                view.cc_psnr,
                Some(view.ssim),
                view.perceptual,
                view.lpips,
                view.psnr_refined,
                view.psnr_fitted,
            ],
        );
    }
    let fitted = [evaluated.psnr_refined, evaluated.psnr_fitted];
    let mean_of = [record.psnr, record.cc_psnr, record.ssim, record.perceptual, record.lpips, fitted[0], fitted[1]];
    text += &line("mean", mean_of);
    for (name, summary) in summaries(evaluated) {
        let Summary { views, psnr, cc_psnr, ssim, ssimulacra2, lpips, worst_psnr, worst_cc_gap } = summary;
        let [worst, gap] = [worst_psnr, worst_cc_gap].map(|value| figure(value, 2));
        let name = format!("{name}: {views} views, worst {worst} dB, up to {gap} dB below cc-PSNR");
        text += &line(&name, [psnr, cc_psnr, ssim, ssimulacra2, lpips, None, None]);
    }
    text += &format!("rendered on {}\n", record.backend);
    if let Some(figures) = &evaluated.moving {
        text += &format!("\n{}", moving(figures));
    }
    if let Some(report) = &evaluated.depth {
        text += &format!("\n{}", depth(report));
    }
    if let Some(report) = &evaluated.objects_moved {
        text += &format!("\n{}", objects_moved(report));
    }
    for report in &evaluated.detections {
        text += &format!("\n{}", detections(report));
    }
    if !evaluated.cuts.is_empty() {
        text += &format!("\n{}\n", cuts(&evaluated.cuts));
    }
    if !evaluated.budgets.is_empty() {
        text += &format!("\n{}", budgets(&evaluated.budgets));
    }
    if let Some(report) = &evaluated.seams {
        text += &format!("\n{}\n\n", seams(report));
    }
    text + &evaluated.sheet.as_ref().map_or(String::new(), |sheet| sheet.display().to_string())
}

/// What detectors find of objects that were moved.
fn objects_moved(report: &MovedReport) -> String {
    let MovedReport { seconds, views, detectors } = report;
    let mut text = format!("objects {seconds} s later on their paths, on {views} held-out views\n");
    for of in detectors {
        let each = [("photos", of.photos), ("renders", of.renders), ("moved", of.moved)].map(|(name, found)| {
            let [map, map50] = [found.precision.map, found.precision.map50].map(|value| figure(value, 3));
            format!("{name} mAP {map}, at 0.5 {map50}, {} objects", found.boxes)
        });
        text += &format!("{}: {}\n", of.detector, each.join("; "));
    }
    text
}

/// Means of groups of views with their names.
fn summaries(evaluated: &Evaluated) -> Vec<(String, Summary)> {
    let by_kind = |of: &str, ByKind { aerial, street }: ByKind| {
        let named = [("aerial", aerial), ("street", street)];
        named.into_iter().filter_map(|(kind, summary)| Some((format!("{of}{kind}"), summary?))).collect::<Vec<_>>()
    };
    let mut all = by_kind("", evaluated.by_kind);
    for (name, group) in [("stretches", &evaluated.stretches), ("trained on", &evaluated.trained_on)] {
        let Some(group) = group else { continue };
        all.push((name.to_owned(), group.all));
        all.extend(by_kind(&format!("{name}, "), group.by_kind));
    }
    all
}

fn moving(figures: &MovingFigures) -> String {
    let MovingFigures { views, pixels, psnr, whole_psnr, objects } = figures;
    let mut text = format!("{:>8} {:>6} {:>11}  objects that move\n", "PSNR", "views", "pixels");
    text += &format!("{:>8} {views:>6} {pixels:>11}  all, mean over views\n", figure(*psnr, 2));
    for object in objects {
        let ObjectFigures { id, class, views, pixels, psnr } = object;
        text += &format!("{psnr:>8.2} {views:>6} {pixels:>11}  {id}, {class}\n");
    }
    text + &format!("{:>8} {:>18}  whole pictures, masked pixels included\n", figure(*whole_psnr, 2), "")
}

fn depth(report: &DepthReport) -> String {
    let heads = ["AbsRel", "RMSE m", "δ<1.25", "empty", "normal °", "n<30°"].map(|head| format!("{head:>8} ")).concat();
    let mut text = format!("{heads}{:>11}  depth against {}\n", "pixels", report.source);
    for (name, of) in report.groups.named() {
        let figures =
            [(of.absrel, 4), (of.rmse, 2), (of.delta1, 4), (of.empty, 4), (of.normal_degrees, 1), (of.normal_30, 4)];
        text += &figures.map(|(value, digits)| format!("{:>8} ", figure(value, digits))).concat();
        text += &format!("{:>11}  {name}: {} views\n", of.pixels, of.views);
    }
    text
}

fn detections(report: &DetectionReport) -> String {
    let mut text = String::from(" photos  renders     kept    extra  ");
    text += &format!("{}: detections with a score of {} or more\n", report.detector, report.score);
    for (name, of) in report.groups.named() {
        for (classes, Counts { photos, renders, kept, extra }) in of.counts.named() {
            let views = of.views;
            text += &format!("{photos:>7} {renders:>8} {kept:>8} {extra:>8}  {classes}, {name}: {views} views\n");
        }
    }
    let [map, map50, iou, psnr, ssim] = ["mAP", "mAP50", "mean IoU", "zone PSNR", "zone SSIM"];
    text += &format!("{map:>7} {map50:>8} {iou:>8} {psnr:>10} {ssim:>10}  renders against photos\n");
    for (name, of) in report.groups.named() {
        let [map, map50, iou, ssim] =
            [of.precision.map, of.precision.map50, of.mean_iou, of.zones.zone_ssim].map(|value| figure(value, 3));
        let (psnr, extra) = (figure(of.zones.zone_psnr, 2), of.extra);
        text +=
            &format!("{map:>7} {map50:>8} {iou:>8} {psnr:>10} {ssim:>10}  {name}: {} missed, {extra} extra", of.misses);
        let Correlations { views, psnr, ssim, lpips } = of.correlations;
        for (with, Correlation { r, p }) in
            [("PSNR", psnr), ("SSIM", ssim), ("LPIPS", lpips)].into_iter().filter_map(|(with, of)| Some((with, of?)))
        {
            text += &format!("\n{:>48} with {with}: r = {r:+.3}, p = {p:.2e} ({views} views)", "mAP");
        }
        text.push('\n');
        let Some(AgainstTruth { boxes, left_out, photos, renders }) = of.truth else { continue };
        for (of, Precision { map, map50 }) in [("photos", photos), ("renders", renders)] {
            let [map, map50] = [map, map50].map(|value| figure(value, 3));
            text += &format!("{map:>7} {map50:>8} {:>30}  {of} against {boxes} true boxes, {left_out} left out\n", "");
        }
    }
    text
}

fn figure(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".into(), |v| format!("{v:.digits$}"))
}

fn cuts(cuts: &[CutFigures]) -> String {
    let mut text = String::from(
        "                  at full resolution        at its viewing distance\n\
         cut         splats    PSNR    loss    mip    PSNR    loss  gain on the pruned finest   rendered\n",
    );
    for cut in cuts {
        let name = format!("level {}", cut.level);
        let (way, best) = cut.away.best();
        text += &format!(
            "{name:<10} {:>7.0} {:>7} {:>7} {:>6.1} {:>7} {:>7} {:>26}   {way}\n",
            cut.splats,
            figure(cut.full.psnr, 2),
            figure(cut.loss_db, 2),
            cut.away_mip,
            figure(best.psnr, 2),
            figure(cut.away_loss_db, 2),
            cut.away_gain_db.map_or("-".into(), |db| format!("{db:+.2}")),
        );
    }
    text
}

fn budgets(budgets: &[BudgetFigures]) -> String {
    let mut text = String::from("  budget    drawn    PSNR    loss  gain on as many of the most important splats\n");
    for of in budgets {
        let gain = of.gain_db.map_or("-".into(), |db| format!("{db:+.2}"));
        let (psnr, loss) = (figure(of.figures.psnr, 2), figure(of.loss_db, 2));
        text += &format!("{:>8} {:>8.0} {psnr:>7} {loss:>7} {gain:>5}\n", of.budget, of.drawn);
    }
    text
}

fn seams(report: &SeamReport) -> String {
    let mut text = format!(
        "band within {:.2} m of a face ({:.1} % of the pixels of {} views) / interior ({:.1} %)\n",
        report.seam_metres,
        100.0 * report.seam_share,
        report.views,
        100.0 * report.interior_share
    );
    let mut lines = vec![("MODEL", &report.figures)];
    lines.extend(report.of.as_ref().map(|of| ("--seams-of", of)));
    text += &format!("{:<10}  {:>14}  {:>15}  {:>15}  gap dB\n", "", "PSNR", "SSIM", "FLIP");
    for (name, f) in lines {
        text += &format!(
            "{name:<10}  {:>6} / {:>5}  {:>6} / {:>6}  {:>6} / {:>6}  {:>6}\n",
            figure(f.seam_psnr, 2),
            figure(f.interior_psnr, 2),
            figure(f.seam_ssim, 4),
            figure(f.interior_ssim, 4),
            figure(f.seam_flip, 4),
            figure(f.interior_flip, 4),
            figure(f.gap_db, 2),
        );
    }
    if let Some(cost) = report.faces_cost_db {
        text += &format!("the faces cost {cost:.2} dB\n");
    }
    text += "face                  views    jump    step";
    text += if report.of.is_some() { "  (MODEL's)\n" } else { "  levels of 255\n" };
    for face in &report.faces {
        let control = face.control_step.map_or(String::new(), |step| format!("  ({step:.1})"));
        let name = format!("{} | {}", face.a, face.b);
        let (jump, step) = (figure(face.jump, 1), figure(face.step, 1));
        text += &format!("{name:<20} {:>6} {jump:>7} {step:>7}{control}\n", face.views);
    }
    text + &format!("{}\n{}", report.sheet.display(), report.birdseye.display())
}
