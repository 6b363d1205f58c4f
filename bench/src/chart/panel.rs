//! Draws one panel of the chart: a measure of quality over its cost.

use std::fmt::Write;

use crate::{CurvePoint, Judged, ResultLine};

/// Height of a panel, pixels.
pub(super) const ROW: f64 = 232.0;
/// Gap between two panels, pixels.
pub(super) const GAP: f64 = 6.0;
const LEFT: f64 = 52.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 26.0;
const BOTTOM: f64 = 46.0;

/// The measure of a panel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Measure {
    /// PSNR over CPU seconds, during training too.
    PsnrOverTime,
    /// Final PSNR of street views over CPU seconds.
    Street,
    /// Final PSNR of aerial views over CPU seconds.
    Aerial,
    /// Final PSNR over splats.
    PsnrOverSplats,
    /// Final SSIMULACRA2 over CPU seconds.
    Ssimulacra2,
    /// Final LPIPS over CPU seconds.
    Lpips,
    /// Share of the objects that detectors find on photos and also on renders, over splats.
    KeptOverSplats,
    /// Mean average precision over splats, mean of the detectors.
    PrecisionOverSplats,
    /// PSNR where photos have objects over splats, mean of the detectors.
    ZonesOverSplats,
    /// Share of the objects over CPU seconds.
    KeptOverTime,
}

/// A point of a panel.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Point {
    /// CPU seconds or splats.
    pub(super) x: f64,
    pub(super) y: f64,
    /// Tooltip.
    pub(super) title: String,
}

/// A line of a panel.
#[derive(Debug, Clone)]
pub(super) struct Series {
    pub(super) label: String,
    pub(super) class: String,
    pub(super) points: Vec<Point>,
}

impl Measure {
    pub(super) const ALL: [Self; 10] = [
        Self::PsnrOverTime,
        Self::Street,
        Self::Aerial,
        Self::PsnrOverSplats,
        Self::Ssimulacra2,
        Self::Lpips,
        Self::KeptOverSplats,
        Self::PrecisionOverSplats,
        Self::ZonesOverSplats,
        Self::KeptOverTime,
    ];

    pub(super) fn width(self) -> f64 {
        if matches!(self, Self::PsnrOverTime | Self::Street) { 400.0 } else { 250.0 }
    }

    fn names(self) -> (&'static str, &'static str) {
        match self {
            Self::PsnrOverTime => ("CPU time, seconds", "PSNR, dB"),
            Self::Street => ("CPU time, seconds", "PSNR of street views, dB"),
            Self::Aerial => ("CPU time, seconds", "PSNR of aerial views, dB"),
            Self::PsnrOverSplats => ("splats", "PSNR, dB"),
            Self::Ssimulacra2 => ("CPU time, seconds", "SSIMULACRA2"),
            Self::Lpips => ("CPU time, seconds", "LPIPS, lower is better"),
            Self::KeptOverSplats => ("splats", "objects kept, share"),
            Self::PrecisionOverSplats => ("splats", "mAP of detectors"),
            Self::ZonesOverSplats => ("splats", "PSNR of objects, dB"),
            Self::KeptOverTime => ("CPU time, seconds", "objects kept, share"),
        }
    }

    /// Minimum span of the axis, and digits of a figure.
    fn span(self) -> (f64, usize) {
        match self {
            Self::PsnrOverTime | Self::Street | Self::Aerial | Self::PsnrOverSplats | Self::ZonesOverSplats => (4.0, 2),
            Self::Ssimulacra2 => (10.0, 1),
            Self::Lpips | Self::KeptOverSplats | Self::PrecisionOverSplats | Self::KeptOverTime => (0.1, 3),
        }
    }

    /// The run's curve if the measure is taken during training, else its final value.
    pub(super) fn curve(self, line: &ResultLine) -> Vec<Point> {
        if self != Self::PsnrOverTime || line.curve.is_empty() {
            return self.end(line, "").into_iter().collect();
        }
        let point = |p: &CurvePoint| {
            let splats = p.splats.map(|n| format!(", {n} splats")).unwrap_or_default();
            let title = format!("{}: {:.2} dB after {:.1} CPU s{splats}", line.label, p.psnr, p.cpu_seconds);
            Point { x: p.cpu_seconds, y: p.psnr, title }
        };
        line.curve.iter().filter(|p| p.cpu_seconds > 0.0).map(point).collect()
    }

    /// The run's final value, if it was measured.
    pub(super) fn end(self, line: &ResultLine, variant: &str) -> Option<Point> {
        let (x, y) = match self {
            Self::PsnrOverTime => (line.cpu_seconds, line.psnr),
            Self::Street => (line.cpu_seconds, line.street?.psnr),
            Self::Aerial => (line.cpu_seconds, line.aerial?.psnr),
            Self::PsnrOverSplats => (line.splats? as f64, line.psnr),
            Self::Ssimulacra2 => (line.cpu_seconds, line.perceptual?),
            Self::Lpips => (line.cpu_seconds, line.lpips?),
            Self::KeptOverSplats => (line.splats? as f64, kept(line)?),
            Self::PrecisionOverSplats => (line.splats? as f64, mean(line, |of| of.map)?),
            Self::ZonesOverSplats => (line.splats? as f64, mean(line, |of| of.zone_psnr)?),
            Self::KeptOverTime => (line.cpu_seconds, kept(line)?),
        };
        let digits = self.span().1;
        let splats = line.splats.map(|n| format!(", {n} splats")).unwrap_or_default();
        let variant = if variant.is_empty() { String::new() } else { format!(", {variant}") };
        let title = format!("{}{variant}: {y:.digits$} after {:.1} CPU s{splats}", line.label, line.cpu_seconds);
        (x > 0.0).then_some(Point { x, y, title })
    }
}

/// Share of the objects on photos that are found on renders too, of all detectors.
fn kept(line: &ResultLine) -> Option<f64> {
    let sum = |count: fn(&Judged) -> u64| line.judged.iter().map(count).sum::<u64>() as f64;
    let objects = sum(|of| of.objects);
    (objects > 0.0).then(|| 1.0 - sum(|of| of.misses) / objects)
}

fn mean(line: &ResultLine, figure: fn(&Judged) -> Option<f64>) -> Option<f64> {
    let sum = line.judged.iter().map(figure).sum::<Option<f64>>()?;
    (!line.judged.is_empty()).then(|| sum / line.judged.len() as f64)
}

/// Maps values to the panel's pixels.
struct Axes {
    width: f64,
    /// log10.
    x: (f64, f64),
    y: (f64, f64),
    step: f64,
}

impl Axes {
    fn around(measure: Measure, series: &[Series]) -> Self {
        let points = || series.iter().flat_map(|s| &s.points);
        let range = |value: fn(&Point) -> f64| {
            points().map(value).fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
        };
        let (x, y) = (range(|p| p.x.log10()), range(|p| p.y));
        // At least a decade wide.
        let wider = ((1.0 - (x.1 - x.0)) / 2.0).max(0.06);
        let x = (x.0 - wider, x.1 + wider);
        let (min_span, middle) = (measure.span().0, 0.5 * (y.0 + y.1));
        let y = (y.0.min(middle - 0.5 * min_span), y.1.max(middle + 0.5 * min_span));
        const STEPS: [f64; 9] = [0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0];
        let step = STEPS.into_iter().find(|step| (y.1 - y.0) / step <= 6.0).unwrap_or(20.0);
        Self { width: measure.width(), x, y: ((y.0 / step).floor() * step, (y.1 / step + 0.25).ceil() * step), step }
    }

    fn px(&self, x: f64) -> f64 {
        LEFT + (x.log10() - self.x.0) / (self.x.1 - self.x.0) * (self.width - LEFT - RIGHT)
    }

    fn py(&self, y: f64) -> f64 {
        ROW - BOTTOM - (y - self.y.0) / (self.y.1 - self.y.0) * (ROW - TOP - BOTTOM)
    }

    /// Multiples of the powers of ten within the range, by 1, 2 and 5, by 1 and 3, or by 1: as many as do not overlap.
    fn ticks(&self) -> Vec<f64> {
        let pixels_per_decade = (self.width - LEFT - RIGHT) / (self.x.1 - self.x.0);
        let factors: &[f64] = match pixels_per_decade {
            ..60.0 => &[1.0],
            60.0..120.0 => &[1.0, 3.0],
            _ => &[1.0, 2.0, 5.0],
        };
        let decades = self.x.0.floor() as i32..=self.x.1.ceil() as i32;
        // Divided for negative exponents, as 3 / 10 is 0.3 in floating point and 3 * 0.1 is not.
        let at = |f: f64, d: i32| if d < 0 { f / 10f64.powi(-d) } else { f * 10f64.powi(d) };
        let ticks = decades.flat_map(|d| factors.iter().map(move |&f| at(f, d)));
        ticks.filter(|t| (self.x.0..=self.x.1).contains(&t.log10())).collect()
    }
}

/// Draws a panel. Every series has at least one point.
pub(super) fn panel(measure: Measure, series: &[Series]) -> String {
    let axes = Axes::around(measure, series);
    let (right, bottom) = (axes.width - RIGHT, ROW - BOTTOM);
    let (cost, quality) = measure.names();
    // Writing to a String cannot fail.
    let mut svg = String::new();
    let _ = writeln!(svg, "<text class=\"panel\" x=\"{LEFT}\" y=\"15\">{quality}</text>");
    for tick in axes.ticks() {
        let x = axes.px(tick);
        let _ = writeln!(svg, "<line class=\"grid\" x1=\"{x:.1}\" y1=\"{TOP}\" x2=\"{x:.1}\" y2=\"{bottom}\"/>");
        let _ = writeln!(
            svg,
            "<text class=\"tick\" x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
            bottom + 15.0,
            short(tick)
        );
    }
    let steps = ((axes.y.1 - axes.y.0) / axes.step).round() as i32;
    let digits = (0..3).find(|&d| (axes.step * 10f64.powi(d)).fract().abs() < 1e-9).unwrap_or(3) as usize;
    for k in 0..=steps {
        let value = axes.y.0 + f64::from(k) * axes.step;
        let y = axes.py(value);
        let _ = writeln!(svg, "<line class=\"grid\" x1=\"{LEFT}\" y1=\"{y:.1}\" x2=\"{right}\" y2=\"{y:.1}\"/>");
        let _ = writeln!(
            svg,
            "<text class=\"tick\" x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{value:.digits$}</text>",
            LEFT - 6.0,
            y + 4.0
        );
    }
    let _ = writeln!(svg, "<path class=\"axis\" d=\"M{LEFT} {TOP}V{bottom}H{right}\"/>");
    let middle = 0.5 * (LEFT + right);
    let _ = writeln!(
        svg,
        "<text class=\"label\" x=\"{middle}\" y=\"{}\" text-anchor=\"middle\">{cost} (log scale)</text>",
        bottom + 32.0
    );
    series.iter().for_each(|one| line(&mut svg, &axes, one));
    let mut values: Vec<(f64, f64)> = Vec::new();
    series.iter().for_each(|one| value(&mut svg, &axes, measure, one, &mut values));
    svg
}

/// Draws the points of a series and a line through them.
fn line(svg: &mut String, axes: &Axes, series: &Series) {
    let places: Vec<String> =
        series.points.iter().map(|p| format!("{:.1} {:.1}", axes.px(p.x), axes.py(p.y))).collect();
    let class = &series.class;
    if places.len() > 1 {
        let _ = writeln!(svg, "<path class=\"line {class}\" d=\"M{}\"/>", places.join("L"));
    }
    for p in &series.points {
        let (x, y) = (axes.px(p.x), axes.py(p.y));
        let _ = writeln!(
            svg,
            "<circle class=\"dot {class}\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.6\"><title>{}</title></circle>",
            escape(&p.title)
        );
    }
}

/// Writes the value at a line's end, without overlap with the `values` written before.
fn value(svg: &mut String, axes: &Axes, measure: Measure, series: &Series, values: &mut Vec<(f64, f64)>) {
    let class = &series.class;
    if let Some(last) = series.points.last() {
        let digits = measure.span().1;
        let (x, dot) = (axes.px(last.x).clamp(LEFT + 34.0, axes.width - RIGHT), axes.py(last.y));
        let taken = |y: f64| values.iter().any(|v| (v.0 - x).abs() < 36.0 && (v.1 - y).abs() < 12.0);
        let inside = |y: f64| (TOP..ROW - BOTTOM - 2.0).contains(&y);
        let y = [-8.0, 16.0, -20.0, 28.0, -32.0, 40.0].map(|shift| dot + shift);
        let y = y.into_iter().find(|&y| !taken(y) && inside(y)).unwrap_or(dot - 8.0);
        values.push((x, y));
        let _ = writeln!(
            svg,
            "<text class=\"value {class}\" x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"end\">{:.digits$}</text>",
            last.y
        );
    }
}

/// Text with the special characters of XML escaped.
pub(super) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A short form of a number: 12000 is 12k.
fn short(value: f64) -> String {
    match value {
        1e6.. => format!("{}M", value / 1e6),
        1e4.. => format!("{}k", value / 1e3),
        _ => format!("{value}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::line;

    fn axes(points: &[(f64, f64)]) -> Axes {
        let points = Measure::PsnrOverTime.curve(&line("plat", "fox", points));
        Axes::around(Measure::PsnrOverTime, &[Series { label: "plat".into(), class: "c0".into(), points }])
    }

    #[test]
    fn cost_grows_to_the_right_and_quality_upwards() {
        let narrow = axes(&[(1.0, 15.0), (100.0, 28.0)]);
        assert!(narrow.px(1.0) < narrow.px(10.0) && narrow.py(28.0) < narrow.py(15.0));
        assert!(narrow.px(1.0) >= LEFT && narrow.py(28.0) >= TOP);
        let middle = 0.5 * (narrow.px(1.0) + narrow.px(100.0));
        assert!((narrow.px(10.0) - middle).abs() < 1e-9, "the axis is logarithmic");
        let ticks = axes(&[(0.2, 15.0), (1000.0, 28.0)]).ticks();
        assert!(ticks.iter().all(|tick| tick.to_string().len() <= 4), "{ticks:?}");
    }

    #[test]
    fn ticks_of_splats_are_short_and_do_not_overlap() {
        let mut run = line("plat", "fox", &[(1.0, 15.0)]);
        run.splats = Some(2_000);
        let mut other = run.clone();
        other.splats = Some(3_000_000);
        let points = [run, other].iter().flat_map(|run| Measure::PsnrOverSplats.end(run, "")).collect();
        let series = [Series { label: "plat".into(), class: "c0".into(), points }];
        let axes = Axes::around(Measure::PsnrOverSplats, &series);
        let ticks = axes.ticks();
        assert!(ticks.windows(2).all(|w| axes.px(w[1]) - axes.px(w[0]) > 20.0), "{ticks:?}");
        assert!(ticks.len() > 2 && ticks.iter().all(|&tick| short(tick).len() <= 4), "{ticks:?}");
    }
}
