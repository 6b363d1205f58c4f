//! Result lines as Markdown tables between two markers: all runs for the documents, a selection for the README.

use std::fmt::Write;

use crate::{Averaged, ResultLine, averaged, scenes};

const BEGIN: &str = "<!-- bench:begin -->";
const END: &str = "<!-- bench:end -->";
/// Maximum number of rows of [`short_table`].
const SHORT_ROWS: usize = 15;

/// The runs of each scene and label that [`averaged`] keeps, references (lines with a source) first; of several seeds the mean, with the
/// range of PSNR. The column of times has the CPU seconds to the reference's best PSNR, and the speed-up over the reference.
pub fn table(lines: &[ResultLine]) -> String {
    let runs = averaged(lines);
    let mut text = String::from(
        "| scene | run | backend | PSNR, dB | street, aerial, dB | SSIM | SSIMULACRA2 | CPU s | estimate over outcome | to the reference's best, CPU s | splats | peak MB |\n\
         |---|---|---|---:|---|---:|---:|---:|---:|---:|---:|---:|\n",
    );
    for scene in scenes(runs.iter().map(|run| &run.line)) {
        let of_scene = |referred: bool| {
            runs.iter().filter(move |run| run.line.scene == scene && run.line.source.is_some() == referred)
        };
        let reference = of_scene(true).next().map(|run| &run.line);
        for run in of_scene(true).chain(of_scene(false)) {
            let line = &run.line;
            // Writing to a String cannot fail.
            let _ = writeln!(
                text,
                "| {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
                scene_cell(line),
                cell(&name(run)),
                cell(&line.backend),
                psnr(run),
                apart(line),
                number(line.ssim, 3),
                number(line.perceptual, 1),
                seconds(line.cpu_seconds),
                number(line.predicted_cpu_seconds.map(|predicted| predicted / line.cpu_seconds), 2),
                reference.map_or("–".into(), |reference| to_best(line, reference)),
                line.splats.map_or("–".into(), thousands),
                number(line.peak_memory_bytes.map(|bytes| bytes as f64 / 1e6), 0),
            );
        }
    }
    text
}

/// One row for each scene, [`SHORT_ROWS`] at most: the run with the highest PSNR, and the best of the first reference. Scenes
/// with a reference come first, then cities (scenes whose names begin with `city`), then others, each in the order of [`table`].
pub fn short_table(lines: &[ResultLine]) -> String {
    let runs = averaged(lines);
    let mut text = String::from(
        "| scene | run | PSNR, dB | street, air | CPU s | splats | peak MB | reference, dB | its CPU s | run to its PSNR, CPU s |\n\
         |---|---|---:|---|---:|---:|---:|---:|---:|---:|\n",
    );
    let of_scene = |scene: &str, referred: bool| {
        let scene = scene.to_owned();
        runs.iter().filter(move |run| run.line.scene == scene && run.line.source.is_some() == referred)
    };
    let mut scenes = scenes(runs.iter().map(|run| &run.line));
    scenes.retain(|scene| of_scene(scene, false).next().is_some());
    scenes.sort_by_key(|scene| (of_scene(scene, true).next().is_none(), !scene.starts_with("city")));
    for scene in scenes.into_iter().take(SHORT_ROWS) {
        let best = of_scene(scene, false).reduce(|a, b| if b.line.psnr > a.line.psnr { b } else { a });
        let Some(best) = best else { continue };
        let line = &best.line;
        let reference = of_scene(scene, true).next().map(|run| (run.line.best_psnr(), &run.line));
        let against = reference.map(|(psnr, reference)| {
            // A reference without a curve reached its PSNR at its end.
            let its = reference.cpu_seconds_to(psnr).unwrap_or(reference.cpu_seconds);
            format!(
                "{psnr:.2} | {} | {}",
                seconds(its),
                line.cpu_seconds_to(psnr).map_or("not reached".into(), seconds)
            )
        });
        let _ = writeln!(
            text,
            "| {} | {} | {:.2} | {} | {} | {} | {} | {} |",
            scene_cell(line),
            cell(&name(best)),
            line.psnr,
            apart(line),
            seconds(line.cpu_seconds),
            line.splats.map_or("–".into(), thousands),
            number(line.peak_memory_bytes.map(|bytes| bytes as f64 / 1e6), 0),
            against.as_deref().unwrap_or("– | – | –"),
        );
    }
    text
}

/// The document with the text between its markers `<!-- bench:begin -->` and `<!-- bench:end -->` replaced; `None`
/// if a marker is missing.
pub fn replace_table(document: &str, table: &str) -> Option<String> {
    let from = document.find(BEGIN)? + BEGIN.len();
    let to = from + document[from..].find(END)?;
    Some(format!("{}\n{}\n{}", &document[..from], table.trim_end(), &document[to..]))
}

/// The scene, with the divisor of its photos' size if it is not 1.
fn scene_cell(line: &ResultLine) -> String {
    let size = if line.downscale > 1 { format!(" 1/{}", line.downscale) } else { String::new() };
    cell(&line.scene) + &size
}

fn name(run: &Averaged) -> String {
    let label = &run.line.label;
    if run.variant.is_empty() { label.clone() } else { format!("{label}, {}", run.variant) }
}

fn psnr(run: &Averaged) -> String {
    let mean = run.line.psnr;
    if run.seeds > 1 {
        format!("{mean:.2} ({} seeds, {:.2} apart)", run.seeds, run.spread)
    } else {
        format!("{mean:.2}")
    }
}

/// PSNR of street and aerial views.
fn apart(line: &ResultLine) -> String {
    match (line.street, line.aerial) {
        (Some(street), Some(aerial)) => format!("{:.2}, {:.2}", street.psnr, aerial.psnr),
        _ => "–".into(),
    }
}

fn to_best(line: &ResultLine, reference: &ResultLine) -> String {
    let best = reference.best_psnr();
    match (line.cpu_seconds_to(best), reference.cpu_seconds_to(best)) {
        (Some(ours), _) if line.source.is_some() => seconds(ours),
        (Some(ours), Some(theirs)) if ours > 0.0 => format!("{} ({:.1}×)", seconds(ours), theirs / ours),
        (Some(ours), _) => seconds(ours),
        (None, _) => "not reached".into(),
    }
}

fn seconds(value: f64) -> String {
    if value < 100.0 { format!("{value:.1}") } else { format!("{value:.0}") }
}

fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("–".into(), |v| format!("{v:.digits$}"))
}

fn thousands(value: u64) -> String {
    let digits = value.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

fn cell(text: &str) -> String {
    text.replace('|', "\\|").replace('\n', " ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::line;

    #[test]
    fn rows_have_the_speed_up_over_the_reference() {
        let mut reference = line("OpenSplat", "fox", &[(100.0, 20.0), (1000.0, 28.0)]);
        reference.source = Some("measured".into());
        let ours = line("plat tree", "fox", &[(10.0, 26.0), (30.0, 30.0)]);
        let ours = ResultLine { predicted_cpu_seconds: Some(33.0), ..ours };
        let worse = line("plat | flat", "fox", &[(10.0, 26.0)]);
        let text = table(&[ours, reference, worse]);
        let rows: Vec<&str> = text.lines().skip(2).collect();
        assert!(rows[0].contains("OpenSplat") && rows[0].contains("| 1000 | – | 1000 |"), "{}", rows[0]);
        assert!(rows[1].contains("| 30.0 | 1.10 | 20.0 (50.0×) | 12,010 |"), "{}", rows[1]);
        assert!(rows[2].contains("plat \\| flat") && rows[2].contains("not reached"), "{}", rows[2]);
    }

    #[test]
    fn the_short_table_has_the_best_run_of_each_scene() {
        let mut reference = line("OpenSplat", "fox", &[(100.0, 20.0), (1000.0, 28.0)]);
        reference.source = Some("measured".into());
        let good = line("plat tree", "fox", &[(10.0, 26.0), (30.0, 30.0)]);
        let worse = line("plat flat", "fox", &[(10.0, 26.0)]);
        let others = (0..SHORT_ROWS).map(|n| line("plat tree", &format!("scene {n}"), &[(10.0, 26.0)]));
        let city = line("plat tree", "city, 0.3 km²", &[(10.0, 26.0)]);
        let lines: Vec<ResultLine> = others.chain([city, worse, good, reference]).collect();
        let text = short_table(&lines);
        let rows: Vec<&str> = text.lines().skip(2).collect();
        assert_eq!(rows.len(), SHORT_ROWS);
        assert!(rows[0].starts_with("| fox | plat tree | 30.00 | – |"), "{}", rows[0]);
        assert!(rows[0].ends_with("| 28.00 | 1000 | 20.0 |"), "{}", rows[0]);
        assert!(rows[1].starts_with("| city, 0.3 km² |") && rows[1].ends_with("| – | – | – |"), "{}", rows[1]);
    }

    #[test]
    fn only_text_between_the_markers_changes() {
        let document = "a\n<!-- bench:begin -->\nold\n<!-- bench:end -->\nb\n";
        let new = replace_table(document, "| new |\n").unwrap();
        assert_eq!(new, "a\n<!-- bench:begin -->\n| new |\n<!-- bench:end -->\nb\n");
        assert_eq!(replace_table(&new, "| new |\n").unwrap(), new);
        assert_eq!(replace_table("<!-- bench:end --> <!-- bench:begin -->", "x"), None);
    }
}
