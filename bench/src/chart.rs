//! Draws the chart of quality over cost as SVG for light and dark pages.
//!
//! Each scene has a row of panels: held-out PSNR over CPU seconds (of street and aerial views apart where all runs have both), PSNR over
//! splats, perceptual measures over CPU seconds. The same lines give the same bytes.

mod panel;

use std::fmt::Write;

use crate::parts::Prune;
use crate::{Averaged, PartLine, ResultLine, averaged, scenes};
use panel::{GAP, Measure, Point, ROW, Series, escape, panel};

const LEFT: f64 = 8.0;
const HEADER: f64 = 50.0;
/// Height of the line with a scene's name.
const NAME: f64 = 26.0;
/// Colours of runs for light and dark themes, distinguishable with colour vision deficiencies (Okabe and Ito 2008).
const COLOURS: [(&str, &str); 6] = [
    ("#0072b2", "#56b4e9"),
    ("#d55e00", "#ff9040"),
    ("#009e73", "#2fd0a4"),
    ("#b0508c", "#e08fc0"),
    ("#8a7000", "#e6cf3c"),
    ("#5b4bc4", "#a99cff"),
];

/// Strokes that tell a colour's labels apart.
const STROKES: [&str; 3] = ["", " dotted", " dash-dot"];

/// The title of the chart of runs.
const TITLE: &str = "Held-out views: quality over CPU time and over splats";
/// The title of the chart of pruning.
const PRUNING: &str = "Held-out views after pruning: quality and what detectors find over splats and over CPU time";

/// A scene and its panels.
type Row<'a> = (&'a str, Vec<(Measure, Vec<Series>)>);

/// Draws the runs of each scene and label that [`averaged`] keeps (of several seeds the mean), and the references dashed. A label with one configuration
/// is drawn as its curve over time; with several, as one point each, joined by a line. Measures without values have no panel, scenes
/// without runs and references no row.
pub fn chart(lines: &[ResultLine], reference: &[ResultLine]) -> String {
    drawn(TITLE, lines, reference)
}

/// Draws what is left of models after pruning, of the lines that detectors judged: a line for each order. `None` without
/// such lines.
pub fn pruning_chart(lines: &[PartLine]) -> Option<String> {
    let of_prune = lines.iter().filter_map(|line| if let PartLine::Prune(line) = line { Some(line) } else { None });
    let judged: Vec<ResultLine> = of_prune.filter(|line| !line.judged.is_empty()).map(Prune::as_run).collect();
    (!judged.is_empty()).then(|| drawn(PRUNING, &judged, &[]))
}

fn drawn(title: &str, lines: &[ResultLine], reference: &[ResultLine]) -> String {
    let [runs, references] = [lines, reference].map(averaged);
    let scenes = scenes(runs.iter().chain(&references).map(|run| &run.line));
    let labels = labels(&runs);
    let rows: Vec<Row> = (scenes.iter())
        .map(|&scene| {
            let with_points = Measure::ALL.into_iter().map(|measure| {
                let series = |runs, labels| series_of(runs, scene, measure, labels);
                (measure, [series(&references[..], None), series(&runs, Some(&labels[..]))].concat())
            });
            (scene, shown(with_points.collect()))
        })
        .collect();
    let width_of = |(_, panels): &Row| -> f64 { panels.iter().map(|(measure, _)| measure.width() + GAP).sum() };
    let width = rows.iter().map(width_of).fold(Measure::ALL[0].width(), f64::max) + 2.0 * LEFT;
    let names: Vec<&str> = references.iter().map(|run| run.line.label.as_str()).collect();
    let (legend, header) = legend(&labels, &names, width - 26.0);
    let height = header + (NAME + ROW) * rows.len() as f64 + 8.0;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
         role=\"img\" aria-label=\"{title}\">\n<style>\n{}</style>\n\
         <rect class=\"card\" x=\"0.5\" y=\"0.5\" width=\"{}\" height=\"{}\" rx=\"8\"/>\n\
         <text class=\"title\" x=\"20\" y=\"28\">{title}</text>\n{legend}",
        style(),
        width - 1.0,
        height - 1.0
    );
    for (n, (scene, panels)) in rows.iter().enumerate() {
        let y = header + (NAME + ROW) * n as f64;
        let size = match runs.iter().chain(&references).find(|run| run.line.scene == *scene) {
            Some(run) if run.line.downscale > 1 => format!(", 1/{} of its size", run.line.downscale),
            _ => String::new(),
        };
        // Writing to a String cannot fail.
        let _ = writeln!(svg, "<text class=\"scene\" x=\"20\" y=\"{}\">{}{size}</text>", y + 18.0, escape(scene));
        let mut x = LEFT;
        for (measure, series) in panels {
            let _ = writeln!(svg, "<g transform=\"translate({x} {})\">\n{}</g>", y + NAME, panel(*measure, series));
            x += measure.width() + GAP;
        }
    }
    svg + "</svg>\n"
}

/// The panels that have points. PSNR of all views is left out where street and aerial views say more of the same runs.
fn shown(panels: Vec<(Measure, Vec<Series>)>) -> Vec<(Measure, Vec<Series>)> {
    let count = |of: Measure| panels.iter().find(|(measure, _)| *measure == of).map_or(0, |(_, series)| series.len());
    // Each run has a PSNR of all views, so as many series are the same runs.
    let apart = count(Measure::Street) == count(Measure::PsnrOverTime);
    let is_said_apart = |measure: Measure| apart && measure == Measure::PsnrOverTime;
    panels.into_iter().filter(|(measure, series)| !series.is_empty() && !is_said_apart(*measure)).collect()
}

/// The labels of runs in order of first appearance.
fn labels(runs: &[Averaged]) -> Vec<&str> {
    let mut labels: Vec<&str> = Vec::new();
    for run in runs {
        if !labels.contains(&run.line.label.as_str()) {
            labels.push(&run.line.label);
        }
    }
    labels
}

/// The series of each label in a panel. Without `coloured` labels they are drawn as references.
fn series_of(runs: &[Averaged], scene: &str, measure: Measure, coloured: Option<&[&str]>) -> Vec<Series> {
    let of_scene: Vec<&Averaged> = runs.iter().filter(|run| run.line.scene == scene).collect();
    let mut series: Vec<Series> = Vec::new();
    for run in &of_scene {
        let label = &run.line.label;
        if series.iter().any(|series| series.label == *label) {
            continue;
        }
        let all: Vec<&Averaged> = of_scene.iter().copied().filter(|other| other.line.label == *label).collect();
        let mut points: Vec<Point> = match all[..] {
            [one] => measure.curve(&one.line),
            _ => all.iter().flat_map(|run| measure.end(&run.line, &run.variant)).collect(),
        };
        // By cost: time of a curve, cost of a sweep's points.
        points.sort_by(|a, b| a.x.total_cmp(&b.x));
        let colour = coloured.and_then(|labels| labels.iter().position(|of| of == label));
        let class = colour.map_or("reference".to_owned(), class);
        if !points.is_empty() {
            series.push(Series { label: label.clone(), class, points });
        }
    }
    series
}

/// The classes of the n-th label's line and points: each colour with one stroke, then each with the next.
fn class(n: usize) -> String {
    format!("c{}{}", n % COLOURS.len(), STROKES[n / COLOURS.len() % STROKES.len()])
}

/// The legend in rows below the title, references last; and the y coordinate at which the panels begin.
fn legend(runs: &[&str], references: &[&str], right: f64) -> (String, f64) {
    const LETTER: f64 = 6.6;
    const LINE: f64 = 18.0;
    let mut names: Vec<(&str, String)> = runs.iter().enumerate().map(|(i, label)| (*label, class(i))).collect();
    for label in references {
        if !names.iter().any(|(name, _)| name == label) {
            names.push((label, "reference".into()));
        }
    }
    let mut svg = String::new();
    let (mut x, mut y) = (20.0, HEADER);
    for (name, class) in &names {
        let length = 32.0 + LETTER * name.chars().count() as f64;
        if x + length > right && x > 20.0 {
            (x, y) = (20.0, y + LINE);
        }
        let _ = writeln!(svg, "<path class=\"line {class}\" d=\"M{x:.1} {:.1}h26\"/>", y - 4.0);
        let _ = writeln!(svg, "<text class=\"label\" x=\"{:.1}\" y=\"{y}\">{}</text>", x + 32.0, escape(name));
        x += length + 20.0;
    }
    (svg, y + 10.0)
}

fn style() -> String {
    let mut css = String::from(
        "text{font-family:system-ui,-apple-system,'Segoe UI',Helvetica,Arial,sans-serif;fill:#24292f}\n\
         .card{fill:#fff;stroke:#d0d7de}\n.title{font-size:16px;font-weight:600}\n.scene{font-size:13.5px;font-weight:600}\n\
         .panel{font-size:12px}\n.tick{font-size:11px}\n.label{font-size:11.5px}\n.value{font-size:11px;font-weight:600;paint-order:stroke;stroke:#fff;stroke-width:3px}\n\
         .grid{stroke:#d8dee4;stroke-width:1}\n.axis{stroke:#6e7781;fill:none}\n\
         .line{fill:none;stroke-width:2;stroke-linejoin:round}\n\
         .line.dotted{stroke-dasharray:2 3}\n.line.dash-dot{stroke-dasharray:9 3 2 3}\n\
         .line.reference{stroke:#6e7781;stroke-dasharray:6 4}\n.dot.reference,.value.reference{fill:#6e7781}\n",
    );
    let colours = |css: &mut String, pick: fn(&(&'static str, &'static str)) -> &'static str| {
        for (i, pair) in COLOURS.iter().enumerate() {
            let _ = writeln!(css, ".line.c{i}{{stroke:{0}}}.dot.c{i},.value.c{i}{{fill:{0}}}", pick(pair));
        }
    };
    colours(&mut css, |pair| pair.0);
    css.push_str(
        "@media (prefers-color-scheme:dark){\ntext{fill:#e6edf3}\n.card{fill:#0d1117;stroke:#30363d}\n\
         .value{stroke:#0d1117}\n.grid{stroke:#2a313a}\n.axis{stroke:#8b949e}\n.line.reference{stroke:#9aa4af}\n\
         .dot.reference,.value.reference{fill:#9aa4af}\n",
    );
    colours(&mut css, |pair| pair.1);
    css.push_str("}\n");
    css
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::line;
    use crate::{Judged, KindFigures};

    /// The panels of a chart, each as text.
    fn panels(svg: &str) -> Vec<&str> {
        svg.split("<g transform").skip(1).collect()
    }

    #[test]
    fn a_row_of_panels_per_scene_and_a_line_per_run() {
        let runs = [
            line("plat tree", "fox", &[(1.0, 15.0), (5.0, 22.0), (30.0, 28.6)]),
            line("plat whole", "fox", &[(1.0, 15.0), (30.0, 28.4)]),
            line("plat tree", "my <scene>", &[(3.0, 20.0), (4.0, 21.0)]),
        ];
        let reference = [line("OpenSplat", "fox", &[(0.6, 12.1), (71.0, 19.4), (1338.0, 28.48)])];
        let svg = chart(&runs, &reference);
        assert_eq!(svg.matches("class=\"scene\"").count(), 2);
        // PSNR over time and over splats; nothing else was measured.
        assert_eq!(svg.matches("class=\"panel\"").count(), 4);
        // One line per curve, and one per label in the legend.
        assert_eq!(svg.matches("line reference\"").count(), 1 + 1);
        assert_eq!(svg.matches("line c0\"").count(), 2 + 1);
        assert_eq!(svg.matches("line c1\"").count(), 1 + 1);
        assert!(svg.contains("my &lt;scene&gt;") && !svg.contains("NaN") && !svg.contains("inf"));
        assert_eq!(svg, chart(&runs, &reference));
    }

    #[test]
    fn perceptual_measures_have_panels_if_they_were_measured() {
        let mut runs = [line("plat", "fox", &[(1.0, 15.0)]), line("plat", "street", &[(2.0, 16.0)])];
        runs[0].perceptual = Some(-16.2);
        runs[1].perceptual = Some(33.3);
        runs[1].lpips = Some(0.217);
        let svg = chart(&runs, &[]);
        let [fox_psnr, _, fox_perceptual, _, _, _, lpips] = panels(&svg)[..] else { panic!("3 and 4 panels: {svg}") };
        assert!(fox_psnr.contains(">15.00<") && fox_perceptual.contains(">-16.2<"), "{fox_perceptual}");
        assert!(lpips.contains(">0.217<") && lpips.contains("LPIPS") && svg.matches("LPIPS, ").count() == 1, "{lpips}");
    }

    #[test]
    fn street_and_aerial_views_have_panels_of_their_own() {
        let of = |psnr: f64| {
            let [ssim, perceptual, worst_cc_gap, depth_absrel, depth_delta1, detections_kept] = [None; 6];
            Some(KindFigures { psnr, ssim, perceptual, worst_cc_gap, depth_absrel, depth_delta1, detections_kept })
        };
        let apart = ResultLine { street: of(18.25), aerial: of(24.75), ..line("plat", "city", &[(1.0, 21.5)]) };
        let mut runs = vec![apart];
        let svg = chart(&runs, &[]);
        let [street, aerial, _] = panels(&svg)[..] else { panic!("street, aerial, splats: {svg}") };
        assert!(street.contains(">18.25<") && aerial.contains(">24.75<") && aerial.contains("PSNR of aerial views"));
        // Another run without them keeps the panel of all views.
        runs.push(line("other", "city", &[(1.0, 20.5)]));
        let svg = chart(&runs, &[]);
        assert!(panels(&svg).len() == 4 && panels(&svg)[0].contains(">21.50<"), "{svg}");
    }

    #[test]
    fn a_sweep_is_drawn_as_a_line_of_final_points() {
        let end = |steps: u32, seconds: f64, psnr: f64| ResultLine {
            steps: Some(steps),
            seed: Some(0),
            ..line("plat", "fox", &[(0.5 * seconds, psnr - 3.0), (seconds, psnr)])
        };
        let svg = chart(&[end(800, 20.0, 27.0), end(200, 5.0, 24.0), end(400, 10.0, 26.0)], &[]);
        let over_time = panels(&svg)[0];
        assert_eq!(over_time.matches("<circle").count(), 3);
        let ends: Vec<usize> = ["200 steps", "400 steps", "800 steps"].map(|s| over_time.find(s).expect(s)).into();
        assert!(ends.is_sorted(), "{over_time}");
    }

    #[test]
    fn labels_of_one_colour_differ_in_their_stroke() {
        let runs: Vec<ResultLine> =
            (0..8).map(|n| line(&format!("run {n}"), "fox", &[(1.0, 15.0), (5.0, 22.0)])).collect();
        let svg = chart(&runs, &[]);
        for class in ["line c1\"", "line c1 dotted\""] {
            // In the legend, and in the panels over time and over splats.
            assert!(svg.matches(class).count() >= 2, "{class}");
        }
    }

    #[test]
    fn one_point_or_none_can_be_drawn() {
        let svg = chart(&[line("plat", "fox", &[(10.0, 20.0)])], &[]);
        assert!(svg.contains("<circle") && !svg.contains("NaN"));
        assert!(!chart(&[], &[]).contains("NaN"));
    }

    #[test]
    fn pruned_models_are_drawn_by_order_where_detectors_judged_them() {
        let line = |order: &str, splats: u64, misses: u64, judges: usize| {
            let judged = Judged {
                detector: "d.onnx".into(),
                objects: 10,
                misses,
                extra: 0,
                map: Some(0.5),
                mean_iou: None,
                zone_psnr: Some(20.0),
            };
            PartLine::Prune(Prune {
                commit: "c".into(),
                machine: "m".into(),
                scene: "street".into(),
                downscale: 1,
                order: order.into(),
                keep: Some(0.5),
                recovery_steps: Some(9),
                tolerance_db: None,
                splats_before: 1000,
                splats,
                held_in_psnr: [25.0, 24.0],
                held_out_psnr: [24.0, 23.0],
                judged: vec![judged; judges],
                cpu_seconds: 3.0,
                command: "plat".into(),
            })
        };
        assert_eq!(pruning_chart(&[line("energy", 500, 1, 0)]), None);
        let lines = [line("energy", 500, 4, 2), line("energy", 250, 5, 2), line("energy-zones", 500, 2, 2)];
        let svg = pruning_chart(&lines).unwrap();
        let kept =
            panels(&svg).into_iter().find(|panel| panel.contains("splats") && panel.contains("objects kept, share"));
        let kept = kept.expect("a panel of the objects kept over splats");
        assert!(kept.contains("energy, 500 splats: 0.600") && kept.contains("energy, 250 splats: 0.500"), "{kept}");
        assert!(kept.contains("energy-zones: 0.800"), "{kept}");
        assert_eq!(svg.matches("class=\"panel\"").count(), 6);
    }
}
