//! The speed-accuracy chart: held-out PSNR over CPU seconds, a panel per scene, as SVG that is legible on light and
//! dark pages. Plain text in, plain text out; the same lines give the same bytes.

use std::fmt::Write;

use crate::{CurvePoint, ResultLine, averaged, scenes};

const PANEL_WIDTH: f64 = 440.0;
const PANEL_HEIGHT: f64 = 300.0;
const LEFT: f64 = 56.0;
const RIGHT: f64 = 18.0;
const TOP: f64 = 40.0;
const BOTTOM: f64 = 48.0;
const HEADER: f64 = 50.0;
/// Colours of runs, told apart by most kinds of sight (Okabe and Ito 2008), as light and dark themes show them.
const COLOURS: [(&str, &str); 6] = [
    ("#0072b2", "#56b4e9"),
    ("#d55e00", "#ff9040"),
    ("#009e73", "#2fd0a4"),
    ("#b0508c", "#e08fc0"),
    ("#8a7000", "#e6cf3c"),
    ("#5b4bc4", "#a99cff"),
];

/// Draws the latest run of each scene and label (of several seeds the mean) as a line, and the references as dashed lines. Scenes with neither
/// have no panel.
pub fn chart(lines: &[ResultLine], reference: &[ResultLine]) -> String {
    let [runs, references] = [lines, reference].map(averaged);
    let [runs, references] = [&runs, &references].map(|runs| runs.iter().map(|run| &run.line).collect::<Vec<_>>());
    let scenes = scenes(runs.iter().chain(&references).copied());
    let mut labels: Vec<&str> = Vec::new();
    for run in &runs {
        if !labels.contains(&run.label.as_str()) {
            labels.push(&run.label);
        }
    }
    let columns = scenes.len().clamp(1, 2);
    let width = PANEL_WIDTH * columns as f64 + 16.0;
    let (names, header) = legend(&labels, &references, width - 26.0);
    let height = header + PANEL_HEIGHT * scenes.len().div_ceil(columns) as f64 + 8.0;
    let mut svg = String::new();
    let mut out = |text: String| svg.push_str(&text);
    out(format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
         role=\"img\" aria-label=\"Held-out PSNR over CPU seconds\">\n<style>\n{}</style>\n",
        style()
    ));
    out(format!(
        "<rect class=\"card\" x=\"0.5\" y=\"0.5\" width=\"{}\" height=\"{}\" rx=\"8\"/>\n",
        width - 1.0,
        height - 1.0
    ));
    out("<text class=\"title\" x=\"20\" y=\"28\">Held-out PSNR over CPU time</text>\n".to_string());
    out(names);
    for (i, scene) in scenes.iter().enumerate() {
        let of_scene = |lines: &[&ResultLine]| -> Vec<Series> {
            let wanted = lines.iter().filter(|line| line.scene == *scene);
            wanted.map(|line| Series::new(line, labels.iter().position(|l| *l == line.label))).collect()
        };
        let mut series: Vec<Series> = of_scene(&references).into_iter().map(Series::dashed).collect();
        series.extend(of_scene(&runs));
        let (x, y) = (8.0 + PANEL_WIDTH * (i % columns) as f64, header + PANEL_HEIGHT * (i / columns) as f64);
        out(format!("<g transform=\"translate({x} {y})\">\n{}</g>\n", panel(scene, &series)));
    }
    out("</svg>\n".to_string());
    svg
}

struct Series {
    label: String,
    class: String,
    downscale: u32,
    points: Vec<CurvePoint>,
}

impl Series {
    fn new(line: &ResultLine, colour: Option<usize>) -> Self {
        let mut points = line.curve.clone();
        if points.is_empty() {
            points.push(CurvePoint { cpu_seconds: line.cpu_seconds, psnr: line.psnr, splats: line.splats });
        }
        points.retain(|p| p.cpu_seconds > 0.0);
        let class = format!("c{}", colour.unwrap_or(0) % COLOURS.len());
        Self { label: line.label.clone(), class, downscale: line.downscale, points }
    }

    fn dashed(self) -> Self {
        Self { class: "reference".into(), ..self }
    }
}

/// Maps values to pixels of the panel.
struct Axes {
    /// log10 of CPU seconds.
    x: (f64, f64),
    /// dB.
    y: (f64, f64),
    step: f64,
}

impl Axes {
    fn around(series: &[Series]) -> Self {
        let points = || series.iter().flat_map(|s| &s.points);
        let range = |value: fn(&CurvePoint) -> f64| {
            points().map(value).fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
        };
        if points().next().is_none() {
            return Self { x: (0.0, 3.0), y: (10.0, 30.0), step: 5.0 };
        }
        let (x, y) = (range(|p| p.cpu_seconds.log10()), range(|p| p.psnr));
        // at least a decade wide and 4 dB high
        let wider = ((1.0 - (x.1 - x.0)) / 2.0).max(0.06);
        let x = (x.0 - wider, x.1 + wider);
        let step = [1.0, 2.0, 5.0, 10.0].into_iter().find(|step| (y.1 - y.0) / step <= 7.0).unwrap_or(20.0);
        let middle = 0.5 * (y.0 + y.1);
        let y = (y.0.min(middle - 2.0), y.1.max(middle + 2.0));
        Self { x, y: ((y.0 / step).floor() * step, (y.1 / step + 0.25).ceil() * step), step }
    }

    fn px(&self, cpu_seconds: f64) -> f64 {
        LEFT + (cpu_seconds.log10() - self.x.0) / (self.x.1 - self.x.0) * (PANEL_WIDTH - LEFT - RIGHT)
    }

    fn py(&self, psnr: f64) -> f64 {
        PANEL_HEIGHT - BOTTOM - (psnr - self.y.0) / (self.y.1 - self.y.0) * (PANEL_HEIGHT - TOP - BOTTOM)
    }

    /// 1, 2 and 5 times the powers of ten within the range; powers of ten alone where it spans over 2.5 decades.
    fn ticks(&self) -> Vec<f64> {
        let factors: &[f64] = if self.x.1 - self.x.0 > 2.5 { &[1.0, 3.0] } else { &[1.0, 2.0, 5.0] };
        let decades = self.x.0.floor() as i32..=self.x.1.ceil() as i32;
        // Divided, as 3 / 10 is 0.3 and 3 * 0.1 is not.
        let at = |f: f64, d: i32| if d < 0 { f / 10f64.powi(-d) } else { f * 10f64.powi(d) };
        let ticks = decades.flat_map(|d| factors.iter().map(move |&f| at(f, d)));
        ticks.filter(|t| (self.x.0..=self.x.1).contains(&t.log10())).collect()
    }
}

fn panel(scene: &str, series: &[Series]) -> String {
    let axes = Axes::around(series);
    let (right, bottom) = (PANEL_WIDTH - RIGHT, PANEL_HEIGHT - BOTTOM);
    let mut svg = String::new();
    let size = match series.iter().map(|s| s.downscale).max().unwrap_or(1) {
        1 => String::new(),
        n => format!(", 1/{n} of its size"),
    };
    // writing to a String cannot fail
    let _ = writeln!(svg, "<text class=\"panel\" x=\"{LEFT}\" y=\"26\">{}{size}</text>", escape(scene));
    for tick in axes.ticks() {
        let x = axes.px(tick);
        let _ = writeln!(svg, "<line class=\"grid\" x1=\"{x:.1}\" y1=\"{TOP}\" x2=\"{x:.1}\" y2=\"{bottom}\"/>");
        let _ = writeln!(
            svg,
            "<text class=\"tick\" x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\">{tick}</text>",
            bottom + 16.0
        );
    }
    let steps = ((axes.y.1 - axes.y.0) / axes.step).round() as i32;
    for k in 0..=steps {
        let psnr = axes.y.0 + f64::from(k) * axes.step;
        let y = axes.py(psnr);
        let _ = writeln!(svg, "<line class=\"grid\" x1=\"{LEFT}\" y1=\"{y:.1}\" x2=\"{right}\" y2=\"{y:.1}\"/>");
        let _ = writeln!(
            svg,
            "<text class=\"tick\" x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{psnr}</text>",
            LEFT - 7.0,
            y + 4.0
        );
    }
    let _ = writeln!(svg, "<path class=\"axis\" d=\"M{LEFT} {TOP}V{bottom}H{right}\"/>");
    let middle = 0.5 * (LEFT + right);
    let _ = writeln!(
        svg,
        "<text class=\"label\" x=\"{middle}\" y=\"{}\" text-anchor=\"middle\">CPU time, seconds (log scale)</text>",
        bottom + 35.0
    );
    let middle = 0.5 * (TOP + bottom);
    let _ = writeln!(
        svg,
        "<text class=\"label\" transform=\"translate(16 {middle}) rotate(-90)\" text-anchor=\"middle\">PSNR, dB</text>"
    );
    let mut values: Vec<(f64, f64)> = Vec::new();
    for one in series {
        curve(&mut svg, &axes, one, &mut values);
    }
    svg
}

/// Draws a curve and the value at its end, clear of the `values` written before.
fn curve(svg: &mut String, axes: &Axes, series: &Series, values: &mut Vec<(f64, f64)>) {
    let places: Vec<String> =
        series.points.iter().map(|p| format!("{:.1} {:.1}", axes.px(p.cpu_seconds), axes.py(p.psnr))).collect();
    let class = &series.class;
    if places.len() > 1 {
        let _ = writeln!(svg, "<path class=\"line {class}\" d=\"M{}\"/>", places.join("L"));
    }
    for p in &series.points {
        let (x, y) = (axes.px(p.cpu_seconds), axes.py(p.psnr));
        let splats = p.splats.map(|n| format!(", {n} splats")).unwrap_or_default();
        let _ = writeln!(
            svg,
            "<circle class=\"dot {class}\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.6\"><title>{}: {:.2} dB after {:.1} CPU s{splats}</title></circle>",
            escape(&series.label),
            p.psnr,
            p.cpu_seconds
        );
    }
    if let Some(last) = series.points.last() {
        let (x, dot) = (axes.px(last.cpu_seconds).min(PANEL_WIDTH - RIGHT), axes.py(last.psnr));
        let taken = |y: f64| values.iter().any(|v| (v.0 - x).abs() < 36.0 && (v.1 - y).abs() < 12.0);
        let y =
            [-8.0, 16.0, -20.0, 28.0].map(|shift| dot + shift).into_iter().find(|&y| !taken(y)).unwrap_or(dot - 8.0);
        values.push((x, y));
        let _ = writeln!(
            svg,
            "<text class=\"value {class}\" x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"end\">{:.2}</text>",
            last.psnr
        );
    }
}

/// Every run's name once, with a sample of its line, in rows under the title; the references come last. And where the panels
/// begin.
fn legend(runs: &[&str], references: &[&ResultLine], right: f64) -> (String, f64) {
    const LETTER: f64 = 6.6;
    const ROW: f64 = 18.0;
    let mut names: Vec<(&str, String)> =
        runs.iter().enumerate().map(|(i, label)| (*label, format!("c{}", i % COLOURS.len()))).collect();
    for line in references {
        if !names.iter().any(|(name, _)| *name == line.label) {
            names.push((&line.label, "reference".into()));
        }
    }
    let mut svg = String::new();
    let (mut x, mut y) = (20.0, HEADER);
    for (name, class) in &names {
        let length = 32.0 + LETTER * name.chars().count() as f64;
        if x + length > right && x > 20.0 {
            (x, y) = (20.0, y + ROW);
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
         .card{fill:#fff;stroke:#d0d7de}\n.title{font-size:16px;font-weight:600}\n.panel{font-size:13px;font-weight:600}\n\
         .tick{font-size:11px}\n.label{font-size:11.5px}\n.value{font-size:11px;font-weight:600}\n\
         .grid{stroke:#d8dee4;stroke-width:1}\n.axis{stroke:#6e7781;fill:none}\n\
         .line{fill:none;stroke-width:2;stroke-linejoin:round}\n\
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
         .grid{stroke:#2a313a}\n.axis{stroke:#8b949e}\n.line.reference{stroke:#9aa4af}\n\
         .dot.reference,.value.reference{fill:#9aa4af}\n",
    );
    colours(&mut css, |pair| pair.1);
    css.push_str("}\n");
    css
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::line;

    #[test]
    fn a_panel_per_scene_and_a_line_per_run() {
        let runs = [
            line("plat tree", "fox", &[(1.0, 15.0), (5.0, 22.0), (30.0, 28.6)]),
            line("plat whole", "fox", &[(1.0, 15.0), (30.0, 28.4)]),
            line("plat tree", "my <scene>", &[(3.0, 20.0), (4.0, 21.0)]),
        ];
        let reference = [line("OpenSplat", "fox", &[(0.6, 12.1), (71.0, 19.4), (1338.0, 28.48)])];
        let svg = chart(&runs, &reference);
        assert_eq!(svg.matches("class=\"panel\"").count(), 2);
        // each curve, and one sample per label in the legend
        assert_eq!(svg.matches("line reference\"").count(), 1 + 1);
        assert_eq!(svg.matches("line c0\"").count(), 2 + 1);
        assert_eq!(svg.matches("line c1\"").count(), 1 + 1);
        assert!(svg.contains("my &lt;scene&gt;") && !svg.contains("NaN") && !svg.contains("inf"));
        assert_eq!(svg, chart(&runs, &reference));
    }

    #[test]
    fn one_point_and_no_point_draw() {
        let svg = chart(&[line("plat", "fox", &[(10.0, 20.0)])], &[]);
        assert!(svg.contains("<circle") && !svg.contains("NaN"));
        assert!(!chart(&[], &[]).contains("NaN"));
    }

    #[test]
    fn faster_is_further_left_and_better_is_higher() {
        let run = line("plat", "fox", &[(1.0, 15.0), (100.0, 28.0)]);
        let axes = Axes::around(&[Series::new(&run, None)]);
        assert!(axes.px(1.0) < axes.px(10.0) && axes.py(28.0) < axes.py(15.0));
        assert!(axes.px(1.0) >= LEFT && axes.py(28.0) >= TOP);
        let middle = 0.5 * (axes.px(1.0) + axes.px(100.0));
        assert!((axes.px(10.0) - middle).abs() < 1e-9, "the axis is logarithmic");
        let wide = line("plat", "fox", &[(0.2, 15.0), (1000.0, 28.0)]);
        let ticks = Axes::around(&[Series::new(&wide, None)]).ticks();
        assert!(ticks.iter().all(|tick| tick.to_string().len() <= 4), "{ticks:?}");
    }
}
