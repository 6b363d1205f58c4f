//! The table of `plat bench stability`: a row for each case, without and with its counter-measure.

use ::bench::Judged;
use ::bench::parts::Stability;
use serde::Serialize;

use crate::stability_cases::Case;

/// The name of a capture that a case made.
pub(crate) const GENERATED: &str = "generated";

/// Means of a case over its seeds, without and with its counter-measure.
#[derive(Debug, Serialize)]
pub(crate) struct Row {
    case: &'static str,
    about: &'static str,
    capture: String,
    counter: Option<&'static str>,
    seeds: usize,
    refused: Option<String>,
    off: Option<Means>,
    on: Option<Means>,
    /// Figures that the counter-measure makes better and worse, of those that the case is about; null without one.
    verdict: Option<String>,
}

#[derive(Debug, Clone, Copy, Default, Serialize)]
struct Means {
    psnr: Option<f64>,
    street_psnr: Option<f64>,
    fitted_psnr: Option<f64>,
    depth_absrel: Option<f64>,
    seam_db: Option<f64>,
    zone_psnr: Option<f64>,
    /// Share of the objects on the photos, of all detectors.
    missed: Option<f64>,
    splats: Option<f64>,
    cpu_seconds: Option<f64>,
}

/// The row of a case, of its lines.
pub(crate) fn row(case: &Case, lines: &[Stability]) -> Row {
    let of = |on: bool| -> Vec<&Stability> { lines.iter().filter(|line| line.on == on).collect() };
    let refused = lines.iter().find_map(|line| line.refused.clone());
    let means = |on: bool| {
        let lines = of(on);
        (!lines.is_empty() && lines.iter().all(|line| line.refused.is_none())).then(|| means(&lines))
    };
    let (off, on) = (means(false), means(true));
    let verdict = off.zip(on).map(|(off, on)| verdict(case, &off, &on));
    Row {
        case: case.name,
        about: case.about,
        capture: lines.first().map_or(String::new(), |line| line.capture.clone()),
        counter: case.counter.name(),
        seeds: of(true).len().max(of(false).len()),
        verdict: if refused.is_some() { Some("yes".to_owned()) } else { verdict },
        refused,
        off,
        on,
    }
}

/// Which of the figures that a case is about are better with the counter-measure.
fn verdict(case: &Case, off: &Means, on: &Means) -> String {
    type Figure = (&'static str, fn(&Means) -> Option<f64>);
    const PSNR: Figure = ("PSNR", |of| of.street_psnr.or(of.psnr));
    let figures: &[Figure] = match case.eval {
        "--seams" => &[("seams", |of| of.seam_db), PSNR],
        "--fit-exposure" => &[("PSNR after the fit", |of| of.fitted_psnr)],
        "--depth" => &[PSNR, ("depth", |of| of.depth_absrel.map(|error| -error))],
        _ => &[PSNR],
    };
    let names = |is_better: bool| {
        let of_kind = figures.iter().filter(|(_, figure)| (figure(on) > figure(off)) == is_better);
        of_kind.map(|(name, _)| *name).collect::<Vec<_>>().join(", ")
    };
    let (better, worse) = (names(true), names(false));
    match (better.is_empty(), worse.is_empty()) {
        (_, true) => "yes".to_owned(),
        (true, _) => "**no**".to_owned(),
        _ => format!("{better}; **not {worse}**"),
    }
}

fn means(lines: &[&Stability]) -> Means {
    let mean = |value: &dyn Fn(&Stability) -> Option<f64>| eval::mean(lines.iter().map(|line| value(line)));
    Means {
        psnr: mean(&|line| line.psnr),
        street_psnr: mean(&|line| line.street_psnr),
        fitted_psnr: mean(&|line| line.fitted_psnr),
        depth_absrel: mean(&|line| line.depth_absrel),
        seam_db: mean(&|line| line.seam_db),
        zone_psnr: mean(&|line| eval::mean(line.judged.iter().map(|of| of.zone_psnr))),
        missed: mean(&|line| missed(&line.judged)),
        splats: mean(&|line| Some(line.splats as f64)),
        cpu_seconds: mean(&|line| Some(line.cpu_seconds)),
    }
}

fn missed(judged: &[Judged]) -> Option<f64> {
    let [misses, objects] =
        [|of: &Judged| of.misses, |of: &Judged| of.objects].map(|of| judged.iter().map(of).sum::<u64>());
    (objects > 0).then(|| misses as f64 / objects as f64)
}

/// A row for each case, off → on.
pub(crate) fn table(rows: &[Row]) -> String {
    let mut text = "| case | what goes wrong | counter-measure | better | PSNR street (all), dB | after exposure fit, dB | depth AbsRel | seams, dB | in zones, dB | objects missed | splats | CPU s |\n".to_owned();
    text += "|---|---|---|---|---|---|---|---|---|---|---|---|\n";
    for row in rows {
        let pair = |value: &dyn Fn(&Means) -> Option<f64>, write: &dyn Fn(f64) -> String| {
            let of = |means: &Option<Means>| means.as_ref().and_then(value).map(write);
            match (of(&row.off), of(&row.on)) {
                (None, None) => "–".to_owned(),
                (Some(off), None) => off,
                (off, Some(on)) => format!("{} → {on}", off.unwrap_or_else(|| "–".into())),
            }
        };
        let decibels = |value: f64| format!("{value:.2}");
        let whole = |value: f64| format!("{value:.0}");
        let street = pair(&|of| of.street_psnr, &decibels);
        let all = pair(&|of| of.psnr, &decibels);
        let better = row.verdict.clone().unwrap_or_else(|| "remains".to_owned());
        let capture = if row.capture == GENERATED { String::new() } else { format!(" ({})", row.capture) };
        let about = match (&row.refused, &row.on) {
            (None, _) => row.about.to_owned(),
            (Some(_), None) => format!("{}: refused", row.about),
            (Some(_), Some(_)) => format!("{}: refused without", row.about),
        };
        let cells = [
            format!("{}{capture}", row.case),
            about,
            row.counter.unwrap_or("none").to_owned(),
            better,
            if street == "–" { all } else { format!("{street} ({all})") },
            pair(&|of| of.fitted_psnr, &decibels),
            pair(&|of| of.depth_absrel, &|value| format!("{value:.3}")),
            pair(&|of| of.seam_db, &|value| format!("{value:+.2}")),
            pair(&|of| of.zone_psnr, &decibels),
            pair(&|of| of.missed, &|value| format!("{:.0} %", 100.0 * value)),
            pair(&|of| of.splats, &whole),
            pair(&|of| of.cpu_seconds, &whole),
        ];
        text += &format!("| {} |\n", cells.join(" | "));
    }
    text
}
