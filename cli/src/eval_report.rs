//! The results of `plat eval`: as `eval/report.json` and as text.

use std::path::PathBuf;

use eval::cuts::CutFigures;
use eval::seams::SeamReport;
use eval::{ByKind, Group, Summary, ViewFigures};
use serde::Serialize;

use crate::run_record::Record;

/// `eval/report.json`.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Evaluated {
    #[serde(flatten)]
    pub(crate) record: Record,
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
    /// With `--level` or `--budget`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) cuts: Vec<CutFigures>,
    /// With `--seams` or `--seams-of`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) seams: Option<SeamReport>,
}

/// The figures, a line per view, then cuts and seams.
pub(crate) fn text(evaluated: &Evaluated) -> String {
    let record = &evaluated.record;
    let line = |name: &str, [psnr, cc_psnr, ssim, perceptual, lpips]: [Option<f64>; 5]| {
        let lpips = record.lpips.map_or(String::new(), |_| format!(" {:>8}", figure(lpips, 4)));
        let [psnr, cc_psnr] = [psnr, cc_psnr].map(|value| figure(value, 2));
        format!("{psnr:>8} {cc_psnr:>8} {:>8} {:>11}{lpips}  {name}\n", figure(ssim, 4), figure(perceptual, 2))
    };
    let lpips = if record.lpips.is_some() { "    LPIPS" } else { "" };
    let mut text = format!("{:>8} {:>8} {:>8} {:>11}{lpips}\n", "PSNR", "cc-PSNR", "SSIM", "SSIMULACRA2");
    for view in &evaluated.views {
        text += &line(&view.view, [view.psnr, view.cc_psnr, Some(view.ssim), view.perceptual, view.lpips]);
    }
    text += &line("mean", [record.psnr, record.cc_psnr, record.ssim, record.perceptual, record.lpips]);
    for (name, summary) in summaries(evaluated) {
        let Summary { views, psnr, cc_psnr, ssim, ssimulacra2, lpips, worst_psnr, worst_cc_gap } = summary;
        let [worst, gap] = [worst_psnr, worst_cc_gap].map(|value| figure(value, 2));
        let name = format!("{name}: {views} views, worst {worst} dB, up to {gap} dB below cc-PSNR");
        text += &line(&name, [psnr, cc_psnr, ssim, ssimulacra2, lpips]);
    }
    text += &format!("rendered on {}\n", record.backend);
    if !evaluated.cuts.is_empty() {
        text += &format!("\n{}\n", cuts(&evaluated.cuts));
    }
    if let Some(report) = &evaluated.seams {
        text += &format!("\n{}\n\n", seams(report));
    }
    text + &evaluated.sheet.as_ref().map_or(String::new(), |sheet| sheet.display().to_string())
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

fn figure(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".into(), |v| format!("{v:.digits$}"))
}

fn cuts(cuts: &[CutFigures]) -> String {
    let mut text = String::from(
        "                  at full resolution        at its viewing distance\n\
         cut         splats    PSNR    loss    mip    PSNR    loss  gain on the pruned finest   rendered\n",
    );
    for cut in cuts {
        let name = match (cut.level, cut.budget) {
            (Some(level), _) => format!("level {level}"),
            (_, Some(budget)) => format!("≤{budget}"),
            (None, None) => String::new(),
        };
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
